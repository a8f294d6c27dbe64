"""Stop a campaign once its statistics are good enough: ``campaign.until = "wfe_rms.p95 ci<=2%"``."""

import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from wavequake.campaign.contract import DONE, Template
from wavequake.campaign.statistics.judged import (
    WORST_OF,
    judged_in,
    judged_of_template,
    populations_of,
    selected,
    title,
)
from wavequake.campaign.statistics.pooled import Part, pooled_quantiles
from wavequake.campaign.statistics.quantiles import Quantile
from wavequake.errors import UserError

if TYPE_CHECKING:
    import xarray as xr

_FORM = re.compile(r"\s*(\w+(?:\[.*\])?)\.p(\d+(?:\.\d+)?)\s+ci\s*<=\s*(\d+(?:\.\d+)?)\s*%\s*")
_FIRST, _GROWTH = 100, 1.5


@dataclass(frozen=True)
class Goal:
    """How well a quantile shall be known: half of its 95 % interval at most `width` times its value."""

    variable: str
    probability: float
    width: float


def goal_of(text: str, template: Template) -> Goal:
    """Read a goal such as ``wfe_rms.p95 ci<=2%``.

    Raises
    ------
    UserError
        If the text has another form, or names nothing that can be judged.
    """
    match = _FORM.fullmatch(text)
    if not match or not 0.0 < float(match[2]) < 100.0 or not float(match[3]) > 0.0:
        raise UserError(
            f"campaign.until: {text!r} is no goal; write VARIABLE.pPERCENT ci<=WIDTH%, such as "
            "'wfe_rms.p95 ci<=2%'."
        )
    try:
        judged_of_template(match[1], template)
    except UserError as error:
        raise UserError(f"campaign.until: {error}") from None
    return Goal(match[1], float(match[2]) / 100.0, float(match[3]) / 100.0)


def looks(cases: int, chunk: int) -> Iterator[int]:
    """Yield the numbers of cases after which to look, up to `cases`; they depend on nothing that was found.

    Each look may stop by luck: as they grow by half, there are few.
    """
    wanted = float(_FIRST)
    while (count := chunk * int(np.ceil(wanted / chunk))) < cases:
        yield count
        wanted = max(wanted * _GROWTH, count + 1.0)
    yield cases


def quantiles_of(goal: Goal, dataset: "xr.Dataset", compared: Iterable[str] = ()) -> dict[str, Quantile]:
    """Return the quantile of each population; instants of one case count as one draw.

    Of a summary it is that of the cases' rms over their instants; of several fields and wavelengths, of the
    worst value, that is of the smallest for probabilities below 0.5 (Strehl ratios) and otherwise of the
    largest; and of other labels that were not chosen (controllers) there is one each.
    """
    judged = judged_in(goal.variable, dataset)
    variable, names = dataset[judged.variable], populations_of(dataset, compared)
    if "statistic" in variable.dims:
        variable = variable.sel(statistic="rms")
    done = dataset["status"].to_numpy() == DONE
    replicates = dataset["replicate"].to_numpy() if "replicate" in dataset.variables else None

    def parts() -> Iterator[Part]:
        for cases, found in selected(judged, variable):
            worst = {label: _worst(values, goal.probability) for label, values in found.items()}
            for name in sorted(set(names.tolist())):
                mine = (names[cases] == name) & done[cases]
                sets = None if replicates is None else replicates[cases][mine]
                for label, values in worst.items():
                    yield title(name, label), values[mine], sets

    return pooled_quantiles(parts, goal.probability)


def _worst(values: "xr.DataArray", probability: float) -> NDArray[np.float64]:
    """Return values (case, instant), of fields and wavelengths the one on the side that is asked for."""
    dims = [dim for dim in WORST_OF if dim in values.dims]
    worst = values.min(dims) if probability < 0.5 else values.max(dims)
    return np.asarray(worst.to_numpy().reshape(values.sizes["case"], -1), dtype=np.float64)


def is_met(goal: Goal, quantiles: Mapping[str, Quantile]) -> bool:
    """Return whether every population is known well enough."""
    return all(_width(one) <= goal.width for one in quantiles.values())


def described(goal: Goal, quantiles: Mapping[str, Quantile]) -> list[str]:
    """Return a line per population: the quantile and its interval."""
    return [
        f"{goal.variable}.p{100 * goal.probability:g} of {name}: {one.value:.5g}, 95 % interval "
        f"{one.low:.5g} to {one.high:.5g} (+-{100 * _width(one):.2g} %)"
        for name, one in quantiles.items()
    ]


def _width(one: Quantile) -> float:
    """Return half of the interval over the value; infinite where either is not known."""
    if not np.isfinite([one.value, one.low, one.high]).all():
        return np.inf
    half = (one.high - one.low) / 2.0
    return half / abs(one.value) if one.value else (0.0 if not half else np.inf)
