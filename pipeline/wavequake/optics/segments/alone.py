"""Each segment of a telescope at an instant, and what follows it, as an optical system of its own.

A sequential program follows light from surface to surface, so it sees one segment at a time: the parent of M1
where the segment's motion takes it, with the segment's glass as its opening.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from wavequake.errors import UserError
from wavequake.kernels.device.tiles import TILE, from_tiles
from wavequake.optics.polynomials.zernike import annular_zernike, noll_to_nm
from wavequake.optics.segments.figures import figure_frames, figure_terms
from wavequake.optics.segments.kinematics import displaced, segment_poses
from wavequake.optics.segments.layout import is_monolithic
from wavequake.optics.segments.parent import parent_system
from wavequake.optics.segments.telescope import M2
from wavequake.optics.shapes.shapes import Conic, Opening, ZernikeSag
from wavequake.optics.systems.freeze import deformed_shape
from wavequake.optics.systems.kinematics import rest_poses
from wavequake.optics.systems.system import OpticalSystem, States, Surface

Array = NDArray[np.float64]

_MOST_LEFT = 2e-9  # mm of a figure that may be lost: 1e-5 waves of visible light
_MARGIN = 1.01  # of the light that is sent to a segment, beyond its corners


def segment_systems(
    telescope: OpticalSystem,
    states: States,
    instant: int,
    wavelengths: Sequence[float],
    beside: Sequence[tuple[float, float]] = ((0.0, 0.0),),
) -> Iterator[tuple[str, OpticalSystem]]:
    """Yield the name of each segment and the system of its light, moved and with nothing left that moves.

    Light fills a circle about the segment in the plane of M1's rim: vignetting factors of the pupil.

    Parameters
    ----------
    telescope : OpticalSystem
    states : States
        Whole tiles.
    instant : int
    wavelengths : sequence of float
        mm.
    beside : sequence of (float, float)
        Angles of the field points from that of the states, rad.

    Raises
    ------
    UserError
        If a segment's figure is so fine that polynomials about the vertex of M1 do not hold it.
    """
    segments = telescope.segments
    behind = tuple(_behind(telescope, states, instant))
    parent = replace(
        parent_system(telescope, wavelengths[0]),
        fields=telescope.fields[0] + states.line_of_sight[instant] + np.array(beside),
        wavelengths=np.array(wavelengths),
    )
    stop, primary, *_ = parent.surfaces
    first = instant - instant % TILE
    tile = segment_poses(segments, states.segment_motion[first : first + TILE])
    poses = from_tiles(tile)[instant - first]
    for number, name in enumerate(segments.names):
        turn, shift = poses[number, :9].reshape(3, 3), poses[number, 9:]
        shape = _figured(telescope, number, states.segment_figure[instant, number])
        moved = replace(primary, name=name, shape=shape, position=-turn.T @ shift, rotation=turn.T)
        if is_monolithic(segments):
            yield name, replace(parent, surfaces=(stop, moved, *behind))
            continue
        corners = segments.corners[number]
        middle = (corners.min(axis=0) + corners.max(axis=0)) / 2.0
        reach = _MARGIN * np.hypot(*(corners - middle).T).max() / telescope.annulus.outer
        share = 1.0 - reach
        glass = Opening(corners=tuple((float(x), float(y)) for x, y in corners))
        light = (*(middle / telescope.annulus.outer).tolist(), share, share, 0.0)
        surfaces = (replace(stop, opening=None), replace(moved, opening=glass), *behind)
        pupil = replace(parent.pupil, obscuration=0.0)
        yield name, replace(parent, surfaces=surfaces, pupil=pupil, vignetting=(light,) * len(beside))


def _figured(telescope: OpticalSystem, segment: int, terms: Array) -> Conic | ZernikeSag:
    """Return the mirror with the figure of a segment: polynomials about its center are some about the vertex.

    These have the same degree and are exact but for rounding, which grows with it: they are small on the
    segment alone.
    """
    bare = Conic(telescope.primary.shape.radius, telescope.primary.shape.conic)
    if not terms.any():
        return bare
    segments, (a, b) = telescope.segments, figure_frames(telescope)[segment, 2:]
    radius = 1.0 / float(np.hypot(a, b))
    center = segments.centers[segment, :2]
    norm = float(np.hypot(*center)) + radius
    degree = noll_to_nm(len(terms))[0]
    angles, rings = 2.0 * np.pi * np.arange(2 * degree + 2) / (2 * degree + 2), np.arange(1, degree + 2)
    across = norm * np.sin(0.5 * np.pi * rings / (degree + 1))  # denser at the rim
    points = (across[:, None, None] * np.stack([np.cos(angles), np.sin(angles)], axis=-1)).reshape(-1, 2)
    inside = center + points * (radius / norm)

    def heights(where: Array) -> Array:
        along = figure_terms(telescope, np.full(len(where), segment), where, len(terms)) @ terms
        return np.asarray(along / -segments.axes[segment, 2, 2])  # along z, with the light

    def basis(where: Array) -> Array:
        count = (degree + 1) * (degree + 2) // 2
        return np.asarray(annular_zernike(where[:, 0] / norm, where[:, 1] / norm, count))

    found = np.linalg.lstsq(basis(points), heights(points))[0]
    left = basis(inside) @ found - heights(inside)
    if np.abs(left).max() > _MOST_LEFT:
        raise UserError(
            f"The figure of the segment {segments.names[segment]} of {telescope.name} has {len(terms)} terms "
            "about its center: about the vertex of M1, as lens files have them, they drown in rounding."
        )
    return ZernikeSag(bare.radius, bare.conic, tuple(found.tolist()), norm)


def _behind(telescope: OpticalSystem, states: States, instant: int) -> Iterator[Surface]:
    """Yield the surfaces after M1 where they stand, with their figures."""
    stand = displaced(*rest_poses(telescope), states.surface_motion[instant][None])
    parts = zip(telescope.surfaces, *(one[0] for one in stand), states.deformations, strict=True)
    for surface, position, rotation, figure in islice(parts, M2, None):
        moved = replace(surface, position=position, rotation=rotation, deformation=None)
        if figure is not None and figure[instant].any():
            shape = deformed_shape(surface, figure[instant])  # conics and even aspheres have one
            assert shape is not None
            moved = replace(moved, shape=shape)
        yield moved
