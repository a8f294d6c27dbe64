"""First-order optics of any sequential system: focal length, principal planes, pupils, magnification.

A paraxial ray (height y, reduced slope n u) follows the axis ray, which enters along the z axis through the
origin and goes on through every surface as if it met it at its vertex, where it is reflected and refracted;
what it turns is straightened, and the power of a surface that is tilted or slightly decentered counts as if
it stood upright and centered.
Distances count along the light: a mirror does not change their sign.
"""

from dataclasses import dataclass
from math import inf, isfinite, pi, tan

import numpy as np
from numpy.typing import NDArray

from wavequake.errors import UserError
from wavequake.optics.systems.axis_ray import AxisStep, first_vertex_z, follow_axis, off_axis
from wavequake.optics.systems.once import once_per_system
from wavequake.optics.systems.system import OpticalSystem, require_system, wavelength_of

Array = NDArray[np.float64]

_INFINITE = 1e12  # what lies further away than so many times the system's size is at infinity


@dataclass(frozen=True)
class Paraxial:
    """First-order data of a system at one wavelength; lengths in mm.

    Attributes
    ----------
    focal_length : float
        In the image space, reduced: an angle on the sky times it is a length in the image; positive for a
        system that collects light, infinite for an afocal one.
    back_focus : float
        From the last surface before the image to the rear focus, along the light.
    front_focus : float
        From the first surface to the front focus, along the light.
    front_principal, rear_principal : float
        From the first surface to the front principal plane, from the last before the image to the rear one.
    image_distance : float
        From the last surface before the image to the paraxial image of the object.
    defocus : float
        From the paraxial image to the image surface.
    magnification : float
        Of a finite object; 0 for one at infinity.
    entrance_pupil : float
        From the first surface to the entrance pupil.
    entrance_pupil_diameter : float
    exit_pupil : float
        From the image surface to the exit pupil; negative where it lies before the image.
    exit_pupil_diameter : float
    stop_radius : float
        Height of the marginal ray at the stop.
    object_na, image_na : float
        The marginal ray's n u, which is n times the sine of the real one where the sine condition holds.
    f_number : float
        1 / (2 NA) in the image space.
    lagrange : float
        n (y_chief u_marginal - y_marginal u_chief) of the largest field (Lagrange invariant); NaN from 90
        degrees on.
    pupil_magnification : float
        Entrance pupil over stop, negative where it is upside down.
    """

    focal_length: float
    back_focus: float
    front_focus: float
    front_principal: float
    rear_principal: float
    image_distance: float
    defocus: float
    magnification: float
    entrance_pupil: float
    entrance_pupil_diameter: float
    exit_pupil: float
    exit_pupil_diameter: float
    stop_radius: float
    object_na: float
    image_na: float
    f_number: float
    lagrange: float
    pupil_magnification: float


