"""Rays over the pupil: a sunflower, a grid, or an exact cubature of every segment; and their amplitude."""

from dataclasses import dataclass, replace
from math import ceil, isfinite, pi, sqrt

import numpy as np
from numpy.typing import NDArray

from wavequake.errors import UserError
from wavequake.optics.checks import number, whole
from wavequake.optics.media.glasses import refractive_index
from wavequake.optics.segments.layout import Segments, areas, candidates, is_monolithic
from wavequake.optics.shapes.concave import triangles
from wavequake.optics.shapes.polygons import centroids, concave
from wavequake.optics.systems.paraxial import paraxial
from wavequake.optics.systems.system import OpticalSystem, wavelength_of

Array = NDArray[np.float64]

# Symmetric Gauss rules on a triangle (Dunavant 1985), by number of points: each orbit is a weight and the
# barycentric coordinates whose distinct permutations are points. Their degrees are 1, 2, 4 and 6.
_ORBITS: dict[int, list[tuple[float, tuple[float, float, float]]]] = {
    1: [(1.0, (1 / 3, 1 / 3, 1 / 3))],
    3: [(1 / 3, (1 / 6, 1 / 6, 2 / 3))],
    6: [
        (0.2233815896780114657, (0.44594849091596488632, 0.44594849091596488632, 0.10810301816807022736)),
        (0.10995174365532186764, (0.09157621350977074346, 0.09157621350977074346, 0.81684757298045851308)),
    ],
    12: [
        (0.11678627572637936603, (0.24928674517091042129, 0.24928674517091042129, 0.50142650965817915742)),
        (0.050844906370206816921, (0.06308901449150222834, 0.06308901449150222834, 0.87382197101699554332)),
        (0.082851075618373575194, (0.053145049844816947353, 0.31035245103378440542, 0.63650249912139864723)),
    ],
}


_MOST_RAYS = 1_000_000_000


@dataclass(frozen=True)
class PupilRays:
    """Rays parallel to the axis.

    Attributes
    ----------
    x, y : ndarray, shape (N,)
        In the stop plane, mm; on the axis these are also the projected coordinates on M1.
    weight : ndarray, shape (N,)
        Share of the pupil that each ray stands for; the sum is 1.
    segment : ndarray of int64, shape (N,)
        The undisturbed segment that the ray meets; -1 for none, or not yet known.
    """

    x: Array
    y: Array
    weight: Array
    segment: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.x)


def sunflower(inner: float, outer: float, count: int) -> PupilRays:
    """Spread rays evenly over an annulus: equal areas, golden angle.

    Ray i has the radius ``sqrt(inner^2 + (i + 1/2) / count (outer^2 - inner^2))`` and the azimuth ``i pi (3 -
    sqrt(5))``.

    Parameters
    ----------
    inner, outer : float
        Radii, mm.
    count : int
        Number of rays.

    Returns
    -------
    PupilRays
        With equal weights; `on_glass` finds their segments.

    Raises
    ------
    UserError
        If the radii or the number do not make an annulus with rays, of which a billion is the most.
    """
    inner, outer = (number(one, "the radius of the pupil") for one in (inner, outer))
    if not (isfinite(outer) and 0.0 <= inner < outer):
        raise UserError(
            f"The pupil reaches from radius {inner:g} to {outer:g} mm; it needs 0 <= inner < outer."
        )
    if not 1 <= whole(count, "the number of rays") <= _MOST_RAYS:
        raise UserError(f"The number of rays is {count}; it must be from 1 to {_MOST_RAYS}.")
    index = np.arange(count)
    radius = np.sqrt(inner**2 + (index + 0.5) / count * (outer**2 - inner**2))
    azimuth = index * (pi * (3.0 - sqrt(5.0)))
    return _unassigned(radius * np.cos(azimuth), radius * np.sin(azimuth))


def grid_rays(outer: float, spacing: float) -> PupilRays:
    """Spread rays on a square grid over the radius `outer`, one at the center of every cell.

    Raises
    ------
    UserError
        If a length is not positive.
    """
    if not (isfinite(outer) and isfinite(spacing) and outer > 0.0 and spacing > 0.0):
        raise UserError(
            f"A grid of rays needs a positive radius and spacing, not {outer:g} and {spacing:g} mm."
        )
    half = ceil(outer / spacing)
    steps = (np.arange(-half, half) + 0.5) * spacing
    x, y = np.meshgrid(steps, steps)
    return _unassigned(x.ravel(), y.ravel())


def _unassigned(x: Array, y: Array) -> PupilRays:
    return PupilRays(x, y, np.full(len(x), 1.0 / len(x)), np.full(len(x), -1, dtype=np.int64))


