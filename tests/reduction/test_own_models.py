"""Reduced models from files, arrays and pyMOR are judged as ours are; what is wrong in them is told."""

import numpy as np
import pytest
import scipy.io

from wavequake.errors import UserError
from wavequake.mechanics.mirrors.models import CircularMirror, circular_mirror
from wavequake.mechanics.model import RayleighDamping
from wavequake.reduction.methods.component_modes import constraint_modes
from wavequake.reduction.metrics import full_receptance, receptance
from wavequake.reduction.own import own_model
from wavequake.reduction.reduce import reduce
from wavequake.reduction.structure import fixed_modes, structure
from wavequake.workflows.kinds import find_kind
from wavequake.workflows.study import load_study

DAMPING = RayleighDamping(0.0, 5e-6)
STUDY = """
[study]
name = "own"
workflow = "mirror-mor"
[model]
shapes = ["circular"]
rings = 2
[reduction]
variants = ["craigb24", "mine", "theirs"]
frequencies = 20
spot_checks = 0
own = {{ mine = "{file}", theirs = "theirs.npz" }}
[imaging]
pixels = 8
pupil_samples = 16
instants = 2
[optics]
rays = 120
zernike_terms = 15
[time]
duration_s = 0.001
[[excitation]]
name = "sine300"
kind = "sinusoid"
frequency_hz = 300.0
"""


@pytest.fixture(scope="module")
def model():
    return circular_mirror(CircularMirror(thickness=0.02, focal_length=1.7, core=2, rings=2, damping=DAMPING))


@pytest.fixture(scope="module")
def basis(model):
    """The space of Craig and Bampton, in coordinates of another scale that are mixed among each other."""
    body = structure(model)
    shapes = np.hstack([constraint_modes(body, body.interface), fixed_modes(body, 15, body.interface)[1]])
    return shapes @ np.random.default_rng(4).standard_normal((24, 24)) * 1e-3


def test_a_basis_gives_the_transfer_function_of_its_space(model, basis):
    frequencies = np.array([20.0, 150.0, 310.0, 900.0])
    ours, theirs = reduce(model, "craigb24"), reduce(model, basis)
    assert theirs.order == 24
    np.testing.assert_allclose(
        receptance(theirs, frequencies), receptance(ours, frequencies), rtol=1e-6, atol=1e-13
    )
    whole = full_receptance(model, frequencies)
    every = own_model(model, np.eye(model.order), "all")
    np.testing.assert_allclose(receptance(every, frequencies), whole, rtol=1e-6, atol=1e-13)


def test_matrices_and_pymor_say_the_same(model, basis):
    ours = own_model(model, basis, "basis")
    letters = {
        "M": ours.mass,
        "D": ours.damping_matrix,
        "K": ours.stiffness,
        "B": ours.inputs,
        "C": ours.surface,
    }
    same = own_model(model, letters, "letters")
    np.testing.assert_array_equal(same.stiffness, ours.stiffness)
    without = own_model(model, {key: values for key, values in letters.items() if key != "D"}, "rayleigh")
    np.testing.assert_allclose(without.damping_matrix, ours.damping_matrix, rtol=1e-9, atol=1e-12)
    iosys = pytest.importorskip("pymor.models.iosys")
    theirs = iosys.SecondOrderModel.from_matrices(*(letters[key] for key in ("M", "D", "K", "B", "C")))
    found = reduce(model, theirs)
    for key in ("mass", "stiffness", "damping_matrix", "inputs", "surface"):
        np.testing.assert_allclose(getattr(found, key), getattr(ours, key), atol=1e-300)