@once_per_system
def paraxial(system: OpticalSystem, wavelength: float | None = None) -> Paraxial:
    """Return the first-order data of a system (Störkle 2018, sections 3.3.1 and 3.3.2).

    Parameters
    ----------
    system : OpticalSystem
    wavelength : float
        mm; the primary one by default, at which the pupil is specified. Light of another wavelength fills the
        stop that this makes.

    Raises
    ------
    UserError
        If a number of the system is out of range, a surface with power is not centered on the axis ray, a
        wavelength is out of a glass' range, or the pupil cannot be as wide as it is specified.
    """
    require_system(system)
    steps = list(follow_axis(system, wavelength_of(system, wavelength)))
    size = sum(abs(step.way) for step in steps) + 1.0
    whole = _matrix(steps)
    to_stop = _matrix(steps[: system.stop + 1], last_power=False)
    from_stop = whole @ np.linalg.inv(to_stop)
    n, n_image = steps[0].index, steps[-1].index
    lens = _from_first_to_last(steps)
    power = -lens[1, 0]

    def ratio(numerator: float, denominator: float) -> float:
        """Return a distance, infinite where rounding alone makes it finite."""
        with np.errstate(over="ignore"):
            if denominator == 0.0 or abs(numerator) > _INFINITE * size * abs(denominator):
                return inf
        return float(numerator / denominator)

    focal = ratio(1.0, power)
    # The ray from the point of the axis that lies L behind the first surface is (y, n u) = (-L / n, 1) there.
    entrance = ratio(n * to_stop[0, 1], to_stop[0, 0])
    pupil_scale = float(1.0 / to_stop[0, 0]) if isfinite(entrance) else inf
    distance = -way_from_object(system)
    marginal = np.array([1.0, 0.0]) if distance == -inf else np.array([-distance / n, 1.0])
    at_last, at_image = lens @ marginal, whole @ marginal
    if wavelength is None or wavelength == wavelength_of(system):
        scale = _scale(system, marginal, at_image, to_stop, n, n_image, entrance, focal)
    else:  # the stop is one opening for light of all colors
        scale = paraxial(system).stop_radius / abs(_height_at_stop(system, to_stop, marginal))
    marginal, at_last, at_image = scale * marginal, scale * at_last, scale * at_image
    image_distance = ratio(-n_image * at_last[0], at_last[1])
    exit_pupil = ratio(-n_image * from_stop[0, 1], from_stop[1, 1])
    chief = _chief(system, to_stop, n)
    last_way = steps[-1].way
    stop_radius = abs(float((to_stop @ marginal)[0]))
    return Paraxial(
        focal_length=focal,
        back_focus=ratio(n_image * lens[0, 0], power),
        front_focus=ratio(-n * lens[1, 1], power),
        front_principal=ratio(n * (1.0 - lens[1, 1]), power),
        rear_principal=ratio(-n_image * (1.0 - lens[0, 0]), power),
        image_distance=image_distance,
        defocus=last_way - image_distance,
        magnification=_magnification(system, lens, distance, image_distance, n, n_image),
        entrance_pupil=entrance,
        entrance_pupil_diameter=2.0 * stop_radius * abs(pupil_scale),
        exit_pupil=exit_pupil,
        exit_pupil_diameter=float(2.0 * stop_radius / abs(from_stop[1, 1])) if isfinite(exit_pupil) else inf,
        stop_radius=stop_radius,
        object_na=abs(float(marginal[1])),
        image_na=abs(float(at_image[1])),
        f_number=ratio(0.5, abs(at_image[1])),
        lagrange=float(chief[0] * marginal[1] - chief[1] * marginal[0]),
        pupil_magnification=pupil_scale,
    )


def oblique_surfaces(system: OpticalSystem, least: float) -> list[tuple[str, float]]:
    """Return which surfaces with power the axis ray meets at more than an angle, and at which (rad).

    Light is focused there by another power in the plane of incidence than across it, which first-order data
    do not know.
    """
    steps = follow_axis(system, wavelength_of(system))
    pairs = zip(system.surfaces, steps, strict=True)
    return [(one.name, step.incidence) for one, step in pairs if step.power and step.incidence > least]


def entrance_pupil_center(system: OpticalSystem, wavelength: float | None = None) -> Array:
    """Return the center of the entrance pupil in the system's frame; z is infinite for one at infinity.

    A stop that is not centered on the axis ray has an entrance pupil that is not, either.
    """
    data = paraxial(system, wavelength)
    if not isfinite(data.entrance_pupil):
        return np.array([0.0, 0.0, inf])
    first = first_vertex_z(system)
    return np.array(
        [*(off_axis(system)[system.stop] * data.pupil_magnification), first + data.entrance_pupil]
    )


def way_from_object(system: OpticalSystem) -> float:
    """Return the way of the axis ray from the object to the vertex plane of the first surface.

    It is the object's distance, unless that surface is both tilted and beside the axis.
    """
    return first_vertex_z(system) - float(system.surfaces[0].position[2]) + system.object_distance


def vergence_before(system: OpticalSystem, number: int, wavelength: float) -> float:
    """Return the reciprocal distance of the object before a surface, as those before it image it, 1/mm.

    Along the light: positive for one that light comes from, 0 at infinity or where it lies in the surface.
    """
    steps = list(follow_axis(system, wavelength))
    distance = way_from_object(system)
    n = steps[0].index
    marginal = np.array([distance / n, 1.0]) if isfinite(distance) else np.array([1.0, 0.0])
    height, slope = _matrix(steps[: number + 1], last_power=False) @ marginal
    return float(slope / (height * steps[number].index)) if height else 0.0


