"""The NumPy twin of the segmented trace: the oracle of the OpenCL kernel, and what runs without OpenCL.

Unit directions, explicit sag and slopes, Newton iteration to convergence on the figure: the kernel shares
none of this algebra. Tiles are traced one at a time, so a tile's bits do not depend on its neighbors.
"""

import numpy as np
from numpy.typing import NDArray

from wavequake.kernels.device.tiles import TILE
from wavequake.kernels.trace.ring import ring_polynomial
from wavequake.kernels.trace.sequence import Basis
from wavequake.kernels.trace.status import GAP, MISS, OK, TOTAL_REFLECTION, VIGNETTED, lost_at
from wavequake.kernels.trace.surfaces import conic_path, conic_sag, conic_slopes
from wavequake.kernels.trace.train import SegmentedTrain, Traced, check_train

Array = NDArray[np.float64]
_NEWTON_STEPS = 30
_GAP = lost_at(GAP, -1)
# Newton's iteration ends with the step after one this short: its square leaves only rounding.
_SHORT = 1e-7
_LOST_RAYS_ARE_DATA = np.errstate(invalid="ignore", divide="ignore", over="ignore")


@_LOST_RAYS_ARE_DATA
def trace_segmented_numpy(
    train: SegmentedTrain,
    ray_x: Array,
    ray_y: Array,
    start_z: float,
    candidates: NDArray[np.int32],
    segment_poses: Array,
    figure: Array | None,
    surface_poses: Array,
    mirror_figure: Array | None,
    directions: Array,
    chief: Array,
) -> Traced:
    """Trace every ray of every instant; arguments as `wavequake.kernels.trace.segmented.trace_segmented`."""
    shape = (segment_poses.shape[0], ray_x.size, TILE)
    traced = Traced(np.empty(shape), np.empty(shape), np.empty(shape), np.empty(shape, dtype=np.int8))
    start = np.stack([ray_x, ray_y, np.full_like(ray_x, start_z)])[:, :, None]
    for tile in range(shape[0]):
        figures = None if figure is None else figure[tile]
        position = np.broadcast_to(start, (3, *shape[1:]))
        direction = np.broadcast_to(directions[tile][:, None, :], (3, *shape[1:]))
        opl = np.sum(position * direction, axis=0)
        position, direction, path, status = _reflect_at_primary(
            train, candidates, segment_poses[tile], figures, position, direction
        )
        mirrors = None if mirror_figure is None else mirror_figure[tile][:, None]
        position, direction, opl, status = _through_surfaces(
            train, surface_poses[tile], mirrors, position, direction, opl + path, status, train.clear_squares
        )
        opl_sphere = opl - _back_to_sphere(position, direction, chief[tile], train.sphere_radius)
        opd = chief[tile, 2] - opl_sphere
        sphere_miss = lost_at(MISS, train.surface_curvatures.size)
        status[(status == OK) & ~np.isfinite(opd)] = sphere_miss
        for out, values in ((traced.opd, opd), (traced.x, position[0]), (traced.y, position[1])):
            out[tile] = np.where(status == OK, values, np.nan)
        traced.status[tile] = status
    return traced


