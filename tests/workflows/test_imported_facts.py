"""What plan and run say of an imported model, so that coherent but wrong units are seen."""

import shutil
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from wavequake import cli
from wavequake.commands import stores
from wavequake.mechanics.importers import import_model
from wavequake.mechanics.mirrors.models import CircularMirror, circular_mirror
from wavequake.reduction.intermediate import intermediate
from wavequake.workflows.mirrors import model_store
from wavequake.workflows.mirrors.imported_facts import facts, frequencies, hull_volume, total_mass
from wavequake.workflows.mirrors.trace import KIND
from wavequake.workflows.planning.plan import plan
from wavequake.workflows.study import load_study

DATA = Path(__file__).parents[1] / "data"
PLATE = {
    "model.file": "plate.sti",
    "model.units": "m,kg,s,N",
    "model.interfaces": "INTERFACES",
    "model.surface": "SURFACE",
    "optics.focal_length_m": 1.7,
    "reduction.variants": ["craigb18"],
    "time.duration_s": 0.005,
}


@pytest.fixture(autouse=True)
def models(tmp_path_factory, monkeypatch):
    folder = tmp_path_factory.getbasetemp() / "plate-models"
    monkeypatch.setattr(model_store, "model_folder", lambda: folder)
    monkeypatch.chdir(DATA)


@pytest.fixture(scope="module")
def plate():
    return import_model(
        DATA / "plate.sti", units="m,kg,s,N", interfaces="INTERFACES", surface="SURFACE"
    ).model


def test_mass_and_volume_of_a_mirror_in_closed_form():
    """A meniscus has the mass pi/4 D^2 t rho, and a paraboloid of sag s is half of its cylinder."""
    mirror = circular_mirror(CircularMirror(diameter=2.0, thickness=0.1, focal_length=1.7, core=2, rings=2))
    assert total_mass(mirror) == pytest.approx(np.pi * 0.1 * 2700.0, rel=2e-3)
    # The hull: the cylinder from the rear vertex to the rim, less what is under the rear face.
    sag = 1.0 / (4 * 1.7)
    assert hull_volume(mirror.nodes) == pytest.approx(np.pi * (0.1 + sag / 2), rel=0.05)


def test_nodes_in_a_plane_have_no_volume(plate):
    flat = replace(plate, nodes=plate.nodes * np.array([1.0, 1.0, 0.0]))
    assert hull_volume(flat.nodes) == 0.0
    assert not any(line.startswith("warning") for line in facts(flat, "m,kg,s,N"))


def test_the_cost_of_large_models_is_said_in_the_same_words_everywhere(plate, monkeypatch):
    assert not any("factorization" in line for line in facts(plate, "m,kg,s,N"))
    monkeypatch.setattr("wavequake.workflows.mirrors.imported_facts.LARGE", 0)
    said = [line for line in facts(plate, "m,kg,s,N") if "factorization" in line]
    assert len(said) == 1
    assert said[0].startswith("imported model: a factorization of 243 unknowns (")
    assert said[0].endswith("billion operations")  # no seconds: a store keeps these words


@pytest.mark.parametrize(
    ("keys", "inputs"),
    [({"model.pads": "average"}, ""), ({"model.pads": "rigid", "model.pad_dofs": 6}, ", 18 inputs")],
)
def test_pads_of_a_study_are_its_interface(keys, inputs, plate, tmp_path, monkeypatch):
    rear = np.setdiff1d(np.arange(len(plate.nodes)), plate.surface_nodes)
    sets = ""
    for number, mount in enumerate(plate.interfaces, 1):
        near = rear[np.argsort(np.linalg.norm(plate.nodes[rear] - plate.nodes[mount], axis=1))[:4]]
        sets += f"*NSET, NSET=PAD{number}\n" + "".join(f"{node + 1},\n" for node in near)
    for ending in ("sti", "mas", "dof"):
        shutil.copy(DATA / f"plate.{ending}", tmp_path)
    deck = (DATA / "plate.inp").read_text()
    (tmp_path / "plate.inp").write_text(deck.replace("*NSET, NSET=SURFACE", sets + "*NSET, NSET=SURFACE"))
    monkeypatch.chdir(tmp_path)
    pads = {"model.interfaces": ["PAD1", "PAD2", "PAD3"], **keys}
    study = load_study("mirror-trace", PLATE | pads)
    note = plan(study)["note"]
    assert f"3 pads ({keys['model.pads']}) of 12 nodes are the interface{inputs}" in note.splitlines()[1]


