"""Segmented telescopes: a segmented (or monolithic) primary mirror followed by mirrors and lenses."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from math import hypot, isfinite

import numpy as np
from numpy.typing import NDArray

from wavequake.errors import UserError
from wavequake.kernels.trace.surfaces import conic_path, conic_sag
from wavequake.optics.media.glasses import AIR, Medium, refractive_index
from wavequake.optics.segments.layout import Segments
from wavequake.optics.shapes.polygons import distance_from_origin
from wavequake.optics.shapes.shapes import Conic, EvenAsphere, Opening, Shape, ZernikeDeformation
from wavequake.optics.systems.system import OpticalSystem, Pupil, Surface, wavelength_of, with_surface

Array = NDArray[np.float64]

M2 = 2
"""Index of the first surface after M1: the stop and M1 stand before it."""

_AXIS = np.array([0.0, 0.0, 1.0])
_NEWTON_STEPS = 20


def segmented_telescope(
    name: str,
    segments: Segments,
    radius: float,
    conic: float,
    surfaces: Iterable[Surface],
    stop_z: float,
    inner: float,
    outer: float,
    note: str = "",
) -> OpticalSystem:
    """Return a telescope whose primary mirror M1 carries segments; lengths in mm.

    Parameters
    ----------
    name : str
    segments : Segments
        The glass of M1.
    radius, conic : float
        Of the parent surface of M1, whose vertex is the origin.
    surfaces : iterable of Surface
        M2, M3, ... and last the image plane, in the optics frame of M1 (z along the incoming light).
    stop_z : float
        The plane in which rays start, that of M1's rim.
    inner, outer : float
        Radii of the annulus that normalizes the Zernike polynomials.
    note : str
        Which of its numbers are assumed or approximate.
    """
    stop = Surface("stop", position=np.array([0.0, 0.0, stop_z]), opening=Opening(outer, inner))
    primary = Surface("M1", Conic(radius, conic), action="reflect", segments=segments)
    pupil = Pupil("entrance_diameter", 2.0 * outer, inner / outer)
    return OpticalSystem(name, (stop, primary, *surfaces), 0, pupil, note=note)


def with_segments(system: OpticalSystem, segments: Segments) -> OpticalSystem:
    """Return the system with other segments."""
    return with_surface(system, M2 - 1, replace(system.primary, segments=segments))


def refractive_indices(system: OpticalSystem) -> Array:
    """Return the index behind each surface after M1 that refracts, shape (L,); NaN for the others.

    Raises
    ------
    UserError
        If a glass has no index at the wavelength.
    """
    wavelength = wavelength_of(system)
    index = [
        refractive_index(one.medium, wavelength) if one.action == "refract" else np.nan  # type: ignore[arg-type]
        for one in system.after_primary
    ]
    return np.array(index)


@dataclass(frozen=True)
class Row:
    """A line of a prescription: where the next surface stands and what it is.

    ``distance`` is the way of the light from the previous surface, mm. ``tilt`` turns a mirror about its y
    axis, rad; what follows turns by twice as much, so that it stands on the folded beam (a lens turns alone).
    ``radius`` is infinite for a plane and positive if the center of curvature lies on the surface's +z side;
    ``even`` are coefficients of rho^2, rho^4, ... in mm^-1, mm^-3, ... that add to the conic. Light beyond
    ``semi_diameter`` (mm, from the vertex in the surface's x and y) is vignetted. A surface with ``glass``
    refracts light into it, the image plane does nothing, all others reflect. Surfaces of one ``body`` can
    move together.
    """

    name: str
    radius: float
    conic: float
    distance: float
    tilt: float = 0.0
    semi_diameter: float = float("inf")
    even: tuple[float, ...] = ()
    glass: Medium | None = None
    body: str = ""


@dataclass(frozen=True)
class FirstOrder:
    """Paraxial properties of a system, and the numerical aperture of its real marginal ray.

    Attributes
    ----------
    focal_length : float
        mm; an angle on the sky times it is a length in the image.
    back_focus : float
        From the last mirror's or lens' vertex to the paraxial focus, mm along the light.
    defocus : float
        From the paraxial focus to the image plane, mm along the light.
    exit_pupil_distance : float
        From the paraxial image of the stop plane to the image plane, mm along the light; negative where it
        lies behind the image, and infinite.
    numerical_aperture : float
        Sine of the angle between the chief ray and the real ray from the pupil's outer rim.
    """

    focal_length: float
    back_focus: float
    defocus: float
    exit_pupil_distance: float
    numerical_aperture: float


def semi_diameters(surfaces: Iterable[Surface]) -> Array:
    """Return how far from its vertex each surface takes light, mm; infinite without an edge."""
    return np.array([np.inf if one.opening is None else one.opening.outer for one in surfaces])


def sequential_surfaces(rows: Iterable[Row]) -> tuple[Surface, ...]:
    """Place the surfaces after M1 one by one along the beam; the last one is the image plane.

    The light meets M2 against the z axis of M1 and turns round at each mirror, not at lenses. Surfaces keep
    the z axis of the incoming light, folds apart, as in Table 4.2 of Störkle 2018.
    """
    prescription = list(rows)
    surfaces = []
    position, frame, sense = np.zeros(3), np.eye(3), -1.0
    for row in prescription:
        position = position + sense * row.distance * frame[:, 2]
        half_turn = _about_y(row.tilt)
        rotation = frame @ half_turn
        surfaces.append(
            Surface(
                row.name,
                EvenAsphere(row.radius, row.conic, row.even) if row.even else Conic(row.radius, row.conic),
                position,
                rotation,
                "refract" if row.glass else "pass" if row is prescription[-1] else "reflect",
                row.glass or AIR,
                Opening(row.semi_diameter) if isfinite(row.semi_diameter) else None,
                body=row.body,
            )
        )
        if row.glass is None:
            frame, sense = rotation @ half_turn, -sense
    return tuple(surfaces)


def around_its_glass(
    name: str, segments: Segments, radius: float, conic: float, rows: Iterable[Row], note: str = ""
) -> OpticalSystem:
    """Assemble a telescope whose pupil is the annulus about its glass; the stop lies in its rim's plane."""
    inner = float(distance_from_origin(segments.corners).min())
    outer = max(hypot(x, y) for x, y in segments.corners.reshape(-1, 2))
    stop_z = float(conic_sag(outer, 0.0, 1.0 / radius, conic))
    return segmented_telescope(
        name, segments, radius, conic, sequential_surfaces(rows), stop_z, inner, outer, note
    )


def _about_y(angle: float) -> Array:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])


