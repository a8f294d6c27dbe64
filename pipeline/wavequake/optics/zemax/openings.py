"""Openings of surfaces as the apertures of lens files, whose intersection they are.

A convex polygon is the intersection of the rectangles about it that lie along its edges: three for a hexagon.
A rectangle that is turned stands on an equal surface between two coordinate breaks about the axis, where the
shape can be turned back. (Zemax' user-defined apertures are not used: other programs do not read them.)
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from wavequake.errors import UserError
from wavequake.optics.polynomials.indices import nm_to_noll
from wavequake.optics.polynomials.zernike import noll_to_nm
from wavequake.optics.shapes.polygons import concave
from wavequake.optics.shapes.shapes import Conic, EvenAsphere, Opening, Shape, ZernikeSag
from wavequake.optics.zemax.rows import written
from wavequake.optics.zemax.surfaces import CORNERS, RING_GROWTH, ellipse, rectangle, ring, spider

Array = NDArray[np.float64]

_SAME = 1e-12  # rad, and of lengths: corners that are computed


@dataclass(frozen=True)
class Aperture:
    """An aperture as lines of a lens file, in axes that are turned about z by ``turn`` (rad).

    ``shape`` is that of its surface, in these axes.
    """

    lines: tuple[str, ...]
    shape: Shape
    turn: float = 0.0


def apertures(opening: Opening, shape: Shape, name: str) -> list[Aperture]:
    """Return the apertures whose intersection an opening of the surface `name` is.

    Raises
    ------
    UserError
        If lens files have no such aperture: names it.
    """
    x, y = opening.center
    shift = (f"OBDC {written(x)} {written(y)}",) if x or y else ()
    found = []
    if opening.arms:
        arms = opening.arms
        if arms != spider(arms[0][1], len(arms)):
            raise UserError(
                f"The surface {name} has arms that are no spider of equal ones at equal angles, the first "
                "along x, which a lens file cannot hold."
            )
        found.append(Aperture((f"SPID {written(arms[0][1])} {len(arms)} 0", *shift), shape))
    if opening.dark:
        found.append(Aperture((_obscuration(opening, name), *shift), shape))
    if opening.corners:
        found += _polygon(opening, shape, name)
    elif math.isfinite(opening.outer):
        found.append(Aperture((f"CLAP {written(opening.inner)} {written(opening.outer)} 0", *shift), shape))
    if opening.inner and not (math.isfinite(opening.outer) and not opening.corners):
        found.append(Aperture((f"OBSC 0.0 {written(opening.inner)} 0", *shift), shape))
    return found


def _obscuration(opening: Opening, name: str) -> str:
    """Return the line of a dark rectangle, ellipse or ring."""
    corners = np.array(opening.dark)
    low, high = (float(one) for one in corners.max(axis=0))
    inner, outer = (float(one) / RING_GROWTH for one in np.hypot(*corners.T)[[-1, 0]])
    half = _half_axes(corners)
    for line, same in (
        (f"SQOB {written(low)} {written(high)} 0", rectangle(low, high)),
        (f"ELOB {written(half[0])} {written(half[1])} 0", ellipse(*half)),
        (f"OBSC {written(inner)} {written(outer)} 0", ring(inner, outer)),
    ):
        if len(same) == len(corners) and np.abs(corners - same).max() < _SAME * np.abs(corners).max():
            return line
    raise UserError(
        f"The surface {name} has a dark polygon that is no rectangle along x and y, ellipse or ring, which a "
        "lens file cannot hold."
    )


def _polygon(opening: Opening, shape: Shape, name: str) -> Iterator[Aperture]:
    corners = np.array(opening.corners)
    x, y = opening.center
    low, high = _half_axes(corners)
    away = np.abs(corners - ellipse(low, high)).max() if len(corners) == CORNERS else math.inf
    if away < _SAME * max(low, high):
        shift = (f"OBDC {written(x)} {written(y)}",) if x or y else ()
        yield Aperture((f"ELAP {written(low)} {written(high)} 0", *shift), shape)
        return
    if concave(corners[None])[0]:
        raise UserError(
            f"The surface {name} has a polygonal opening with a dent, which a lens file cannot hold; an "
            "opening whose corners all point outwards it can."
        )
    for turn in _directions(corners):
        turned = _turned(shape, turn)
        if turned is None:
            raise UserError(
                f"The surface {name} is a {type(shape).__name__} with an opening whose edges are not "
                "along x and y, which a lens file cannot hold."
            )
        axes = np.array([[math.cos(turn), math.sin(turn)], [-math.sin(turn), math.cos(turn)]])
        inside = (corners + opening.center) @ axes.T
        least, most = inside.min(axis=0), inside.max(axis=0)
        (wide, tall), (right, up) = (most - least) / 2.0, (most + least) / 2.0
        shift = (f"OBDC {written(right)} {written(up)}",) if right or up else ()
        yield Aperture((f"SQAP {written(wide)} {written(tall)} 0", *shift), turned, turn)


def _turned(shape: Shape, turn: float) -> Shape | None:
    """Return a shape in axes that are turned about z, if it has the same form there."""
    if not turn or isinstance(shape, Conic | EvenAsphere):
        return shape
    if not isinstance(shape, ZernikeSag):
        return None
    given = {noll_to_nm(j): value for j, value in enumerate(shape.coefficients, start=1)}
    found = np.zeros(len(given) + 1)  # of the last two terms of one degree, one may be missing
    for (n, m), value in given.items():
        found[nm_to_noll(n, m) - 1] += value * math.cos(m * turn)
        if m:
            found[nm_to_noll(n, -m) - 1] -= value * math.sin(m * turn)
    return replace(shape, coefficients=tuple(found.tolist()))


def _half_axes(corners: Array) -> tuple[float, float]:
    """Return the half-axes of the ellipse that the corners may stand for."""
    return float(corners[:, 0].max()) / RING_GROWTH, float(corners[:, 1].max()) / RING_GROWTH


def _directions(corners: Array) -> list[float]:
    """Return the angles of the edges from x, each once; rectangles along them lie across them, too."""
    edges = np.roll(corners, -1, axis=0) - corners
    edges = edges[np.hypot(*edges.T) > _SAME * np.abs(corners).max()]
    found: list[float] = []
    for angle in np.arctan2(edges[:, 1], edges[:, 0]) % (0.5 * math.pi):
        angle = 0.0 if min(angle, 0.5 * math.pi - angle) < _SAME else float(angle)
        if all(abs(angle - other) > _SAME for other in found):
            found.append(angle)
    return found
