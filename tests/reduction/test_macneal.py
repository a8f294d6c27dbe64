"""MacNeal's model: free modes and the flexibility of the others, without their mass."""

import numpy as np
import pytest
import scipy.linalg

from wavequake.errors import UserError
from wavequake.mechanics.model import RayleighDamping
from wavequake.mechanics.vibration.drive import Drive, Harmonic
from wavequake.mechanics.vibration.modal import modal_model
from wavequake.mechanics.vibration.response import displacements, respond
from wavequake.reduction.intermediate import intermediate
from wavequake.reduction.methods.component_modes import MASSLESS_HZ
from wavequake.reduction.metrics import eps_mor, pseudo_frequencies, receptance
from wavequake.reduction.names import parse
from wavequake.reduction.reduce import reduce
from wavequake.reduction.two_stage import covers, reduce_variants

FREQUENCIES = np.array([3.0, 40.0, 111.0, 300.0])


def interface_dofs(model):
    return (3 * model.interfaces[:, None] + np.arange(3)).ravel()


def summed(model, kept, frequencies):
    """MacNeal 1971 from all modes of the full matrices: the first `kept` vibrate, the others give way."""
    squared, shapes = scipy.linalg.eigh(model.stiffness.toarray(), model.mass.toarray())
    rigid = int((squared < 1e-6 * squared[-1]).sum())
    squared[:rigid] = 0.0
    alpha, beta = model.damping.mass, model.damping.stiffness
    rows, result = shapes[interface_dofs(model)], []
    for omega in 2 * np.pi * np.asarray(frequencies):
        inertia = np.where(np.arange(len(squared)) < kept, -(omega**2) + 1j * omega * alpha, 0.0)
        dynamic = inertia + squared * (1 + 1j * omega * beta)
        result.append((rows / dynamic) @ rows.T)
    return np.array(result)


@pytest.mark.parametrize("order", [20, 30, 54])
def test_the_modes_that_are_left_out_give_way_without_inertia(lattice, order):
    """At 300 Hz the mass of shapes at 1 MHz is 1e-7 of the residual."""
    wanted = summed(lattice, order - 9, FREQUENCIES)
    found = receptance(reduce(lattice, f"macneal{order}"), FREQUENCIES)
    np.testing.assert_allclose(found, wanted, rtol=0, atol=2e-7 * np.abs(wanted).max())


def test_of_a_supported_body_too_and_its_statics_are_exact(supported_lattice, exact):
    reduced = reduce(supported_lattice, "macneal24")
    static = exact(supported_lattice, [0.0])
    np.testing.assert_allclose(receptance(reduced, 0.0), static, rtol=1e-8, atol=1e-16)
    wanted = summed(supported_lattice, 15, FREQUENCIES)
    np.testing.assert_allclose(
        receptance(reduced, FREQUENCIES), wanted, rtol=0, atol=2e-7 * np.abs(wanted).max()
    )


def test_the_residual_mass_is_what_rubin_adds(lattice, exact):
    """Well below the first mode that is left out both are good, Rubin's the better one."""
    frequencies = np.linspace(1.0, 60.0, 30)
    truth = exact(lattice, frequencies)
    rubin, macneal, modal = (
        eps_mor(truth, receptance(reduce(lattice, name), frequencies)).max()
        for name in ("rubin30", "macneal30", "modal30")
    )
    assert 30.0 * rubin < macneal < modal / 10.0


def test_modes_are_exact_and_the_rest_is_far_above(lattice):
    reduced = reduce(lattice, "macneal20")
    squared = scipy.linalg.eigh(lattice.stiffness.toarray(), lattice.mass.toarray(), eigvals_only=True)
    frequencies = pseudo_frequencies(reduced)
    assert (frequencies[:6] == 0).all()
    np.testing.assert_allclose(frequencies[6:11], np.sqrt(squared[6:11]) / (2 * np.pi), rtol=1e-9)
    np.testing.assert_allclose(frequencies[11:], MASSLESS_HZ, rtol=1e-12)
    assert (reduced.mass == np.eye(20)).all()


def test_prescribed_interfaces_leave_the_oscillators_of_a_massless_residual(lattice):
    """u = rows q + F f with u = 0: f = -F^-1 rows q, so the modes see springs F^-1 at the interface."""
    kept = 15
    squared, shapes = scipy.linalg.eigh(lattice.stiffness.toarray(), lattice.mass.toarray())
    squared[:6] = 0.0
    rows = shapes[interface_dofs(lattice)]
    flexibility = (rows[:, kept:] / squared[kept:]) @ rows[:, kept:].T
    stiffness = np.diag(squared[:kept]) + rows[:, :kept].T @ np.linalg.solve(flexibility, rows[:, :kept])
    wanted = np.linalg.eigvalsh(stiffness)
    modal = modal_model(reduce(lattice, f"macneal{kept + 9}"), np.ones(9, dtype=bool))
    np.testing.assert_allclose(modal.squared, wanted, rtol=1e-5)


def test_time_responses_are_those_of_modes_and_a_flexibility_that_gives_way(lattice):
    """A sine of 20 Hz that sets in: the shapes at 1 MHz, overdamped, add what their flexibility gives."""
    kept, omega = 15, 2 * np.pi * 20.0
    time, force = np.arange(400) * 5e-4, np.arange(1.0, 10.0)
    zeros = np.zeros(9)
    drive = Drive(np.zeros(9, dtype=bool), (Harmonic(omega, 0.0, zeros, force),))

    def moved(name):
        model = reduce(lattice, name)
        return displacements(respond(modal_model(model), [drive], time), model.inputs.T)[0]

    squared, shapes = scipy.linalg.eigh(lattice.stiffness.toarray(), lattice.mass.toarray())
    rows = shapes[interface_dofs(lattice), kept:]
    flexibility = (rows / squared[kept:]) @ rows.T
    # K (u + beta u') = sin(omega t) from rest.
    beta = lattice.damping.stiffness
    lag = np.sin(omega * time) - omega * beta * (np.cos(omega * time) - np.exp(-time / beta))
    wanted = moved(f"modal{kept}") + np.outer(lag / (1 + (omega * beta) ** 2), flexibility @ force)
    found = moved(f"macneal{kept + 9}")
    scale = np.abs(wanted - moved(f"modal{kept}")).max()
    np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-5 * scale)


def test_the_intermediate_model_gives_the_same(coarse_mirror, mirror_stage):
    variant = parse("macneal35")  # 36 cuts a pair of modes
    assert covers(mirror_stage, variant)
    frequencies = np.linspace(20.0, 1200.0, 40)
    direct, staged = reduce(coarse_mirror, variant), reduce_variants(mirror_stage, [variant])[0]
    apart = eps_mor(receptance(direct, frequencies), receptance(staged, frequencies))
    assert apart.max() < 1e-7


def test_orders_that_do_not_suit(lattice, make_lattice):
    with pytest.raises(UserError, match="macneal14 is below the 15 rigid motions and attachment modes"):
        reduce(lattice, "macneal14")
    with pytest.raises(UserError, match=r"macneal20: shapes without mass ring .* choose rubin"):
        reduce(make_lattice(damping=RayleighDamping(1.0, 0.0)), "macneal20")
    with pytest.raises(UserError, match="'macneal' has no order"):
        reduce(lattice, "macneal")
    with pytest.raises(UserError, match="above the 54 degrees of freedom"):
        reduce(lattice, "macneal55")
    assert not covers(intermediate(make_lattice(shape=(5, 5, 4)), modes=20), parse("macneal100"))
