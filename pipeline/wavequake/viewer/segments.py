"""Segments that move, with the wavefront, image and line of sight that they make."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from wavequake.campaign.store.store import Manifest
from wavequake.drawing.solid import telescope_scene
from wavequake.errors import UserError
from wavequake.kernels.device.devices import choose_device
from wavequake.kernels.device.tiles import TILE, from_tiles
from wavequake.optics.segments.figures import figure_terms, glass_triangles
from wavequake.optics.segments.layout import is_monolithic
from wavequake.optics.segments.parent import parent_system
from wavequake.optics.segments.prepared import chief_rays, trace_states
from wavequake.optics.segments.wavefront import analyse
from wavequake.optics.shapes.sag import shape_sag
from wavequake.optics.systems.kinematics import rest_states
from wavequake.optics.systems.system import OpticalSystem
from wavequake.report.at_hand import device_at_hand
from wavequake.report.populations import is_whole, populations, representatives
from wavequake.viewer.chosen import worst_cases
from wavequake.viewer.film import Array, Map, Stage, Take, map_of, over_pupil, stage_of
from wavequake.workflows.segments.bench import MAS_PER_RAD, MM_PER_M, Bench, bench_of
from wavequake.workflows.segments.disturbance import draw
from wavequake.workflows.segments.images import instant_images
from wavequake.workflows.segments.launches import CaseDraw, surface_states
from wavequake.workflows.segments.mor import flattened

TO_SKY = np.array([1.0, 1.0, -1.0])
_MOST_INSTANTS = 208  # whole tiles
_NM_PER_MM = 1e6
_BENT = "Segments deform; their color is the plane of their wavefront, the map shows all of it."


def film_of(
    dataset: xr.Dataset, manifest: Manifest, chosen: Sequence[int], tell: Callable[[str], None]
) -> tuple[tuple[Stage, ...], tuple[Take, ...]]:
    """Return the telescope, its z axis to the sky, and the chosen or the worst cases."""
    bench = bench_of(manifest.study)
    cases = list(chosen) or _worst(dataset)
    device = device_at_hand(manifest)
    with threadpool_limits(1):
        takes = []
        for case in cases:
            takes.append(take_of(bench, case, device))
            tell(takes[-1].label)
    return (stage_of_telescope(bench),), tuple(takes)


def _worst(dataset: xr.Dataset) -> list[int]:
    """Return the worst case of each disturbance; of a store without images or instants by its wavefront.

    Of several field points and wavelengths it is that at the first ones, which is what is shown.
    """
    dataset = dataset.isel({dim: 0 for dim in ("field", "wavelength") if dim in dataset.dims})
    if is_whole(dataset):
        return [worst for _, worst in representatives(populations(dataset)).values()]
    error = dataset["wfe_rms_raw"]
    if "statistic" in error.dims:
        error = error.sel(statistic="rms")
    return worst_cases(dataset, (error**2).mean([dim for dim in error.dims if dim != "case"]).to_numpy())


def stage_of_telescope(bench: Bench) -> Stage:
    """Return the telescope with a body for every segment; those that have figures are of triangles."""
    stage = stage_of_segments(bench.system)
    return (
        _bending(bench, stage) if bench.figure_terms and not is_monolithic(bench.system.segments) else stage
    )


def stage_of_segments(system: OpticalSystem) -> Stage:
    """Return a telescope with a body for every segment; what follows M1 stands still."""
    whole, segments = stage_of(telescope_scene(system)), system.segments
    points, pivots = whole.points * TO_SKY, whole.pivots * TO_SKY
    body, names, axes = whole.body, whole.names, np.array(whole.axes)
    if not is_monolithic(segments):
        count, size = segments.corners.shape[:2]
        rest = body[count * size :] - 1 + count
        body = np.concatenate([np.repeat(np.arange(count), size), rest])
        names = (*segments.names, *names[1:])
        pivots = np.concatenate([segments.centers * TO_SKY / MM_PER_M, pivots[1:]])
        axes = np.concatenate([segments.axes, axes[1:]])
    # What follows M1 moves in its own frame, about its vertex.
    after = {surface.name: surface for surface in system.after_primary}
    for number, name in enumerate(names):
        if name in after:
            pivots[number] = after[name].position * TO_SKY / MM_PER_M
            axes[number] = np.diag(TO_SKY) @ after[name].rotation
    lines = tuple((color, line * TO_SKY) for color, line in whole.lines)
    labels = tuple((name, point * TO_SKY) for name, point in whole.labels)
    up = np.array([0.0, 0.0, 1.0])
    return Stage(points, whole.faces, body, whole.colors, names, pivots, axes, lines, labels, up)


def _bending(bench: Bench, stage: Stage) -> Stage:
    """Return a stage whose segments, one face each, are triangles with the terms of their figures."""
    system, (flat, faces, segment) = bench.system, glass_triangles(bench.system)
    count, size = system.segments.corners.shape[:2]
    height = np.asarray(shape_sag(parent_system(system).surfaces[1].shape, *flat.T)[0])
    points = np.concatenate([flat, height[:, None]], axis=1) * TO_SKY / MM_PER_M
    rest = stage.body[count * size :]
    terms = figure_terms(system, segment, flat, bench.figure_terms)
    wide = np.pad(faces, ((0, 0), (0, stage.faces.shape[1] - 3)), mode="edge")
    return replace(
        stage,
        points=np.concatenate([points, stage.points[count * size :]]),
        faces=np.concatenate([wide, stage.faces[count:] + len(flat) - count * size]),
        body=np.concatenate([segment, rest]),
        colors=(stage.colors[0],) * len(faces) + stage.colors[count:],
        terms=np.pad(terms, ((0, len(rest)), (0, 0))),
    )


def figures_on(stage: Stage, figure: Array, which: NDArray[np.int64] | None = None) -> Array:
    """Return figures (T, segment, J) of all segments, or of some, as those of a stage's bodies."""
    assert stage.terms is not None
    found = np.zeros((len(figure), len(stage.names), stage.terms.shape[1]))
    where = np.arange(figure.shape[1]) if which is None else which
    found[:, where, : figure.shape[2]] = figure
    return found


