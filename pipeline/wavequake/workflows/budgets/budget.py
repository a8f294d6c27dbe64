"""Which disturbance, and which ring of segments or element, contributes what: a budget of a study.

Every case is traced with all disturbances, with each of them switched off, and with each of them drawn again
while the others stay. All share their random numbers, so that differences stand out from the scatter.
"""

import json
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from wavequake.campaign.provenance import code, collect
from wavequake.campaign.schema import Study
from wavequake.campaign.store.store import (
    BUDGET,
    MANIFEST,
    read_manifest,
    refuse_foreign,
    refuse_other,
    write_errors_explained,
)
from wavequake.campaign.store.whole import write_dataset
from wavequake.errors import UserError
from wavequake.kernels.device.devices import choose_device
from wavequake.mechanics.disturbances.registry import Combine
from wavequake.workflows.budgets import budget_segments, budget_systems
from wavequake.workflows.budgets.budget_factors import Experiment
from wavequake.workflows.budgets.indices import Estimate, removed_shares, variance_shares
from wavequake.workflows.budgets.kept import SCHEMA, UNITS, open_budget
from wavequake.workflows.segments.segment_study import SegmentStudy
from wavequake.workflows.systems.system_study import SystemStudy

if TYPE_CHECKING:
    import xarray as xr

Array = NDArray[np.float64]
Progress = Callable[[int, int, int], None]

FEWEST = 16  # cases below which an interval says nothing
# Cases that are measured, until all are: one line each.
_UNFINISHED = f"{BUDGET}.partial.jsonl"


def summed(study: SegmentStudy | SystemStudy, name: str | None) -> Combine:
    """Return the sum of disturbances that a budget is made of: a combination of the study, or of all.

    Raises
    ------
    UserError
        If there is no combination `name`, or several to choose from.
    """
    combined = [entry for entry in study.disturbance if isinstance(entry, Combine)]
    if name is not None:
        found = [entry for entry in combined if entry.name == name]
        names = ", ".join(entry.name for entry in combined) or "none"
        if not found:
            raise UserError(f"There is no combination {name!r} in this study; there is {names}.")
        return found[0]
    if len(combined) > 1:
        names = ", ".join(entry.name for entry in combined)
        raise UserError(f"This study has several combinations; choose one with --of: {names}.")
    if combined:
        return combined[0]
    singles = study.disturbance
    return Combine.model_construct(
        model="combine",
        name="all",
        of=tuple(entry.name for entry in singles),
        duration_s=max(entry.duration_s for entry in singles),
        instants=max(entry.instants for entry in singles),
        share=1,
    )


def budget(
    study: Study,
    cases: int,
    of: str | None = None,
    progress: Progress | None = None,
    unfinished: Path | None = None,
) -> "xr.Dataset":
    """Return what each source and each ring of segments or element contributes, with 95 % intervals.

    Parameters
    ----------
    study : Study
        Of the workflow segment-disturbance or system-disturbance.
    cases : int
        Realizations; each is traced 2 + 2 (sources + rings or elements) times.
    of : str, optional
        The combination to take apart; by default the study's only one, or else the sum of its disturbances.
    progress : callable, optional
        Called with the numbers of cases done, wanted and 0.
    unfinished : Path, optional
        A file that keeps what is measured, so that the same call goes on after an interruption.

    Raises
    ------
    UserError
        If the study is another kind of study, has several combinations, or most cases cannot be traced.
    """
    if not isinstance(study, SegmentStudy | SystemStudy) or study.study.workflow not in _WORKFLOWS:
        raise UserError(f"A budget is of {' and '.join(_WORKFLOWS)} studies, not of {study.study.workflow}.")
    if cases < FEWEST:
        raise UserError(f"A budget of {cases} cases says nothing; take at least {FEWEST}.")
    population = summed(study, of)
    device = choose_device(study.campaign.device)
    with threadpool_limits(1):
        experiment = (
            budget_systems.experiment(study, population, device.name)
            if isinstance(study, SystemStudy)
            else budget_segments.experiment(study, population, device.name)
        )
        identity = [study.identity(), population.name, device.name, code()]
        values = _measured(experiment, cases, identity, unfinished, progress)
        rest = experiment.rest()
    attrs = {
        "title": "Budget of disturbances",
        "schema": SCHEMA,
        "study": study.identity_text(),
        "study_sha256": study.identity(),
        "population": population.name,
        "cases": cases,
        "device": f"{device.name} ({device.kind})",
        **collect(device),
    }
    return _dataset(values, rest, experiment, attrs)


_WORKFLOWS = ("segment-disturbance", "system-disturbance")