@pytest.mark.parametrize("suffix", ["npz", "mtx"])
def test_studies_judge_own_models_by_the_image_beside_ours(tmp_path, model, basis, suffix):
    if suffix == "npz":
        np.savez(tmp_path / "mine.npz", basis=basis)
    else:
        scipy.io.mmwrite(tmp_path / "mine.mtx", basis, precision=17)
    poor = own_model(model, basis[:, :16], "poor")
    arrays = {"mass": poor.mass, "stiffness": poor.stiffness, "inputs": poor.inputs, "surface": poor.surface}
    np.savez(tmp_path / "theirs.npz", **arrays)
    (tmp_path / "study.toml").write_text(STUDY.format(file=f"mine.{suffix}"))
    study, kind = load_study(tmp_path / "study.toml"), find_kind("mirror-mor")
    (tmp_path / "theirs.npz").unlink()  # they belong to the study
    text = study.identity_text()
    kind.check(text)
    table = kind.case_table(text, 0, 4)
    assert table["variant"].tolist() == ["full", "craigb24", "mine", "theirs"]
    assert table["method"].tolist() == ["full", "craigb", "own", "own"]
    found = kind.compute(text, np.arange(4), "numpy")
    assert found.messages == ("",) * 4
    ours, mine, theirs = (found.arrays["eps_opt"][row] for row in (1, 2, 3))
    np.testing.assert_allclose(mine, ours, rtol=1e-3)
    assert theirs.max() > 2.0 * mine.max()
    assert found.arrays["order"].tolist()[1:] == [24.0, 24.0, 16.0]
    np.testing.assert_allclose(found.arrays["image_error"][2], found.arrays["image_error"][1], rtol=0.05)


def arrays_of(model, order=4):
    return {
        "mass": np.eye(order),
        "stiffness": np.eye(order),
        "inputs": np.ones((order, 3 * len(model.interfaces))),
        "surface": np.ones((3 * len(model.surface_nodes), order)),
    }


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"mass": -np.eye(4)}, "mass of the reduced model 'mine' is not positive definite"),
        ({"stiffness": np.triu(np.ones((4, 4)))}, "stiffness of the reduced model 'mine' is not symmetric"),
        ({"stiffness": np.eye(3)}, r"stiffness of .* has the shape \(3, 3\); with 4 coordinates"),
        (
            {"inputs": np.ones((4, 8))},
            r"inputs of .* has the shape \(4, 8\); with 4 coordinates, 3 interface",
        ),
        ({"surface": np.full((3, 4), np.nan)}, "surface of .* must be a matrix of finite numbers"),
        ({"mass": np.array("x")}, "mass of .* is no array of real numbers"),
        ({"mass": np.zeros((0, 0))}, "mass of the reduced model 'mine' has the shape"),
        ({"extra": np.eye(4)}, "holds 'extra'; it takes basis, or mass, stiffness"),
        ({"surface": None}, "'mine' has no surface; give it, or a basis"),
    ],
)
def test_what_is_wrong_with_matrices_is_told(model, change, words):
    given = {key: one for key, one in (arrays_of(model) | change).items() if one is not None}
    with pytest.raises(UserError, match=words):
        own_model(model, given, "mine")


def test_what_is_wrong_with_a_basis_is_told(model, basis):
    with pytest.raises(UserError, match=r"its rows must be the .* degrees of freedom"):
        reduce(model, basis[:-1])
    with pytest.raises(UserError, match=r"columns of the basis of .* are linearly dependent"):
        reduce(model, np.hstack([basis, basis[:, :1]]))
    with pytest.raises(UserError, match="moves nothing that has mass"):
        reduce(model, np.zeros((model.order, 1)))


@pytest.mark.parametrize(
    ("file", "content", "words"),
    [
        ("mine.csv", b"1,2", "reduction.own.mine: mine.csv must be an .npz file, or an .mtx file"),
        ("mine.mtx", b"%%MatrixMarket nonsense", "mine.mtx is no complete Matrix Market file"),
        ("none.npz", None, "reduction.own.mine: the file .*none.npz"),
        ("mine.npz", b"PK", "The file of the reduced model 'mine' cannot be read"),
    ],
)
def test_files_that_cannot_be_read_are_named(tmp_path, model, file, content, words):
    np.savez(tmp_path / "theirs.npz", **arrays_of(model))
    if content is not None:
        (tmp_path / file).write_bytes(content)
    (tmp_path / "study.toml").write_text(STUDY.format(file=file))
    with pytest.raises(UserError, match=words):
        find_kind("mirror-mor").check(load_study(tmp_path / "study.toml").identity_text())


def test_other_studies_refuse_own_models(tmp_path):
    with pytest.raises(UserError, match="own models belong to the workflows mirror-mor"):
        load_study("controller-mor", {"reduction.own": {"mine": "mine.npz"}})
