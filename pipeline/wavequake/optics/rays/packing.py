"""From an optical system and its states to what the sequential trace takes."""

import sys
from dataclasses import replace
from math import cos, isfinite, sin

import numpy as np
from numpy.typing import NDArray

from wavequake.errors import UserError
from wavequake.kernels.device.devices import NUMPY, Device, require_device
from wavequake.kernels.trace.poses import surface_poses
from wavequake.kernels.trace.sequence import Element, Focus, Grid, Moving, Phase, Region, Sequence
from wavequake.optics.checks import all_within
from wavequake.optics.media.glasses import refractive_index
from wavequake.optics.media.gradients import gradient_of, medium_index
from wavequake.optics.shapes.basis import spline_coefficients, zernike_basis
from wavequake.optics.shapes.concave import crossing
from wavequake.optics.shapes.heights import centered_grid, require_grid
from wavequake.optics.shapes.phases import PerfectLens, phase_of
from wavequake.optics.shapes.polygons import edge_spans, signed_areas
from wavequake.optics.shapes.shapes import GridDeformation, Opening, ZernikeDeformation
from wavequake.optics.systems.axis_ray import senses
from wavequake.optics.systems.kinematics import relative_poses, require_motion, rest_poses
from wavequake.optics.systems.paraxial import entrance_pupil_center, vergence_before
from wavequake.optics.systems.system import (
    LARGEST,
    OpticalSystem,
    States,
    Surface,
    is_wide,
    require_system,
)
from wavequake.prepared import prepared

Array = NDArray[np.float64]

_MOST_STEPS = 5e4  # from one surface to the next; the trace ends at twice as many, as rays wind


def pack(system: OpticalSystem, wavelength_mm: float) -> Sequence:
    """Return the surfaces of a system as the trace sees them at one wavelength.

    Parameters
    ----------
    system : OpticalSystem
    wavelength_mm : float

    Raises
    ------
    UserError
        If a number of the system is out of range, or the wavelength out of a glass' range.
    """
    require_system(system)
    if system.segmented is not None:
        raise UserError(
            f"{system.primary.name} of {system.name} carries segments, which light meets one by one: "
            "`wavequake.trace` follows it, `parent_system` is the system with one mirror"
        )
    start = index = refractive_index(system.medium, wavelength_mm)
    elements = []
    for number, surface in enumerate(system.surfaces):
        gradient = None
        if surface.action == "refract":
            index = medium_index(surface.medium, wavelength_mm)
            gradient = gradient_of(surface.medium, wavelength_mm)
        try:
            if gradient is not None and number + 1 < len(system.surfaces):
                behind = system.surfaces[number + 1].position - surface.position
                _require_few_steps(gradient.step, float(np.linalg.norm(behind)))
            element = replace(_element(surface, index), gradient=gradient)
            if surface.phase is not None:
                element = replace(element, phase=_phase(system, number, wavelength_mm))
            elements.append(element)
        except UserError as error:
            raise UserError(f"the surface {surface.name} of {system.name}: {error}") from error
    if np.isinf(system.object_distance) and is_wide(system.fields):  # a ray's own z has no sense there
        pairs = zip(elements, senses(system, wavelength_mm), strict=True)
        elements = [replace(element, sense=1 if sense > 0.0 else -1) for element, sense in pairs]
    return Sequence(tuple(elements), start)


def _require_few_steps(step: float, way: float) -> None:
    """Raise UserError if a ray would take too many steps on its way through a gradient, mm."""
    if way > _MOST_STEPS * step:
        raise UserError(
            f"rays would take {way / step:.1g} steps of {step:.1g} mm through {way:.4g} mm of a medium whose "
            f"index changes so fast; {_MOST_STEPS:g} at most are traced"
        )


def _phase(system: OpticalSystem, number: int, wavelength: float) -> Phase | Focus:
    """Return what a surface adds to light; a perfect lens images the object with equal paths."""
    effect = system.surfaces[number].phase
    if isinstance(effect, PerfectLens):
        return Focus(1.0 / effect.focal_length, vergence_before(system, number, wavelength))
    assert effect is not None
    return phase_of(effect, wavelength)


def _element(surface: Surface, index: float) -> Element:
    shape, form = surface.shape, surface.deformation
    packed = shape.packed()
    zernike, radius = None, 1.0
    if isinstance(form, ZernikeDeformation):
        zernike, radius = zernike_basis(form.terms, form.obscuration), form.pupil_radius
    near = None if packed.form is None else packed.form.near
    return Element(
        curvature=1.0 / shape.radius if near is None else near,
        conic=shape.conic if near is None else -1.0,  # a paraboloid, of which no ray meets another half
        action=surface.action,
        index=index,
        even=packed.even,
        polynomial=packed.polynomial,
        grid=packed.grid,
        form=packed.form,
        deformation_degree=zernike.degree if zernike else -1,
        deformation_radius=radius,
        deformation_basis=zernike.basis if zernike else "monomial",
        deformation_grid=_deformation_grid(form.residual if isinstance(form, ZernikeDeformation) else form),
        regions=opening_regions(surface.opening) if surface.opening is not None else (),
    )