def take_of(bench: Bench, case: int, device_name: str) -> Take:
    """Compute a case of segment-disturbance anew."""
    drawn = draw(bench, case)
    step = -(-len(drawn.time) // _MOST_INSTANTS)
    instants = len(drawn.time)
    states = surface_states(bench, drawn, 0, instants)
    traced = trace_states(bench.prepared, states, choose_device(device_name))
    wavefront = analyse(bench.prepared, traced, chief_rays(bench.prepared, states))
    to_nm = bench.prepared.wavelength * _NM_PER_MM
    to_mas = MAS_PER_RAD / bench.first_order.focal_length
    images, trouble = None, ""
    if bench.study.imaging.enabled:
        try:
            images = instant_images(bench, traced, wavefront, slice(0, instants))[::step]
        except UserError as error:  # the store has quarantined such a case
            trouble = f"There is no image: {error}."
    los = (wavefront.los - bench.static.los[0])[:instants:step] * to_mas
    series = {
        "wavefront error, rms": ("nm", (wavefront.rms_flat[:instants:step] * to_nm)[:, None]),
        "line of sight": ("mas", los),
    }
    segmented = not is_monolithic(bench.system.segments)
    figures, maps = None, tuple[Map, ...]()
    if segmented and bench.figure_terms:
        given = drawn.motion.segment_figure
        over_time = np.broadcast_to(given, (instants, *given.shape[-2:]))
        figures = figures_on(stage_of_telescope(bench), over_time[::step])
        rays = bench.prepared.rays
        opd = from_tiles(flattened(bench.prepared, traced.opd - _path_at_rest(bench, device_name)))
        opd = opd[:instants:step]
        maps = (map_of("wavefront from rest", "nm", over_pupil(rays.x, rays.y), opd),)
    phase = wavefront.segment_phase[:instants] - bench.static.segment_phase[0]
    return Take(
        f"{drawn.population.name}, case {case}",
        drawn.time[::step],
        case=case,
        note=f"{_note(drawn, step)} {_BENT if maps else ''} {trouble}".strip(),
        poses=_poses(bench, drawn)[::step] if segmented else None,
        figures=figures,
        planes=_planes(bench, phase * to_nm)[::step] if segmented else None,
        maps=maps,
        images=images,
        pixel=bench.study.imaging.sampling,
        series=series,
    )


def _path_at_rest(bench: Bench, device_name: str) -> Array:
    """Return the optical path differences of the telescope at rest, (ray, 1) in mm."""
    still = rest_states(bench.prepared.system, TILE)
    return np.asarray(trace_states(bench.prepared, still, choose_device(device_name)).opd[0, :, :1])


def _note(drawn: CaseDraw, step: int) -> str:
    motion, notes = drawn.motion, []
    if not motion.segment_motion.any() and not motion.segment_figure.any():
        notes.append("No segment moves in this case: the line of sight does.")
    elif not np.ptp(motion.segment_motion, axis=0).any() and (
        motion.segment_figure.ndim < 3 or not np.ptp(motion.segment_figure, axis=0).any()
    ):
        notes.append("Nothing changes over time in this case.")
    notes += [f"One instant in {step} is shown."] if step > 1 else []
    return " ".join(notes)


def _poses(bench: Bench, drawn: CaseDraw) -> Array:
    """Return the motion of segments, and none of what follows M1, (T, B, 6)."""
    motion = drawn.motion.segment_motion
    others = len(telescope_scene(bench.system).skins) - 1
    return np.concatenate([motion, np.zeros((len(motion), others, 6))], axis=1)


def _planes(bench: Bench, phase: Array) -> Array:
    """Return the wavefront (T, B, 3) without the plane that fits its pistons, nm and nm per m."""
    x, y = bench.system.segments.centers[:, :2].T / MM_PER_M
    planes = np.concatenate([phase[..., :1], phase[..., 1:] * MM_PER_M], axis=2)
    common = np.linalg.pinv(np.stack([np.ones_like(x), x, y], axis=1)) @ np.nan_to_num(planes[..., 0]).T
    planes[..., 0] -= common[0][:, None] + np.outer(common[1], x) + np.outer(common[2], y)
    planes[..., 1:] -= common[1:].T[:, None]
    others = len(telescope_scene(bench.system).skins) - 1
    return np.pad(np.nan_to_num(planes), ((0, 0), (0, others), (0, 0)))