@_LOST_RAYS_ARE_DATA
def trace_chief(
    train: SegmentedTrain,
    surface_poses: Array,
    directions: Array,
    start_z: float,
    start_xy: tuple[float, float] = (0.0, 0.0),
    mirror_figure: Array | None = None,
) -> Array:
    """Trace the virtual chief ray: undisturbed parent of M1, moved surfaces, no apertures.

    Parameters
    ----------
    train : SegmentedTrain
        The telescope; edges and figure play no role.
    surface_poses : ndarray, shape (T, L, 12, 16)
        Relative poses of the surfaces after M1.
    directions : ndarray, shape (T, 3, 16)
        Unit directions of the incoming light.
    start_z : float
        Plane of the stop, mm.
    start_xy : tuple of float
        Where the ray starts in it; the center of the stop by default.
    mirror_figure : ndarray, shape (T, L - 1, M, 16), optional
        Figures of the mirrors after M1.

    Returns
    -------
    ndarray, shape (T, 3, 16)
        Image x, y and the optical path length to the reference sphere (that to the image less the sphere's
        radius), mm; NaN where the ray misses a surface.
    """
    check_train(train)
    direction = np.moveaxis(directions, 1, 0)
    position = np.broadcast_to(np.reshape([*start_xy, start_z], (3, 1, 1)), direction.shape)
    opl = np.sum(position * direction, axis=0)
    path = conic_path(position, direction, train.primary_curvature, train.primary_conic)
    position = position + path * direction
    slopes = conic_slopes(position[0], position[1], train.primary_curvature, train.primary_conic)
    status = np.zeros(opl.shape, dtype=np.int8)
    poses = np.moveaxis(surface_poses, 1, 0)
    mirrors = None if mirror_figure is None else np.moveaxis(mirror_figure, 1, 0)
    no_edge = np.full(len(poses), np.inf)
    position, _, opl, status = _through_surfaces(
        train, poses, mirrors, position, _reflected(direction, *slopes), opl + path, status, no_edge
    )
    chief = np.stack([position[0], position[1], opl - train.sphere_radius], axis=1)
    return np.where((status == OK)[:, None, :], chief, np.nan)


def _reflect_at_primary(
    train: SegmentedTrain,
    candidates: NDArray[np.int32],
    poses: Array,
    figures: Array | None,
    position: Array,
    direction: Array,
) -> tuple[Array, Array, Array, NDArray[np.int8]]:
    """Reflect each ray at the first of its candidate segments whose glass it meets."""
    out_position, out_direction = np.full(position.shape, np.nan), np.full(position.shape, np.nan)
    path = np.full(position.shape[1:], np.nan)
    status = np.full(position.shape[1:], _GAP, dtype=np.int8)
    for column in candidates.T:
        rays = np.flatnonzero((column >= 0) & (status == _GAP).any(axis=-1))
        segments = column[rays]
        pose = poses[segments]
        local, local_direction = _into(pose, position[:, rays], direction[:, rays])
        coefficients = None if figures is None else figures[segments]
        step, slopes = _meet(
            (train.primary_curvature, train.primary_conic),
            train.figure_frames[segments],
            (train.figure_degree, train.figure_basis),
            *(coefficients, local, local_direction),
        )
        hit = local + step * local_direction
        inside = _on_glass(train.edges[segments], hit) & (status[rays] == _GAP)
        back_position, back_direction = _back(pose, hit, _reflected(local_direction, *slopes))
        for out, values in ((out_position, back_position), (out_direction, back_direction)):
            out[:, rays] = np.where(inside, values, out[:, rays])
        path[rays] = np.where(inside, step, path[rays])
        status[rays] = np.where(inside, OK, status[rays])
    return out_position, out_direction, path, status


def _meet(
    conic: tuple[float, float],
    frames: Array,
    form: tuple[int, Basis],
    coefficients: Array | None,
    position: Array,
    direction: Array,
) -> tuple[Array, tuple[Array, Array]]:
    """Return path and slopes where rays (3, n, 16) meet a conic plus figures (n, M, 16) in frames (n, 4).

    NaN where a ray misses the conic, or the iteration finds no point of the figured surface: it folds over.
    """
    c, kappa = conic
    path = conic_path(position, direction, c, kappa)
    hit = position + path * direction
    if coefficients is None:
        return path, conic_slopes(hit[0], hit[1], c, kappa)
    going, near, met = np.isfinite(path), *np.zeros((2, *path.shape), dtype=np.bool_)
    for count in range(_NEWTON_STEPS + 1):
        x, y, z = hit
        deformation, figure_x, figure_y = _figure(frames, form, coefficients, x, y)
        conic_x, conic_y = conic_slopes(x, y, c, kappa)
        slope_x, slope_y = conic_x + figure_x, conic_y + figure_y
        rise = direction[2] - slope_x * direction[0] - slope_y * direction[1]
        if count == _NEWTON_STEPS or not going.any():
            break
        # A ray that has converged is left alone, so its bits do not depend on its neighbors.
        step = np.where(going, (conic_sag(x, y, c, kappa) + deformation - z) / rise, 0.0)
        hit, path = hit + step * direction, path + step
        met |= near & np.isfinite(step)
        near = going & (np.abs(step) <= _SHORT)
        going &= ~met & np.isfinite(step)
    # The ray has to cross the surface in the sense in which it crosses the vertex plane.
    return np.where(met & (rise * direction[2] > 0.0), path, np.nan), (slope_x, slope_y)


