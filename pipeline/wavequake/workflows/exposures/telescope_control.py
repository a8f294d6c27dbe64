"""Perfect correction of a telescope by its M2, as a rigid or as a deformable mirror.

The target motion is the inverse of the kinematic-optical sensitivities times the measured aberration
(Störkle 2018, Eq. 4.25 and 4.27); what it does to the light is then ray traced, not supposed.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from wavequake.campaign.schema import study_from_identity
from wavequake.chain.images.shortcuts import CANVAS, FOCUS
from wavequake.errors import UserError
from wavequake.imaging.engines.segment_basis import SegmentBasis, ray_basis
from wavequake.kernels.device.devices import Device, choose_device
from wavequake.kernels.device.tiles import TILE, from_tiles, padded
from wavequake.kernels.trace.train import Traced
from wavequake.optics.derivatives.central import SIGNS, checked_derivative
from wavequake.optics.segments.prepared import PreparedTrace, at_field, chief_rays, prepare, trace_states
from wavequake.optics.segments.telescope import M2
from wavequake.optics.segments.wavefront import analyse
from wavequake.optics.systems.kinematics import rest_states
from wavequake.optics.systems.system import States
from wavequake.optics.wavefronts.record import Wavefront
from wavequake.prepared import prepared
from wavequake.workflows.exposures.exposure_study import TelescopeExposureStudy
from wavequake.workflows.segments.bench import Bench, bench_of, monolithic
from wavequake.workflows.segments.images import energy_scale, images_of_rays
from wavequake.workflows.segments.study import segment_text

Array = NDArray[np.float64]

CONTROLLERS = ("static", "disturbed", "rigid", "elastic")
STATIC, DISTURBED, RIGID, ELASTIC = CONTROLLERS
# Half width of the central differences of M2's figure, mm.
_STEP = 1e-5
# Beyond it, two deformations cannot be told apart.
_CONDITION = 1e6


@dataclass(frozen=True)
class ControlBench:
    """A telescope whose M2 moves and deforms, and its images.

    Attributes
    ----------
    study : TelescopeExposureStudy
    bench : Bench
        Of the same study without the exposure; its `prepared` has the figure of M2.
    static : Wavefront
        At rest, a tile of equal instants.
    correction : ndarray, shape (F - 1, 2 + J - 3)
        From tilt (waves, Noll normalization) of the line of sight in x and y and Noll coefficients 4..J in
        waves to the deformation of M2, Noll coefficients 2..F in mm, that takes them away.
    basis : SegmentBasis
        Images as sums over rays.
    static_image : ndarray, shape (n, n)
        At rest, about the line of sight.
    static_focus : ndarray, shape (focus, n, n)
        The same with defocus added.
    area : float
        Of the pupil that the rays stand for, mm².
    """

    study: TelescopeExposureStudy
    bench: Bench
    static: Wavefront
    correction: Array
    basis: SegmentBasis
    static_image: Array
    static_focus: Array
    area: float

    @property
    def prepared(self) -> PreparedTrace:
        """The bench's."""
        return self.bench.prepared

    @property
    def diameter(self) -> float:
        """Of the pupil, mm."""
        return 2.0 * self.bench.system.annulus.outer

    @property
    def tilt_per_mm(self) -> float:
        """Noll tilt coefficient, waves, of a line of sight of 1 mm (Störkle 2018, Eq. 3.39)."""
        one = self.prepared
        annular = np.hypot(1.0, one.system.pupil.obscuration)
        return float(annular * one.numerical_aperture / (2.0 * one.wavelength))


@prepared(maxsize=2)
def control_bench_of(study_text: str) -> ControlBench:
    """Prepare an exposure study, on one BLAS thread and in NumPy so that all workers have the same bits.

    Raises
    ------
    UserError
        If the telescope has no mirror M2, a disturbance deforms it, or its deformations do not determine
        the wavefront.
    """
    if bench_of(segment_text(study_text)).mirror_terms:
        raise UserError(
            "Disturbances that deform mirrors after M1 belong to the workflow segment-disturbance: here "
            "M2 deforms to correct; leave its figures out."
        )
    control = imaged_bench_of(study_text)
    return replace(control, correction=_correction(control))