def _measured(
    experiment: Experiment, cases: int, identity: list[str], file: Path | None, progress: Progress | None
) -> Array:
    """Return (cases, variants, quantities + 1), of which `file` may have some and gets the others."""
    known = {case: values for case, values in _kept(file, identity).items() if case < cases}
    for first in range(0, cases, experiment.at_once):
        last = min(first + experiment.at_once, cases)
        if known.keys() >= set(range(first, last)):
            continue
        if progress:
            progress(first, cases, 0)
        found = dict(zip(range(first, last), experiment.values(first, last), strict=True))
        known |= found
        if file is not None:
            _keep(file, identity, found)
    if progress:
        progress(cases, cases, 0)
    return np.array([known[case] for case in range(cases)])


def _keep(file: Path, identity: list[str], found: dict[int, Array]) -> None:
    lines = [json.dumps([identity, case, values.tolist()]) for case, values in found.items()]
    with write_errors_explained(file.parent):
        file.parent.mkdir(parents=True, exist_ok=True)
        with file.open("a", encoding="utf-8") as out:
            out.write("\n" + "\n".join(lines) + "\n")  # what comes before may be torn


def _kept(file: Path | None, identity: list[str]) -> dict[int, Array]:
    """Return the cases that a file has of this budget, in whole lines."""
    found: dict[int, Array] = {}
    if file is None or not file.exists():
        return found
    for line in file.read_text(encoding="utf-8", errors="replace").splitlines():
        try:
            whose, case, values = json.loads(line)
            if whose == identity:
                found[int(case)] = np.array(values, dtype=np.float64)
        except (ValueError, TypeError):
            continue
    return found


def _dataset(values: Array, rest: Array, experiment: Experiment, attrs: dict[str, object]) -> "xr.Dataset":
    """Return the budget of `Experiment.values` of all cases and those at rest."""
    import xarray as xr

    good: NDArray[np.bool_] = np.asarray(np.isfinite(values).all(axis=(1, 2)))
    if good.sum() < FEWEST:
        raise UserError(
            f"{len(good) - good.sum()} of {len(good)} cases cannot be traced with every disturbance on and "
            f"off, and {FEWEST} are needed; lower the disturbances or raise --cases."
        )
    light = _missing_light(experiment, values[good, :, -1].max(axis=1), int(rest[-1]))
    values, rest = values[..., :-1], rest[:-1]
    kept = values[good]
    names = [factor.name for factor in experiment.factors]
    count = len(names)
    sets: dict[str, Callable[[Array], Estimate]] = {
        "share": lambda v: removed_shares(v[:, 0], v[:, 2 : 2 + count]),
        "first": lambda v: variance_shares(v[:, 0], v[:, 1], v[:, 2 + count :]).first,
        "total": lambda v: variance_shares(v[:, 0], v[:, 1], v[:, 2 + count :]).total,
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
    mixed = {"units": ", ".join(UNITS[name] for name in experiment.quantities)}
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
        "variant": np.array(
            [
                "all",
                "all again",
                *(f"without {name}" for name in names),
                *(f"{name} again" for name in names),
            ],
            dtype=object,
        ),
        "case": np.arange(len(values)),
        "segments": (
            ("factor",),
            np.array([factor.members for factor in experiment.factors], dtype=np.int64),
        ),
    }
    more = {"cases_used": int(good.sum()), **({"vignetted": light} if light else {})}
    found: xr.Dataset = xr.Dataset(variables, coordinates, {**attrs, **more})
    return found


def _missing_light(experiment: Experiment, most: Array, at_rest: int) -> str:
    """Say how many rays do not arrive at rest and in cases (case,), and what that means; "" if all do."""
    parts = [f"{at_rest} of {experiment.rays} rays do not arrive at rest"] if at_rest else []
    if (more := most > at_rest).any():
        parts.append(
            f"up to {int(most.max())} of {experiment.rays} do not arrive at an instant of "
            f"{np.count_nonzero(more)} of {len(most)} cases"
        )
    return f"{'; '.join(parts)}. {experiment.light}" if parts else ""


def stored_budget(
    study: Study, path: Path, cases: int, of: str | None = None, progress: Progress | None = None
) -> tuple["xr.Dataset", bool]:
    """Return the budget that the folder of a store keeps, or compute and keep it; and whether it was there.

    What was measured before an interruption is not measured again.

    Raises as :func:`budget` and :func:`open_budget`, and UserError where the folder is something else.
    """
    path = Path(path)
    target = path / BUDGET
    refuse_foreign(path)
    if (path / MANIFEST).exists():
        manifest = read_manifest(path)
        refuse_other(path, manifest, study.study.workflow, study.identity_text(), manifest.device_kind)
    if target.exists():
        found = open_budget(path)
        wanted = of or found.attrs["population"]
        if (found.attrs["study_sha256"], found.attrs["cases"], found.attrs["population"]) == (
            study.identity(),
            cases,
            wanted,
        ):
            return found, True
    made = budget(study, cases, of, progress, path / _UNFINISHED)
    write_dataset(made, target)
    (path / _UNFINISHED).unlink(missing_ok=True)
    return made, False
