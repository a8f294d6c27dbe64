"""Each basis keeps exactly what its definition promises."""

import numpy as np
import pytest
import scipy.linalg
from hypothesis import given
from hypothesis import strategies as st

from wavequake.errors import UserError
from wavequake.reduction.metrics import pseudo_frequencies, receptance
from wavequake.reduction.reduce import reduce

FREQUENCIES = np.array([3.0, 40.0, 111.0, 300.0])
ALL = [
    "modal20",
    "guyan9",
    "craigb20",
    "rubin20",
    "dualcb20",
    "inertia20",
    "hintz20",
    "krylov20(90)",
    "krylov24(50j)",
    "krylov24(60+20j)",
    "bt20",
    "flbt20(0-200)",
    "fwbt20(0-100*1,100-300*0.1)",
    "pod20",
    "pod20(70)",
]


def full_frequencies(model, clamped=()):
    free = np.setdiff1d(np.arange(model.order), clamped)
    matrices = (a.toarray()[np.ix_(free, free)] for a in (model.stiffness, model.mass))
    return np.sqrt(np.maximum(scipy.linalg.eigh(*matrices, eigvals_only=True), 0)) / (2 * np.pi)


def clamped_frequencies(reduced, rows):
    """Frequencies of a reduced model whose interface displacements `rows` are held."""
    motions = scipy.linalg.null_space(reduced.inputs.T[rows])
    squared = scipy.linalg.eigh(
        motions.T @ reduced.stiffness @ motions, motions.T @ reduced.mass @ motions, eigvals_only=True
    )
    return np.sqrt(squared) / (2 * np.pi)


def interface_dofs(model):
    return (3 * model.interfaces[:, None] + np.arange(3)).ravel()


def test_modal_truncation_keeps_the_lowest_frequencies(lattice):
    assert pseudo_frequencies(reduce(lattice, "modal20"))[6:] == pytest.approx(
        full_frequencies(lattice)[6:20], rel=1e-9
    )


def test_static_condensation_is_the_schur_complement(lattice):
    reduced = reduce(lattice, "guyan")
    kept = interface_dofs(lattice)
    rest = np.setdiff1d(np.arange(lattice.order), kept)
    full = lattice.stiffness.toarray()
    schur = full[np.ix_(kept, kept)] - full[np.ix_(kept, rest)] @ np.linalg.solve(
        full[np.ix_(rest, rest)], full[np.ix_(rest, kept)]
    )
    back = np.linalg.inv(reduced.inputs)
    assert back @ reduced.stiffness @ back.T == pytest.approx(schur, abs=1e-9 * np.abs(schur).max())
    assert reduced.name == "guyan9"


@pytest.mark.parametrize(
    "name", ["guyan9", "craigb15", "rubin15", "dualcb15", "inertia15", "hintz15", "krylov15(0)"]
)
def test_statics_of_a_supported_body_are_exact(supported_lattice, exact, name):
    static = exact(supported_lattice, [0.0])
    assert receptance(reduce(supported_lattice, name), 0.0) == pytest.approx(static, rel=1e-8, abs=1e-16)


@pytest.mark.parametrize("name", ["rubin18", "dualcb18", "inertia18", "hintz18", "krylov18(0)", "craigb18"])
def test_elastic_flexibility_of_a_free_body_is_exact(lattice, name):
    squared, shapes = scipy.linalg.eigh(lattice.stiffness.toarray(), lattice.mass.toarray())
    rows = shapes[interface_dofs(lattice), 6:]
    wanted = rows @ (rows.T / squared[6:, None])
    reduced = reduce(lattice, name)
    got = (reduced.inputs[6:].T / np.diag(reduced.stiffness)[6:]) @ reduced.inputs[6:]
    # Constraint modes are exact under interface forces alone, not under the inertia of the free body.
    error = np.abs(got - wanted).max() / np.abs(wanted).max()
    assert error < 1e-9 if name not in ("craigb18", "hintz18") else error > 1e-4


@pytest.mark.parametrize("name", ["craigb54", "rubin54", "modal54", "hintz54", "inertia54"])
def test_all_modes_are_the_full_model(lattice, exact, name):
    reduced = reduce(lattice, name)
    assert pseudo_frequencies(reduced)[6:] == pytest.approx(full_frequencies(lattice)[6:], rel=1e-8)
    wanted = exact(lattice, FREQUENCIES)
    assert receptance(reduced, FREQUENCIES) == pytest.approx(wanted, abs=1e-8 * np.abs(wanted).max())


