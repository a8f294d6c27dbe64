"""How long a second step onto a figured mirror may be, see ``kernels/figure.h``."""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from wavequake.kernels.trace.packing import _BEYOND, _HEIGHT, _SLOPE, _bend
from wavequake.kernels.trace.polynomial_numpy import polynomial
from wavequake.kernels.trace.sequence import Basis
from wavequake.kernels.trace.train import SegmentedTrain

Array = NDArray[np.float64]

# Rays that meet mirrors under up to 60 degrees take steps up to so much longer than the figure is high.
_OBLIQUE = 4.0
# Light that meets segments so nearly along their normals does not move sideways in the first step, and the
# second is exact: 1 mm per coefficient leaves 4e-9 mm at the image. Segments are many, and limits take time.
_ALONG_NORMALS = 1e-3


def train_limits(
    train: SegmentedTrain,
    segment_poses: Array,
    figure: Array | None,
    mirror_figure: Array | None,
    directions: Array,
) -> tuple[Array | None, Array | None]:
    """Return limits of the segments' figures (T, S, 16) and of those of the mirrors after M1 (T, L - 1, 16).

    Arguments are those of `wavequake.kernels.trace.segmented.trace_segmented`. A limit is the square of the
    longest lateral second step, mm^2, after which height and slopes of a figure still hold; None where no ray
    takes a longer one, or where there is no figure.
    """
    segments = mirrors = None
    inclination = 2.0 * _largest(directions[:, :2])
    if figure is not None and (figure.shape[1] == 1 or inclination > _ALONG_NORMALS):
        inclination += 2.0 * _largest(segment_poses[:, :, 2:6:3])
        form = (train.figure_degree, train.figure_basis)
        lean = abs(train.primary_curvature) * (1.0 + abs(1.0 + train.primary_conic))
        segments = figure_limits(figure, form, train.figure_frames, lean, inclination)
    if mirror_figure is not None:
        form = (train.mirror_degree, train.mirror_basis)
        lean = np.max(np.abs(train.surface_curvatures) * (1.0 + np.abs(1.0 + train.surface_conics)))
        mirrors = figure_limits(mirror_figure, form, train.mirror_frames, lean, 1.0)
    return segments, mirrors


@np.errstate(divide="ignore", over="ignore", invalid="ignore")
def figure_limits(
    figure: Array, form: tuple[int, Basis], frames: Array, lean: float, inclination: float
) -> Array | None:
    """Return the limits (T, K, 16) of figures (T, K, M, 16) of a degree and basis in frames (K, 4), or None.

    ``lean`` bounds the second derivatives of the mirrors without figures (1/mm), and ``inclination`` the
    lateral part of directions at them.
    """
    scale = np.hypot(frames[:, 2], frames[:, 3])
    # By the inequality of Cauchy and Schwarz, which takes one pass over the coefficients.
    each = figure.reshape(-1, figure.shape[2] * figure.shape[3])
    largest = np.sqrt(_largest(np.vecdot(each, each)))
    high, steep, bent = (largest * np.linalg.norm(size) for size in _sizes(*form))
    steep, bent = steep * scale.max(), bent * scale.max() ** 2
    second = _OBLIQUE * high * (steep * inclination + lean * high)
    if (second * inclination) ** 2 <= _limit(bent) and second**2 * lean <= _HEIGHT:
        return None
    return _limit(np.matmul(_sizes(*form)[2], np.abs(figure)) * scale[:, None] ** 2)


def _largest(values: Array) -> float:
    """Return the largest absolute value of those that are numbers: of the others light is lost anyhow."""
    return float(np.fmax.reduce(np.abs(values), axis=None, initial=0.0))


def _limit(bend: Array) -> Array:
    return np.asarray(np.minimum(_HEIGHT / bend, np.square(_SLOPE / bend)))


@lru_cache(maxsize=16)
def _sizes(degree: int, basis: Basis) -> tuple[Array, Array, Array]:
    """Return bounds of the polynomials, their slopes and their second derivatives on the unit circle."""
    terms = np.eye((degree + 1) * (degree + 2) // 2)
    radii = _BEYOND * np.array([0.25, 0.5, 0.75, 1.0])
    angles = np.linspace(0.0, 2.0 * np.pi, 2 * degree + 2, endpoint=False)
    u, v = (radii[:, None] * np.stack([np.cos(angles), np.sin(angles)])[:, None]).reshape(2, 1, -1)
    value, slope_u, slope_v = (np.abs(a).max(axis=1) for a in polynomial(degree, 1.0, basis, terms, u, v))
    return value, slope_u + slope_v, _bend(terms, degree, basis)