@prepared(maxsize=2)
def imaged_bench_of(study_text: str) -> ControlBench:
    """Prepare the same without a correction by M2's deformations."""
    study = study_from_identity(TelescopeExposureStudy, study_text)
    bench = bench_of(segment_text(study_text))
    system, old = bench.system, bench.prepared
    if len(system.after_primary) < 2 or system.after_primary[0].action != "reflect":
        raise UserError(f"the telescope {system.name} has no mirror M2 that could correct its image")
    terms = max(study.figure_terms, bench.mirror_terms)
    prepared = prepare(
        system,
        old.rays,
        old.wavelength,
        study.wavefront.zernike_terms,
        figure_terms=bench.figure_terms,
        mirror_terms=terms,
    )
    # Edges that the beam clears are not looked at.
    train = replace(prepared.train, semi_diameters=old.train.semi_diameters)
    prepared = at_field(replace(prepared, train=train), bench.field)
    bench = replace(bench, prepared=prepared, mirror_terms=terms)
    rays = prepared.rays
    basis = ray_basis(
        rays.x,
        rays.y,
        prepared.weight,
        CANVAS * study.imaging.pixels,
        study.imaging.sampling,
        2.0 * system.annulus.outer,
    )
    basis = replace(basis, peak=basis.peak * bench.stopped.light)
    still = rest_states(bench.prepared.system, TILE)
    traced, static = trace(bench.prepared, still, choose_device("numpy"))
    none = np.zeros((0, 0))
    control = ControlBench(study, bench, static, none, basis, none, none, _area(study, bench))
    if lost := bench.stopped.otherwise:
        raise UserError(
            f"{lost} rays of {system.name} at rest are lost, so that its image would have holes; check "
            "telescope and optics.field_arcmin"
        )
    opd, focus = measured_opd(control, traced), control.prepared.fit.basis[:, 3]
    image = local_images(control, opd, static)[0]
    defocused = local_images(control, opd + np.resize(FOCUS, TILE)[:, None] * focus, static)[: len(FOCUS)]
    return replace(control, static_image=image, static_focus=defocused)


def trace(prepared: PreparedTrace, states: States, device: Device) -> tuple[Traced, Wavefront]:
    """Trace a batch of instants and measure its wavefronts."""
    traced = trace_states(prepared, states, device)
    return traced, analyse(prepared, traced, chief_rays(prepared, states), device)


def controlled(control: ControlBench, controller: str, states: States, measured: Wavefront) -> States:
    """Return the disturbed states (batch) with the motion of M2 that a controller adds.

    ``measured`` is the wavefront of the disturbed telescope, whose aberrations are supposed to be known
    without delay and error.
    """
    if controller == STATIC:
        moved = ("segment_motion", "segment_figure", "surface_motion", "line_of_sight")
        return replace(states, **{name: np.zeros_like(getattr(states, name)) for name in moved})
    if controller == RIGID:
        motion = states.surface_motion.copy()
        motion[:, M2, 3:5] += rigid_tilt(control, measured)
        return replace(states, surface_motion=motion)
    if controller == ELASTIC:
        forms = list(states.deformations)
        figure = np.array(forms[M2])
        figure[:, 1 : control.study.figure_terms] += elastic_figure(control, measured)
        forms[M2] = figure
        return replace(states, deformations=tuple(forms))
    return states


def rigid_tilt(control: ControlBench, measured: Wavefront) -> Array:
    """Return the tilts (batch, 2) of M2 in rad that bring the line of sight back (Störkle 2018, Eq. 4.25)."""
    sky = (measured.los - control.static.los[0]) / control.prepared.focal_length
    return np.asarray(-sky @ control.bench.m2_tilt.T)


def elastic_figure(control: ControlBench, measured: Wavefront) -> Array:
    """Return the figures (batch, F - 1) of M2, Noll 2..F in mm, that flatten the wavefront (Eq. 4.27)."""
    tilt = (measured.los - control.static.los[0]) * control.tilt_per_mm
    change = np.hstack([tilt, measured.zernike[:, 3:] - control.static.zernike[0, 3:]])
    # One product per instant: its bits do not depend on the batch.
    figure: Array = (control.correction @ change[..., None])[..., 0]
    return figure