def test_craig_bampton_keeps_the_fixed_interface_modes(lattice):
    fixed = full_frequencies(lattice, interface_dofs(lattice))
    assert clamped_frequencies(reduce(lattice, "craigb20"), range(9)) == pytest.approx(fixed[:11], rel=1e-8)


def test_fixed_interface_modes_never_move_the_interface(lattice):
    reduced = reduce(lattice, "modalfix12")
    fixed = full_frequencies(lattice, interface_dofs(lattice))
    assert pseudo_frequencies(reduced) == pytest.approx(fixed[:12], rel=1e-9)
    assert np.abs(reduced.inputs).max() == 0


def test_mixed_boundary_keeps_the_modes_of_a_determinate_support(lattice):
    """Some six of the nine interface directions are held; with them the lowest modes are exact."""
    reduced = reduce(lattice, "hintz20")
    matches = 0
    for left_out in [(a, b, c) for a in range(9) for b in range(a) for c in range(b)]:
        rows = np.setdiff1d(np.arange(9), left_out)
        if np.linalg.svd(reduced.inputs.T[rows, :6], compute_uv=False)[-1] < 1e-6:
            continue
        wanted = full_frequencies(lattice, interface_dofs(lattice)[rows])[:11]
        matches += np.allclose(clamped_frequencies(reduced, rows)[:11], wanted, rtol=1e-8)
    assert matches == 1


def test_rubin_martinez_and_inertia_relief_span_one_space(lattice):
    rubin, martinez, relief = (
        receptance(reduce(lattice, f"{name}20"), 90.0) for name in ("rubin", "dualcb", "inertia")
    )
    assert martinez == pytest.approx(rubin, rel=1e-9)
    assert relief == pytest.approx(rubin, rel=1e-7, abs=1e-9 * np.abs(rubin).max())


@given(st.integers(0, 10**6), st.sampled_from(ALL))
def test_reduced_lattices_are_symmetric_and_keep_rigid_motions(make_lattice, seed, name):
    model = make_lattice(seed=seed)
    reduced = reduce(model, name)
    assert np.array_equal(reduced.mass, np.eye(reduced.order))
    assert np.array_equal(reduced.stiffness, reduced.stiffness.T)
    squared = np.diag(reduced.stiffness)
    assert (squared[:6] == 0).all()
    assert squared[6] > 0
    # Forces at the interface accelerate the body as Newton and Euler say, whatever the basis.
    shapes = scipy.linalg.eigh(model.stiffness.toarray(), model.mass.toarray())[1][:, :6]
    motions = shapes[interface_dofs(model)]
    assert reduced.inputs[:6].T @ reduced.inputs[:6] == pytest.approx(motions @ motions.T, abs=1e-9)
    # Rayleigh-Ritz: no frequency below that of the full model, none above its highest.
    full = full_frequencies(model)
    frequencies = pseudo_frequencies(reduced)
    assert (frequencies[6:] >= full[6 : reduced.order] * (1 - 1e-9)).all()
    assert frequencies[-1] <= full[-1] * (1 + 1e-9)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("craigb8", "below the 9 rigid motions and constraint modes"),
        ("rubin14", "below the 15 rigid motions and attachment modes"),
        ("guyan12", "exactly the order 9"),
        ("modal6", "above 6, the number of rigid motions"),
        ("craigb55", "above the 54 degrees of freedom"),
        ("modalfix50", "only 45 with 9 coordinates clamped"),
        ("rubin54", None),
    ],
)
def test_orders_that_do_not_suit_are_refused(lattice, name, message):
    if message is None:
        assert reduce(lattice, name).order == 54
        return
    with pytest.raises(UserError, match=message):
        reduce(lattice, name)


@pytest.mark.parametrize("interfaces", [[0], [0, 4]])
@pytest.mark.parametrize("name", ["craigb30", "guyan", "modalfix12", "hintz30"])
def test_interfaces_that_leave_the_body_free_are_refused(make_lattice, interfaces, name):
    with pytest.raises(UserError, match="at least three that are not on one line"):
        reduce(make_lattice(interfaces=interfaces), name)


@pytest.mark.parametrize("name", ["modal20", "rubin20", "inertia20", "krylov20(100)"])
def test_two_interface_nodes_are_enough_where_nothing_is_clamped(make_lattice, exact, name):
    model = make_lattice(interfaces=[0, 4])
    wanted = exact(model, [10.0])
    assert receptance(reduce(model, name), 10.0) == pytest.approx(wanted, abs=2e-2 * np.abs(wanted).max())


def test_more_than_half_of_many_modes_are_refused(coarse_mirror):
    with pytest.raises(UserError, match="asks for 1000 modes, too many for the 1845 degrees of freedom"):
        reduce(coarse_mirror, "modal1006")
