import numpy as np
import pytest

from wavequake.errors import UserError
from wavequake.mechanics.mirrors.models import CircularMirror, circular_mirror
from wavequake.reduction.intermediate import intermediate
from wavequake.workflows.mirrors import model_store


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.setattr(model_store, "model_folder", lambda: tmp_path)
    return tmp_path


@pytest.fixture(scope="module")
def small():
    return intermediate(circular_mirror(CircularMirror(core=2, rings=2)), modes=12)


def test_a_model_is_built_once_and_comes_back_bit_for_bit(small, folder):
    built = []

    def build():
        built.append(1)
        return small

    for _ in range(2):
        again = model_store.kept_intermediate("x", build)
        assert np.array_equal(again.stiffness, small.stiffness)
        assert np.array_equal(again.surface, small.surface)
        assert (again.name, again.damping, again.modes) == (small.name, small.damping, small.modes)
    assert built == [1]
    assert len(list(folder.iterdir())) == 1


def test_what_other_code_has_built_is_built_again(small, monkeypatch):
    """A store names the code of its numbers: a model that older code left behind must not make them."""
    built = []
    for version in ("1 (abc)", "1 (abd)", "1 (abc)"):
        monkeypatch.setattr(model_store, "code", lambda version=version: f"wavequake {version}")
        model_store.kept_intermediate("x", lambda version=version: built.append(version) or small)
    assert built == ["1 (abc)", "1 (abd)"]


@pytest.mark.parametrize("damage", [b"", b"PK\x03\x04 no archive", None])
def test_a_damaged_file_is_built_again(small, folder, damage):
    model_store.kept_intermediate("x", lambda: small)
    (path,) = folder.iterdir()
    path.write_bytes(path.read_bytes()[:5000] if damage is None else damage)
    again = model_store.kept_intermediate("x", lambda: small)
    assert np.array_equal(again.mass, small.mass)
    assert len(path.read_bytes()) > 5000


def test_a_full_disk_costs_no_result(small, monkeypatch):
    def fail(*args, **kwargs):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(model_store.np, "savez", fail)
    assert model_store.kept_intermediate("x", lambda: small).modes == 12


def test_imported_models_come_back_and_are_one_however_often_they_are_imported(folder, tmp_path):
    model = circular_mirror(CircularMirror(core=2, rings=2))
    table = np.column_stack([model.dof_node, model.dof_direction])
    assert len(table) == model.order
    packed = model_store._packed(model)
    model_store._write("m", packed)
    again = model_store.kept_model("m")
    assert (again.mass != model.mass).nnz == 0
    assert np.array_equal(again.surface_weights, model.surface_weights)
    with pytest.raises(UserError, match="is not in"):
        model_store.kept_model("absent")


def test_digests_follow_the_record():
    assert model_store.digest({"a": 1, "b": 2}) == model_store.digest({"b": 2, "a": 1})
    assert model_store.digest({"a": 1}) != model_store.digest({"a": 2})