def figure_gains(control: ControlBench) -> Array:
    """Return how line of sight (as tilt) and Noll 4..J follow M2's figure, (J - 1, F - 1), waves per mm.

    The line of sight stands for the tilt: rows c_2 and c_3 nearly vanish, as the chief ray follows the tilt.
    Central differences of ray traces (Störkle 2018, Eq. 4.26), in NumPy as all that a study prepares.

    Raises
    ------
    UserError
        If steps of h and 2 h do not agree.
    """
    prepared, terms = control.prepared, control.study.figure_terms
    steps = _STEP * np.eye(terms)[1:]
    figures = np.concatenate([factor * steps for factor in SIGNS])
    states = rest_states(prepared.system, padded(len(figures)))
    bent = states.deformations[M2]
    assert bent is not None
    bent[: len(figures), :terms] = figures
    found = trace(prepared, states, choose_device("numpy"))[1]
    values = np.hstack([found.los * control.tilt_per_mm, found.zernike[:, 3:]])[: len(figures)]
    gains = checked_derivative(
        values.reshape(4, terms - 1, -1), _STEP, "M2's figure", "use more rays or fewer exposure.figure_terms"
    )
    return np.ascontiguousarray(gains.T)


def _correction(control: ControlBench) -> Array:
    """Return minus the pseudo-inverse of `figure_gains`."""
    gains = figure_gains(control)
    if not np.linalg.cond(gains) < _CONDITION:
        raise UserError(
            f"the deformations of M2 by {control.study.figure_terms} terms act nearly alike on the "
            "wavefront, so that they are not determined; use fewer exposure.figure_terms"
        )
    return np.asarray(-np.linalg.pinv(gains), dtype=np.float64)


def position(control: ControlBench, wavefront: Wavefront) -> Array:
    """Return the line of sight (batch, 2) relative to rest in lambda/D."""
    per_mm = control.diameter / (control.prepared.wavelength * control.prepared.focal_length)
    return np.asarray((wavefront.los - control.static.los[0]) * per_mm)


def local_images(control: ControlBench, opd: Array, wavefront: Wavefront) -> Array:
    """Return images (batch, n, n), each about its own line of sight, from OPDs (batch, N) in waves.

    Where that is NaN a ray is dark.
    """
    size = control.basis.pixels
    phase = ray_phase(control, opd, wavefront, wavefront.los)
    images = images_of_rays(control.basis, phase, wavefront.device)
    return np.asarray(images, dtype=np.float64).reshape(-1, size, size)


def ray_phase(control: ControlBench, opd: Array, wavefront: Wavefront, about: Array) -> Array:
    """Return the phases (batch, N) in waves of images about a place (batch or 1, 2), mm in the image."""
    rays, prepared = control.prepared.rays, control.prepared
    # A phase that grows along +x moves the image to +x; the OPD of a positive line of sight falls along +x.
    slopes = (wavefront.chief - about) / (prepared.wavelength * prepared.focal_length)
    return np.asarray(slopes[:, :1] * rays.x + slopes[:, 1:] * rays.y - opd)


def measured_opd(control: ControlBench, traced: Traced) -> Array:
    """Return the OPDs (batch, N) of the rays about the chief ray in waves."""
    return np.asarray(from_tiles(traced.opd) / control.prepared.wavelength)


def fitted_opd(control: ControlBench, wavefront: Wavefront, measured: Array) -> Array:
    """Return the OPDs (batch, N) that the fitted Zernike polynomials describe, of rays that were measured."""
    fitted = np.asarray(wavefront.zernike[:, None, :] @ control.prepared.fit.basis.T)[:, 0]
    fitted[np.isnan(measured)] = np.nan
    return fitted


def _area(study: TelescopeExposureStudy, bench: Bench) -> float:
    """Return the area (mm²) of the pupil that the rays stand for whose light arrives at rest."""
    if study.optics.sampling == "segments" and not monolithic(bench.system):
        return float(energy_scale(bench)["area"])
    system = bench.system
    share = len(bench.prepared.weight) / study.optics.rays
    return float(np.pi * (system.annulus.outer**2 - system.annulus.inner**2) * share * bench.stopped.light)
