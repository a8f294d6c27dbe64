"""Each family against its basis as textbooks write it down, by dense algebra on the full matrices.

Craig and Kurdila 2006, Chapter 17; Rixen 2004 for the dual method; Hintz 1975. Bases of one space give the
same transfer matrix and frequencies.
"""

import numpy as np
import pytest
import scipy.linalg

from wavequake.mechanics.model import rigid_modes
from wavequake.reduction.metrics import pseudo_frequencies, receptance
from wavequake.reduction.reduce import reduce
from wavequake.reduction.structure import held, structure

FREQUENCIES = np.array([2.0, 37.0, 90.0, 260.0])


class Full:
    """Dense matrices of a free lattice and what textbooks derive from them."""

    def __init__(self, model):
        self.mass, self.stiffness, self.inputs = (
            a.toarray() for a in (model.mass, model.stiffness, model.inputs)
        )
        self.damping = model.damping_matrix.toarray()
        self.rigid = rigid_modes(model.nodes, np.zeros(3))
        self.boundary = (3 * model.interfaces[:, None] + np.arange(3)).ravel()
        squared, shapes = scipy.linalg.eigh(self.stiffness, self.mass)
        # Which six directions Hintz holds is a choice; what is made of them is not.
        self.held = held(structure(model))
        self.squared, self.free = squared[6:], shapes[:, 6:]

    def flexibility(self):
        """Elastic flexibility: clamp six coordinates, filter the rigid parts of loads and displacements."""
        inner = np.setdiff1d(np.arange(len(self.mass)), self.boundary[self.determinate()])
        clamped = np.zeros_like(self.mass)
        clamped[np.ix_(inner, inner)] = np.linalg.inv(self.stiffness[np.ix_(inner, inner)])
        rigid_mass = self.rigid.T @ self.mass @ self.rigid
        filtered = np.eye(len(self.mass)) - self.mass @ self.rigid @ np.linalg.solve(rigid_mass, self.rigid.T)
        return filtered.T @ clamped @ filtered

    def determinate(self):
        """Six interface coordinates that hold the body: pivots of the mass-normalized rigid motions."""
        factor = np.linalg.cholesky(self.rigid.T @ self.mass @ self.rigid)
        normalized = np.linalg.solve(factor, self.rigid.T).T
        return np.sort(scipy.linalg.qr(normalized[self.boundary].T, mode="r", pivoting=True)[1][:6])

    def constraint_modes(self, kept):
        inner = np.setdiff1d(np.arange(len(self.mass)), kept)
        modes = np.zeros((len(self.mass), len(kept)))
        modes[kept] = np.eye(len(kept))
        modes[inner] = -np.linalg.solve(
            self.stiffness[np.ix_(inner, inner)], self.stiffness[np.ix_(inner, kept)]
        )
        return modes

    def fixed_modes(self, kept, count):
        inner = np.setdiff1d(np.arange(len(self.mass)), kept)
        found = np.zeros((len(self.mass), count))
        matrices = (a[np.ix_(inner, inner)] for a in (self.stiffness, self.mass))
        found[inner] = scipy.linalg.eigh(*matrices, subset_by_index=(0, count - 1))[1]
        return found

    def attachment_modes(self, held, loaded):
        inner = np.setdiff1d(np.arange(len(self.mass)), held)
        forces = np.eye(len(self.mass))[:, loaded]
        modes = np.zeros_like(forces)
        modes[inner] = np.linalg.solve(self.stiffness[np.ix_(inner, inner)], forces[inner])
        return modes

    def basis(self, method, order):
        boundary, kept = self.boundary, order - 15
        if method == "modal":
            return np.hstack([self.rigid, self.free[:, : order - 6]])
        if method == "modalfix":
            return self.fixed_modes(boundary, order)
        if method == "guyan":
            return self.constraint_modes(boundary)
        if method == "craigb":
            return np.hstack([self.constraint_modes(boundary), self.fixed_modes(boundary, order - 9)])
        if method == "hintz":
            held = self.held
            loaded = np.setdiff1d(boundary, held)
            static = self.attachment_modes(held, loaded)
            return np.hstack([self.rigid, static, self.fixed_modes(held, order - 9)])
        attachment = self.flexibility() @ self.inputs
        modes = self.free[:, :kept]
        if method in ("rubin", "dualcb"):
            attachment = attachment - modes @ ((modes.T @ self.inputs) / self.squared[:kept, None])
        return np.hstack([self.rigid, modes, attachment])

    def receptance(self, basis, frequencies):
        mass, damping, stiffness = (basis.T @ a @ basis for a in (self.mass, self.damping, self.stiffness))
        inputs = basis.T @ self.inputs
        omega = 2 * np.pi * frequencies
        return np.array(
            [inputs.T @ np.linalg.solve(stiffness + 1j * w * damping - w**2 * mass, inputs) for w in omega]
        )


@pytest.mark.parametrize(
    ("method", "order"),
    [
        ("modal", 20),
        ("guyan", 9),
        ("craigb", 21),
        ("rubin", 21),
        ("dualcb", 21),
        ("inertia", 21),
        ("hintz", 21),
    ],
)
@pytest.mark.parametrize("seed", [0, 7])
def test_reduced_models_are_those_of_the_textbook_basis(make_lattice, method, order, seed):
    model = make_lattice(seed=seed)
    full, reduced = Full(model), reduce(model, method, order)
    basis = full.basis(method, order)
    assert basis.shape == (54, order) == (54, np.linalg.matrix_rank(basis))
    wanted = full.receptance(basis, FREQUENCIES)
    np.testing.assert_allclose(
        receptance(reduced, FREQUENCIES), wanted, rtol=0, atol=1e-9 * np.abs(wanted).max()
    )
    squared = scipy.linalg.eigvalsh(basis.T @ full.stiffness @ basis, basis.T @ full.mass @ basis)
    np.testing.assert_allclose(pseudo_frequencies(reduced)[6:], np.sqrt(squared[6:]) / (2 * np.pi), rtol=1e-8)


def test_fixed_interface_modes_are_those_of_the_clamped_matrices(lattice):
    full, reduced = Full(lattice), reduce(lattice, "modalfix12")
    basis = full.basis("modalfix", 12)
    squared = scipy.linalg.eigvalsh(basis.T @ full.stiffness @ basis, basis.T @ full.mass @ basis)
    np.testing.assert_allclose(pseudo_frequencies(reduced), np.sqrt(squared) / (2 * np.pi), rtol=1e-9)
    # Shapes up to sign at the optical nodes.
    found, wanted = reduced.surface, lattice.surface @ basis
    signs = np.sign(np.sum(found * wanted, axis=0))
    np.testing.assert_allclose(found, wanted * signs, rtol=0, atol=1e-8)


def test_guyan_is_exact_under_static_loads_at_the_interface(supported_lattice):
    """K_r is the Schur complement: its displacements are those of the full matrix, inside too."""
    model, reduced = supported_lattice, reduce(supported_lattice, "guyan")
    forces = np.random.default_rng(3).normal(size=9)
    inside = np.linalg.solve(model.stiffness.toarray(), model.inputs.toarray() @ forces)
    coordinates = np.linalg.solve(reduced.stiffness, reduced.inputs @ forces)
    np.testing.assert_allclose(reduced.surface @ coordinates, model.surface @ inside, rtol=1e-9, atol=1e-15)