def _figure(
    frames: Array, form: tuple[int, Basis], coefficients: Array, x: Array, y: Array
) -> tuple[Array, Array, Array]:
    """Return the figure polynomial (n, 16) and its slopes along x and y, term by term."""
    center_x, center_y, e_x, e_y = frames.T[:, :, None]
    u = e_x * (x - center_x) + e_y * (y - center_y)
    v = e_x * (y - center_y) - e_y * (x - center_x)
    degree, basis = form
    if basis != "monomial":
        terms = np.moveaxis(coefficients, 1, 0)
        value, slope_u, slope_v = ring_polynomial(degree, basis.inner, terms, u, v)
        return value, e_x * slope_u - e_y * slope_v, e_y * slope_u + e_x * slope_v
    powers_u, powers_v = [np.ones_like(u)], [np.ones_like(v)]
    for _ in range(degree):
        powers_u.append(powers_u[-1] * u)
        powers_v.append(powers_v[-1] * v)
    exponents = [(total - j, j) for total in range(degree + 1) for j in range(total + 1)]
    value, slope_u, slope_v = np.zeros_like(u), np.zeros_like(u), np.zeros_like(u)
    for term, (i, j) in enumerate(exponents):
        factor = coefficients[:, term]
        value += factor * powers_u[i] * powers_v[j]
        if i:
            slope_u += i * factor * powers_u[i - 1] * powers_v[j]
        if j:
            slope_v += j * factor * powers_u[i] * powers_v[j - 1]
    return value, e_x * slope_u - e_y * slope_v, e_y * slope_u + e_x * slope_v


def _on_glass(edges: Array, hit: Array) -> NDArray[np.bool_]:
    """Tell which hits (3, n, 16) lie on the segments with `edges` (n, V, 3 or 5); a NaN hit on none."""
    if edges.shape[2] == 5:
        odd = np.zeros(hit.shape[1:], dtype=np.bool_)
        for a, b, c, low, high in np.moveaxis(edges, 0, -1)[..., None]:
            odd ^= (hit[1] >= low) & (hit[1] < high) & (a * (a * hit[0] + b * hit[1] - c) < 0.0)
        return odd
    inside = np.ones(hit.shape[1:], dtype=np.bool_)
    inside &= np.isfinite(hit).all(axis=0)
    for a, b, c in np.moveaxis(edges, 0, -1)[..., None]:
        inside &= a * hit[0] + b * hit[1] <= c
    return inside


