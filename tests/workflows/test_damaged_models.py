"""Models that no reduction can take: one sentence and exit code 2 before anything is computed."""

import sys
from pathlib import Path

import numpy as np
import pytest
import scipy.linalg
from typer.testing import CliRunner

from wavequake import cli
from wavequake.campaign.store.store import open_store
from wavequake.commands import stores
from wavequake.mechanics.importers import import_model
from wavequake.workflows.mirrors import model_store

DATA = Path(__file__).parents[1] / "data"
KEYS = [
    "model.file=plate.npz",
    f"model.mesh={DATA / 'plate.inp'}",
    "model.units=m,kg,s,N",
    "model.interfaces=INTERFACES",
    "model.surface=SURFACE",
    "optics.focal_length_m=1.7",
    'reduction.variants=["craigb18"]',
    "optics.zernike_terms=11",
]


@pytest.fixture(autouse=True)
def models(tmp_path, monkeypatch):
    monkeypatch.setattr(model_store, "model_folder", lambda: tmp_path / "models")
    monkeypatch.chdir(tmp_path)


@pytest.fixture(scope="module")
def plate():
    model = import_model(
        DATA / "plate.sti", units="m,kg,s,N", interfaces="INTERFACES", surface="SURFACE"
    ).model
    dofs = np.loadtxt(DATA / "plate.dof", dtype=str)
    pairs = np.array([[int(part) for part in line.split(".")] for line in dofs])
    return {"stiffness": model.stiffness.toarray(), "mass": model.mass.toarray(), "dofs": pairs}


def unsymmetric(model):
    model["stiffness"][5, 40] += 1e-3 * np.abs(model["stiffness"]).max()


def weightless(model):
    model["mass"][:] = 0.0


def massless_node(model):
    model["mass"][12:15] = model["mass"][:, 12:15] = 0.0


def rank_deficient_mass(model):
    """A combination of motions without mass, as reduced integration leaves it."""
    direction = np.zeros(len(model["mass"]))
    direction[[0, 3]] = [1.0, -1.0]
    pull = model["mass"] @ direction
    model["mass"] -= np.outer(pull, pull) / (direction @ pull)


def loose_node(model):
    """A node of the surface that nothing holds."""
    model["stiffness"][9:12] = model["stiffness"][:, 9:12] = 0.0


def hinged(model):
    """One direction of a node is slack: a mechanism that no support of the interface can hold."""
    model["stiffness"][30] = model["stiffness"][:, 30] = 0.0
    model["stiffness"][30, 30] = 1e-9


def without_coordinates(model):
    model["dofs"][60:63, 0] = 9999


def negative(model):
    model["stiffness"][:] *= -1.0


def not_a_number(model):
    model["mass"][7, 7] = np.nan


@pytest.mark.parametrize("damage", [massless_node, rank_deficient_mass])
def test_singular_masses_are_harmless_where_the_stiffness_holds(damage, plate, tmp_path, monkeypatch, capsys):
    """The reduced model is as exact as of a plate without the damage."""
    monkeypatch.setattr(stores, "write_report", lambda *_, **__: None)
    model = {name: values.copy() for name, values in plate.items()}
    damage(model)
    np.savez("plate.npz", **model)
    keys = ["reduction.frequencies=9", "imaging.pixels=8", "imaging.pupil_samples=16", "imaging.instants=2"]
    keys += ["time.duration_s=0.002", "optics.rays=60", 'reduction.variants=["craigb60"]']
    words = ["run", "mirror-mor", *KEYS, *keys, "--on", "serial", "--store", str(tmp_path / "s")]
    result = CliRunner().invoke(cli.app, words)
    assert result.exit_code == 0, result.output
    errors = open_store(tmp_path / "s")["eps_mech"].values
    assert errors.max() < 1e-2


def test_an_expansion_point_on_a_resonance_is_no_error(plate, tmp_path, monkeypatch):
    """It is moved by a millihertz; the variant comes out as exact near its point as elsewhere."""
    monkeypatch.setattr(stores, "write_report", lambda *_, **__: None)
    np.savez("plate.npz", **plate)
    squared = scipy.linalg.eigh(plate["stiffness"], plate["mass"], eigvals_only=True)
    resonance = float(np.sqrt(squared[6])) / (2 * np.pi)
    keys = [f'reduction.variants=["krylov36({resonance!r})"]', "reduction.frequencies=25", "imaging.pixels=8"]
    keys += ["imaging.pupil_samples=16", "imaging.instants=2", "time.duration_s=0.002", "optics.rays=60"]
    keys += [f"reduction.last_hz={2 * resonance!r}"]
    words = ["run", "mirror-mor", *KEYS, *keys, "--on", "serial", "--store", str(tmp_path / "s")]
    result = CliRunner().invoke(cli.app, words)
    assert result.exit_code == 0, result.output
    found = open_store(tmp_path / "s")
    assert (found["status"].values == 1).all()
    near = np.abs(found["frequency"].values - resonance) < 0.2 * resonance
    errors = found["eps_mech"].values.reshape(-1, 25)[:, near]
    assert errors.max() < 1e-4


@pytest.mark.parametrize(
    ("damage", "keys", "words"),
    [
        (unsymmetric, [], "symmetric"),
        (weightless, [], "mass"),
        (loose_node, [], "node"),
        (hinged, [], "stiffness"),
        (without_coordinates, [], "9999"),
        (negative, [], "negative"),
        (not_a_number, [], "not finite"),
        (None, ["model.surface=[]"], "surface"),
        (None, ["optics.zernike_terms=231"], "do not determine 231 Zernike terms"),
        (None, ["model.interfaces=[11,1,5]"], "lie on a line"),
        (None, ['reduction.variants=["craigb5000"]'], "craigb5000 is above the"),
        (None, ["model.damping_alpha=-1"], "damping_alpha"),
        (None, ['reduction.variants=["krylov18(150,150)"]'], "expansion point twice"),
    ],
)
def test_what_no_reduction_can_take_ends_with_one_sentence(
    damage, keys, words, plate, tmp_path, monkeypatch, capsys
):
    model = {name: values.copy() for name, values in plate.items()}
    if damage is not None:
        damage(model)
    np.savez("plate.npz", **model)
    words_of = ["run", "mirror-mor", *KEYS, *keys, "--on", "serial", "--store", str(tmp_path / "s")]
    monkeypatch.setattr(sys, "argv", ["wavequake", *words_of])
    with pytest.raises(SystemExit) as end:
        cli.main()
    message = capsys.readouterr().err.strip()
    print(message)
    assert end.value.code == 2
    assert words in message
    assert message.count("\n") == message.count(". ") == 0
    assert not (tmp_path / "s").exists()
