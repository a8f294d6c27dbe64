"""From displacements of a surface's nodes to what the optics take: rigid motion, coefficients, a grid.

The rigid motion is that of the nodes less their figure from j = 4 on, both found together: a rigid motion
with a figure that the polynomials hold comes back as it was, wherever the nodes are. Angles are finite.
"""

from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from wavequake.errors import UserError
from wavequake.mechanics.disturbances.layout import Moved
from wavequake.mechanics.disturbances.population import Population
from wavequake.mechanics.disturbances.registry import parts
from wavequake.mechanics.disturbances.sources.nodal_displacements import NodalDisplacements
from wavequake.mechanics.importers.areas import area_shares
from wavequake.mechanics.importers.mesh import MeshFile
from wavequake.optics.segments.kinematics import cardan, cardan_angles
from wavequake.optics.shapes.fit import (
    ILL_CONDITIONED,
    SurfaceFit,
    coefficients,
    heights,
    residual,
    residual_grid,
    surface_fit,
)
from wavequake.optics.shapes.shapes import GridDeformation, Shape, ZernikeDeformation
from wavequake.optics.systems.bodies import surface_index
from wavequake.optics.systems.system import OpticalSystem

Array = NDArray[np.float64]

MM_PER_M = 1e3
_ON_SURFACE = 0.01  # of the radius: how far nodes may lie from the surface where nobody says
_TURNS = 6  # corrections of the rotation; each squares what is missing
_FAR = 0.95  # of the radius: nodes that end before leave a rim to extrapolation
_REACH = 1.0 + 2e-6  # of the radius, which round-off of a node may exceed


def nodal_sources(populations: Sequence[Population]) -> Iterator[NodalDisplacements]:
    """Yield the disturbances of a study that are fitted to surfaces, each once."""
    found = (part for population in populations for part in parts(populations, population))
    yield from {part.name: part for part in found if isinstance(part, NodalDisplacements)}.values()


def nodal_grids(system: OpticalSystem, sources: Sequence[NodalDisplacements]) -> dict[int, GridDeformation]:
    """Return the grids that sources ask for, by surface; the surfaces can deform already.

    Raises
    ------
    UserError
        If two ask for different ones of a surface.
    """
    grids: dict[int, GridDeformation] = {}
    for part in sources:
        if part.grid:
            index, form = _form(system, part)
            step = 2.0 * form.pupil_radius * _REACH / (part.grid - 1)
            grid = GridDeformation(part.grid, part.grid, step, step)
            if grids.setdefault(index, grid) != grid or form.residual not in (None, grid):
                raise UserError(
                    f"The disturbance {part.name!r} deforms {part.surface!r} on another grid than one "
                    "before; give all heights of a surface on the same grid."
                )
    return grids


def fitted(system: OpticalSystem, sources: Sequence[NodalDisplacements]) -> Mapping[str, Moved]:
    """Return what is fitted to the nodes of each source, by its name.

    Raises
    ------
    UserError
        If nodes do not lie on the surface, are too few or do not tell the polynomials apart.
    """
    return {part.name: _moved(system, part) for part in sources}


def _form(system: OpticalSystem, part: NodalDisplacements) -> tuple[int, ZernikeDeformation]:
    index = surface_index(system, part.surface)
    form = system.surfaces[index].deformation
    assert isinstance(form, ZernikeDeformation)
    return index, form


def _moved(system: OpticalSystem, part: NodalDisplacements) -> Moved:
    index, form = _form(system, part)
    surface = system.surfaces[index]
    points, moved = part.results.points * MM_PER_M, part.displacements() * MM_PER_M
    if part.frame == "system":
        turn = np.asarray(surface.rotation)
        points, moved = (points - surface.position) @ turn, moved @ turn
    try:
        seen = on_surface(points, form, surface.shape, part.off_mm)
        fit = nodal_fit(points[seen], part.terms, form, surface.shape, part.name)
        poses, rest = separate_motion(fit, moved[:, seen], form.pupil_radius)
        above = heights(fit, rest, linear=False)
    except UserError as error:
        raise UserError(
            f"The disturbance {part.name!r} at {part.surface!r}: {str(error).rstrip('.')}."
        ) from None
    figure = coefficients(fit, above)
    left = residual(fit, above, figure)
    grid = nodal_grids(system, [part]).get(index)
    added = None if grid is None else residual_grid(fit, left, grid) / MM_PER_M
    poses[:, :3] /= MM_PER_M
    words = _words(part, fit, poses, (above, left), form.pupil_radius)
    return Moved(poses, figure / MM_PER_M, added, words)


def nodal_fit(points: Array, terms: int, form: ZernikeDeformation, shape: Shape, source: str) -> SurfaceFit:
    """Return the fit of the figure at bare nodes on a surface (p, 3), mm, by shares of the area.

    Raises
    ------
    UserError
        As `surface_fit`.
    """
    nodes = np.arange(len(points))
    weights = area_shares(MeshFile(source, nodes, points), nodes)
    return surface_fit(points[:, :2], weights, terms, form.pupil_radius, form.obscuration, shape)


