"""Shapes that the report of mirror-mor draws: modes on the mirror and in its light, and a node that moves."""

import numpy as np
from numpy.typing import NDArray

from wavequake.mechanics.model import ReducedModel
from wavequake.optics.shapes.fit import apply, coefficients, heights
from wavequake.reduction.metrics import pseudo_frequencies, surface_modes
from wavequake.workflows.mirrors.optics import Optics, displacements_mm

Array = NDArray[np.float64]

SHOWN_MODES = 16
MOST_TERMS = 231
# Relative distance of two frequencies that count as one: a symmetric mirror has pairs of modes.
PAIR = 1e-3
_MM_PER_UM = 1e-3
_ROUNDING = 1e-9


def mode_shapes(optics: Optics, model: ReducedModel) -> tuple[Array, Array]:
    """Return the first elastic modes as the light sees them (Störkle 2018, Fig. 4.28).

    Returns
    -------
    figures : ndarray, shape (m, J)
        Noll coefficients of the heights above the undeformed surface, along the light, whose rms over the
        surface is 1; the largest is positive. 0 for a mode that leaves the surface as it is. Two modes of
        one frequency, of which any mixture is a mode, are turned so that the second lacks the first of the
        polynomials that are strong in them.
    wavefronts : ndarray, shape (m, J)
        Noll coefficients of the wavefront, nm, where that rms is 1 um.
    """
    frequencies = pseudo_frequencies(model)
    rigid = int(np.sum(frequencies == 0.0))
    shapes = displacements_mm(surface_modes(model)[:, rigid : rigid + SHOWN_MODES].T)
    near = (
        np.diff(frequencies[rigid : rigid + len(shapes)])
        <= PAIR * frequencies[rigid : rigid + len(shapes) - 1]
    )
    for first in np.flatnonzero(near & ~np.concatenate([[False], near[:-1]])):
        pair = shapes[first : first + 2]
        pair[:] = np.tensordot(_turn(apply(optics.surface, pair)), pair, 1)
    above = heights(optics.surface, shapes)
    moved = np.sqrt(np.square(shapes).sum(axis=2) @ optics.surface.weights)
    rms = np.sqrt(np.square(above) @ optics.surface.weights)
    seen = rms > _ROUNDING * moved
    figures = coefficients(optics.surface, above) * np.divide(1.0, rms, out=0.0 * rms, where=seen)[:, None]
    largest = np.take_along_axis(figures, np.abs(figures).argmax(axis=1)[:, None], axis=1)
    figures = np.where(largest < 0.0, -figures, figures)
    return figures, _MM_PER_UM * figures @ optics.sensitivity[2:].T


def _turn(figures: Array) -> Array:
    """Return the rotation (2, 2) of two figures (2, J) after which the second lacks a strong polynomial."""
    strength = np.square(figures).sum(axis=0)
    strong = int(np.argmax(strength >= 0.9 * strength.max()))
    size = np.hypot(*figures[:, strong]) or 1.0
    along, across = figures[:, strong] / size
    return np.array([[along, across], [-across, along]])


def rim_node(model: ReducedModel) -> int:
    """Return the place among the optical nodes of the node on the rim that is farthest from all mounts.

    Of nodes that are equally far it is the one of the least angle about the axis (Störkle 2018, Fig. 4.24:
    a node on the rim).
    """
    nodes = model.nodes[model.surface_nodes]
    radius = np.hypot(nodes[:, 0], nodes[:, 1])
    mounts = model.nodes[model.interfaces]
    away = np.linalg.norm(nodes[:, None, :2] - mounts[None, :, :2], axis=2).min(axis=1)
    apart = np.where(radius > (1.0 - 1e-6) * radius.max(), away, -1.0)
    farthest = np.flatnonzero(apart > apart.max() - 1e-6 * radius.max())
    angle = np.arctan2(nodes[farthest, 1], nodes[farthest, 0]) % (2.0 * np.pi)
    return int(farthest[np.argmin(np.round(angle, 6))])


def rim_angle(model: ReducedModel) -> float:
    """Return where on the rim that node is, in deg about the axis from x."""
    x, y, _ = model.nodes[model.surface_nodes][rim_node(model)]
    return float(np.degrees(np.arctan2(y, x)))


def node_row(model: ReducedModel) -> Array:
    """Return the row (1, r) that gives the motion of the test node along z, m per unit coordinate."""
    place = 3 * rim_node(model) + 2
    row: Array = np.asarray(model.surface[place : place + 1])
    return row