def _through_surfaces(
    train: SegmentedTrain,
    poses: Array,
    figures: Array | None,
    position: Array,
    direction: Array,
    opl: Array,
    status: NDArray[np.int8],
    clear_squares: Array,
) -> tuple[Array, Array, Array, NDArray[np.int8]]:
    """Reflect or refract at each surface after M1, stop at the image; `poses`, `figures`: surfaces first."""
    last, form = train.surface_curvatures.size - 1, (train.mirror_degree, train.mirror_basis)
    before = train.indices_before
    for surface, (c, kappa) in enumerate(zip(train.surface_curvatures, train.surface_conics, strict=True)):
        position, direction = _into(poses[surface], position, direction)
        figure = figures[surface] if figures is not None and surface < last else None
        frames = train.mirror_frames[surface : surface + 1]
        path, slopes = _meet((c, kappa), frames, form, figure, position, direction)
        position, opl = position + path * direction, opl + before[surface] * path
        clear = position[0] ** 2 + position[1] ** 2 <= clear_squares[surface]  # not where there is no path
        missed, beyond = (np.int8(lost_at(reason, surface)) for reason in (MISS, VIGNETTED))
        reason = np.where(np.isnan(path), missed, beyond)
        status = np.where((status == OK) & ~clear, reason, status)
        if train.refracts[surface]:
            direction = _refracted(direction, *slopes, before[surface], before[surface + 1])
            kept = (status != OK) | np.isfinite(direction[2])
            status = np.where(kept, status, np.int8(lost_at(TOTAL_REFLECTION, surface)))
        elif surface < last:
            direction = _reflected(direction, *slopes)
    return position, direction, opl, status


def _back_to_sphere(position: Array, direction: Array, chief: Array, radius: float) -> Array:
    """Return the path from the image back to the reference sphere; NaN where the ray misses it.

    It is negative for a negative radius: that of a sphere behind the image.
    """
    offset = np.stack([position[0] - chief[0], position[1] - chief[1], position[2]])
    along = np.sum(offset * direction, axis=0)
    root = np.sqrt(along * along - np.sum(offset * offset, axis=0) + radius * radius)
    path: Array = along + np.copysign(root, radius)
    return path


def _reflected(direction: Array, slope_x: Array, slope_y: Array) -> Array:
    """Reflect unit directions at a surface with the given slopes."""
    normal = np.stack([-slope_x, -slope_y, np.ones_like(slope_x)])
    twice: Array = 2.0 * np.sum(direction * normal, axis=0) / np.sum(normal * normal, axis=0)
    return direction - twice * normal


def _refracted(direction: Array, slope_x: Array, slope_y: Array, before: float, behind: float) -> Array:
    """Refract unit directions at a surface with the given slopes; NaN where they are totally reflected."""
    normal = np.stack([-slope_x, -slope_y, np.ones_like(slope_x)])
    normal = normal / np.sqrt(np.sum(normal * normal, axis=0))
    cosine = np.sum(direction * normal, axis=0)
    sines = before / behind * (direction - cosine * normal)  # Snell: the part along the surface
    return np.asarray(sines + np.copysign(np.sqrt(1.0 - np.sum(sines * sines, axis=0)), cosine) * normal)


def _into(pose: Array, position: Array, direction: Array) -> tuple[Array, Array]:
    """Map positions and directions (3, ..., 16) by q = A p + o; `pose` is (..., 12, 16)."""
    rows = [[pose[..., 3 * i + j, :] for j in range(3)] for i in range(3)]
    shifts = [pose[..., 9 + i, :] for i in range(3)]
    moved = np.stack([_dot(row, position) + shift for row, shift in zip(rows, shifts, strict=True)])
    return moved, np.stack([_dot(row, direction) for row in rows])


def _back(pose: Array, position: Array, direction: Array) -> tuple[Array, Array]:
    """Undo `_into`: A is a rotation, so its inverse is its transpose."""
    columns = [[pose[..., 3 * i + j, :] for i in range(3)] for j in range(3)]
    shifted = np.stack([position[i] - pose[..., 9 + i, :] for i in range(3)])
    return np.stack([_dot(column, shifted) for column in columns]), np.stack(
        [_dot(column, direction) for column in columns]
    )


def _dot(row: list[Array], vector: Array) -> Array:
    """Return the sum of products in a fixed order."""
    total: Array = row[0] * vector[0] + row[1] * vector[1] + row[2] * vector[2]
    return total
