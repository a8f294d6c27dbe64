"""A study kind from outside the package works in every command."""

import re
from pathlib import Path

import numpy as np
import pytest

from wavequake.campaign import extra, plugins
from wavequake.campaign.contract import DONE, RAISED
from wavequake.campaign.measured import one_by_one, study_kind
from wavequake.campaign.measures import stored
from wavequake.campaign.schema import Study
from wavequake.campaign.store.store import open_store
from wavequake.errors import UserError
from wavequake.workflows import kinds
from wavequake.workflows.kinds import find_kind, kind_names, register

PLUGIN = Path(__file__).parents[1] / "workflows" / "pendulum.py"
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
    monkeypatch.setattr(extra, "_registered", {})
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
    assert "<b>Swing.</b> the first case" in page
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
        ("x = 1\0\n", "cannot be loaded: "),
        ("import sys\nsys.exit(3)\n", "line 2: SystemExit: 3"),
        ("raise GeneratorExit('so')\n", "line 1: GeneratorExit: so"),
        ("class E(Exception):\n def __str__(self): 1 / 0\nraise E\n", "line 3: E: it cannot say what"),
    ],
)
def test_plugins_that_cannot_be_loaded_say_where(tmp_path, wavequake, text, words):
    file = tmp_path / "own.py"
    file.write_text(text)
    code, _, err = wavequake("studies", "--plugin", file)
    assert code == 2
    assert words in re.sub(r"\s+", " ", err)
    assert not plugins.loaded_plugins()


OMEGA = 'Measure({}, "1", "x", (), lambda r: r["omega"]{})'


@pytest.mark.parametrize(
    ("part", "code", "words"),
    [
        ("def axes(b): return {'time': Axis(0)}", 2, "axis 'time' must be an Axis of one entry or more"),
        ("def axes(b): return None", 2, "fails in measures, axes or fixed"),
        ("def measures(b): return ['angle']", 2, "'angle' is no measure"),
        (f"def measures(b): return [{OMEGA.format(repr('a/b'), '')}]", 2, "'a/b' needs a name of letters"),
        (f"def measures(b): return [{OMEGA.format(repr('status'), '')}]", 2, "two arrays called 'status'"),
        (
            f"def measures(b): return [{OMEGA.format(repr('length_m'), '')}]",
            2,
            "two arrays called 'length_m'",
        ),
        (f"def measures(b): return [{OMEGA.format(repr('a'), ', dtype=str(5)')}]", 2, "the dtype '5'"),
        (f"def measures(b): return [{OMEGA.format(repr('a'), ', over_time=5')}]", 2, "has over_time=5"),
        (f"def measures(b): return [{OMEGA.format(repr('a'), ', dtype=str(int.__name__)')}]", 3, "not int"),
        (f"def measures(b): return [{OMEGA.format(repr('a'), ' * 1j')}]", 3, "has values of complex128"),
        ("def cases(s, ids): return None", 2, "fails in cases"),
        ("def cases(s, ids): return {'length_m': np.ones(1), 'realization': ids}", 2, "with 'length_m'"),
        ("def cases(s, ids): return {'angle': ids, 'length_m': ids + 1.0, 'realization': ids}", 2, "'angle'"),
        ("def compute(*rest): raise SystemExit(5)", 3, "compute called sys.exit(5)"),
        ("def compute(*rest): return {'omega': 1}", 3, "not Block"),
        ("def prepare(s): raise KeyError('q')", 2, "fails in prepare: KeyError"),
        ("fixed = lambda b: {'z': np.ones(3)}", 2, "fixed has no"),
        ("fixed = lambda b: {'z': (('time',), np.ones(3), {})}", 2, "'z' has the shape (3,) along time"),
        ("PendulumStudy = dict", 2, "must be a subclass of Study"),
        ("prepare = 3", 2, "prepare of the study kind 'pendulum' must be a function"),
    ],
)
def test_parts_of_a_kind_that_do_not_fit_cost_a_sentence(tmp_path, swing, wavequake, part, code, words):
    """Whatever an author's function gives: a sentence, and no store that is written by half."""
    file, store = tmp_path / "own.py", tmp_path / "store"
    text = PLUGIN.read_text().replace("\nKIND = ", f"\n{part}\nKIND = ")
    given = "fixed=fixed, compared=" if part.startswith("fixed") else "compared="
    file.write_text(text.replace("    compared=", f"    {given}"))
    for command in (("plan", swing), ("run", swing, "--store", store, "--on", "serial")):
        found, out, err = wavequake(*command, "--plugin", file)
        said = err + " ".join(wavequake("status", store)[1:] if store.exists() else ())
        if command[0] == "run":
            assert found == code, out + err
            assert words in re.sub(r"\s+", " ", said)
        assert found in (0, 2, 3), out + err
        assert "Internal" not in said
    assert store.exists() == (code == 3)


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