def _matrix(steps: list[AxisStep], last_power: bool = True) -> Array:
    """Return the matrix from (y, n u) before the first surface to after the last one."""
    matrix = np.eye(2)
    for number, step in enumerate(steps):
        matrix = step.transfer @ matrix
        if last_power or number < len(steps) - 1:
            matrix = np.array([[1.0, 0.0], [-step.power, 1.0]]) @ matrix
    return matrix


def _from_first_to_last(steps: list[AxisStep]) -> Array:
    """Return the matrix from before the first surface to after the last one before the image."""
    return _matrix(steps[:-1]) if len(steps) > 1 else np.eye(2)


def _height_at_stop(system: OpticalSystem, to_stop: Array, marginal: Array) -> float:
    height = float((to_stop @ marginal)[0])
    if height == 0.0:
        raise UserError(
            f"the stop of {system.name} lies in an image of its object; it must limit the light's cone"
        )
    return height


def _scale(
    system: OpticalSystem,
    marginal: Array,
    at_image: Array,
    to_stop: Array,
    index: float,
    image_index: float,
    entrance: float,
    focal: float,
) -> float:
    """Return by what the marginal ray is multiplied so that the pupil is as wide as specified."""
    pupil, name = system.pupil, system.name
    at_stop = _height_at_stop(system, to_stop, marginal)
    if pupil.kind == "stop":
        return abs(pupil.value / at_stop)
    if pupil.kind == "entrance_diameter":
        if not isfinite(entrance):
            raise UserError(
                f"the entrance pupil of {name} lies at infinity and has no diameter; specify the pupil by "
                "its numerical aperture or by the radius of the stop"
            )
        with np.errstate(over="ignore"):
            radius = float(abs(pupil.value / 2.0 * to_stop[0, 0] / at_stop))
        if not isfinite(radius):
            raise UserError(f"the entrance pupil of {name} is seen as no stop of finite size")
        return radius
    if pupil.kind == "f_number":
        afocal = not (isfinite(focal) or isfinite(system.object_distance))
        if at_image[1] == 0.0 or afocal:
            raise UserError(
                f"light leaves {name} parallel, as an afocal system, and has no f-number; specify its "
                "entrance pupil"
            )
        return float(abs(0.5 / pupil.value / at_image[1]))
    if pupil.kind == "object_na":
        if not isfinite(system.object_distance):
            raise UserError(f"the object of {name} is at infinity and has no numerical aperture")
        return float(abs(_aperture(pupil.value, index, name) / marginal[1]))
    if pupil.kind == "image_na":
        if at_image[1] == 0.0:
            raise UserError(f"the image of {name} is at infinity and has no numerical aperture")
        return float(abs(_aperture(pupil.value, image_index, name) / at_image[1]))
    raise UserError(f"the pupil of {name} is specified by {pupil.kind!r}, which is unknown")


def _aperture(na: float, index: float, name: str) -> float:
    if na >= index:
        raise UserError(
            f"the numerical aperture of {name} is {na}; it must be less than the index {index:g} around it"
        )
    return na


def _magnification(
    system: OpticalSystem, lens: Array, distance: float, image_distance: float, n: float, n_image: float
) -> float:
    if not isfinite(distance):
        return 0.0
    if not isfinite(image_distance):
        return inf
    return float(lens[0, 0] + image_distance / n_image * lens[1, 0])


def _chief(system: OpticalSystem, to_stop: Array, index: float) -> Array:
    """Return the chief ray (y, n u) of the largest field at the first surface."""
    field = float(np.max(np.hypot(system.fields[:, 0], system.fields[:, 1])))
    if not isfinite(system.object_distance):
        if not field < pi / 2.0:
            return np.array([np.nan, np.nan])
        slope = index * tan(field)
        if to_stop[0, 0] == 0.0:
            return np.array([np.nan, slope])
        return np.array([-to_stop[0, 1] / to_stop[0, 0] * slope, slope])
    height, reach = field, way_from_object(system) / index
    # y_stop = A (h + reach s) + B s = 0
    forward = to_stop[0, 0] * reach + to_stop[0, 1]
    slope = -to_stop[0, 0] * height / forward
    return np.array([height + reach * slope, slope])
