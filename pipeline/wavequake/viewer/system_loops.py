"""Any optical system in closed loop: its surfaces move under the controllers that tell most."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import xarray as xr
from threadpoolctl import threadpool_limits

from wavequake.campaign.contract import DONE
from wavequake.campaign.schema import study_from_identity
from wavequake.campaign.store.store import Manifest
from wavequake.report.loops.telescope import controllers_of, results, seen_by_loops, telling
from wavequake.viewer.chosen import worst_cases
from wavequake.viewer.film import Stage, Take
from wavequake.viewer.systems import stage_of_system, take_of
from wavequake.workflows.loops.system_loop import bench_of, motion_left
from wavequake.workflows.loops.system_loop_study import SystemLoopStudy


def film_of(
    dataset: xr.Dataset, manifest: Manifest, chosen: Sequence[int], tell: Callable[[str], None]
) -> tuple[tuple[Stage, ...], tuple[Take, ...]]:
    """Return the system, and the chosen or the worst case of each disturbance, by controller.

    Of the controllers the ideal ones are shown, and the best one of each actuator for the disturbance.
    """
    bench = bench_of(study_from_identity(SystemLoopStudy, manifest.study))
    system, known, seen = bench.optics.bench, controllers_of(dataset), seen_by_loops(dataset)
    stage, surfaces = stage_of_system(system)
    away = seen["los"].isel(controller=0) ** 2
    away = away.mean([dim for dim in away.dims if dim != "case"])
    takes = list[Take]()
    with threadpool_limits(1):
        for case in list(chosen) or worst_cases(dataset, away.to_numpy()):
            name = str(dataset["disturbance"].sel(case=case).item())
            alike = seen.isel(case=(dataset["disturbance"] == name).to_numpy())
            names = telling(results(alike.isel(case=(alike["status"] == DONE).to_numpy())), known)
            for one in (each for each in bench.controllers if each.name in names):
                label = f"{name}, case {case}: {one.name}"
                stored = dataset.sel(case=case, controller=one.name)
                left = motion_left(bench, one, case)
                take = take_of(system, stored, left, label, stage, surfaces, of=one.name)
                takes.append(replace(take, note=f"{_does(known[one.name])} {take.note}"))
                tell(label)
    return (stage,), tuple(takes)


def _does(controller: Mapping[str, object]) -> str:
    words = {"off": "Nothing is done about the disturbance.", "perfect": "Acts at once and without error."}
    model = str(controller["model"])
    return words.get(model, f"{model}: reads {controller['sensor']}, moves {controller['actuator']}.")
