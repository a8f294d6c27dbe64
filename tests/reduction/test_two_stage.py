from dataclasses import replace

import numpy as np
import pytest
from scipy.sparse import csc_array, diags_array

from wavequake.errors import UserError
from wavequake.mechanics.mirrors.models import CircularMirror, circular_mirror, on_springs
from wavequake.mechanics.model import RayleighDamping
from wavequake.reduction.intermediate import dense_structure, intermediate
from wavequake.reduction.metrics import eps_mor, full_receptance, pseudo_frequencies, receptance
from wavequake.reduction.names import Variant, parse
from wavequake.reduction.reduce import reduce
from wavequake.reduction.structure import structure
from wavequake.reduction.two_stage import check_variants, covers, reduce_variants, reference, spot_check

# None of them is a frequency on which the basis was built (multiples of 300 Hz).
CHECKS = np.array([17.0, 103.0, 431.0, 777.0, 1111.0])
BAND = np.arange(2.0, 1200.0, 9.3)


def test_the_intermediate_model_stands_for_the_full_one(coarse_mirror, mirror_stage):
    """As far as full-size solutions are known: rounding by the condition of the dynamic stiffness.

    With a diagonal of ones it is 3e8, 5e8, 1e7, 7e6 and 7e5: a free body is almost singular at first.
    """
    known = np.maximum([6.7e-8, 1.2e-7, 2.8e-9, 1.5e-9, 1.7e-10], 1e-9)
    assert (spot_check(coarse_mirror, [reference(mirror_stage)], CHECKS)[0] < known).all()


@pytest.mark.parametrize(
    "name",
    ["craigb36", "rubin37", "modal37", "hintz36", "guyan9", "modalfix36", "inertia37", "krylov(200*2,450*2)"],
)
def test_variants_are_those_of_the_full_model(coarse_mirror, mirror_stage, name):
    """The 21st and 22nd elastic mode are a pair: rubin36 would keep one, turned at random."""
    direct, dense = reduce(coarse_mirror, name), reduce_variants(mirror_stage, [name])[0]
    assert pseudo_frequencies(dense) == pytest.approx(pseudo_frequencies(direct), rel=1e-6, abs=1e-6)
    wanted = receptance(direct, BAND)
    assert receptance(dense, BAND) == pytest.approx(wanted, abs=1e-6 * np.abs(wanted).max() + 1e-30)
    wanted = receptance(direct, [50.0, 777.0], direct.surface)
    assert receptance(dense, [50.0, 777.0], dense.surface) == pytest.approx(
        wanted, abs=1e-6 * np.abs(wanted).max() + 1e-30
    )
    assert dense.name == direct.name


def test_krylov108_loses_nothing(coarse_mirror, mirror_stage):
    """Its last directions are rounding errors; what counts is the error against full-size solutions."""
    names = ["krylov108(200,450,700)", "krylov108(100,200,400)"]
    assert spot_check(coarse_mirror, reduce_variants(mirror_stage, names), CHECKS).max() < 1e-7


@pytest.mark.parametrize(
    ("name", "covered"),
    [
        ("craigb108", True),
        ("craigb118", False),
        ("modal114", True),
        ("modal115", False),
        ("hintz63", True),
        ("hintz64", False),
        ("krylov36(1200)", True),
        ("krylov36(1300)", False),
        ("krylov(100*20)", False),
        ("flbt42(0-1200)", True),
        ("flbt42(0-1300)", False),
        ("bt150", False),
        ("pod36(100)", True),
    ],
)
def test_what_lies_in_the_span_is_known(mirror_stage, name, covered):
    assert covers(mirror_stage, parse(name)) is covered


def test_what_is_not_covered_is_reduced_directly(coarse_mirror, mirror_stage):
    with pytest.raises(UserError, match="outside what the intermediate model"):
        reduce_variants(mirror_stage, ["krylov36(1500)"])
    inside, outside = reduce_variants(mirror_stage, ["rubin36", "krylov36(1500)"], coarse_mirror)
    assert (inside.name, outside.name) == ("rubin36", "krylov36(1500)")
    error = eps_mor(full_receptance(coarse_mirror, [1501.0]), receptance(outside, [1501.0]))
    assert error < 1e-3


def test_what_cannot_be_reduced_is_known_before(mirror_stage):
    """Orders are those of the full model of 1845, not of the intermediate one."""
    check_variants(mirror_stage, ["craigb118", "craigb926", "modal900", "krylov(100*20)", "pod36", "guyan"])
    for name, words in [
        ("craigb927", "918 modes, too many for the 1845"),
        ("rubin1846", "above the 1845 degrees of freedom"),
        ("hintz8", "below the 9 rigid motions and attachment modes"),
        ("irka6", "must be above 6, the number of rigid motions"),
    ]:
        with pytest.raises(UserError, match=words):
            check_variants(mirror_stage, ["craigb36", name])
    undamped = replace(mirror_stage, damping=RayleighDamping(0.0, 0.0))
    for name in ("bt36", "flbt36(0-400)", "fwbt36(0-400)", "irka36", "pod36"):
        with pytest.raises(UserError, match="need positive damping"):
            check_variants(undamped, [name])