def on_surface(
    points: Array, form: ZernikeDeformation, shape: Shape, off_mm: float | None
) -> NDArray[np.int64]:
    """Return which nodes (p, 3), mm in the surface's frame, lie on it to `off_mm`, within what deforms.

    Raises
    ------
    UserError
        If none does, or, with `off_mm` None, one is off by more than 1 % of the radius.
    """
    away = np.hypot(points[:, 0], points[:, 1]) / form.pupil_radius
    inside = (away <= 1.0 + 1e-9) & (away >= form.obscuration - 1e-9)
    with np.errstate(invalid="ignore"):
        off = np.abs(points[:, 2] - np.asarray(shape.sag(points[:, 0], points[:, 1])[0]))
        near = off <= (_ON_SURFACE * form.pupil_radius if off_mm is None else off_mm)
    seen = np.flatnonzero(inside & near)
    if off_mm is None and not near[inside].all():
        worst = float(np.nanmax(np.where(np.isfinite(off[inside]), off[inside], np.inf)))
        raise UserError(
            f"{np.count_nonzero(~near[inside])} of {np.count_nonzero(inside)} nodes within "
            f"{form.pupil_radius:g} mm do not lie on the surface, the farthest {worst:.3g} mm off; is it the "
            "unit or the frame, or leave other nodes out by off_mm"
        )
    if not len(seen):
        nearest = f"the nearest is {away.min() * form.pupil_radius:.4g} mm from the axis" if len(away) else ""
        raise UserError(
            f"none of {len(points)} nodes lies on the surface within {form.pupil_radius:g} mm of its vertex "
            f"({nearest}); is it the unit or the frame"
        )
    return seen


def separate_motion(fit: SurfaceFit, displacements: Array, radius: float) -> tuple[Array, Array]:
    """Split displacements into a rigid motion by finite angles and what is left in the moved frame.

    Parameters
    ----------
    fit : SurfaceFit
    displacements : ndarray, shape (n, p, 3)
        mm.
    radius : float
        mm, by which rotations are compared with shifts.

    Returns
    -------
    poses : ndarray, shape (n, 6)
        dx, dy, dz in mm and Cardan angles in rad about the vertex.
    rest : ndarray, shape (n, p, 3)

    Raises
    ------
    UserError
        If the nodes do not tell the rigid motion from the figure, or displacements are not finite.
    """
    project = _apart(fit, radius)
    turn = np.broadcast_to(np.eye(3), (len(displacements), 3, 3)).copy()
    shift, rest = np.zeros((len(displacements), 3)), displacements
    for _ in range(_TURNS):
        pose = rest.reshape(len(rest), -1) @ project.T
        shift = shift + np.einsum("nij,nj->ni", turn, pose[:, :3])
        turn = turn @ cardan(pose[:, 3:])
        rest = (fit.nodes + displacements - shift[:, None]) @ turn - fit.nodes
    return np.hstack([shift, cardan_angles(turn)]), rest


def _apart(fit: SurfaceFit, radius: float) -> Array:
    """Return the matrix (6, 3 p) from displacements to the rigid motion beside a figure.

    With pose p = P (u - E c) and figure c = F H (u - G p), p = (1 - P E F H G)^-1 P (u - E F H u).
    """
    pose = fit.pose_projection
    along_z = pose.reshape(6, -1, 3)[:, :, 2] @ fit.basis[:, 3:]
    taken = along_z @ fit.projection[3:]
    by_heights = np.stack([-taken * fit.slopes[:, 0], -taken * fit.slopes[:, 1], taken], axis=2).reshape(
        6, -1
    )
    scale = np.array([1.0, 1.0, 1.0, radius, radius, radius])
    left = np.eye(6) - by_heights @ fit.rigid
    condition = np.linalg.cond(left * scale[:, None] / scale)
    if not condition < ILL_CONDITIONED:
        raise UserError(
            f"the nodes do not tell a rigid motion from the figure (condition number {condition:.1e}); take "
            "fewer terms, or more nodes"
        )
    return np.asarray(np.linalg.solve(left, pose - by_heights))


def _words(
    part: NodalDisplacements, fit: SurfaceFit, poses: Array, found: tuple[Array, Array], radius: float
) -> str:
    """Say how many nodes there are, how they move, and how much of their figure is left."""
    whole, left = (float(np.sqrt(np.square(one) @ fit.weights).max()) / MM_PER_M * 1e9 for one in found)
    shift, turn = (np.linalg.norm(one, axis=1).max() for one in (poses[:, :3], poses[:, 3:]))
    rest = "on a grid" if part.grid else "left out"
    reach = float(np.hypot(*fit.nodes[:, :2].T).max()) / radius
    bare = (
        f"; beyond {reach:.0%} of the radius there are no nodes, and the terms go on" if reach < _FAR else ""
    )
    return (
        f"{part.surface} by {len(fit.nodes)} nodes: shifts by up to {shift * 1e6:.4g} um and turns by up to "
        f"{turn * 1e6:.4g} urad; of a figure of {whole:.4g} nm rms, {left:.3g} nm are no sum of "
        f"{part.terms} terms ({rest}; condition number {fit.condition:.3g}){bare}"
        + (f"; materials {part.results.note}" if part.results.note else "")
    )
