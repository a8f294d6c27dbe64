"""Wavefronts of any optical system: OPD, Zernike coefficients, line of sight, spots.

In waves. The chief ray goes through the center of the stop, wherever that moves, and virtually where it is
obscured; it ends at the center of the reference sphere, whose radius is the paraxial exit pupil's distance.
Of rays that a GPU traced no more than these numbers come from it: `wavequake.kernels.device.resident`.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import compress

import numpy as np
from numpy.typing import NDArray

from wavequake.errors import UserError
from wavequake.kernels.device.devices import NUMPY, Device
from wavequake.kernels.sums.opd import count_status, path_differences, without_planes
from wavequake.kernels.sums.ray_sums import ray_moments
from wavequake.kernels.trace.sequence import Moving, Rays, Sequence, TracedRays
from wavequake.kernels.trace.sequential import launches_of, trace_sequence
from wavequake.kernels.trace.sequential_numpy import joined_moving, moving_part
from wavequake.kernels.trace.sequential_source import OUTPUTS
from wavequake.kernels.trace.status import VIGNETTED
from wavequake.optics.checks import alike, whole
from wavequake.optics.polynomials.zernike import MOST_TERMS
from wavequake.optics.rays.aiming import losses, pupil_rays
from wavequake.optics.rays.field_light import field_light
from wavequake.optics.rays.packing import moving, pack
from wavequake.optics.rays.pupils import pupil_amplitude
from wavequake.optics.rays.stop_following import follow_stop, stays, steering
from wavequake.optics.shapes.sag import shape_sag
from wavequake.optics.systems.image_aperture import image_cosines, image_index, require_flat_image
from wavequake.optics.systems.kinematics import rest_states
from wavequake.optics.systems.paraxial import paraxial
from wavequake.optics.systems.system import OpticalSystem, States, wavelength_of
from wavequake.optics.wavefronts.fits import MORE_RAYS, Fit, fit_instants, fit_with_plane, pupil_fit
from wavequake.optics.wavefronts.record import Wavefront, joined
from wavequake.optics.wavefronts.reference_sphere import sphere_radius
from wavequake.optics.wavefronts.slopes import (
    SystemSlopes,
    on_sphere,
    shifted_pupil,
    slope_coefficients,
    system_slopes,
)
from wavequake.optics.wavefronts.sphere_fit import sphere_basis_fit

Array = NDArray[np.float64]
Traced = tuple[Array, TracedRays, Array]  # see `trace_light`

_PLANE = 3  # terms, without which there is no line of sight


@dataclass(frozen=True, eq=False)
class PreparedSystem:
    """What a system, a field, a wavelength and the rays determine once for all instants.

    Attributes
    ----------
    system, sequence : OpticalSystem, Sequence
    rays, chief : Rays
        The N rays of the pupil, and the one through the center of the stop.
    pupil : ndarray, shape (N, 2)
        Where the rays pass the pupil, in units of its outer radius.
    fit : Fit
        Of the Noll Zernike polynomials, annular where the pupil is obscured.
    wavelength, sphere_radius : float
        mm; the radius is negative where the exit pupil lies behind the image.
    image_index : float
        Refractive index before the image.
    cosines : ndarray, shape (2, 2)
        Change of the direction cosines (u, v) in the image frame from the pupil's center to its rim, for x
        (first column) and y: the numerical aperture with its signs.
    field : int
        Index of the field point.
    steering : ndarray, shape (2, 2)
        How the light moves where the stop does, see `wavequake.optics.rays.stop_following`.
    status, surface : ndarray of int8, shape (N,)
        0 and -1, or why and where light ends that no ray brings to its point of the stop at rest; such a ray
        is NaN and lost at all instants.
    slopes : SystemSlopes, optional
        Takes the coefficients from image points and directions instead of path lengths.
    sphere : Fit, optional
        Its second and third coefficients are the best-fit sphere's image point times the aperture.
    amplitude : ndarray, shape (N,), optional
        Of the rays' light where the pupil is apodized; its square is in the weights of the fit.
    """

    system: OpticalSystem
    sequence: Sequence
    rays: Rays
    chief: Rays
    pupil: Array
    fit: Fit
    wavelength: float
    sphere_radius: float
    image_index: float
    cosines: Array
    field: int
    steering: Array
    status: NDArray[np.int8]
    surface: NDArray[np.int8]
    slopes: SystemSlopes | None = None
    sphere: Fit | None = None
    amplitude: Array | None = None


def prepare_system(
    system: OpticalSystem,
    x: Array,
    y: Array,
    weight: Array,
    terms: int,
    field: int = 0,
    wavelength: float | None = None,
) -> PreparedSystem:
    """Collect what does not change from instant to instant.

    Parameters
    ----------
    system : OpticalSystem
    x, y, weight : ndarray, shape (N,)
        Where the rays pass the pupil, in units of its outer radius, and the share of the pupil of each. It
        has that share of the light, times what an apodized pupil has of it there.
    terms : int
        Number of Noll Zernike polynomials: 3, for the line of sight, to 2016.
    field : int
        Index of the field point.
    wavelength : float, optional
        mm; the system's primary one by default.

    Raises
    ------
    UserError
        If the field does not exist, `pupil_fit` refuses the rays, the chief ray or all rays do not arrive at
        the stop, those about it do not at the image, or the rays arrive there parallel to each other.
    """
    x, y, weight = alike("the rays in the pupil and their weights", x, y, weight)
    first_order, wavelength = paraxial(system, wavelength), wavelength_of(system, wavelength)
    sequence = pack(system, wavelength)
    if not 0 <= whole(field, "the index of the field") < len(system.fields):
        raise UserError(f"{system.name} has {len(system.fields)} fields; there is no field {field}")
    if whole(terms, "the number of Zernike terms") < _PLANE:
        raise UserError(f"the number of Zernike terms is {terms}; it must be from {_PLANE} to {MOST_TERMS}")
    amplitude = pupil_amplitude(system, x, y)
    light = weight if amplitude is None else weight * amplitude**2
    try:
        fit = pupil_fit(x, y, light, terms, system.pupil.obscuration)
    except UserError as error:
        if amplitude is None:
            raise
        share = float(amplitude.min()) ** 2
        raise UserError(
            f"{error} The apodization of {system.name} leaves {share:.2g} of the light at the rim."
        ) from None
    point = system.fields[field]
    chief = pupil_rays(system, point, wavelength, np.zeros(1), np.zeros(1))
    cosines = image_cosines(system, sequence, point, wavelength)
    aimed = field_light(system, field, wavelength, x, y)
    if aimed.lost.all():
        raise UserError(
            f"no ray of {system.name} reaches its point of the stop: they are lost, "
            f"{losses(system, aimed.status, aimed.surface)}; make the pupil or the field smaller"
        )
    return PreparedSystem(
        system=system,
        sequence=sequence,
        rays=aimed.rays,
        chief=chief,
        pupil=np.stack([x, y], axis=1),
        fit=fit,
        wavelength=wavelength,
        sphere_radius=sphere_radius(-first_order.exit_pupil),
        image_index=image_index(sequence),
        cosines=cosines,
        field=field,
        steering=steering(system, sequence, chief),
        status=aimed.status,
        surface=aimed.surface,
        amplitude=amplitude,
    )


def with_slopes(prepared: PreparedSystem) -> PreparedSystem:
    """Return the same with coefficients from ray slopes (Störkle 2018, Eq. 4.13-4.20), not path lengths.

    Their piston is NaN. Line of sight and `Wavefront.rms` follow the coefficients; all else remains
    that of path lengths. Both methods agree to 4e-7 waves as far as the polynomials describe the wavefront.

    Raises
    ------
    UserError
        If the image is curved, or the rays that arrive do not determine the coefficients.
    """
    require_flat_image(prepared.system, "wavefront.method = 'slopes'")
    distance, points = _sphere_points(prepared, *shifted_pupil(prepared.pupil))
    slopes = system_slopes(
        prepared.pupil,
        points.reshape(2, len(prepared.pupil), -1),
        distance.reshape(len(prepared.pupil), -1)[:, 0],
        prepared.fit,
        prepared.sphere_radius,
        prepared.wavelength / prepared.image_index,
        prepared.system.pupil.obscuration,
    )
    return replace(prepared, slopes=slopes)


def with_fitted_sphere(prepared: PreparedSystem) -> PreparedSystem:
    """Return the same with OPDs about the sphere that fits the wavefront best (Störkle 2018, section 3.3.3).

    The line from the pupil's center to the sphere's replaces the chief ray: what was tilt is in its image
    point. `Wavefront.chief` remains where the chief ray arrives.

    Raises
    ------
    UserError
        If the image is curved, or the rays that arrive determine no sphere.
    """
    require_flat_image(prepared.system, "wavefront.reference = 'fitted'")
    _, points = _sphere_points(prepared, *prepared.pupil.T)
    rest = moving(prepared.system, rest_states(prepared.system))
    traced = trace_sequence(prepared.sequence, prepared.chief, rest, NUMPY, ignore_apertures=True)
    chief = np.concatenate([traced.u[0], traced.v[0]])
    known = np.isfinite(points[0])  # the others' OPDs are NaN, too
    toward = np.where(known[:, None], -points.T / prepared.sphere_radius, chief)
    weight = np.where(known, prepared.fit.weight, 0.0)
    return replace(prepared, sphere=sphere_basis_fit(toward, chief, _aperture(prepared), weight, MORE_RAYS))


def _aperture(prepared: PreparedSystem) -> float:
    """Return the sine of the largest angle between a ray of the rim and the chief ray, about."""
    return float(np.linalg.norm(prepared.cosines, 2))


def _sphere_points(prepared: PreparedSystem, x: Array, y: Array) -> tuple[Array, Array]:
    """Return where rays of the pupil meet the reference sphere at rest: distances (N,), x and y (2, N).

    Those that do not arrive are NaN.
    """
    system, rest = prepared.system, moving(prepared.system, rest_states(prepared.system))
    aimed = field_light(system, prepared.field, prepared.wavelength, x, y)
    traced = trace_sequence(prepared.sequence, aimed.rays, rest, NUMPY, ignore_apertures=True)
    points, distance = on_sphere(traced, chief_points(prepared, rest)[0], prepared.sphere_radius)
    return distance[0], points[:, 0]


def incoming_light(prepared: PreparedSystem, states: States, device: Device = NUMPY) -> Moving:
    """Return what moves, with light that fills the stop where it stands at each instant."""
    return incoming_lights(prepared, [states], [moving(prepared.system, states, device=device)])[0]


def incoming_lights(prepared: PreparedSystem, states: list[States], lights: list[Moving]) -> list[Moving]:
    """Return what moves in several cases (`moving`), each with light that fills the stop where it stands."""
    goes = [not stays(prepared.system, prepared.chief, one) for one in states]
    chosen = list(compress(lights, goes))
    if not chosen:
        return lights
    light, parts = joined_moving(chosen)
    followed = follow_stop(prepared.system, prepared.sequence, prepared.chief, prepared.steering, light)
    moved = iter(parts)
    return [moving_part(followed, next(moved)) if go else one for go, one in zip(goes, lights, strict=True)]


def chief_points(prepared: PreparedSystem, light: Moving) -> tuple[Array, Array]:
    """Return the image points (T, 2) of the chief ray and its paths (T,) to the reference sphere, mm."""
    traced = trace_sequence(prepared.sequence, prepared.chief, light, NUMPY, ignore_apertures=True)
    path = traced.path[:, 0] - prepared.image_index * prepared.sphere_radius
    return np.stack([traced.x[:, 0], traced.y[:, 0]], axis=1), path


def trace_system(prepared: PreparedSystem, states: States, device: Device) -> Traced:
    """Trace all rays at all instants; returns as `trace_light`."""
    return trace_light(prepared, incoming_light(prepared, states, device), device)


def trace_light(prepared: PreparedSystem, light: Moving, device: Device) -> Traced:
    """Trace all rays at all instants of what moves.

    Returns
    -------
    opd : ndarray, shape (T, N)
        Waves: the chief ray's path less the ray's, at the reference sphere; NaN for a lost ray.
    traced : TracedRays
    chief : ndarray, shape (T, 2)
        Image point of the chief ray, mm.
    """
    return next(trace_lights(prepared, [light], device))


def trace_lights(prepared: PreparedSystem, lights: list[Moving], device: Device) -> Iterator[Traced]:
    """Return for each of several cases what `trace_light` does, traced as it is asked for.

    Their chief rays are traced at once: the bits of a case do not depend on the others.
    """
    joined, parts = joined_moving(lights)
    chiefs, paths = chief_points(prepared, joined)
    cases = zip(lights, parts, strict=True)
    return (_about(prepared, light, chiefs[part], paths[part], device) for light, part in cases)


def _about(prepared: PreparedSystem, light: Moving, chief: Array, path: Array, device: Device) -> Traced:
    about = about_chief(prepared, light, chief)
    traced = trace_sequence(prepared.sequence, prepared.rays, about, device, outputs=_outputs(prepared))
    return path_differences(traced.path, path, prepared.wavelength), traced, chief


def about_chief(prepared: PreparedSystem, light: Moving, chief: Array) -> Moving:
    """Return what moves, with spheres about the chief ray's image points (T, 2); all are lost without it."""
    center = np.where(np.isfinite(chief), chief, 0.0)
    height, *_ = shape_sag(prepared.system.surfaces[-1].shape, center[:, :1], center[:, 1:])
    return replace(light, spheres=np.hstack([center, height, np.full_like(height, prepared.sphere_radius)]))


