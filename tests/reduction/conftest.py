"""Free-floating lattices of point masses and axial springs, and their dense solutions."""

import numpy as np
import pytest
from scipy.sparse import csc_array

from wavequake.mechanics.mirrors.models import AnnularMirror, CircularMirror, annular_mirror, circular_mirror
from wavequake.mechanics.model import FiniteElementModel, RayleighDamping
from wavequake.reduction.intermediate import intermediate


def build_lattice(shape=(3, 3, 2), seed=0, interfaces=None, supported=False, damping=None, jitter=0.1):
    """Jittered unit cells, springs to all neighbors up to a space diagonal; some 60 Hz upward."""
    random = np.random.default_rng(seed)
    nodes = np.stack(np.meshgrid(*(np.arange(n, dtype=float) for n in shape), indexing="ij"), -1).reshape(
        -1, 3
    )
    nodes += random.uniform(-jitter, jitter, nodes.shape)
    first, second = np.triu_indices(len(nodes), 1)
    near = np.linalg.norm(nodes[first] - nodes[second], axis=1) < 1.95
    first, second = first[near], second[near]
    along = nodes[second] - nodes[first]
    along /= np.linalg.norm(along, axis=1)[:, None]
    stretch = np.zeros((len(first), 3 * len(nodes)))
    for axis in range(3):
        stretch[np.arange(len(first)), 3 * first + axis] = -along[:, axis]
        stretch[np.arange(len(first)), 3 * second + axis] = along[:, axis]
    stiffness = stretch.T @ (random.uniform(0.5e6, 2e6, len(first))[:, None] * stretch)
    if supported:
        stiffness[np.arange(3), np.arange(3)] += 1e6
        stiffness[-3:, -3:] += 1e6 * np.eye(3)
        stiffness[4, 4] += 1e6
    if interfaces is None:
        interfaces = [0, shape[2] * (shape[1] - 1), len(nodes) - shape[2]]
    return FiniteElementModel(
        name="lattice",
        mass=csc_array(np.diag(np.repeat(random.uniform(0.5, 2.0, len(nodes)), 3))),
        stiffness=csc_array(stiffness),
        damping=damping or RayleighDamping(1.0, 2e-5),
        nodes=nodes,
        dof_node=np.repeat(np.arange(len(nodes)), 3),
        dof_direction=np.tile(np.arange(3), len(nodes)),
        interfaces=np.array(interfaces),
        surface_nodes=np.arange(shape[2] - 1, len(nodes), shape[2]),
        surface_weights=np.full(shape[0] * shape[1], 1.0 / (shape[0] * shape[1])),
    )


def dense_receptance(model, frequencies, outputs=None):
    """One solution per frequency of the full matrices."""
    mass, stiffness, damping = (a.toarray() for a in (model.mass, model.stiffness, model.damping_matrix))
    inputs = model.inputs.toarray()
    outputs = inputs.T if outputs is None else outputs
    omega = 2 * np.pi * np.asarray(frequencies)
    return np.array(
        [outputs @ np.linalg.solve(stiffness + 1j * w * damping - w**2 * mass, inputs) for w in omega]
    )


@pytest.fixture(scope="session")
def lattice():
    return build_lattice()


@pytest.fixture(scope="session")
def supported_lattice():
    return build_lattice(supported=True)


@pytest.fixture(scope="session")
def coarse_mirror():
    """The mirror of Störkle 2018, Section 4.3, on a mesh of 1845 degrees of freedom."""
    return circular_mirror(CircularMirror(core=3, rings=3))


@pytest.fixture(scope="session")
def mirror_stage(coarse_mirror):
    return intermediate(coarse_mirror)


@pytest.fixture(scope="session")
def annular_stage():
    return intermediate(annular_mirror(AnnularMirror(around=24, rings=3)))


@pytest.fixture(scope="session")
def make_lattice():
    return build_lattice


@pytest.fixture(scope="session")
def exact():
    return dense_receptance