def _deformation_grid(form: GridDeformation | None) -> Grid | None:
    if form is None:
        return None
    return centered_grid(
        form.rows, form.columns, form.dx, form.dy, np.zeros((form.rows + 2, form.columns + 2))
    )


def opening_regions(opening: Opening) -> tuple[Region, ...]:
    """Return the regions whose intersection is an opening.

    A polygon replaces the outer circle; the inner circle, the dark polygon and the spider arms, which reach
    from the center outwards, block.

    Raises
    ------
    UserError
        If the corners do not go round a polygon once, counterclockwise, or it crosses itself, an arm has no
        width, or the center is not finite.
    """
    regions = []
    x, y = opening.center
    if not (abs(x) <= LARGEST and abs(y) <= LARGEST):
        raise UserError(
            f"the center of an opening is {opening.center}; it must be two numbers of at most {LARGEST:g} mm"
        )
    if opening.corners:
        corners = np.asarray(opening.corners, dtype=np.float64)
        regions.append(_polygon(corners, x, y))
    elif isfinite(opening.outer):
        regions.append(Region("circle", (x, y, opening.outer)))
    if opening.inner > 0.0:
        regions.append(Region("circle", (x, y, opening.inner), blocks=True))
    if opening.dark:
        regions.append(replace(_polygon(np.asarray(opening.dark, dtype=np.float64), x, y), blocks=True))
    for angle, width in opening.arms:
        if not (isfinite(angle) and isfinite(width) and width > 0.0):
            raise UserError(f"a spider arm has the angle {angle} rad and the width {width} mm")
        along_x, along_y, half = cos(angle), sin(angle), width / 2.0
        strip = (-along_y, along_x, half, along_y, -along_x, half, -along_x, -along_y, 0.0)
        regions.append(Region("polygon", _shifted(strip, x, y), blocks=True))
    return tuple(regions)


def _shifted(half_planes: tuple[float, ...], x: float, y: float) -> tuple[float, ...]:
    """Return half planes a x + b y <= c whose origin moves to (x, y)."""
    table = np.array(half_planes).reshape(-1, 3)
    table[:, 2] += table[:, 0] * x + table[:, 1] * y
    return tuple(table.ravel().tolist())


def _polygon(corners: Array, x: float, y: float) -> Region:
    """Return the region of a polygon whose origin moves to (x, y)."""
    if (
        corners.ndim != 2
        or corners.shape[1] != 2
        or len(corners) < 3
        or not (np.abs(corners) <= LARGEST).all()
    ):
        raise UserError(
            f"a polygonal opening needs at least 3 corners, pairs of numbers of at most {LARGEST:g} mm"
        )
    corners = corners[(np.roll(corners, -1, axis=0) != corners).any(axis=1)]  # none twice in a row
    edge = np.roll(corners, -1, axis=0) - corners
    following = np.roll(edge, -1, axis=0)
    turn = edge[:, 0] * following[:, 1] - edge[:, 1] * following[:, 0]
    around = np.sum(np.arctan2(turn, np.sum(edge * following, axis=1)))
    if not (signed_areas(corners[None])[0] > 0.0 and np.isclose(around, 2.0 * np.pi)):
        raise UserError("the corners of a polygonal opening must go round it once, counterclockwise")
    if (turn < 0.0).any():
        if crossing(corners[None])[0]:
            raise UserError("the corners of a polygonal opening must go round it once; its edges cross")
        spans = edge_spans(corners[None] + np.array([x, y]))
        return Region("outline", tuple(spans.ravel().tolist()))
    normal = np.stack([edge[:, 1], -edge[:, 0]], axis=1) / np.linalg.norm(edge, axis=1)[:, None]
    offset = np.sum(normal * corners, axis=1)
    half_planes = tuple(float(number) for number in np.column_stack([normal, offset]).ravel())
    return Region("polygon", _shifted(half_planes, x, y))


