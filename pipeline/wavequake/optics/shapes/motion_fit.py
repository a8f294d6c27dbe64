"""The Zernike fit of motions that are sums of few shapes, without displacing nodes at every instant.

A node that moves by u on the paraboloid ``z = c/2 (x^2 + y^2)`` stands ``u_z - c (x u_x + y u_y) -
c/2 (u_x^2 + u_y^2)`` above it (Störkle 2018, Eq. 4.8): exactly linear plus quadratic. The linear part of a
motion is that of its shapes. The square of its motion across the axis is a sum over pairs of a few patterns,
found by principal components over time; their products are fitted once, not every instant. On other
surfaces, and for motions with too many patterns, the nodes are displaced at every instant.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from wavequake.errors import UserError
from wavequake.optics.shapes.fit import SurfaceFit, apply, coefficients
from wavequake.optics.shapes.shapes import Conic

Array = NDArray[np.float64]

TOLERANCE = 1e-12
"""What the patterns may lose of the figure, both as rms over time and surface."""

# Of the motion across the axis: what patterns leave of it is known as a square only.
_ROUNDING = np.sqrt(np.finfo(np.float64).eps)
# Instants at a time, so that the products of patterns, or all displacements, fit the memory.
_BLOCK = 1024


@dataclass(frozen=True)
class MotionFit:
    """What is fitted once for r shapes of a surface with p nodes.

    Attributes
    ----------
    fit : SurfaceFit
    shapes : ndarray, shape (r, p, 3)
        Displacements, mm.
    linear : ndarray, shape (r, terms)
        Coefficients of each shape (Störkle 2018, Eq. 4.22), mm.
    across : ndarray, shape (r, s)
        Shapes across the axis in terms of s fields that are orthonormal over the surface.
    fields : ndarray, shape (s, p, 2)
    """

    fit: SurfaceFit
    shapes: Array
    linear: Array
    across: Array
    fields: Array


def motion_fit(fit: SurfaceFit, shapes: Array) -> MotionFit:
    """Prepare the fit of sums of shapes (r, p, 3), in mm.

    Raises
    ------
    UserError
        If the shapes do not fit the nodes or are not finite.
    """
    linear = apply(fit, shapes)
    root = np.sqrt(fit.weights)[:, None]
    fields, across = np.linalg.qr((shapes[:, :, :2] * root).reshape(len(shapes), -1).T)
    fields = np.ascontiguousarray(fields.T).reshape(-1, len(root), 2) / root
    return MotionFit(fit, shapes, linear, np.ascontiguousarray(across.T), fields)


def figures(motion: MotionFit, amplitudes: Array) -> Array:
    """Return the Zernike coefficients of amplitudes (T, r) times the shapes, mm, shape (T, terms).

    As `surface_fit.apply` of the displaced nodes with the undeformed surface at their displaced x and y, to
    1e-10 of the largest figure.

    Raises
    ------
    UserError
        If an amplitude is not finite, or a node moves beyond the shape.
    """
    if not np.isfinite(amplitudes.sum()):
        raise UserError("an amplitude of a surface's motion is not finite")
    across, linear = amplitudes @ motion.across, amplitudes @ motion.linear
    directions = _patterns(motion, across, linear)
    if directions is None:
        return _node_by_node(motion, amplitudes)
    first, second = np.triu_indices(directions.shape[1])
    patterns = np.tensordot(directions.T, motion.fields, axes=1)
    products = np.einsum("npd,npd->np", patterns[first], patterns[second])
    products *= np.where(first == second, -0.5, -1.0)[:, None] * _curvature(motion)
    fitted = coefficients(motion.fit, products)
    sizes = across @ directions
    for start in range(0, len(linear), _BLOCK):
        part = sizes[start : start + _BLOCK]
        linear[start : start + _BLOCK] += (part[:, first] * part[:, second]) @ fitted
    return linear


def _curvature(motion: MotionFit) -> float:
    """Return the curvature of a paraboloid or plane, 1/mm; NaN for other shapes."""
    shape = motion.fit.shape
    if not isinstance(shape, Conic):
        return np.nan
    flat = np.isinf(shape.radius)
    return 0.0 if flat else 1.0 / shape.radius if shape.conic == -1.0 else np.nan


def _patterns(motion: MotionFit, across: Array, linear: Array) -> Array | None:
    """Return what makes few patterns of the fields, (s, k); None where displacing nodes is cheaper.

    Leaving out patterns of rms d out of a motion of rms u changes the heights by c u d.
    """
    instants, nodes = len(across), len(motion.fit.nodes)
    square, directions = np.linalg.eigh(across.T @ across / instants)
    left_out = np.sqrt(np.maximum(np.cumsum(square), 0.0))
    left_out += _ROUNDING * left_out[-1]
    lost = abs(_curvature(motion)) * left_out[-1] * left_out
    kept = ~(lost <= TOLERANCE * np.sqrt(np.square(linear).sum() / instants))
    products = kept.sum() * (kept.sum() + 1)  # each is formed and fitted: twice as dear as a node's height
    if np.isnan(lost).any() or products * (instants + nodes) > instants * nodes:
        return None
    return np.ascontiguousarray(directions[:, kept])


def _node_by_node(motion: MotionFit, amplitudes: Array) -> Array:
    """Return the same by displacing all nodes at every instant."""
    shape = motion.shapes.shape
    flat = motion.shapes.reshape(len(motion.shapes), -1)
    parts = [
        apply(motion.fit, (amplitudes[start : start + _BLOCK] @ flat).reshape(-1, *shape[1:]), linear=False)
        for start in range(0, len(amplitudes), _BLOCK)
    ]
    return np.concatenate(parts)