def test_rigid_motions_survive_both_stages(mirror_stage):
    body = dense_structure(mirror_stage)
    assert body.rigid.T @ body.mass @ body.rigid == pytest.approx(np.eye(6), abs=1e-9)
    scale = np.abs(np.diag(body.stiffness)).max()
    assert np.abs(body.stiffness @ body.rigid).max() < 1e-9 * scale
    for reduced in reduce_variants(mirror_stage, ["craigb36", "krylov36(150)", "flbt42(0-1200)"]):
        assert (np.diag(reduced.stiffness)[:6] == 0).all()


def test_a_supported_mirror_has_no_rigid_motions():
    model = on_springs(circular_mirror(CircularMirror(core=2, rings=2)), (1e6, 1e6, 1e7))
    stage = intermediate(model)
    variants = [reference(stage), *reduce_variants(stage, ["rubin54", "craigb54", "krylov45(300)"])]
    errors = spot_check(model, variants, [20.0, 333.0])
    assert errors[0].max() < 1e-9
    assert errors[1:].max() < 2e-2
    assert pseudo_frequencies(variants[1])[0] > 1.0


def test_methods_on_modal_coordinates_use_an_intermediate_model():
    model = circular_mirror(CircularMirror(core=2, rings=2))
    direct, dense = (
        reduce(model, "flbt42(0-1200)"),
        reduce_variants(intermediate(model), ["flbt42(0-1200)"])[0],
    )
    assert pseudo_frequencies(direct)[:30] == pytest.approx(pseudo_frequencies(dense)[:30], rel=1e-6)


def test_interfaces_alone_are_enough_for_transfer_functions(mirror_stage):
    with_optics, without = (
        reduce_variants(mirror_stage, ["rubin36"], optics=flag)[0] for flag in (True, False)
    )
    assert np.array_equal(receptance(without, BAND), receptance(with_optics, BAND))
    assert without.surface.shape == (0, 36)
    assert len(without.surface_nodes) == len(without.surface_weights) == 0


def test_results_do_not_depend_on_what_was_reduced_before():
    """Order 36 cuts a pair of equal frequencies, whose turn would tell."""
    first, second = (circular_mirror(CircularMirror(core=2, rings=2)) for _ in range(2))
    reduce(first, "modal100")
    after, alone = reduce(first, "modal36"), reduce(second, Variant("modal", 36))
    assert np.array_equal(after.inputs, alone.inputs)


def test_factorizations_are_shared(coarse_mirror):
    assert structure(coarse_mirror) is structure(coarse_mirror)


def test_a_small_lattice_is_its_own_intermediate_model(lattice, exact):
    stage = intermediate(lattice)
    assert stage.order == lattice.order
    wanted = exact(lattice, CHECKS)
    assert receptance(reference(stage), CHECKS) == pytest.approx(wanted, abs=1e-9 * np.abs(wanted).max())
    assert reduce_variants(stage, ["modal54"])[0].order == 54


@pytest.mark.parametrize(("modes", "highest"), [(0, 100.0), (10, 0.0), (10, np.nan), (10, np.inf)])
def test_bad_intermediate_models_are_refused(lattice, modes, highest):
    with pytest.raises(UserError, match="positive highest frequency and at least one mode"):
        intermediate(lattice, modes, highest)


@pytest.mark.parametrize("interfaces", [[0, 2, 4], [0, 4], [3]])
def test_an_interface_on_a_line_is_refused(make_lattice, interfaces):
    with pytest.raises(UserError, match="at least three that are not on one line"):
        intermediate(make_lattice(interfaces=interfaces, jitter=0.0))


def test_singular_matrices_are_explained(make_lattice):
    model = make_lattice()
    loose = model.stiffness.toarray()
    loose[-3:] = loose[:, -3:] = 0.0
    with pytest.raises(UserError, match="singular"):
        reduce(replace(model, stiffness=csc_array(loose)), "craigb20")
    masses = model.mass.diagonal()
    masses[7] = 0.0
    weightless = reduce(replace(model, mass=csc_array(diags_array(masses))), "craigb20")
    masses[7] = 1e-9 * masses.max()
    light = reduce(replace(model, mass=csc_array(diags_array(masses))), "craigb20")
    assert receptance(weightless, CHECKS) == pytest.approx(receptance(light, CHECKS), rel=1e-4)
    masses[7] = np.nan
    with pytest.raises(UserError, match="not finite"):
        reduce(replace(model, mass=csc_array(diags_array(masses))), "craigb20")
    with pytest.raises(UserError, match="needs interface nodes"):
        reduce(replace(model, interfaces=np.zeros(0, dtype=int)), "craigb20")
