"""A study kind from outside the package works in every command."""

import re
from pathlib import Path

import numpy as np
import pytest

from wavequake.campaign import plugins
from wavequake.campaign.store.store import open_store
from wavequake.errors import UserError
from wavequake.workflows import kinds
from wavequake.workflows.kinds import find_kind, kind_names, register

PLUGIN = Path(__file__).parent / "pendulum.py"
STUDY = """
[study]
name = "swing"
workflow = "pendulum"
title = "Pendulums that are struck"
[campaign]
cases = 12
[store]
chunk_cases = 4
"""


@pytest.fixture(autouse=True)
def _nothing_is_left_behind(monkeypatch):
    monkeypatch.setattr(kinds, "_registered", {})
    monkeypatch.setattr(plugins, "_loaded", {})


@pytest.fixture
def swing(tmp_path):
    study = tmp_path / "swing.toml"
    study.write_text(STUDY)
    return study


def test_every_command_takes_a_kind_of_a_plugin(tmp_path, swing, wavequake):
    store, plugin = tmp_path / "store", ("--plugin", PLUGIN)
    code, out, err = wavequake("run", swing, "--store", store, "--workers", 2, *plugin)
    assert (code, err) == (0, ""), out
    assert "0.25" in out
    assert "angle" in out
    dataset = open_store(store)
    omega = np.sqrt(9.81 / dataset["length_m"].to_numpy())
    np.testing.assert_allclose(dataset["frequency"].to_numpy(), omega / (2 * np.pi), rtol=1e-15)
    # Pendulums of one realization have the same kick, whatever their length: angle * omega / sin(omega t).
    last = dataset["angle"].to_numpy()[:, -1] * omega / np.sin(omega * dataset["time_s"].to_numpy()[:, -1])
    np.testing.assert_allclose(last[0::2], last[1::2], rtol=1e-12)
    page = (store / "report.html").read_text()
    assert "Swing: the first case" in page
    assert "angle over time" in page
    for words in (
        ("report", store),
        ("status", store),
        ("verify", store),
        ("rerun", store, "--case", 3),
        ("export", store, tmp_path / "swing.csv"),
        ("compare", store, store),
        ("plan", swing),
        ("run", swing, "--store", store, "campaign.cases=16", "--on", "serial"),
    ):
        code, out, err = wavequake(*words, *plugin)
        assert code == 0, (words, out, err)
    assert "too few for a tail" in wavequake("tail", store, "--variable", "angle", *plugin)[2]


def test_a_store_whose_kind_is_not_here_says_how_to_bring_it(tmp_path, swing, wavequake, monkeypatch):
    store = tmp_path / "store"
    assert wavequake("run", swing, "--store", store, "--on", "serial", "--plugin", PLUGIN)[0] == 0
    monkeypatch.setattr(kinds, "_registered", {})
    monkeypatch.setattr(plugins, "_loaded", {})
    for words in (("report", store), ("rerun", store, "--case", 0)):
        code, _, err = wavequake(*words)
        assert code == 2
        assert "pendulum" in err
        assert "--plugin FILE" in re.sub(r"\s+", " ", err)
    for words in (("status", store), ("verify", store)):  # need no kind
        assert wavequake(*words)[0] == 0


def test_another_text_of_the_plugin_is_another_version(tmp_path, swing, wavequake):
    store, other = tmp_path / "store", tmp_path / "pendulum.py"
    assert wavequake("run", swing, "--store", store, "--on", "serial", "--plugin", PLUGIN)[0] == 0
    other.write_text(PLUGIN.read_text() + "\n# changed\n")
    kinds._registered.clear()
    plugins._loaded.clear()
    code, _, err = wavequake(
        "run", swing, "campaign.cases=16", "--store", store, "--on", "serial", "--plugin", other
    )
    assert code == 2
    assert "plug-in pendulum.py" in re.sub(r"\s+", " ", err)


@pytest.mark.parametrize(
    ("key", "code", "words"),
    [
        ("pendulum.wrong=raises", 3, "the rope is torn"),
        ("pendulum.wrong=shape", 3, "the measure 'angle' has the shape"),
        ("pendulum.breaks_at=-0.4", 3, "breaks at"),
        ("pendulum.lengths_m=[-1.0]", 2, "lengths are above 0"),
        ("pendulum.length=[1.0]", 2, "nearest valid key is 'lengths_m'"),
    ],
)
def test_own_parts_that_fail_cost_a_sentence(tmp_path, swing, wavequake, key, code, words):
    store = tmp_path / "store"
    found, out, err = wavequake("run", swing, key, "--store", store, "--on", "serial", "--plugin", PLUGIN)
    said = re.sub(r"\s+", " ", err + " ".join(wavequake("status", store)[1:] if code == 3 else ()))
    assert found == code, out + err
    assert words in said
    assert "Traceback" not in said


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("x = (", "line 1: SyntaxError"),
        ("a = 1\n1 / 0\n", "line 2: ZeroDivisionError"),
        ("from wavequake.workflows.kinds import register\nregister(3)\n", "3 is no study kind"),
    ],
)
def test_plugins_that_cannot_be_loaded_say_where(tmp_path, wavequake, text, words):
    file = tmp_path / "own.py"
    file.write_text(text)
    code, _, err = wavequake("studies", "--plugin", file)
    assert code == 2
    assert words in re.sub(r"\s+", " ", err)
    assert not plugins.loaded_plugins()


def test_a_missing_plugin_is_named(wavequake):
    assert "nowhere.py cannot be read" in re.sub(
        r"\s+", " ", wavequake("studies", "--plugin", "nowhere.py")[2]
    )
    assert "needs the file" in wavequake("studies", "--plugin")[2]


def test_bundled_names_are_taken():
    kind = find_kind("lens-passive")
    with pytest.raises(UserError, match="already"):
        register(kind)
    assert set(kind_names()) == set(kinds._BUNDLED)
    with pytest.raises(UserError, match="did you mean 'mirror-mor'"):
        find_kind("miror-mor")