def _outputs(prepared: PreparedSystem) -> tuple[str, ...]:
    return OUTPUTS if prepared.slopes is not None else OUTPUTS[:3]  # directions take a tenth of the time


def measure_system(prepared: PreparedSystem, states: States, device: Device) -> Wavefront:
    """Trace a batch of instants and reduce it to its wavefronts, those of one launch at a time.

    Raises
    ------
    UserError
        If the states do not fit the system.
    """
    light = incoming_light(prepared, states, device)
    lights = [part for _, part in launches_of(prepared.rays, light, _outputs(prepared))]
    found = [analyse_system(prepared, *traced, device) for traced in trace_lights(prepared, lights, device)]
    return joined(found)


def line_of_sight(prepared: PreparedSystem, chief: Array, zernike: Array) -> Array:
    """Return the image point of the best-fit plane, shape (T, 2), mm (Störkle 2018, Eq. 3.39).

    A tilt that grows by W waves from the pupil's center to its rim moves the image by W wavelengths over the
    numerical aperture there; the signs of the aperture's direction cosines hold for folded and inverting
    systems. The tilt of an annular polynomial is steeper by 1 / sqrt(1 + eps^2) (see `los_eq339`).
    """
    slope = 2.0 / np.sqrt(1.0 + prepared.system.pupil.obscuration**2) * prepared.wavelength * zernike[:, 1:3]
    shift: Array = slope @ np.linalg.inv(prepared.cosines) / prepared.image_index
    return chief + shift


