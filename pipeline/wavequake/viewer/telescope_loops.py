"""A telescope in closed loop: segments and M2 move under the controllers that tell most."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import xarray as xr
from threadpoolctl import threadpool_limits

from wavequake.campaign.schema import study_from_identity
from wavequake.campaign.store.store import Manifest
from wavequake.chain.loops.designed import Designed
from wavequake.errors import UserError
from wavequake.kernels.device.devices import Device, choose_device
from wavequake.mechanics.model import Integers
from wavequake.optics.segments.layout import is_monolithic
from wavequake.optics.segments.telescope import M2
from wavequake.optics.systems.system import States
from wavequake.report.at_hand import device_at_hand
from wavequake.report.loops.telescope import controllers_of, results, telling
from wavequake.viewer.chosen import worst_cases
from wavequake.viewer.exposures import MOST_INSTANTS, light_of, m2_map, m2_shapes
from wavequake.viewer.film import Array, Stage, Take, map_of, over_pupil, same_reach
from wavequake.viewer.segments import stage_of_telescope
from wavequake.workflows.exposures.telescope_control import ControlBench, trace
from wavequake.workflows.loops.telescope_bench import Bench, bench_of
from wavequake.workflows.loops.telescope_light import drawn, seen_of
from wavequake.workflows.loops.telescope_loop import cases, chosen_instants, positions_of, states_of
from wavequake.workflows.loops.telescope_study import TelescopeLoopStudy
from wavequake.workflows.segments.bench import MAS_PER_RAD, MM_PER_M
from wavequake.workflows.segments.launches import CaseDraw

_NM_PER_MM = 1e6
_SHIFTS = np.repeat([1.0 / MM_PER_M, 1.0], 3)


def film_of(
    dataset: xr.Dataset, manifest: Manifest, chosen: Sequence[int], tell: Callable[[str], None]
) -> tuple[tuple[Stage, ...], tuple[Take, ...]]:
    """Return the telescope, and the chosen or the worst case of each disturbance, by controller.

    Of the controllers the ideal ones are shown, and the best one of each actuator for the disturbance.
    """
    study = study_from_identity(TelescopeLoopStudy, manifest.study)
    bench = bench_of(study)
    device, stage = choose_device(device_at_hand(manifest)), stage_of_telescope(bench.optics.control.bench)
    known = controllers_of(dataset)
    error = dataset["wfe_rms"].isel(controller=0)
    badness = error if "statistic" not in error.dims else error.sel(statistic="rms")
    others = [dim for dim in badness.dims if dim != "case"]
    ids = list(chosen) or worst_cases(dataset, (badness**2).mean(others).to_numpy())
    table = cases(study, np.array(ids))
    takes = list[Take]()
    with threadpool_limits(1):
        for case, name, realization in zip(ids, table["disturbance"], table["realization"], strict=True):
            alike = dataset.isel(case=dataset["disturbance"].to_numpy() == name)
            names = telling(results(alike.isel(case=alike["status"].to_numpy() == 1)), known)
            index = [entry.name for entry in study.disturbance].index(name)
            motion = drawn(study, bench.optics, index, int(realization))
            mine = [one for one in bench.controllers if one.name in names]
            found = [_take(bench, stage, one, index, motion, device) for one in mine]
            maps = same_reach([take.maps[0] for take in found])
            for take, shown in zip(found, maps, strict=True):
                label = f"{name}, case {case}: {take.of}"
                takes.append(replace(take, label=label, case=case, maps=(shown, *take.maps[1:])))
                tell(label)
    return (stage,), tuple(takes)


def _take(bench: Bench, stage: Stage, one: Designed, index: int, motion: CaseDraw, device: Device) -> Take:
    control = bench.optics.control
    seen = [seen_of(bench.study, bench.optics, motion)]
    positions, _, diverged = positions_of(bench, one, index, [motion], seen, device)
    if diverged[0]:
        raise UserError(f"Case {motion.realization} of {motion.population.name} diverges under {one.name}.")
    shown = chosen_instants(len(positions[0]), min(MOST_INSTANTS, len(positions[0])))
    states = states_of(bench, one, motion, positions[0], shown)
    traced, wavefront = trace(control.prepared, states, device)
    if wavefront.lost[: len(shown)].any():
        raise UserError(f"{motion.population.name} loses rays ({one.name}), so that its image has holes.")
    waves, images, track, errors = light_of(control, traced, wavefront, np.arange(len(shown)))
    rays, figure = control.prepared.rays, _figure(states, shown)
    maps = [map_of(f"wavefront, {one.name}", "nm", over_pupil(rays.x, rays.y), waves)]
    to_mas = control.prepared.wavelength / control.diameter * MAS_PER_RAD
    deforms = bool(figure.any())
    return Take(
        one.name,
        motion.time[1 + shown],
        note=_note(bench, one, len(positions[0]), len(shown)),
        poses=_poses(control, stage, states, len(shown)),
        shapes=m2_shapes(control, stage, figure.shape[1]) if deforms else None,
        weights=figure / MM_PER_M if deforms else None,
        images=images,
        pixel=control.study.imaging.sampling,
        track=track,
        maps=(*maps, m2_map(figure * _NM_PER_MM)) if deforms else tuple(maps),
        series={
            "wavefront error of the fitted terms, rms": ("nm", errors[:, None]),
            "line of sight, x and y": ("mas", track * to_mas),
        },
        of=one.name,
    )


def _figure(states: States, shown: Integers) -> Array:
    """Return the deformation of M2 at the instants, Noll coefficients from 2 in mm; (s, 0) without any."""
    figure = states.deformations[M2]
    return np.zeros((len(shown), 0)) if figure is None else figure[: len(shown), 1:]


def _poses(control: ControlBench, stage: Stage, states: States, count: int) -> Array:
    """Return how segments and the mirrors after them move, (T, B, 6) in m and rad."""
    system = control.bench.system
    poses = np.zeros((count, len(stage.names), 6))
    if not is_monolithic(system.segments):
        poses[:, : len(system.segments)] = states.segment_motion[:count]
    places = {surface.name: number for number, surface in enumerate(system.surfaces)}
    for body, name in enumerate(stage.names):
        if name in places:
            poses[:, body] = states.surface_motion[:count, places[name]]
    return np.asarray(poses * _SHIFTS)


def _note(bench: Bench, one: Designed, instants: int, shown: int) -> str:
    record = bench.study.part("controller", one.name)
    words = {"off": "Nothing is done about the disturbance.", "perfect": "Acts at once and without error."}
    said = words.get(record.model, f"{record.model}: reads {record.sensor}, moves {record.actuator}.")
    return said + (f" {shown} of {instants} instants are shown." if shown < instants else "")