def surface_transforms(system: OpticalSystem) -> Array:
    """Return the transforms (L, 12) from each surface's frame to the next in the reference configuration.

    A point p of the previous frame (first: the optics frame of M1) has the coordinates ``A p + o``: nine
    entries of ``A = R_i^T R_(i-1)`` by rows, then ``o = R_i^T (p_(i-1) - p_i)``.
    """
    transforms = []
    position, rotation = np.zeros(3), np.eye(3)
    for surface in system.after_primary:
        inverse = surface.rotation.T
        shift = inverse @ (position - surface.position)
        transforms.append(np.concatenate([(inverse @ rotation).ravel(), shift]))
        position, rotation = surface.position, surface.rotation
    return np.array(transforms)


@np.errstate(invalid="ignore", over="ignore", divide="ignore")
def first_order(system: OpticalSystem) -> FirstOrder:
    """Trace a system paraxially from the stop plane to the image, and its marginal ray really.

    The paraxial trace follows the vertex ray, so folds by plane mirrors do not matter; the power of a curved
    mirror is taken as if it stood upright. Its slopes are times the refractive index.

    Raises
    ------
    UserError
        If the system has no focus, its exit pupil lies in the image, or the marginal ray misses a surface or
        is totally reflected.
    """
    matrix = np.eye(2)
    distance = 0.0
    for distance, power in _unfolded(system):
        matrix = np.array([[1.0, 0.0], [-power, 1.0]]) @ np.array([[1.0, distance], [0.0, 1.0]]) @ matrix
    (height, stop_height), (slope, stop_slope) = matrix
    infinite = 1e9 * abs(system.primary.shape.radius)  # rounding leaves nothing exactly at infinity
    if abs(slope) * infinite < 1.0:
        raise UserError(f"The telescope {system.name} is afocal; it must form an image.")
    pupil = stop_height / stop_slope if abs(stop_slope) * infinite > abs(stop_height) else np.inf
    if not pupil:
        raise UserError(
            f"The exit pupil of the telescope {system.name} lies in the image; it must be elsewhere."
        )
    defocus = height / slope
    return FirstOrder(
        focal_length=float(-1.0 / slope),
        back_focus=float(distance - defocus),
        defocus=float(defocus),
        exit_pupil_distance=float(pupil),
        numerical_aperture=_marginal_sine(system),
    )


def _unfolded(system: OpticalSystem) -> Iterator[tuple[float, float]]:
    """Yield the way to each surface from its predecessor over its index, and the power of the surface.

    The first way is that from the stop plane to M1.
    """
    yield -system.stop_z, -2.0 / system.primary.shape.radius
    position, direction, before = np.zeros(3), -_AXIS, 1.0
    for surface, index in zip(system.after_primary, refractive_indices(system), strict=True):
        normal = surface.rotation[:, 2]
        way = float(direction @ (surface.position - position)) / before
        shape = surface.shape
        bend = (1.0 / shape.radius + shape.added_curvature()) * float(np.sign(direction @ normal))
        if surface.action == "reflect":
            yield way, -2.0 * before * bend
            direction = direction - 2.0 * (direction @ normal) * normal
        elif surface.action == "pass":
            yield way, 0.0
        else:
            yield way, (index - before) * bend
            before = float(index)
        position = surface.position