def analyse_system(
    prepared: PreparedSystem, opd: Array, traced: TracedRays, chief: Array, device: Device = NUMPY
) -> Wavefront:
    """Reduce what `trace_system` returns to the numbers of its wavefronts."""
    point, weight = chief, prepared.fit.weight
    if prepared.sphere is not None:
        tilt = fit_instants(prepared.sphere, opd, device)[:, 1:3]
        opd = without_planes(opd, np.ascontiguousarray(prepared.sphere.basis[:, 1:3].T), tilt)
        point = chief + tilt * (prepared.wavelength / prepared.image_index / _aperture(prepared))
    zernike, plane = fit_with_plane(prepared.fit, opd, device)
    slopes = np.ascontiguousarray(prepared.fit.basis[:, 1:3].T)
    found = ray_moments(opd, traced.x, traced.y, weight, slopes, plane, device)
    strehl = found.strehl
    if prepared.amplitude is not None:  # amplitudes add up in the image, not the light of each ray
        amount = weight / prepared.amplitude
        strehl = ray_moments(opd, traced.x, traced.y, amount, slopes, plane, device).strehl
    if prepared.slopes is not None:
        zernike = slope_coefficients(prepared.slopes, traced, chief)
    return Wavefront(
        zernike=zernike,
        rms_raw=found.rms_raw,
        rms_flat=found.rms_flat,
        pv=found.pv,
        chief=chief,
        los=line_of_sight(prepared, point, zernike),
        centroid=found.centroid,
        spot_rms=found.spot_rms,
        strehl=strehl,
        lost=weight.size - found.arrived,
        vignetted=count_status(traced.status, VIGNETTED) + np.count_nonzero(prepared.status == VIGNETTED),
        device=device,
    )
