"""What a trace through a segmented telescope takes and gives."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wavequake.kernels.device.tiles import TILE
from wavequake.kernels.trace.sequence import Basis
from wavequake.kernels.trace.status import MOST_SURFACES, surface_of

Array = NDArray[np.float64]


@dataclass(frozen=True)
class SegmentedTrain:
    """A segmented primary mirror followed by L conic surfaces, of which the last is the image plane; mm.

    Attributes
    ----------
    primary_curvature, primary_conic : float
        1/R (1/mm) and conic constant of the parent surface of M1.
    edges : ndarray, shape (S, V, 3)
        Half planes (a, b, c) of each segment: (x, y) is on its glass when ``a x + b y <= c`` for all V,
        x and y in the parent frame of the displaced segment. V = 0 is a monolithic mirror without an edge.
        Where a segment is not convex, (S, V, 5): with the lowest and highest y of each edge (low, high). A
        point is on the glass if it lies beside an odd number of edges, ``low <= y < high`` and
        ``a (a x + b y - c) < 0``.
    figure_frames : ndarray, shape (S, 4)
        xc, yc, ex, ey of each segment: ``u = ex (x-xc) + ey (y-yc)``, ``v = -ey (x-xc) + ex (y-yc)``.
    figure_degree : int
        Total degree of the figure polynomial in u and v; -1 for no figure.
    surface_curvatures, surface_conics : ndarray, shape (L,)
        Of the surfaces after M1; the last is a plane.
    sphere_radius : float
        Radius of the reference sphere about the chief ray's image point; negative behind the image.
    semi_diameters : ndarray, shape (L,), optional
        Light that meets a surface farther than this from its vertex is vignetted; infinite for none.
    mirror_degree : int
        Total degree of the figure polynomials of the L - 1 mirrors after M1; -1 for none.
    mirror_radii : ndarray, shape (L - 1,), optional
        Lengths of u and v of these figures: ``u = x / radius``, ``v = y / radius``.
    figure_basis, mirror_basis : "monomial" or Ring
        Of the figures' polynomials: above degree 20 monomials cancel too much.
    indices : ndarray, shape (L,), optional
        Refractive index behind each surface that refracts, NaN for one that reflects and for the image; all
        reflect if left out. Before the first and at the image it is 1.
    """

    primary_curvature: float
    primary_conic: float
    edges: Array
    figure_frames: Array
    figure_degree: int
    surface_curvatures: Array
    surface_conics: Array
    sphere_radius: float
    semi_diameters: Array | None = None
    mirror_degree: int = -1
    mirror_radii: Array | None = None
    figure_basis: Basis = "monomial"
    mirror_basis: Basis = "monomial"
    indices: Array | None = None

    @property
    def refracts(self) -> NDArray[np.bool_]:
        """Which surfaces refract, shape (L,)."""
        nothing = np.zeros(self.surface_curvatures.size, dtype=np.bool_)
        return nothing if self.indices is None else ~np.isnan(self.indices)

    @property
    def indices_before(self) -> Array:
        """Refractive indices before each surface, shape (L,)."""
        before = np.ones(self.surface_curvatures.size)
        for surface in np.flatnonzero(self.refracts[:-1]):
            before[surface + 1 :] = self.indices[surface]  # type: ignore[index]
        return before

    @property
    def clear_squares(self) -> Array:
        """Squares of the semi-diameters, shape (L,)."""
        surfaces = self.surface_curvatures.size
        return np.full(surfaces, np.inf) if self.semi_diameters is None else self.semi_diameters**2

    @property
    def mirror_frames(self) -> Array:
        """Figure frames of the mirrors after M1, shape (L - 1, 4), as `figure_frames`."""
        frames = np.zeros((self.surface_curvatures.size - 1, 4))
        if self.mirror_radii is not None:
            frames[:, 2] = 1.0 / self.mirror_radii
        return frames


@dataclass(frozen=True)
class Traced:
    """Traced rays in tile layout (T, N, 16); lost rays are NaN.

    A device with memory of its own keeps them until NumPy asks, see `wavequake.kernels.device.resident`.

    Attributes
    ----------
    opd : ndarray, shape (T, N, 16)
        Chief ray's minus the ray's optical path length to the reference sphere, mm.
    x, y : ndarray, shape (T, N, 16)
        Position in the image frame, mm.
    status : ndarray of int8, shape (T, N, 16)
        0, or why and where a ray is lost, see `wavequake.kernels.trace.status.lost_at`: in a gap of M1, at
        a surface after it that it misses, meets beyond the semi-diameter or is totally reflected at, or at
        the reference sphere (surface L).
    """

    opd: Array
    x: Array
    y: Array
    status: NDArray[np.int8]


def vignetted(train: SegmentedTrain, status: NDArray[np.int8]) -> NDArray[np.bool_]:
    """Return which rays of a `Traced.status` pass by a mirror or lens after M1."""
    surface = surface_of(status)
    return np.asarray((surface >= 0) & (surface < train.surface_curvatures.size - 1))


def figure_terms(degree: int) -> int:
    """Return the number of polynomials of total degree up to `degree` in two variables."""
    return (degree + 1) * (degree + 2) // 2


def check_train(train: SegmentedTrain) -> None:
    """Raise ValueError unless the train's arrays fit together."""
    segments = train.edges.shape[0]
    if segments == 0:
        raise ValueError("the train has no segments; a monolithic mirror is one segment with V = 0 edges")
    edges, numbers = train.edges.shape[1:] if train.edges.ndim == 3 else (-1, 3)
    _require("edges", train.edges, (segments, edges, 5 if numbers == 5 else 3))
    _require("figure_frames", train.figure_frames, (segments, 4))
    surfaces = train.surface_curvatures.size
    _require("surface_curvatures", train.surface_curvatures, (surfaces,))
    _require("surface_conics", train.surface_conics, (surfaces,))
    if surfaces > MOST_SURFACES:
        raise ValueError(f"the train has {surfaces} surfaces after M1; it can have {MOST_SURFACES}")
    if surfaces == 0 or train.surface_curvatures[-1] != 0.0:
        raise ValueError("the last of surface_curvatures must be 0: it is the image plane")
    if train.semi_diameters is not None:
        _require("semi_diameters", train.semi_diameters, (surfaces,))
    if train.indices is not None:
        _require("indices", train.indices, (surfaces,))
        if not (train.indices[train.refracts] > 0.0).all() or train.refracts[-1]:
            raise ValueError("indices must be positive, and NaN for mirrors and for the image")
        if train.indices_before[-1] != 1.0:
            raise ValueError(f"the index before the image is {train.indices_before[-1]}; it must be 1")
    if train.mirror_degree >= 0:
        if train.mirror_radii is None:
            raise ValueError("mirror_degree needs mirror_radii")
        _require("mirror_radii", train.mirror_radii, (surfaces - 1,))
    if not (np.isfinite(train.sphere_radius) and train.sphere_radius):
        raise ValueError(f"sphere_radius is {train.sphere_radius}; it must be finite and not 0")