def test_the_frequencies_are_the_first_elastic_ones(plate):
    """104 Hz: see test_imported_mirror."""
    words = frequencies(intermediate(plate))
    assert words.startswith("6 rigid motions, then 10")
    assert words.count(",") == 5


@pytest.mark.parametrize(
    ("scale", "heavier", "words"),
    [
        (1.0, 1.0, None),
        (1e3, 1e9, "1e+06 mm wide"),
        (1e-4, 1e-12, "0.1 mm wide"),
        (1.0, 1e3, "too heavy"),
        (1.0, 1e-3, "too light"),
    ],
)
def test_sizes_and_densities_beyond_reason_are_doubted_in_one_sentence(plate, scale, heavier, words):
    model = replace(plate, nodes=plate.nodes * scale, mass=plate.mass * heavier)
    warnings = [line for line in facts(model, "m,kg,s,N") if line.startswith("warning")]
    assert len(warnings) == (words is not None)
    for warning in warnings:
        assert words in warning
        assert warning.endswith("are model.units = 'm,kg,s,N' those of the files?")


def test_the_plan_and_the_store_say_what_was_imported():
    study = load_study("mirror-trace", PLATE)
    note = plan(study)["note"]
    assert "81 nodes, 243 degrees of freedom, 1000 x 1000 x 20 mm, 42.31 kg (units m,kg,s,N)" in note
    assert "6 rigid motions, then 106.3, 106.3, 184" in note
    dims, kept, _ = KIND.template(study.identity_text()).fixed["import_notice"]
    assert dims == ("import_notice",)
    assert "\n".join(kept) == note
    assert "import_notice" not in KIND.template(load_study("mirror-trace", {}).identity_text()).fixed


def test_a_run_in_wrong_units_warns_before_it_starts(tmp_path, monkeypatch, capsys):
    words = [
        f"{key}={value}".replace("'", '"') for key, value in (PLATE | {"model.units": "mm,t,s,N"}).items()
    ]
    run = ["run", "mirror-trace", *words, "--on", "serial", "--store", str(tmp_path / "s")]
    monkeypatch.setattr(sys, "argv", ["wavequake", *run])
    monkeypatch.setattr(stores, "write_report", lambda *_, **__: None)
    with pytest.raises(SystemExit):
        cli.main()
    said = capsys.readouterr().out
    assert "too heavy for a solid; are model.units = 'mm,t,s,N' those of the files?" in said
    assert said.index("too heavy") < said.index(" computed")


def test_what_the_import_did_is_kept_with_the_model(tmp_path):
    """Fixed degrees of freedom that were left out; also where the model was kept before."""
    study = load_study("mirror-trace", PLATE)
    assert model_store.kept_notes(study.model.content) == ()
    mirror = circular_mirror(CircularMirror(core=2, rings=2))
    stiffness, mass = mirror.stiffness.toarray(), mirror.mass.toarray()
    stiffness[30], stiffness[:, 30], mass[30], mass[:, 30] = 0.0, 0.0, 0.0, 0.0
    table = np.column_stack([mirror.dof_node, mirror.dof_direction]) + 1
    np.savez(tmp_path / "held.npz", stiffness=stiffness, mass=mass, nodes=mirror.nodes, dofs=table)
    keys = {
        "file": "held.npz",
        "units": "m,kg,s,N",
        "zero_rows": "drop",
        "interfaces": [int(node) + 1 for node in mirror.interfaces],
        "surface": [int(node) + 1 for node in mirror.surface_nodes],
    }
    for _ in range(2):
        notes = model_store.kept_notes(model_store.keep_imported(keys, tmp_path))
        assert len(notes) == 1
        assert "1 fixed degrees of freedom were left out" in notes[0]
