"""Segments that move, with the wavefront, image and line of sight that they make."""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from wavequake.campaign.store.store import Manifest, open_store
from wavequake.drawing.solid import telescope_scene
from wavequake.errors import UserError
from wavequake.kernels.device.devices import choose_device
from wavequake.optics.segments.layout import is_monolithic
from wavequake.optics.segments.prepared import chief_rays, trace_states
from wavequake.optics.segments.wavefront import analyse
from wavequake.report.campaign import device_at_hand
from wavequake.report.populations import representatives
from wavequake.viewer.film import Array, Stage, Take, stage_of
from wavequake.workflows.segments.bench import MAS_PER_RAD, MM_PER_M, Bench, bench_of
from wavequake.workflows.segments.images import instant_images
from wavequake.workflows.segments.segment_disturbance import CaseDraw, draw, surface_states

_TO_SKY = np.array([1.0, 1.0, -1.0])
_MOST_INSTANTS = 208  # whole tiles
_NM_PER_MM = 1e6


def film_of(
    store: Path, manifest: Manifest, chosen: Sequence[int], tell: Callable[[str], None]
) -> tuple[tuple[Stage, ...], tuple[Take, ...]]:
    """Return the telescope, its z axis to the sky, and the chosen or the worst cases."""
    bench = bench_of(manifest.study)
    cases = list(chosen) or [worst for _, worst in representatives(open_store(store)).values()]
    device = device_at_hand(manifest)
    with threadpool_limits(1):
        takes = []
        for case in cases:
            takes.append(take_of(bench, case, device))
            tell(f"case {case}: {takes[-1].label}")
    return (stage_of_telescope(bench),), tuple(takes)


def stage_of_telescope(bench: Bench) -> Stage:
    """Return the telescope with a body for every segment; what follows M1 stands still."""
    whole, segments = stage_of(telescope_scene(bench.system)), bench.system.segments
    points, pivots = whole.points * _TO_SKY, whole.pivots * _TO_SKY
    body, names, axes = whole.body, whole.names, np.array(whole.axes)
    if not is_monolithic(segments):
        count, size = segments.corners.shape[:2]
        rest = body[count * size :] - 1 + count
        body = np.concatenate([np.repeat(np.arange(count), size), rest])
        names = (*segments.names, *names[1:])
        pivots = np.concatenate([segments.centers * _TO_SKY / MM_PER_M, pivots[1:]])
        axes = np.concatenate([segments.axes, axes[1:]])
    lines = tuple((color, line * _TO_SKY) for color, line in whole.lines)
    labels = tuple((name, point * _TO_SKY) for name, point in whole.labels)
    up = np.array([0.0, 0.0, 1.0])
    return Stage(points, whole.faces, body, whole.colors, names, pivots, axes, lines, labels, up)


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
    phase = wavefront.segment_phase[:instants] - bench.static.segment_phase[0]
    return Take(
        f"{drawn.population.name}, case {case}",
        drawn.time[::step],
        note=f"{_note(drawn, step)} {trouble}".strip(),
        poses=_poses(bench, drawn)[::step] if segmented else None,
        planes=_planes(bench, phase * to_nm)[::step] if segmented else None,
        images=images,
        pixel=bench.study.imaging.sampling,
        series=series,
    )


def _note(drawn: CaseDraw, step: int) -> str:
    motion, notes = drawn.motion, []
    if not motion.segment_motion.any():
        notes.append("No segment moves in this case: the line of sight does.")
    elif not np.ptp(motion.segment_motion, axis=0).any():
        notes.append("Nothing changes over time in this case.")
    notes += [f"Every {step}th instant is shown."] if step > 1 else []
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
