import numpy as np
import pytest
import scipy.integrate
import scipy.linalg

from wavequake.errors import UserError
from wavequake.reduction.methods import pod as module
from wavequake.reduction.metrics import pseudo_frequencies
from wavequake.reduction.reduce import reduce
from wavequake.reduction.structure import structure

SQUARED = np.array([30.0, 400.0, 25.0, 9.0])
DAMPINGS = np.array([0.3, 1.0, 30.0, 6.0])
INSTANTS = np.linspace(0.05, 1.5, 8)


def integrate(squared, damping, force, start):
    solution = scipy.integrate.solve_ivp(
        lambda t, y: [y[1], force(t) - damping * y[1] - squared * y[0]],
        (0, INSTANTS[-1]), start, t_eval=INSTANTS, rtol=1e-10, atol=1e-13,
    )  # fmt: skip
    return solution.y[0]


def test_impulse_responses_solve_the_equation_of_motion():
    wanted = [integrate(w, d, lambda t: 0.0, (0, 1)) for w, d in zip(SQUARED, DAMPINGS, strict=True)]
    assert module._impulse(SQUARED, DAMPINGS, INSTANTS) == pytest.approx(np.array(wanted), abs=1e-7)


def test_sine_responses_solve_the_equation_of_motion():
    wanted = [
        integrate(w, d, lambda t: np.sin(7 * t), (0, 0)) for w, d in zip(SQUARED, DAMPINGS, strict=True)
    ]
    assert module._sine(SQUARED, DAMPINGS, INSTANTS, 7.0) == pytest.approx(np.array(wanted), abs=1e-7)


def test_snapshots_of_few_modes_give_these_modes_back(lattice):
    squared, shapes = scipy.linalg.eigh(lattice.stiffness.toarray(), lattice.mass.toarray())
    random = np.random.default_rng(0)
    snapshots = shapes[:, :10] @ random.normal(size=(10, 30))
    frequencies = pseudo_frequencies(reduce(lattice, "pod10", snapshots=snapshots))
    assert frequencies[6:] == pytest.approx(np.sqrt(squared[6:10]) / (2 * np.pi), rel=1e-6)


def test_no_basis_of_its_size_catches_more_of_the_snapshots(lattice):
    """Eckart and Young in the norm of the mass: the loss is that of the smaller singular values."""
    random = np.random.default_rng(4)
    snapshots = random.normal(size=(54, 20)) * np.geomspace(1.0, 1e-2, 20)
    body = structure(lattice)
    weight = np.sqrt(lattice.mass.diagonal())[:, None]
    elastic = body.remove_rigid(snapshots)
    basis = module.pod(body, 8, snapshots)
    q = np.linalg.qr(weight * basis)[0]
    lost = weight * elastic - q @ (q.T @ (weight * elastic))
    wanted = np.sum(np.linalg.svd(weight * elastic, compute_uv=False)[8:] ** 2)
    assert np.sum(lost**2) == pytest.approx(wanted, rel=1e-9)


@pytest.mark.parametrize(
    ("name", "snapshots", "message"),
    [
        ("pod12", np.ones((5, 4)), "must be finite and have 54 rows"),
        ("pod12", np.full((54, 4), np.nan), "must be finite"),
        ("pod12", np.random.default_rng(0).normal(size=(54, 4)), "span 4 elastic directions"),
        ("pod12", np.zeros((54, 0)), "must be finite and have 54 rows"),
        ("pod12", np.zeros((54, 9)), "span 0 elastic directions"),
        ("craigb20", np.ones((54, 4)), "Snapshots are for pod"),
    ],
)
def test_bad_snapshots_are_explained(lattice, name, snapshots, message):
    with pytest.raises(UserError, match=message):
        reduce(lattice, name, snapshots=snapshots)
