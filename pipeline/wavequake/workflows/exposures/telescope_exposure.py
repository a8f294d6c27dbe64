"""The workflow "telescope-exposure": what a detector receives of a vibrating telescope, by controller of M2.

A case is one realization of one population of disturbances, as in segment-disturbance. It is exposed at
rest, disturbed, with perfectly corrected line of sight (a rigid M2 tilts) and with perfectly corrected
wavefront (M2 deforms), as in Störkle 2018, Section 4.6 and Fig. 4.45; M2's motion is ray traced.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from wavequake.campaign.measured import Block, CaseTable, one_by_one, study_kind
from wavequake.campaign.measures import Axis, Measure, stored
from wavequake.campaign.stopwatch import Stopwatch
from wavequake.chain.images.coherent import LitObject, lit_object, mean_image
from wavequake.chain.images.extended import check_object
from wavequake.chain.images.shortcuts import (
    CANVAS,
    FOCUS,
    exposed,
    exposure_axes,
    exposure_measures,
)
from wavequake.errors import UserError
from wavequake.imaging.exposures.exposure_models import cut, full_exposure
from wavequake.imaging.pupils.nyquist import ray_samples_for, too_few_rays
from wavequake.kernels.device.devices import Device, choose_device
from wavequake.kernels.device.tiles import TILE
from wavequake.kernels.trace.train import Traced
from wavequake.mechanics.disturbances.motion import scaled
from wavequake.optics.systems.system import States
from wavequake.optics.wavefronts.record import Wavefront
from wavequake.workflows.disturbed_study import case_labels
from wavequake.workflows.exposures.exposure_study import TelescopeExposureStudy
from wavequake.workflows.exposures.telescope_control import (
    CONTROLLERS,
    DISTURBED,
    STATIC,
    ControlBench,
    control_bench_of,
    controlled,
    elastic_figure,
    fitted_opd,
    local_images,
    measured_opd,
    position,
    ray_phase,
    rigid_tilt,
    trace,
)
from wavequake.workflows.segments import disturbance as segment_disturbance
from wavequake.workflows.segments.bench import MAS_PER_RAD
from wavequake.workflows.segments.disturbance import draw
from wavequake.workflows.segments.launches import CaseDraw, surface_states

Array = NDArray[np.float64]

# Instants at once: bounds the memory, however long an exposure is.
_BLOCK = 8 * TILE
_NM_PER_MM = 1e6


def prepare(study: TelescopeExposureStudy) -> ControlBench:
    """Return what all cases of a study share; raises as `control_bench_of`."""
    return control_bench_of(study.identity_text())


def compute(control: ControlBench, table: CaseTable, device_name: str, clock: Stopwatch) -> Iterator[Block]:
    """Expose cases; one whose rays are lost is quarantined with the reason."""
    device = choose_device(device_name)
    return one_by_one(table["case"], lambda case: exposed_case(control, scaled_draw(control, case), device))


def scaled_draw(control: ControlBench, case: int) -> CaseDraw:
    """Draw a case of the disturbance, exaggerated by the study's scale."""
    drawn, scale = draw(control.bench, case), control.study.exposure.scale
    return replace(drawn, motion=scaled(drawn.motion, scale))


