"""Stop a campaign once its statistics are good enough: ``campaign.until = "wfe_rms.p95 ci<=2%"``."""

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from wavequake.errors import UserError
from wavequake.workflows.contract import DONE, Template
from wavequake.workflows.quantiles import Quantile, quantile

if TYPE_CHECKING:
    import xarray as xr

_FORM = re.compile(r"\s*(\w+)\.p(\d+(?:\.\d+)?)\s+ci\s*<=\s*(\d+(?:\.\d+)?)\s*%\s*")
_FIRST, _GROWTH = 100, 1.5
_LIGHT = ("field", "wavelength")


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
        If the text has another form, or the variable is none with one number per case or instant.
    """
    match = _FORM.fullmatch(text)
    if not match or not 0.0 < float(match[2]) < 100.0 or not float(match[3]) > 0.0:
        raise UserError(
            f"campaign.until: {text!r} is no goal; write VARIABLE.pPERCENT ci<=WIDTH%, such as "
            "'wfe_rms.p95 ci<=2%'."
        )
    valid = [
        name
        for name, variable in template.per_case.items()
        if {*variable.dims} <= {"time", "statistic", *_LIGHT}
        and variable.dtype.startswith("float")
        and not variable.coordinate
    ]
    if not valid:
        raise UserError(
            "campaign.until: nothing in this study is one number per case or instant; leave it out."
        )
    if match[1] not in valid:
        raise UserError(f"campaign.until: there is no {match[1]!r} to judge; use one of {', '.join(valid)}.")
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


def quantiles_of(goal: Goal, dataset: "xr.Dataset") -> dict[str, Quantile]:
    """Return the quantile of each population; instants of one case count as one draw.

    Of a summary it is that of the cases' rms over their instants; of several fields and wavelengths, of the
    largest value.
    """
    variable = dataset[goal.variable]
    if "statistic" in variable.dims:
        variable = variable.sel(statistic="rms")
    values = (
        variable.max([dim for dim in _LIGHT if dim in variable.dims])
        .to_numpy()
        .reshape(dataset.sizes["case"], -1)
    )
    names = (
        np.array(dataset["disturbance"].to_numpy().tolist())
        if "disturbance" in dataset.variables
        else np.full(len(values), "all cases")
    )
    done = dataset["status"].to_numpy() == DONE
    found = {}
    for name in sorted(set(names.tolist())):
        rows = values[(names == name) & done]
        there = ~np.isnan(rows)
        sets = None
        if "replicate" in dataset.variables:
            labels = dataset["replicate"].to_numpy()[(names == name) & done]
            sets = np.broadcast_to(labels[:, None], rows.shape)[there]
        draws = min(len(rows), int(there.sum())) if sets is None else None
        found[name] = quantile(rows[there], goal.probability, draws, sets)
    return found


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
