"""Keys of a study that belong to the files of its model."""

import sys

import numpy as np
import pytest

from wavequake import cli
from wavequake.errors import UserError
from wavequake.mechanics.mirrors.models import CircularMirror, circular_mirror
from wavequake.workflows.mirrors import model_store
from wavequake.workflows.study import load_study


@pytest.fixture
def mirror(tmp_path, monkeypatch):
    """Write the upper triangles of a mirror, with one direction of the rear face fixed."""
    monkeypatch.setattr(model_store, "model_folder", lambda: tmp_path / "models")
    monkeypatch.chdir(tmp_path)
    model = circular_mirror(CircularMirror(core=2, rings=2))
    rear = np.setdiff1d(np.arange(len(model.nodes)), [*model.surface_nodes, *model.interfaces])[0]
    rows = np.flatnonzero((model.dof_node == rear) & (model.dof_direction == 2))
    matrices = {"stiffness": np.triu(model.stiffness.toarray()), "mass": np.triu(model.mass.toarray())}
    for matrix in matrices.values():
        matrix[rows], matrix[:, rows] = 0.0, 0.0
    table = np.column_stack([model.dof_node, model.dof_direction]) + 1
    np.savez("half.npz", **matrices, nodes=model.nodes, dofs=table)
    return {
        "model.file": "half.npz",
        "model.units": "m,kg,s,N",
        "model.interfaces": [int(node) + 1 for node in model.interfaces],
        "model.surface": [int(node) + 1 for node in model.surface_nodes],
        "reduction.variants": ["craigb18"],
        "optics.zernike_terms": 6,
    }


def test_a_study_declares_both(mirror):
    with pytest.raises(UserError, match="holds the upper triangle only"):
        load_study("mirror-mor", mirror)
    with pytest.raises(UserError, match="1 degrees of freedom have empty rows"):
        load_study("mirror-mor", mirror | {"model.triangle": "upper"})
    study = load_study("mirror-mor", mirror | {"model.triangle": "upper", "model.zero_rows": "drop"})
    model = model_store.kept_model(study.model.content)
    assert (model.stiffness != model.stiffness.T).nnz == 0
    # The content is the identity, however it was written.
    again = load_study("mirror-mor", mirror | {"model.triangle": "upper", "model.zero_rows": "drop"})
    assert "triangle" not in study.identity_text()
    assert again.identity_text() == study.identity_text()


@pytest.mark.parametrize(
    ("key", "text", "words"),
    [
        ("triangle", "left", "model.triangle"),
        ("zero_rows", "keep", "model.zero_rows"),
        ("triangle", "lower", "holds the upper triangle, but triangle = 'lower'"),
    ],
)
def test_a_wrong_declaration_is_one_sentence(mirror, monkeypatch, capsys, key, text, words):
    keys = " ".join(f"{name}={value}" for name, value in (mirror | {f"model.{key}": text}).items())
    arguments = [word.replace("'", '"') for word in keys.replace(", ", ",").split()]
    monkeypatch.setattr(sys, "argv", ["wavequake", "plan", "mirror-mor", *arguments])
    with pytest.raises(SystemExit) as stop:
        cli.main()
    assert stop.value.code == 2
    said = " ".join(capsys.readouterr().err.split())
    assert words in said
    assert "Traceback" not in said


def test_a_misspelled_key_is_said_before_what_is_wrong_without_it(mirror):
    with pytest.raises(UserError, match=r"nearest valid key is .triangle"):
        load_study("mirror-mor", mirror | {"model.triagle": "upper"})


@pytest.mark.parametrize("key", ["mass", "dofs", "mesh", "triangle", "zero_rows"])
def test_what_belongs_to_a_file_needs_one(key):
    with pytest.raises(UserError, match=f"{key} belongs to a model file"):
        load_study("mirror-mor", {f"model.{key}": "drop" if key == "zero_rows" else "upper"})
