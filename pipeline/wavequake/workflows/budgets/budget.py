"""Which disturbance, and which ring of segments or element, contributes what: a budget of a study.

Every case is traced with all disturbances, with each of them switched off, with each of them drawn again
while the others stay, and with each group of the budget's tree alone. All share their random numbers, so that
differences stand out from the scatter.
"""

import hashlib
import json
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from wavequake.campaign.contract import StudyKind
from wavequake.campaign.engine.pool import HERE, Place, mapped
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
from wavequake.kernels.device.devices import Device, choose_device
from wavequake.mechanics.disturbances.registry import Combine
from wavequake.prepared import one_thread, prepared
from wavequake.words import counted, lasting
from wavequake.workflows.budgets import segments as budget_segments
from wavequake.workflows.budgets import systems as budget_systems
from wavequake.workflows.budgets.dataset import budget_dataset, with_allocations
from wavequake.workflows.budgets.factors import Experiment
from wavequake.workflows.budgets.kept import SCHEMA, open_budget
from wavequake.workflows.budgets.tree import Branch, allocations
from wavequake.workflows.kinds import find_kind
from wavequake.workflows.segments.study import SegmentStudy
from wavequake.workflows.systems.study import SystemStudy

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
    place: Place = HERE,
    measure: str | None = None,
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
    place : Place
        Where the cases are traced; the numbers are the same everywhere.
    measure : str, optional
        A further number of cases by which to rank, as ``peak`` of exposures.

    Raises
    ------
    UserError
        If the study is another kind of study, has several combinations, or most cases cannot be traced.
    """
    _require_budget(study, cases)
    assert isinstance(study, SegmentStudy | SystemStudy)
    work, device = _work_of(study, of, measure)
    experiment = _experiment(work)
    name = summed(study, of).name
    allowed = allocations(study.budget, experiment.branches, experiment.quantities)
    identity = [study.identity(), name, device.name, code(), _digest(experiment.branches), measure or ""]
    values = _measured(work, experiment, cases, identity, unfinished, progress, place)
    with one_thread():
        rest = experiment.rest()
    attrs = {
        "title": "Budget of disturbances",
        "schema": SCHEMA,
        "study": study.identity_text(),
        "study_sha256": study.identity(),
        "population": name,
        "cases": cases,
        "groups": _digest(experiment.branches),
        "measure": measure or "",
        "device": f"{device.name} ({device.kind})",
        **collect(device),
    }
    return with_allocations(budget_dataset(values, rest, experiment, attrs, FEWEST), allowed)


def plan_budget(
    study: Study, cases: int, of: str | None = None, measure: str | None = None
) -> dict[str, str]:
    """Say what a budget would take, by a pilot of some cases; nothing is kept.

    Raises as :func:`budget`.
    """
    _require_budget(study, cases)
    assert isinstance(study, SegmentStudy | SystemStudy)
    work, device = _work_of(study, of, measure)
    experiment = _experiment(work)
    allocations(study.budget, experiment.branches, experiment.quantities)
    block = (0, min(experiment.at_once, cases))
    _block(work, block)  # builds kernels and tables
    start = time.perf_counter()
    values = _block(work, block)
    each = (time.perf_counter() - start) / len(values)
    kinds = Counter(factor.kind for factor in experiment.factors)
    return {
        "budget": f"{summed(study, of).name} of {study.study.name} ({study.identity()[:12]})",
        "factors": ", ".join(counted(number, kind) for kind, number in kinds.items()),
        "groups": ", ".join(branch.name for branch in experiment.branches) or "none ([[budget.group]])",
        "quantities": ", ".join(experiment.quantities),
        "cases": f"{cases}, each traced {values.shape[1]} times",
        "device": f"{device.name} ({device.kind})",
        "one case": f"{lasting(each)} in one process (pilot of {counted(len(values), 'case')}, after set-up)",
        "pieces": f"{-(-cases // experiment.at_once)}, which --on and --workers share out",
        "estimate": f"{cases * each:.0f} s of one process",
    }


@dataclass(frozen=True)
class _Work:
    """What a worker has to know: the kind brings its plug-ins, ``study`` is the whole study as JSON."""

    kind: StudyKind
    study: str
    of: str | None
    device: str
    measure: str | None = None


def _work_of(study: Study, of: str | None, measure: str | None) -> tuple[_Work, Device]:
    device = choose_device(study.campaign.device)
    kind = find_kind(study.study.workflow)
    return _Work(kind, study.model_dump_json(), of, device.name, measure), device


def _experiment(work: _Work) -> Experiment:
    return _prepared(work.kind.name, work.study, work.of, work.device, work.measure)


@prepared(2)
def _prepared(kind: str, text: str, of: str | None, device: str, measure: str | None) -> Experiment:
    study = find_kind(kind).model.model_validate_json(text, strict=False)
    assert isinstance(study, SegmentStudy | SystemStudy)
    population = summed(study, of)
    if isinstance(study, SystemStudy):
        return budget_systems.experiment(study, population, device, measure)
    return budget_segments.experiment(study, population, device, measure)


def _block(work: _Work, cases: tuple[int, int]) -> Array:
    with one_thread():
        return _experiment(work).values(*cases)


def _digest(branches: Sequence[Branch]) -> str:
    """Return a fingerprint of what the groups are, whatever they are allowed."""
    lines = [[branch.name, branch.parent, sorted(branch.parts)] for branch in branches]
    return hashlib.sha256(json.dumps(lines).encode()).hexdigest()[:16] if lines else ""


def _require_budget(study: Study, cases: int) -> None:
    if not isinstance(study, SegmentStudy | SystemStudy) or study.study.workflow not in _WORKFLOWS:
        raise UserError(f"A budget is of {' and '.join(_WORKFLOWS)} studies, not of {study.study.workflow}.")
    if cases < FEWEST:
        raise UserError(f"A budget of {cases} cases says nothing; take at least {FEWEST}.")


_WORKFLOWS = ("segment-disturbance", "system-disturbance")


def _measured(
    work: _Work,
    experiment: Experiment,
    cases: int,
    identity: list[str],
    file: Path | None,
    progress: Progress | None,
    place: Place,
) -> Array:
    """Return (cases, variants, quantities + 1), of which `file` may have some and gets the others."""
    known = {case: values for case, values in _kept(file, identity).items() if case < cases}
    blocks = [
        (first, min(first + experiment.at_once, cases)) for first in range(0, cases, experiment.at_once)
    ]
    lacking = [block for block in blocks if not known.keys() >= set(range(*block))]
    if progress:
        progress(len(known), cases, 0)
    for block, values in mapped(_block, work, lacking, place):
        found = dict(zip(range(*block), values, strict=True))
        known |= found
        if file is not None:
            _keep(file, identity, found)
        if progress:
            progress(len(known), cases, 0)
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


def stored_budget(
    study: Study,
    path: Path,
    cases: int,
    of: str | None = None,
    progress: Progress | None = None,
    place: Place = HERE,
    measure: str | None = None,
) -> tuple["xr.Dataset", bool]:
    """Return the budget that the folder of a store keeps, or compute and keep it; and whether it was there.

    What was measured before an interruption is not measured again. Other allocations of the same groups
    need no new cases.

    Raises as :func:`budget` and :func:`open_budget`, and UserError where the folder is something else.
    """
    path = Path(path)
    target = path / BUDGET
    refuse_foreign(path)
    if (path / MANIFEST).exists():
        manifest = read_manifest(path)
        refuse_other(path, manifest, study.study.workflow, study.identity_text(), manifest.device_kind)
    if target.exists() and isinstance(study, SegmentStudy | SystemStudy):
        found = open_budget(path)
        wanted = of or found.attrs["population"]
        branches = _experiment(_work_of(study, of, measure)[0]).branches if study.budget else ()
        keys = ("study_sha256", "cases", "population", "groups", "measure")
        if [found.attrs.get(key, "") for key in keys] == [
            study.identity(),
            cases,
            wanted,
            _digest(branches),
            measure or "",
        ]:
            allowed = allocations(study.budget, branches, found["quantity"].to_numpy().tolist())
            again = with_allocations(found, allowed)
            if not again.equals(found):
                write_dataset(again, target)
            return again, True
    made = budget(study, cases, of, progress, path / _UNFINISHED, place, measure)
    write_dataset(made, target)
    (path / _UNFINISHED).unlink(missing_ok=True)
    return made, False
