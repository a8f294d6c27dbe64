"""The dataset of a budget: shares, groups and every case."""

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from wavequake.errors import UserError
from wavequake.workflows.budgets.factors import Experiment
from wavequake.workflows.budgets.indices import Estimate, removed_shares, variance_shares
from wavequake.workflows.budgets.tree import RolledUp, rolled_up

if TYPE_CHECKING:
    import xarray as xr

Array = NDArray[np.float64]


def budget_dataset(
    values: Array, rest: Array, experiment: Experiment, attrs: dict[str, object], fewest: int
) -> "xr.Dataset":
    """Return the budget of `Experiment.values` of all cases and those at rest.

    Raises
    ------
    UserError
        If fewer than `fewest` cases can be traced.
    """
    import xarray as xr

    good: NDArray[np.bool_] = np.asarray(np.isfinite(values).all(axis=(1, 2)))
    if good.sum() < fewest:
        raise UserError(
            f"{len(good) - good.sum()} of {len(good)} cases cannot be traced with every disturbance on and "
            f"off, and {fewest} are needed; lower the disturbances or raise --cases."
        )
    light = _missing_light(experiment, values[good, :, -1].max(axis=1), int(rest[-1]))
    values, rest = values[..., :-1], rest[:-1]
    kept = values[good]
    names = [factor.name for factor in experiment.factors]
    count = len(names)
    sets: dict[str, Callable[[Array], Estimate]] = {
        "share": lambda v: removed_shares(v[:, 0], v[:, 2 : 2 + count]),
        "first": lambda v: variance_shares(v[:, 0], v[:, 1], v[:, 2 + count : 2 + 2 * count]).first,
        "total": lambda v: variance_shares(v[:, 0], v[:, 1], v[:, 2 + count : 2 + 2 * count]).total,
    }
    words = {
        "share": "share of the mean square that goes when the factor is switched off",
        "first": "first-order Sobol index: share of the variance over cases by the factor alone",
        "total": "total Sobol index: share of the variance over cases by the factor and its interactions",
    }
    known = np.array([factor.independent for factor in experiment.factors])
    variables: dict[str, object] = {}
    for key, estimate in sets.items():
        each: list[Estimate] = [estimate(kept[..., q]) for q in range(len(experiment.quantities))]
        for suffix, attribute in (("", "value"), ("_low", "low"), ("_high", "high")):
            numbers = np.stack([getattr(one, attribute) for one in each], axis=1)
            if key != "share":
                numbers = np.where(known[:, None], numbers, np.nan)
            bound = {"": "", "_low": ", lower bound (95 %)", "_high": ", upper bound (95 %)"}[suffix]
            variables[f"{key}{suffix}"] = (
                ("factor", "quantity"),
                numbers,
                {"units": "1", "long_name": words[key] + bound},
            )
    rms = np.sqrt(np.mean(kept**2, axis=0))
    mixed = {"units": ", ".join(experiment.units)}
    variables["rms"] = (("quantity",), rms[0], {**mixed, "long_name": "rms over cases and instants"})
    variables["rms_without"] = (
        ("factor", "quantity"),
        rms[2 : 2 + count],
        {**mixed, "long_name": "rms over cases and instants with the factor switched off"},
    )
    variables["rms_rest"] = (
        ("quantity",),
        rest,
        {**mixed, "long_name": "rms of what no factor causes: the telescope at rest"},
    )
    variables["value"] = (
        ("case", "variant", "quantity"),
        values,
        {**mixed, "long_name": "rms over the instants of a case; NaN: cannot be traced"},
    )
    coordinates = {
        "factor": np.array(names, dtype=object),
        "kind": (("factor",), np.array([factor.kind for factor in experiment.factors], dtype=object)),
        "quantity": np.array(experiment.quantities, dtype=object),
        "unit": (("quantity",), np.array(experiment.units, dtype=object)),
        "variant": np.array(
            [
                "all",
                "all again",
                *(f"without {name}" for name in names),
                *(f"{name} again" for name in names),
                *(f"only {branch.name}" for branch in experiment.branches),
            ],
            dtype=object,
        ),
        "case": np.arange(len(values)),
        "segments": (
            ("factor",),
            np.array([factor.members for factor in experiment.factors], dtype=np.int64),
        ),
    }
    if experiment.branches:
        whole = np.concatenate([kept[:, :1], kept[:, 2 + 2 * count :]], axis=1)
        rolled = [
            rolled_up(whole[..., q], float(rest[q]), experiment.branches)
            for q in range(len(experiment.quantities))
        ]
        variables |= _tree(rolled)
        coordinates["branch"] = np.array(
            [str(attrs["population"]), *(branch.name for branch in experiment.branches)], dtype=object
        )
        coordinates["parent"] = (
            ("branch",),
            np.array(
                ["", *(branch.parent or attrs["population"] for branch in experiment.branches)], dtype=object
            ),
        )
    more = {"cases_used": int(good.sum()), **({"vignetted": light} if light else {})}
    found: xr.Dataset = xr.Dataset(variables, coordinates, {**attrs, **more})
    return found


def _tree(rolled: Sequence[RolledUp]) -> dict[str, object]:
    """Return the variables of the groups, of each quantity."""
    words = {
        "branch_rms": "rms of what the group contributes alone; of the whole with what there is at rest",
        "branch_apart": "root of the sum of squares of the group's branches, as if they were independent",
        "branch_correlation": "mean correlation of what the group's branches contribute",
    }
    found: dict[str, object] = {}
    for name, attribute in (("branch_rms", "rms"), ("branch_correlation", "correlation")):
        for suffix, side in (("", "value"), ("_low", "low"), ("_high", "high")):
            values = np.stack([getattr(getattr(one, attribute), side) for one in rolled], axis=1)
            found[name + suffix] = (("branch", "quantity"), values, {"long_name": words[name]})
    apart = np.stack([one.apart for one in rolled], axis=1)
    found["branch_apart"] = (("branch", "quantity"), apart, {"long_name": words["branch_apart"]})
    return found


def with_allocations(found: "xr.Dataset", allowed: Array) -> "xr.Dataset":
    """Return a budget with what its groups may be (b + 1, q), in place of what they might before."""
    if "branch" not in found.dims:
        return found
    words = {"long_name": "what the group may contribute; NaN where nothing is said"}
    return found.assign(allocation=(("branch", "quantity"), allowed, words))


def _missing_light(experiment: Experiment, most: Array, at_rest: int) -> str:
    """Say how many rays do not arrive at rest and in cases (case,), and what that means; "" if all do."""
    parts = [f"{at_rest} of {experiment.rays} rays do not arrive at rest"] if at_rest else []
    if (more := most > at_rest).any():
        parts.append(
            f"up to {int(most.max())} of {experiment.rays} do not arrive at an instant of "
            f"{np.count_nonzero(more)} of {len(most)} cases"
        )
    return f"{'; '.join(parts)}. {experiment.light}" if parts else ""
