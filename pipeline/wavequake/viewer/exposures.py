"""A vibrating telescope under the controllers of its M2: segments and M2 move, the wavefront follows."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import xarray as xr
from threadpoolctl import threadpool_limits

from wavequake.campaign.store.store import Manifest
from wavequake.errors import UserError
from wavequake.imaging.exposures.exposure_models import cut, full_exposure
from wavequake.kernels.device.devices import Device, choose_device
from wavequake.kernels.trace.train import Traced
from wavequake.mechanics.model import Integers
from wavequake.optics.polynomials.zernike import annular_zernike
from wavequake.optics.segments.layout import is_monolithic
from wavequake.optics.segments.telescope import M2, footprints
from wavequake.optics.wavefronts.record import Wavefront
from wavequake.report.at_hand import device_at_hand
from wavequake.viewer.chosen import worst_cases
from wavequake.viewer.film import Array, Map, Stage, Take, map_of, over_pupil, same_reach, zernike_map
from wavequake.viewer.segments import TO_SKY, stage_of_telescope
from wavequake.workflows.exposures.telescope_control import (
    CONTROLLERS,
    ELASTIC,
    RIGID,
    STATIC,
    ControlBench,
    control_bench_of,
    local_images,
    measured_opd,
    position,
)
from wavequake.workflows.exposures.telescope_exposure import case_blocks, motion_of_m2, scaled_draw
from wavequake.workflows.segments.bench import MAS_PER_RAD, MM_PER_M
from wavequake.workflows.segments.launches import CaseDraw

MOST_INSTANTS = 60  # each has an image
_M_PER_NM = 1e-9
_NOTES = {
    "disturbed": "Nothing is done about the disturbance.",
    RIGID: "M2 tilts so that the line of sight stays.",
    ELASTIC: "M2 deforms so that line of sight and fitted wavefront stay.",
}


def film_of(
    dataset: xr.Dataset, manifest: Manifest, chosen: Sequence[int], tell: Callable[[str], None]
) -> tuple[tuple[Stage, ...], tuple[Take, ...]]:
    """Return the telescope, and the chosen cases or the dimmest of each disturbance, by controller."""
    control = control_bench_of(manifest.study)
    device, stage = choose_device(device_at_hand(manifest)), stage_of_telescope(control.bench)
    peak = dataset["peak"].sel(controller="disturbed").to_numpy()
    cases = list(chosen) or worst_cases(dataset, -peak)
    takes = list[Take]()
    with threadpool_limits(1):
        for case in cases:
            takes += takes_of(control, stage, case, device, tell)
    return (stage,), tuple(takes)


def takes_of(
    control: ControlBench, stage: Stage, case: int, device: Device, tell: Callable[[str], None]
) -> list[Take]:
    """Compute a case of telescope-exposure anew: a take for every controller, the same colors in all."""
    drawn = scaled_draw(control, case)
    motion = motion_of_m2(control, drawn, device)
    takes = []
    for controller in CONTROLLERS:
        if controller != STATIC:
            takes.append(_take(control, stage, drawn, case, controller, motion, device))
            tell(takes[-1].label)
    alike = same_reach([take.maps[0] for take in takes])
    return [replace(take, maps=(shown, *take.maps[1:])) for take, shown in zip(takes, alike, strict=True)]


def _take(
    control: ControlBench,
    stage: Stage,
    drawn: CaseDraw,
    case: int,
    controller: str,
    motion: dict[str, Array],
    device: Device,
) -> Take:
    instants = len(drawn.time)
    step = -(-instants // MOST_INSTANTS)
    rays = control.prepared.rays
    found, first = list[tuple[Array, ...]](), 0
    for count, traced, wavefront in case_blocks(control, drawn, device, controller):
        if (wavefront.lost > wavefront.vignetted)[:count].any():  # those that a mirror stops are dark
            raise UserError(f"Case {case} loses rays ({controller}), so that its image would have holes.")
        shown = np.flatnonzero((first + np.arange(count)) % step == 0)
        first += count
        found.append(light_of(control, traced, wavefront, shown))
    waves, images, track, errors = (np.concatenate(one) for one in zip(*found, strict=True))
    cells = over_pupil(rays.x, rays.y)
    maps = [map_of(f"wavefront, {controller}", "nm", cells, waves)]
    shapes, weights = None, None
    if controller == ELASTIC:
        figure = motion["m2_figure"][::step]
        maps.append(m2_map(figure))
        shapes, weights = m2_shapes(control, stage, figure.shape[1]), figure * _M_PER_NM
    to_mas = control.prepared.wavelength / control.diameter * MAS_PER_RAD
    population = drawn.population.name
    return Take(
        f"{population}, case {case}: {controller}",
        drawn.time[::step],
        note=_NOTES[controller] + (f" One instant in {step} is shown." if step > 1 else ""),
        poses=_poses(control, stage, drawn, controller, motion["m2_tilt"])[::step],
        shapes=shapes,
        weights=weights,
        images=images,
        pixel=control.study.imaging.sampling,
        track=track,
        maps=tuple(maps),
        series={
            "wavefront error of the fitted terms, rms": ("nm", errors[:, None]),
            "line of sight, x and y": ("mas", track * to_mas),
        },
        case=case,
        of=controller,
    )


def light_of(
    control: ControlBench, traced: Traced, wavefront: Wavefront, shown: Integers
) -> tuple[Array, Array, Array, Array]:
    """Return what the shown of traced instants do to the light.

    Wavefronts without tilt (s, N) in nm, images (s, n, n), lines of sight (s, 2) in lambda/D, and errors of
    the fitted terms (s,) in nm.
    """
    rays, imaging = control.prepared.rays, control.study.imaging
    to_nm, opd = control.study.optics.wavelength_nm, measured_opd(control, traced)
    slopes = (wavefront.los - wavefront.chief) / (control.prepared.wavelength * control.prepared.focal_length)
    flat = opd + slopes[:, :1] * rays.x + slopes[:, 1:] * rays.y
    waves = (flat - np.nanmean(flat, axis=1, keepdims=True))[shown] * to_nm
    there, local = position(control, wavefront)[shown], local_images(control, opd, wavefront)[shown]
    images = [
        cut(full_exposure([one[None]], place[None], imaging.sampling), imaging.pixels)
        for one, place in zip(local, there, strict=True)
    ]
    pictures = np.array(images).reshape(len(shown), imaging.pixels, imaging.pixels)
    return waves, pictures, there, wavefront.rms[shown] * to_nm


def _poses(control: ControlBench, stage: Stage, drawn: CaseDraw, controller: str, tilt: Array) -> Array:
    """Return how segments and a rigid M2 move, (T, B, 6) in m and rad."""
    motion = drawn.motion.segment_motion
    poses = np.zeros((len(motion), len(stage.names), 6))
    if not is_monolithic(control.bench.system.segments):
        poses[:, : motion.shape[1]] = motion
    if controller == RIGID:
        poses[:, _m2(stage), 3:5] = tilt
    return poses


def _m2(stage: Stage) -> int:
    """Return which body is the first mirror after M1."""
    return next(k for k, name in enumerate(stage.names) if name == "M2")


def m2_shapes(control: ControlBench, stage: Stage, terms: int) -> Array:
    """Return how M2's corners move, (terms, V, 3), by one metre of each Noll coefficient from 2."""
    surface = control.bench.system.surfaces[M2]
    on_m2 = stage.body == _m2(stage)
    local = (stage.points[on_m2] * TO_SKY * MM_PER_M - surface.position) @ surface.rotation
    x, y = local[:, :2].T / footprints(control.bench.system)[0]
    inside = np.maximum(1.0, np.hypot(x, y))  # the rim beyond the beam follows the beam's edge
    heights = annular_zernike(x / inside, y / inside, terms + 1, 0.0)[:, 1:]
    shapes = np.zeros((terms, len(stage.points), 3))
    shapes[:, on_m2] = heights.T[..., None] * (surface.rotation[:, 2] * TO_SKY)
    return shapes


def m2_map(figure: Array) -> Map:
    """Return the deformation of M2 over the beam, from Noll coefficients (T, terms) from 2 in nm."""
    shown = np.concatenate([np.zeros((len(figure), 1)), figure], axis=1)
    return zernike_map("deformation of M2", shown, 0.0)
