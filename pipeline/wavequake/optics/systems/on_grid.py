"""A surface of any shape, and what deforms it at an instant, as heights on a grid over its conic."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from wavequake.errors import UserError
from wavequake.optics.shapes.sag import deformation_sag
from wavequake.optics.shapes.sag_file import MAX_NODES
from wavequake.optics.shapes.shapes import Conic, GridDeformation, GridSag
from wavequake.optics.systems.system import Surface

Array = NDArray[np.float64]

MOST_OFF = 2e-9  # mm: a mirror adds twice as much to the path, 1e-5 waves of visible light
_MARGIN = 1.05  # of what the beams fill: splines are worst at their edges
_LEAST = 1e-2  # mm, where light comes to a point
_INTERVALS = 60


def on_grid(surface: Surface, numbers: Array, reach: Array) -> GridSag:
    """Return heights that are those of a surface within 2e-9 mm wherever the beams come.

    The grid is refined until it is so. Nodes of a grid that deforms the surface stay nodes, so that its
    splines are kept as they are.

    Parameters
    ----------
    surface : Surface
    numbers : ndarray
        Of its deformation, as `wavequake.optics.shapes.sag.deformation_sag` takes them.
    reach : ndarray, shape (2,)
        Largest abs(x) and abs(y) of the beams on the surface, mm.

    Raises
    ------
    UserError
        If no grid of at most 262,144 nodes is fine enough, or the surface does not reach over the grid.
    """
    reach = np.maximum(reach, _LEAST)
    why = f"needs more than {MAX_NODES} nodes"
    for nodes_x, nodes_y in _grids(surface, reach):
        heights = _heights(surface, numbers, *np.meshgrid(nodes_x, nodes_y))
        if not np.isfinite(heights).all():
            raise UserError(
                f"The surface {surface.name} is a {type(surface.shape).__name__} that deforms and does not "
                "reach over the square about its beams, on which a lens file would hold it; displacements, "
                "FILE.txt, hold all."
            )
        found = GridSag(
            surface.shape.radius,
            surface.shape.conic,
            heights,
            float(nodes_x[1] - nodes_x[0]),
            float(nodes_y[1] - nodes_y[0]),
        )
        between = np.meshgrid(*(_between(*pair) for pair in ((nodes_x, reach[0]), (nodes_y, reach[1]))))
        off = float(np.abs(found.over_conic(*between)[0] - _heights(surface, numbers, *between)).max())
        if off <= MOST_OFF:
            return found
        why = f"is {off:.1g} mm off with {heights.size} nodes (at most {MOST_OFF:g} are right to 1e-5 waves)"
    raise UserError(
        f"The surface {surface.name} is a {type(surface.shape).__name__} that deforms, which a lens file can "
        f"hold as heights on a grid only, and the grid {why}; displacements, FILE.txt, hold all."
    )


def _between(nodes: Array, reach: float) -> Array:
    """Return nodes and the places halfway between, as far as light comes.

    A spline is farthest off halfway; along x alone or y alone where what both do cancels (x^4 - y^4).
    """
    places: Array = np.linspace(nodes[0], nodes[-1], 2 * len(nodes) - 1)
    return places[np.abs(places) <= reach]


def _heights(surface: Surface, numbers: Array, x: Array, y: Array) -> Array:
    """Return the heights of a deformed surface over the conic of its own; NaN where it does not reach."""
    form, shape = surface.deformation, surface.shape
    assert form is not None
    given = numbers.reshape(form.rows, form.columns) if isinstance(form, GridDeformation) else numbers
    with np.errstate(invalid="ignore"):
        bare = Conic(shape.radius, shape.conic).sag(x, y)[0]
        heights: Array = shape.sag(x, y)[0] - bare + deformation_sag(form, given, x, y)[0]
    return heights


def _grids(surface: Surface, reach: Array) -> Iterator[tuple[Array, Array]]:
    """Yield nodes along x and y, finer and finer."""
    half, intervals = _MARGIN * reach, np.array([_INTERVALS, _INTERVALS])
    form = surface.deformation
    grid = form if form is None or isinstance(form, GridDeformation) else form.residual
    if grid is not None:
        intervals = np.array([grid.columns, grid.rows]) - 1
        step = np.array([grid.dx, grid.dy])
        half = step * intervals / 2.0
        beyond = np.maximum(np.ceil((reach - half) / step), 0).astype(int)
        half, intervals = half + step * beyond, intervals + 2 * beyond
    while np.prod(intervals + 1) <= MAX_NODES:
        x, y = (np.linspace(-h, h, n + 1) for h, n in zip(half, intervals, strict=True))
        yield x, y
        intervals = 2 * intervals