def moving(
    system: OpticalSystem, states: States, spheres: Array | None = None, device: Device = NUMPY
) -> Moving:
    """Return what changes from instant to instant as the trace takes it.

    The line of sight turns the whole incoming bundle, as a rigid body, about the center of the entrance
    pupil, so that the phase of its wavefront stays with it.

    Parameters
    ----------
    system : OpticalSystem
    states : States
        T instants.
    spheres : ndarray, shape (T, 4), or None
        Reference spheres in the image's frame, see `wavequake.kernels.trace.sequence.Moving`.
    device : Device
        Where to compute the poses.

    Raises
    ------
    UserError
        If the arrays of the states do not fit the system or are not finite, the device is none, or the line
        of sight moves and the entrance pupil is at infinity.
    """
    motion = states.surface_motion
    require_device(device)
    require_motion(system, motion)
    instants = len(motion)
    if len(states.deformations) != len(system.surfaces):
        raise UserError(
            f"the states hold {len(states.deformations)} deformations; the system {system.name} has "
            f"{len(system.surfaces)} surfaces"
        )
    if states.line_of_sight.shape != (instants, 2) or not np.isfinite(states.line_of_sight).all():
        raise UserError(f"the line of sight must be an array ({instants}, 2) of finite angles")
    forms = [
        _deformation(surface, coefficients, instants)
        for surface, coefficients in zip(system.surfaces, states.deformations, strict=True)
    ]
    return Moving(
        _poses(system, motion, states.line_of_sight, device),
        tuple(polynomial for polynomial, _ in forms),
        tuple(grid for _, grid in forms),
        spheres,
    )


def _deformation(
    surface: Surface, coefficients: Array | None, instants: int
) -> tuple[Array | None, Array | None]:
    """Return the coefficients of the polynomial and of the grid that deform a surface."""
    form = surface.deformation
    if form is None or coefficients is None:
        if coefficients is not None:
            raise UserError(f"the surface {surface.name} cannot deform, but the states deform it")
        if form is None:
            return None, None
        raise UserError(f"the surface {surface.name} can deform, but the states hold no coefficients for it")
    size = (form.size,) if isinstance(form, ZernikeDeformation) else (form.rows, form.columns)
    if coefficients.shape != (instants, *size):
        raise UserError(
            f"the deformation of {surface.name} has the shape {coefficients.shape}, it must be "
            f"{(instants, *size)}"
        )
    if isinstance(form, GridDeformation):
        require_grid(coefficients, form.dx, form.dy)
        return None, spline_coefficients(coefficients)
    if not all_within(coefficients, sys.float_info.max):
        raise UserError(f"the deformation of {surface.name} holds numbers that are not finite")
    grid, rest = None, form.residual
    if rest is not None:
        left = coefficients[:, form.terms :].reshape(instants, rest.rows, rest.columns)
        grid, coefficients = spline_coefficients(left), coefficients[:, : form.terms]
    matrix = zernike_basis(form.terms, form.obscuration).matrix
    return np.ascontiguousarray(coefficients @ matrix.T), grid


def _poses(system: OpticalSystem, motion: Array, line_of_sight: Array, device: Device) -> Array:
    """Return the transforms (T, L, 12) of `surface_poses`, with the incoming bundle turned."""
    position, rotation = rest_poses(system)
    found = surface_poses(*_steps_at_rest(position.tobytes(), rotation.tobytes()), motion, device)
    if line_of_sight.any():
        bundle, offset = bundle_rotation(system, line_of_sight)
        first = found[:, 0, :9].reshape(-1, 3, 3)
        found[:, 0, 9:] += (first @ offset[..., None])[..., 0]
        found[:, 0, :9] = (first @ bundle).reshape(-1, 9)
    return found


@prepared(maxsize=64)
def _steps_at_rest(position: bytes, rotation: bytes) -> tuple[Array, Array]:
    """Return `relative_poses`, which are asked for again with every batch of one system."""
    return relative_poses(np.frombuffer(position).reshape(-1, 3), np.frombuffer(rotation).reshape(-1, 3, 3))


def bundle_rotation(system: OpticalSystem, line_of_sight: Array) -> tuple[Array, Array]:
    """Return rotation (T, 3, 3) and shift (T, 3) of the incoming bundle in the system's frame.

    The axis turns to (tan a, tan b, 1) on the shortest way; the center of the entrance pupil stays.

    Raises
    ------
    UserError
        If the entrance pupil is at infinity.
    """
    center = entrance_pupil_center(system)
    if not np.isfinite(center).all():
        raise UserError(
            f"the entrance pupil of {system.name} is at infinity, so its line of sight cannot turn about it; "
            "move the surfaces instead"
        )
    slopes = np.tan(line_of_sight)
    length = np.sqrt(1.0 + np.sum(slopes**2, axis=1))
    x, y, z = slopes[:, 0] / length, slopes[:, 1] / length, 1.0 / length
    share = 1.0 / (1.0 + z)
    rotation = np.stack(
        [1.0 - share * x * x, -share * x * y, x, -share * x * y, 1.0 - share * y * y, y, -x, -y, z], axis=1
    ).reshape(-1, 3, 3)
    return rotation, center - rotation @ center
