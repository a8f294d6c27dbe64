"""An optical system in closed loop: its surfaces move as the controllers that tell most leave it."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import xarray as xr
from threadpoolctl import threadpool_limits

from wavequake.campaign.contract import DONE
from wavequake.campaign.schema import study_from_identity
from wavequake.campaign.store.store import Manifest
from wavequake.errors import UserError
from wavequake.mechanics.disturbances.element_motion import add_elements
from wavequake.report.loops.telescope import controllers_of, results, seen_by_loops, telling
from wavequake.viewer.chosen import worst_cases
from wavequake.viewer.film import Stage, Take
from wavequake.viewer.systems import stage_of_system, take_of
from wavequake.workflows.loops.system_light import moved, seen_of
from wavequake.workflows.loops.system_loop import Bench, bench_of, positions_of
from wavequake.workflows.loops.system_loop_study import SystemLoopStudy
from wavequake.workflows.mirrors.mirror_study import FULL
from wavequake.workflows.systems.system_disturbance import drawn_with
from wavequake.workflows.systems.system_variants import slot_of


def film_of(
    dataset: xr.Dataset, manifest: Manifest, chosen: Sequence[int], tell: Callable[[str], None]
) -> tuple[tuple[Stage, ...], tuple[Take, ...]]:
    """Return the system, and the chosen or the worst case of each disturbance, by controller.

    Of the controllers the ideal ones are shown, and the best one of each actuator for the disturbance.
    """
    bench = bench_of(study_from_identity(SystemLoopStudy, manifest.study))
    stage, surfaces = stage_of_system(bench.optics.bench)
    seen, known, takes = seen_by_loops(dataset), controllers_of(dataset), list[Take]()
    sight = seen["los"].isel(controller=0)
    others = [dim for dim in sight.dims if dim != "case"]
    ids = list(chosen) or worst_cases(dataset, (sight**2).mean(others).to_numpy())
    with threadpool_limits(1):
        for case in ids:
            population = slot_of(bench.optics.bench.study, case)[0]
            mine = (seen["disturbance"].to_numpy() == population.name) & (seen["status"].to_numpy() == DONE)
            for name in telling(results(seen.isel(case=mine)), known):
                takes.append(_take(bench, dataset, case, name, stage, surfaces))
                tell(takes[-1].label)
    return (stage,), tuple(takes)


def _take(bench: Bench, dataset: xr.Dataset, case: int, name: str, stage: Stage, surfaces: list[int]) -> Take:
    system = bench.optics.bench
    population, realization, _ = slot_of(system.study, case)
    index = system.study.disturbance.index(population)
    times, one = bench.optics.times[index], next(one for one in bench.controllers if one.name == name)
    if times is None:
        raise ValueError(f"{population.name} has no cases")
    disturbance = seen_of(bench.optics, index, realization)
    positions, _, diverged = positions_of(bench, one, index, disturbance, realization)
    if diverged:
        raise UserError(f"Case {case} diverges under {name}.")
    shaken = drawn_with(system, population, realization, FULL)
    left = add_elements(shaken, moved(bench.optics, one, positions[times.instants]))
    stored = dataset.sel(case=case).isel(controller=np.flatnonzero(dataset["controller"] == name)[0])
    label = f"{population.name}, case {case}: {name}"
    take = take_of(system, left, stored, label, stage, surfaces)
    return replace(take, case=case, of=name, note=f"{_note(bench, name)} {take.note}")


def _note(bench: Bench, name: str) -> str:
    record = bench.study.part("controller", name)
    words = {"off": "Nothing is done about the disturbance.", "perfect": "Acts at once and without error."}
    return words.get(record.model, f"{record.model}: reads {record.sensor}, moves {record.actuator}.")