def exposed_case(control: ControlBench, drawn: CaseDraw, device: Device) -> dict[str, Array]:
    """Return all stored numbers of one case, time axes as long as the case's own.

    Images follow once all lines of sight are known and are summed as they come; rays are traced anew for
    them, so that no instant is kept.
    """
    imaging = control.study.imaging
    grid = imaging.pixels, imaging.sampling, control.area, control.diameter
    instants = len(drawn.time)
    found: dict[str, list[Array]] = {}
    lit = lit_object_of(control)
    for controller in CONTROLLERS:
        # All instants at rest are one.
        case = replace(drawn, time=drawn.time[:1]) if controller == STATIC else drawn
        history = _history(control, case, device, controller)
        los = history.pop("position")
        history = {name: np.repeat(values, instants // len(los), axis=0) for name, values in history.items()}
        images, fitted = (_images(control, case, device, controller, of) for of in ("rays", "terms"))
        history |= exposed(images, control.static_image, los, *grid, control.study.object)
        if lit is not None:
            history["object_image"] = mean_image(lit, _phases(control, case, device, controller))
        history["exposure_fitted"] = cut(full_exposure(fitted, los, imaging.sampling), imaging.pixels)
        for name, values in history.items():
            found.setdefault(name, []).append(values)
    stacked = {name: np.stack(values) for name, values in found.items()}
    motion = motion_of_m2(control, drawn, device)
    resolution = np.asarray(control.prepared.wavelength / control.diameter * MAS_PER_RAD)
    focus = np.array([cut(image, imaging.pixels) for image in control.static_focus])
    fixed = {"resolution_mas": resolution, "static_focus": focus}
    return {"time_s": drawn.time, **stacked, **motion, **fixed}


def case_blocks(
    control: ControlBench, drawn: CaseDraw, device: Device, controller: str
) -> Iterator[tuple[int, Traced, Wavefront]]:
    """Trace a case under a controller: number of instants, rays and wavefronts of each block."""
    for count, states in controlled_blocks(control, drawn, device, controller):
        yield count, *trace(control.prepared, states, device)


def controlled_blocks(
    control: ControlBench, drawn: CaseDraw, device: Device, controller: str
) -> Iterator[tuple[int, States]]:
    """Yield how a case moves under a controller: number of instants and states of each block."""
    for count, states, measured in _disturbed(control, drawn, device):
        yield count, controlled(control, controller, states, measured)


def _disturbed(
    control: ControlBench, drawn: CaseDraw, device: Device
) -> Iterator[tuple[int, States, Wavefront]]:
    for first in range(0, len(drawn.time), _BLOCK):
        last = min(first + _BLOCK, len(drawn.time))
        states = surface_states(control.bench, drawn, first, last)
        yield last - first, states, trace(control.prepared, states, device)[1]


def _history(control: ControlBench, drawn: CaseDraw, device: Device, controller: str) -> dict[str, Array]:
    """Return wavefront errors, Strehl ratio and line of sight over time, and its position in lambda/D."""
    to_nm = control.study.optics.wavelength_nm
    to_mas = MAS_PER_RAD / control.bench.first_order.focal_length
    parts: list[dict[str, Array]] = []
    for count, _, wavefront in case_blocks(control, drawn, device, controller):
        if lost := int((wavefront.lost - wavefront.vignetted)[:count].max()):
            raise UserError(f"{lost} rays are lost ({controller}), so that the image would have holes")
        values = {
            "wfe_rms": wavefront.rms * to_nm,
            "wfe_rms_flat": wavefront.rms_flat * to_nm,
            "strehl": wavefront.strehl,
            "los": (wavefront.los - control.static.los[0]) * to_mas,
            "position": position(control, wavefront),
        }
        parts.append({name: value[:count] for name, value in values.items()})
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def _images(
    control: ControlBench, drawn: CaseDraw, device: Device, controller: str, of: str
) -> Iterator[Array]:
    """Yield the local images of a case by blocks: of its rays, or of the fitted Zernike terms alone."""
    for count, traced, wavefront in case_blocks(control, drawn, device, controller):
        opd = measured_opd(control, traced)
        opd = opd if of == "rays" else fitted_opd(control, wavefront, opd)
        yield local_images(control, opd, wavefront)[:count]


def lit_object_of(control: ControlBench) -> LitObject | None:
    """Return the object of a study if its light is coherent or partially so."""
    shown, imaging, prepared = control.study.object, control.study.imaging, control.prepared
    if shown is None or shown.light == "incoherent":
        return None
    rays = prepared.rays.x, prepared.rays.y, prepared.weight
    glass = control.area / control.bench.stopped.light
    return lit_object(shown, rays, imaging.pixels, imaging.sampling, glass, control.diameter)


def _phases(control: ControlBench, drawn: CaseDraw, device: Device, controller: str) -> Iterator[Array]:
    """Yield the phases of the rays by blocks, about the line of sight at rest."""
    for count, traced, wavefront in case_blocks(control, drawn, device, controller):
        opd = measured_opd(control, traced)
        yield ray_phase(control, opd, wavefront, control.static.los[:1])[:count]


def motion_of_m2(control: ControlBench, drawn: CaseDraw, device: Device) -> dict[str, Array]:
    """Return the targets of M2 over time: tilts in rad, figure in nm."""
    parts = [
        (rigid_tilt(control, measured)[:count], elastic_figure(control, measured)[:count])
        for count, _, measured in _disturbed(control, drawn, device)
    ]
    tilt, figure = (np.concatenate(part) for part in zip(*parts, strict=True))
    return {"m2_tilt": tilt, "m2_figure": figure * _NM_PER_MM}


def axes(control: ControlBench) -> dict[str, Axis]:
    """Return the dimensions of the measures."""
    study = control.study
    return {
        "controller": Axis(CONTROLLERS, "what is done about the disturbance"),
        "time": Axis(max(population.instants for population in study.disturbance)),
        "noll": Axis(np.arange(2, study.figure_terms + 1), "Noll index"),
        **exposure_axes(study.imaging.pixels, study.imaging.sampling),
    }


def measures(control: ControlBench) -> Iterator[Measure]:
    """Yield the measures of a case."""
    history, frame = ("controller", "time"), ("controller", "y", "x")
    words = "time of the instant; NaN beyond the population's instants"
    yield stored("time_s", "s", words, ("time",), coordinate=True)
    yield stored("wfe_rms", "nm", "wavefront error rms of the fitted Zernikes j >= 4", history)
    words = "wavefront error rms over the rays on glass, piston and tilt removed"
    yield stored("wfe_rms_flat", "nm", words, history)
    yield stored("strehl", "1", "Strehl ratio in the direction of the best-fit plane", history)
    words = "line of sight of the best-fit plane relative to rest "
    words += "(Störkle 2018, Eq. 3.39, annular tilt / sqrt(1 + eps^2))"
    yield stored("los", "mas", words, (*history, "axis"))
    words = "target rotations of the rigid M2 about x and y (Eq. 4.25)"
    yield stored("m2_tilt", "rad", words, ("time", "axis"))
    words = "target deformation of the elastic M2, Noll coefficients over the beam's footprint (Eq. 4.27)"
    yield stored("m2_figure", "nm", words, ("time", "noll"))
    yield stored("resolution_mas", "mas", "lambda/D on the sky")
    words = "image at rest with defocus added; 1 = peak of the perfect one"
    yield stored("static_focus", "1", words, ("focus", "y", "x"))
    yield from exposure_measures("controller", control.study.object)
    words = "the same of the wavefronts that the fitted Zernike terms describe, without what segments leave "
    yield stored("exposure_fitted", "1", words + "beside them", frame)


def describe(control: ControlBench) -> dict[str, str]:
    """Return rays and disturbances, for the plan."""
    return segment_disturbance.describe(control.bench)


def check(study: TelescopeExposureStudy) -> None:
    """Raise UserError if the object does not fit."""
    if study.object:
        check_object(study.object, study.imaging.pixels, study.imaging.sampling)


def notices(study: TelescopeExposureStudy) -> Iterator[str]:
    """Yield what to say of too few rays: for the images' field, their focus, or the disturbed phase.

    Each disturbance is judged by the first instants of its first case.
    """
    control = prepare(study)
    imaging, prepared, device = control.study.imaging, control.prepared, choose_device("numpy")
    still = replace(scaled_draw(control, 0), time=np.zeros(1))
    _, traced, wavefront = next(case_blocks(control, still, device, STATIC))
    if words := control.bench.stopped.words():
        yield words
    rest = _whole_phase(control, traced, wavefront)[:1]
    phases = [rest - np.array(FOCUS)[:, None] * prepared.fit.basis[:, 3]]
    for case in range(len(control.study.disturbance)):
        drawn = scaled_draw(control, case)
        drawn = replace(drawn, time=drawn.time[:TILE])
        count, traced, wavefront = next(case_blocks(control, drawn, device, DISTURBED))
        phases.append(_whole_phase(control, traced, wavefront)[:count])
    radius, rays = 0.5 * control.diameter, prepared.rays
    places = rays.x / radius, rays.y / radius, rays.segment
    field = CANVAS * imaging.pixels * imaging.sampling
    needed = ray_samples_for(places, 2.0 * np.pi * np.concatenate(phases), field)
    fill = control.area / control.diameter**2
    if text := too_few_rays(len(rays), fill, needed, field):
        yield f"{text} or a smaller exposure.scale"


def _whole_phase(control: ControlBench, traced: Traced, wavefront: Wavefront) -> Array:
    """Return the phases (batch, N) of all rays in waves; dark ones have that of the fitted polynomials."""
    opd = measured_opd(control, traced)
    opd = np.where(np.isnan(opd), fitted_opd(control, wavefront, np.zeros_like(opd)), opd)
    return ray_phase(control, opd, wavefront, wavefront.los)


KIND = study_kind(
    "telescope-exposure",
    TelescopeExposureStudy,
    prepare=prepare,
    cases=case_labels,
    compute=compute,
    measures=measures,
    axes=axes,
    describe=describe,
    check=check,
    notices=notices,
)