def segment_rays(segments: Segments, points: int) -> PupilRays:
    """Spread rays over the glass of every segment so that integrals over the glass are sums over rays.

    Each polygon is a fan of triangles about its centroid (one that is not convex is cut into triangles
    without it) with a Gauss rule on each: a polynomial of degree 1,
    2, 4 or 6 in x and y is integrated exactly by 1, 3, 6 or 12 points per triangle.

    Parameters
    ----------
    segments : Segments
    points : {1, 3, 6, 12}
        Per triangle; a hexagon has six triangles.

    Returns
    -------
    PupilRays
        Those of one segment lie side by side; the weights are their shares of the projected area of glass.

    Raises
    ------
    UserError
        If there is no such rule, or the mirror has no segments.
    """
    if points not in _ORBITS:
        raise UserError(
            f"There is no rule of {points} rays per triangle; choose one of {', '.join(map(str, _ORBITS))}."
        )
    if is_monolithic(segments):
        raise UserError(
            "A monolithic mirror has no segments to spread rays over; sample its pupil by a sunflower."
        )
    corners = segments.corners
    middle = np.broadcast_to(centroids(corners)[:, None], corners.shape)
    parts = np.stack([middle, corners, np.roll(corners, -1, axis=1)], axis=2)
    if concave(corners).any():
        parts = triangles(corners)
    (u_x, u_y), (v_x, v_y) = (np.moveaxis(parts[:, :, k] - parts[:, :, 0], -1, 0) for k in (1, 2))
    share = 0.5 * (u_x * v_y - u_y * v_x) / areas(segments).sum()
    coordinates, weights = _triangle_rule(points)
    position = np.einsum("pk,svkx->svpx", coordinates, parts)
    real = np.repeat(share.ravel() > 0.0, points)  # the triangle at a repeated corner has no area
    segment = np.repeat(np.arange(len(segments)), parts.shape[1] * points)
    weight = (share[..., None] * weights).ravel()[real]
    x, y = np.moveaxis(position, -1, 0).reshape(2, -1)[:, real]
    return PupilRays(x, y, weight / weight.sum(), segment[real])


def _triangle_rule(points: int) -> tuple[Array, Array]:
    """Return barycentric coordinates (points, 3) and weights (points,) that sum to 1."""
    coordinates, weights = [], []
    for weight, (a, b, c) in _ORBITS[points]:
        orbit = sorted({(a, b, c), (b, c, a), (c, a, b), (b, a, c), (a, c, b), (c, b, a)})
        coordinates += orbit
        weights += [weight] * len(orbit)
    return np.array(coordinates), np.array(weights)


def on_glass(system: OpticalSystem, rays: PupilRays) -> PupilRays:
    """Find the undisturbed segment that each ray meets, and keep only rays that meet one.

    The glass of a monolithic mirror is the annulus of its pupil. The weights are scaled to the sum 1 again.

    Raises
    ------
    UserError
        If no ray is left.
    """
    segment = candidates(system.segments, rays.x, rays.y)[:, 0].astype(np.int64)
    if is_monolithic(system.segments):
        radius = np.hypot(rays.x, rays.y)
        segment = np.where((radius >= system.annulus.inner) & (radius <= system.annulus.outer), 0, -1)
    hit = segment >= 0
    total = rays.weight[hit].sum()
    if not total > 0.0:
        raise UserError(
            f"No ray passes the pupil of {system.name}: none of the {len(rays)} rays (pupil radii "
            f"{system.annulus.inner:g} to {system.annulus.outer:g} mm) meets the glass of a segment."
        )
    return replace(rays, x=rays.x[hit], y=rays.y[hit], weight=rays.weight[hit] / total, segment=segment[hit])


def pupil_amplitude(system: OpticalSystem, x: Array, y: Array) -> Array | None:
    """Return the amplitude of the light at places of an apodized pupil; None: it is 1 everywhere.

    Parameters
    ----------
    system : OpticalSystem
    x, y : ndarray, shape (N,)
        In units of the pupil's radius; the light is that of the whole pupil, whatever part a field fills.

    Returns
    -------
    ndarray, shape (N,), or None
        1 at the center; by the formulas of `wavequake.optics.systems.apodization.Apodization`.
    """
    given = system.pupil.apodization
    if given is None or (given.kind == "cosine_cubed" and not isfinite(system.object_distance)):
        return None
    square = x**2 + y**2
    if given.kind == "gaussian":
        return np.exp(-given.factor * square) if given.factor else None
    tangent = paraxial(system).object_na / refractive_index(system.medium, wavelength_of(system))
    return np.asarray((1.0 + tangent**2 * square) ** -0.75, dtype=np.float64)