def check_rays(
    train: SegmentedTrain,
    ray_x: Array,
    ray_y: Array,
    candidates: NDArray[np.int32],
    segment_poses: Array,
    figure: Array | None,
    surface_poses: Array,
    directions: Array,
    chief: Array,
    mirror_figure: Array | None = None,
) -> None:
    """Raise ValueError unless rays, poses and figure fit the train and each other."""
    check_train(train)
    segments, surfaces = train.edges.shape[0], train.surface_curvatures.size
    rays, tiles = ray_x.size, segment_poses.shape[0]
    _require("ray_x", ray_x, (rays,))
    _require("ray_y", ray_y, (rays,))
    columns = candidates.shape[1] if candidates.ndim == 2 else -1
    _require("candidates", candidates, (rays, columns), np.int32)
    if candidates.size and not (candidates.min() >= -1 and candidates.max() < segments):
        raise ValueError(f"candidates must lie between -1 (none) and {segments - 1}, the last segment")
    _require("segment_poses", segment_poses, (tiles, segments, 12, TILE))
    _require("surface_poses", surface_poses, (tiles, surfaces, 12, TILE))
    _require("directions", directions, (tiles, 3, TILE))
    _require("chief", chief, (tiles, 3, TILE))
    if (mirror_figure is None) != (train.mirror_degree < 0):
        raise ValueError(
            f"mirror_degree is {train.mirror_degree}: mirror_figure must be "
            f"{'given' if mirror_figure is None else 'None'}"
        )
    if mirror_figure is not None:
        shape = (tiles, surfaces - 1, figure_terms(train.mirror_degree), TILE)
        _require("mirror_figure", mirror_figure, shape)
    if (figure is None) != (train.figure_degree < 0):
        raise ValueError(
            f"figure_degree is {train.figure_degree}: figure must be {'given' if figure is None else 'None'}"
        )
    if figure is not None:
        _require("figure", figure, (tiles, segments, figure_terms(train.figure_degree), TILE))


def _require(
    name: str, array: NDArray[Any], shape: tuple[int, ...], kind: type[np.generic] = np.float64
) -> None:
    if array.shape != shape:
        raise ValueError(f"{name} has shape {array.shape}; it must be {shape}")
    if array.dtype != kind:
        raise ValueError(f"{name} is {array.dtype}; it must be {np.dtype(kind)}")
