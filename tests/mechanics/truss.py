"""Small three-dimensional bodies for tests: masses joined by bars, whose rigid motions cost nothing."""

import numpy as np

from wavequake.mechanics.model import ReducedModel

TOWER = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0.1, 0.2, 1], [1.1, -0.1, 0.9], [0.2, 1, 1.2]])


def bars(points, stiffness):
    """Stiffness matrix of axial springs between all pairs of points."""
    count = len(points)
    matrix = np.zeros((3 * count, 3 * count))
    for i in range(count):
        for j in range(i):
            along = (points[i] - points[j]) / np.linalg.norm(points[i] - points[j])
            pull = np.zeros(3 * count)
            pull[3 * i : 3 * i + 3], pull[3 * j : 3 * j + 3] = along, -along
            matrix += stiffness * (1 + 0.1 * i + 0.03 * j) * np.outer(pull, pull)
    return matrix


def model(mass, damping, stiffness, inputs, name="toy", **changes):
    """Return a model given by matrices alone."""
    mass, damping, stiffness, inputs = (np.array(m, dtype=float) for m in (mass, damping, stiffness, inputs))
    none = np.zeros(0, dtype=np.int64)
    fields = {
        "name": name,
        "method": "none",
        "mass": mass,
        "damping_matrix": damping,
        "stiffness": stiffness,
        "inputs": inputs,
        "surface": np.zeros((0, len(mass))),
        "nodes": np.zeros((0, 3)),
        "interfaces": none,
        "surface_nodes": none,
        "surface_weights": np.zeros(0),
        "seconds": 0.0,
    }
    return ReducedModel(**(fields | changes))


def oscillator(omega, ratio, mass=1.0):
    """Return one mass on a spring and a damper, driven by a force."""
    return model([[mass]], [[2 * ratio * omega * mass]], [[omega**2 * mass]], [[1.0]])


def truss(points=TOWER, stiffness=4e6, damping=2e-6, interfaces=(0, 1, 2), extra=None):
    """Return a free body of point masses with proportional damping, and perhaps a further damping matrix."""
    count = len(points)
    mass = np.diag(np.repeat(1.0 + 0.2 * np.arange(count), 3))
    matrix = bars(points, stiffness)
    chosen = np.array(interfaces, dtype=np.int64)
    columns = (3 * chosen[:, None] + np.arange(3)).ravel()
    return model(
        mass,
        damping * matrix + (0 if extra is None else extra),
        matrix,
        np.eye(3 * count)[:, columns],
        name="truss",
        surface=np.eye(3 * count),
        nodes=points,
        interfaces=chosen,
        surface_nodes=np.arange(count),
        surface_weights=np.full(count, 1 / count),
    )