COMA = """
import numpy as np
from wavequake.campaign.extra import register
from wavequake.campaign.measures import Measure

def coma(numbers):
    if {fails}:
        raise ValueError("no coma today")
    return np.hypot(numbers["zernike"][..., 6], numbers["zernike"][..., 7])

register(Measure("coma", "nm", "rms of the coma terms j = 7 and 8", {dims}, coma, over_time="max"))
"""


LENS = ("run", "double-gauss", "optics.rays=60", "imaging.pixels=16", "--on", "serial")
FEW = ("disturbance.vibration.instants=4", "disturbance.all.instants=4")
FEW += ("system.fields_deg=[[0.0, 5.0]]", "system.wavelengths_nm=[587.6]")


def coma_file(tmp_path, fails=False, dims=("time", "field", "wavelength")):
    file = tmp_path / "coma.py"
    file.write_text(COMA.format(fails=fails, dims=dims))
    return file


def test_one_record_adds_a_number_to_any_kind(tmp_path, wavequake):
    """It is computed, stored, reduced, judged and exported; stores that do not ask for it have none."""
    plugin, store = ("--plugin", coma_file(tmp_path)), tmp_path / "store"
    words = [*LENS, *FEW, "campaign.cases=4"]
    code, out, err = wavequake(*words, "store.measures=['coma']", "--store", store, *plugin)
    assert (code, err) == (0, ""), out
    dataset = open_store(store)
    zernike = dataset["zernike"].to_numpy()
    np.testing.assert_array_equal(dataset["coma"].to_numpy(), np.hypot(zernike[..., 6], zernike[..., 7]))
    assert dataset["coma"].attrs["long_name"] == "rms of the coma terms j = 7 and 8"
    assert wavequake("rerun", store, "--case", "1", *plugin)[0] == 0
    summary = tmp_path / "summary"
    keys = ("store.measures=['coma']", "store.reduce=summary", "--store", summary)
    assert wavequake(*words, *keys, *plugin)[0] == 0
    assert open_store(summary)["coma"].dims == ("case", "statistic", "field", "wavelength")
    assert wavequake(*words, "--store", tmp_path / "plain", *plugin)[0] == 0
    assert "coma" not in open_store(tmp_path / "plain")


@pytest.mark.parametrize(
    ("keys", "code", "words"),
    [
        ({"fails": True}, 3, "the measure 'coma' failed: ValueError: no coma today"),
        ({"dims": ("time",)}, 3, "the measure 'coma' has the shape"),
        ({"dims": ("time", "mode")}, 2, "has the dimension 'mode', which is none of the axes"),
    ],
)
def test_measures_that_fail_cost_a_sentence(tmp_path, wavequake, keys, code, words):
    run = [*LENS, *FEW, "campaign.cases=2"]
    given = (
        "store.measures=['coma']",
        "--store",
        tmp_path / "store",
        "--plugin",
        coma_file(tmp_path, **keys),
    )
    found, out, err = wavequake(*run, *given)
    said = err + " ".join(wavequake("status", tmp_path / "store")[1:] if code == 3 else ())
    assert found == code, out + err
    assert words in re.sub(r"\s+", " ", said)


def test_a_list_of_no_weights_is_named(wavequake):
    code, _, err = wavequake("plan", "double-gauss", "imaging.weights=[]")
    assert code == 2
    assert "imaging: weights are at least 0" in re.sub(r"\s+", " ", err)


def test_an_unknown_measure_is_named(tmp_path, wavequake):
    words = ("run", "double-gauss", "store.measures=['comma']", "--store", tmp_path / "store")
    code, _, err = wavequake(*words)
    assert code == 2
    assert "there is no measure 'comma'" in re.sub(r"\s+", " ", err)
    assert not (tmp_path / "store").exists()


def halves(study, table, device, clock):
    def of_case(case):
        if case == 2:
            raise UserError("two is not halved")
        return {"half": 0.5 * case}

    return one_by_one(table["case"], of_case)


def test_cases_one_by_one_fail_alone_and_a_check_speaks_first():
    def check(study):
        if study.study.seed == 3:
            raise UserError("three is no seed")

    kind = study_kind(
        "halves",
        Study,
        cases=lambda study, ids: {"realization": ids},
        compute=halves,
        measures=lambda study: [stored("half", "1", "half of it")],
        check=check,
        memory=lambda study: 1000,
    )
    text, wrong = (
        Study(study={"name": "a", "workflow": "halves", "seed": seed}).identity_text() for seed in (1, 3)
    )
    found = kind.compute(text, np.arange(1, 4), "numpy")
    assert found.status.tolist() == [DONE, RAISED, DONE]
    assert found.messages == ("", "two is not halved", "")
    np.testing.assert_array_equal(found.arrays["half"], [0.5, np.nan, 1.5])
    assert kind.template(text).working_bytes == 8 + 1000
    assert kind.module == __name__
    kind.check(text)
    with pytest.raises(UserError, match="three is no seed"):
        kind.check(wrong)