def _marginal_sine(system: OpticalSystem) -> float:
    """Return the sine of the angle between the real rays of the pupil's rim and center at the image."""
    marginal, chief = (_final_direction(system, y) for y in (system.annulus.outer, 0.0))
    if not np.isfinite(marginal).all():
        raise UserError(
            f"The ray at the outer pupil radius of {system.annulus.outer:g} mm misses a surface "
            f"of {system.name}, or is totally reflected there; surfaces must reach out to it."
        )
    return float(np.linalg.norm(np.cross(marginal, chief)))


def _final_direction(system: OpticalSystem, y: float) -> Array:
    """Return the direction at the image of the axial ray at height y; NaN if it misses a surface."""
    *_, (_, direction) = _axial_rays(system, np.array([[0.0], [y], [system.stop_z]]))
    return direction[:, 0]


def rim_aberration(system: OpticalSystem) -> float:
    """Return how far apart the axial rays of the pupil's rim and center meet the image plane, mm."""
    start = np.array([[0.0, 0.0], [system.annulus.outer, 0.0], [system.stop_z, system.stop_z]])
    *_, (hit, direction) = _axial_rays(system, start)
    *others, image = system.after_primary
    point = others[-1].position[:, None] + others[-1].rotation @ hit if others else hit
    normal = image.rotation[:, 2]
    way = normal @ (image.position[:, None] - point) / (normal @ direction)
    ends = point + way * direction
    return float(np.linalg.norm(ends[:, 0] - ends[:, 1]))


def _axial_rays(system: OpticalSystem, position: Array) -> Iterator[tuple[Array, Array]]:
    """Yield where axial rays (3, n) meet M1 and all after it but the image, and their directions then.

    Points are in the frame of the surface, directions in that of the optics.
    """
    direction = np.broadcast_to(_AXIS[:, None], position.shape)
    before = 1.0
    surfaces = (system.primary, *system.after_primary[:-1])
    for surface, index in zip(surfaces, (np.nan, *refractive_indices(system)[:-1]), strict=True):
        frame = surface.rotation
        local, along = frame.T @ (position - surface.position[:, None]), frame.T @ direction
        hit, slope_x, slope_y = _met(surface.shape, local, along)
        normal = np.stack([-slope_x, -slope_y, np.ones_like(slope_x)])
        square, incident = np.sum(normal**2, axis=0), np.sum(along * normal, axis=0)
        if surface.action == "reflect":
            along = along - 2.0 * incident / square * normal
        else:
            tangent = before / index * (along - incident / square * normal)
            kept = np.sqrt((1.0 - np.sum(tangent**2, axis=0)) / square)  # NaN: total reflection
            along, before = tangent + np.copysign(kept, incident) * normal, index
        position, direction = surface.position[:, None] + frame @ hit, frame @ along
        yield hit, direction


def _met(shape: Shape, position: Array, direction: Array) -> tuple[Array, Array, Array]:
    """Return where rays (3, ...) meet a surface in its frame, and its slopes there; NaN for a miss."""
    hit = position + conic_path(position, direction, 1.0 / shape.radius, shape.conic) * direction
    for _ in range(_NEWTON_STEPS * (not isinstance(shape, Conic))):
        sag, slope_x, slope_y = shape.sag(hit[0], hit[1])
        rise = direction[2] - slope_x * direction[0] - slope_y * direction[1]
        hit = hit + (sag - hit[2]) / rise * direction
    return hit, *shape.sag(hit[0], hit[1])[1:]


@np.errstate(invalid="ignore", over="ignore", divide="ignore")
def footprints(system: OpticalSystem) -> Array:
    """Return the radii (L - 1,) of the axial beam on the surfaces between M1 and image, from each vertex, mm.

    That is where the light of the rim of the pupil arrives; on a fold, its farthest point. NaN where that
    light misses a surface.
    """
    azimuth = 2.0 * np.pi * np.arange(64) / 64
    rim = system.annulus.outer
    start = np.stack([rim * np.cos(azimuth), rim * np.sin(azimuth), np.full(64, system.stop_z)])
    return np.array([np.hypot(hit[0], hit[1]).max() for hit, _ in _axial_rays(system, start)][1:])


def with_figures(system: OpticalSystem, segment_terms: int, mirror_terms: int) -> OpticalSystem:
    """Return the system whose segments, and whose mirrors after M1 over their footprints, can deform."""
    segments = replace(system.segments, figure_terms=segment_terms)
    stop, primary, *others, image = system.surfaces
    radii = footprints(system) if mirror_terms else np.zeros(len(others))
    forms = [ZernikeDeformation(mirror_terms, float(radius)) if mirror_terms else None for radius in radii]
    bent = [replace(one, deformation=form) for one, form in zip(others, forms, strict=True)]
    return replace(system, surfaces=(stop, replace(primary, segments=segments), *bent, image))
