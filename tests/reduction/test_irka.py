import numpy as np
import pytest
import scipy.linalg

from wavequake.errors import UserError
from wavequake.reduction.methods import irka as module
from wavequake.reduction.metrics import receptance
from wavequake.reduction.reduce import reduce
from wavequake.reduction.two_stage import reduce_variants


@pytest.mark.parametrize("order", [24, 25, 30])
def test_the_fixed_point_interpolates_at_its_own_mirrored_poles(lattice, order):
    """Elastic parts of H(s) b agree at s = -p, where b is the direction of the residue of the pole p."""
    reduced = reduce(lattice, f"irka{order}")
    squared, shapes = scipy.linalg.eigh(lattice.stiffness.toarray(), lattice.mass.toarray())
    squared, inputs = squared[6:], (lattice.inputs.T @ shapes).T[6:]
    small, driven = np.diag(reduced.stiffness)[6:], reduced.inputs[6:]
    alpha, beta = lattice.damping.mass, lattice.damping.stiffness
    half = (alpha + beta * small) / 2
    strength = (driven**2).sum(axis=1) / (half * small)
    interpolated = optimal = 0
    for mode in np.argsort(-strength):
        s = half[mode] + 1j * np.sqrt(small[mode] - half[mode] ** 2)
        full = inputs.T @ ((inputs @ driven[mode]) / (squared + s * (alpha + beta * squared) + s**2))
        own = driven.T @ ((driven @ driven[mode]) / (small + s * (alpha + beta * small) + s**2))
        interpolated += np.linalg.norm(full - own) < 1e-4 * np.linalg.norm(full)
        optimal += is_hermite(s, (squared, inputs), (small, driven), driven[mode], (alpha, beta))
    assert interpolated >= (order - 6) // 2
    assert optimal >= (order - 6) // 2


def is_hermite(s, full, reduced, direction, damping):
    """Condition of first order of the H2 norm: b^T H'(s) b agrees, too (Gugercin et al. 2008)."""
    slopes = []
    for squared, inputs in (full, reduced):
        rates = damping[0] + damping[1] * squared
        seen = (inputs @ direction) ** 2
        slopes.append(np.sum(-seen * (2 * s + rates) / (squared + s * rates + s**2) ** 2))
    return abs(slopes[0] - slopes[1]) < 1e-4 * abs(slopes[0])


def test_irka_beats_modal_truncation_between_the_resonances(lattice, exact):
    frequencies = np.array([20.0, 45.0])
    wanted = exact(lattice, frequencies)
    errors = [
        np.abs(receptance(reduce(lattice, n), frequencies) - wanted).max() for n in ("irka24", "modal24")
    ]
    assert errors[0] < errors[1]


@pytest.mark.parametrize("order", [7, 9, 23, 24, 37])
def test_even_and_odd_orders_settle_on_a_mirror(mirror_stage, order):
    (reduced,) = reduce_variants(mirror_stage, [f"irka{order}"])
    assert reduced.order == order
    assert np.isfinite(reduced.inputs).all()


def test_shifts_that_do_not_settle_are_reported(make_lattice, monkeypatch):
    monkeypatch.setattr(module, "_ITERATIONS", 2)
    with pytest.raises(UserError, match="did not converge: after 2 iterations"):
        reduce(make_lattice(seed=5), "irka24")


def test_order_above_the_model_is_refused(lattice):
    with pytest.raises(UserError, match="above the 54 degrees of freedom"):
        reduce(lattice, "irka60")
