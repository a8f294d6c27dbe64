"""From a mirror-mor store to what its report compares: one record per variant, and which one is enough."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from wavequake.campaign.contract import DONE

Array = NDArray[np.float64]
Item = TypeVar("Item")

# Methods of which one variant each is drawn, as far as there is room.
_DRAWN = ("craigb", "krylov", "rubin", "flbt", "modal", "bt", "hintz")
MEASURES = {"wfe": "wavefront error", "los": "line-of-sight error", "image": "image error"}


@dataclass(frozen=True)
class VariantResult:
    """What one variant of one model is worth.

    ``errors`` maps "wfe", "los" and "image" to one number per excitation: the largest error over time as a
    share of the reference's largest value (wavefront), in lambda/D (line of sight), and the L2 norm of the
    difference of unit-energy exposures.
    ``eps_mech`` and ``eps_opt`` are the largest over frequency, ``*_low`` those over its lower third.
    """

    case: int
    variant: str
    method: str
    order: int
    reduce_seconds: float
    pseudo_frequency_max: float
    eps_mech: float
    eps_mech_low: float
    eps_opt: float
    eps_opt_low: float
    errors: dict[str, Array]


@dataclass(frozen=True)
class ModelResult:
    """The variants of one model by order, its reference, and the smallest variant that is good enough."""

    name: str
    reference: VariantResult | None
    variants: tuple[VariantResult, ...]
    enough: VariantResult | None


@dataclass(frozen=True)
class Criterion:
    """Which error decides ("wfe", "los" or "image"), the largest that is good enough, and excitations."""

    measure: str
    bound: float
    excitations: tuple[int, ...]


def criterion_of(study: dict[str, Any]) -> Criterion:
    """Return the criterion of a store's effective study."""
    section = study["criterion"]
    names = [entry["name"] for entry in study["excitation"]]
    chosen = section["excitations"] or names
    places = tuple(place for place, name in enumerate(names) if name in chosen)
    return Criterion(section["measure"], float(section["largest"]), places)


def model_results(dataset: xr.Dataset, reference: str, criterion: Criterion) -> list[ModelResult]:
    """Return the finished variants of every model of a store.

    Parameters
    ----------
    dataset : xarray.Dataset
        What ``open_store`` gives.
    reference : str
        Name of the variant that errors refer to.
    criterion : Criterion
    """
    done = np.flatnonzero(dataset["status"].to_numpy() == DONE)
    models, variants = dataset["model"].to_numpy(), dataset["variant"].to_numpy()
    found, numbers = [], _numbers_per_case(dataset)
    for name in dict.fromkeys(models):
        rows = [int(row) for row in done if models[row] == name]
        own = next((row for row in rows if variants[row] == reference), None)
        if own is None:
            found.append(ModelResult(str(name), None, (), None))
            continue
        scale = dataset["wfe_rms"].isel(case=own).to_numpy().max(axis=-1)
        results = [_result(numbers.isel(case=row), scale) for row in rows]
        others = sorted(
            (result for result in results if result.variant != reference),
            key=lambda result: (result.order, largest(result, criterion)),
        )
        enough = next((one for one in others if largest(one, criterion) <= criterion.bound), None)
        mine = next(result for result in results if result.variant == reference)
        found.append(ModelResult(str(name), mine, tuple(others), enough))
    return found


def largest(result: VariantResult, criterion: Criterion) -> float:
    """Return the largest error of the criterion's measure over its excitations."""
    return float(np.max(result.errors[criterion.measure][list(criterion.excitations)]))


def _numbers_per_case(dataset: xr.Dataset) -> xr.Dataset:
    """Reduce spectra and histories to their largest values, chunk by chunk, and read what is left.

    Of the statistics that a summary holds of errors, the maximum is the largest.
    """
    third = slice(max(1, dataset.sizes["frequency"] // 3))
    spectra = {name: dataset[name] for name in ("eps_mech", "eps_opt")}
    largest = {
        **spectra,
        **{f"{name}_low": values.isel(frequency=third) for name, values in spectra.items()},
        **{name: dataset[name] for name in ("wfe_error", "los_error")},
    }
    others = ("order", "reduce_seconds", "pseudo_frequency_max", "resolution_mm", "image_error")
    return xr.Dataset(
        {name: values.max(str(values.dims[-1]), skipna=False) for name, values in largest.items()}
        | {name: dataset[name] for name in others}
    ).compute()


def _result(case: xr.Dataset, scale: Array) -> VariantResult:
    worst = {name: case[f"{name}_error"].to_numpy() for name in ("wfe", "los")}
    return VariantResult(
        case=int(case["case"]),
        variant=str(case["variant"].to_numpy()),
        method=str(case["method"].to_numpy()),
        order=int(case["order"]),
        reduce_seconds=float(case["reduce_seconds"]),
        pseudo_frequency_max=float(case["pseudo_frequency_max"]),
        eps_mech=float(case["eps_mech"]),
        eps_mech_low=float(case["eps_mech_low"]),
        eps_opt=float(case["eps_opt"]),
        eps_opt_low=float(case["eps_opt_low"]),
        errors={
            "wfe": np.divide(worst["wfe"], scale, out=np.full_like(scale, np.nan), where=scale > 0),
            "los": worst["los"] / float(case["resolution_mm"]),
            "image": case["image_error"].to_numpy(),
        },
    )


def representatives(model: ModelResult, most: int = 6) -> list[VariantResult]:
    """Return variants to draw: the one that is enough, then of each method that of the nearest order."""
    order = model.enough.order if model.enough else 36
    chosen: list[VariantResult] = [model.enough] if model.enough else []
    for method in _DRAWN:
        mine = [one for one in model.variants if one.method == method and one not in chosen]
        if mine and len(chosen) < most:
            chosen.append(min(mine, key=lambda one: abs(one.order - order)))
    for one in model.variants:
        if len(chosen) < most and one not in chosen:
            chosen.append(one)
    return sorted(chosen, key=lambda one: (one.order, one.variant))


def few(items: Sequence[Item], most: int = 12) -> list[Item]:
    """Return what a figure has room for: all items, or some evenly spaced, the first and the last of all."""
    places = np.linspace(0, len(items) - 1, min(most, len(items))).round().astype(int)
    return [items[place] for place in places]
