"""`import wavequake as wq`: every name of the command line, quick to import, errors of one line."""

import doctest
import inspect
import json
import shutil
import subprocess
import sys

import numpy as np
import pytest
import typer
import xarray as xr
from small_pistons import STUDY

import wavequake as wq
from wavequake import cli, plot
from wavequake.doors import models, studies
from wavequake.doors import stores as store_doors
from wavequake.errors import UserError
from wavequake.optics.zemax import export
from wavequake.report.answers.rare import rare_answer
from wavequake.workflows import study, zernike_arrays
from wavequake.workflows.systems import source as system_source

# Commands that Python says by another name: a module has the first one, others are two words.
NAMES = {
    "errors": "store_errors",
    "firmware build": "build_firmware",
    "firmware flash": "flash_firmware",
    "firmware test": "try_firmware",
}
# Options by what does the same in Python, where it is no argument of the same name.
OPTIONS = {
    "overrides": "keys of the study as keywords, or as `load_study` takes them",
    "debug": "Python shows tracebacks",
    "allow files": "output",
    "budget plan": "wq.plan_budget",
    "compare of": "wq.agreement",
    "compare stores": "first, others",
    "compare table": "wq.agreement gives the table",
    "draw file": "wq.write_drawing",
    "identify files": "output",
    "info figure": "wq.write_drawing",
    "info system": "what",
    "plan accuracy": "wq.plan_accuracy",
    "plan measure": "wq.plan_accuracy",
    "plan wait": "seconds",
    "report animate": "wq.animate",
    "report by": "wq.rank",
    "report controller": "wq.animate",
    "report format": "wq.animate",
    "run profile": "wq.profile",
}


@pytest.fixture(scope="module")
def stores(tmp_path_factory):
    """Give two stores of six cases of one study, of which the second has larger pistons."""
    folder = tmp_path_factory.mktemp("door")
    (folder / "tiny.toml").write_text(STUDY)
    found = []
    for name, size in (("one", 20.0), ("two", 40.0)):
        wq.run(
            folder / "tiny.toml", cases=6, store=folder / name, **{"disturbance__pistons__piston_nm": size}
        )
        found.append(folder / name)
    return found


def commands(group, before=""):
    """Yield the name of every command and its parameters."""
    for name, command in group.commands.items():
        if hasattr(command, "commands"):
            yield from commands(command, f"{before}{name} ")
        else:
            yield f"{before}{name}", [one.name for one in command.params if one.name != "help"]


COMMANDS = dict(commands(typer.main.get_command(cli.app)))


def test_every_command_has_a_function_and_every_function_says_what_it_does():
    assert {NAMES.get(name, name) for name in COMMANDS} <= set(wq.__all__)
    for name in wq.__all__:
        thing = getattr(wq, name)
        assert inspect.getdoc(thing), name
        assert name in dir(wq)
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        wq.nothing  # noqa: B018


def test_every_option_of_a_command_is_one_of_its_function():
    lacking, asked = set(), set()
    for name, options in COMMANDS.items():
        found = getattr(wq, NAMES.get(name, name))
        taken = set(inspect.signature(studies.report if name == "report" else found).parameters)
        if name == "rare":  # what it passes on
            taken |= set(inspect.signature(rare_answer).parameters)
        lacking |= {f"{name} {one}" for one in options if one not in taken}
        asked |= {one for one in options if one not in taken}
    assert {one for one in lacking if one.rpartition(" ")[2] not in OPTIONS} == {
        one for one in OPTIONS if " " in one
    }
    assert {"overrides", "debug"} <= asked
    for said in OPTIONS.values():
        assert not said.startswith("wq.") or hasattr(wq, said.split()[0].removeprefix("wq.")), said


def test_a_plan_takes_cases_and_keys_as_a_run_does(tmp_path):
    (tmp_path / "tiny.toml").write_text(STUDY)
    file, loaded = tmp_path / "tiny.toml", wq.load_study(tmp_path / "tiny.toml")
    for one in (file, str(file), loaded):
        found = wq.plan(one, cases=7, disturbance__pistons__piston_nm=35.0)
        assert found["cases"] == "7 in 2 chunks of 4"
        assert found["pistons"] == "35 nm rms piston per segment"
    with pytest.raises(UserError, match="wavelengt"):
        wq.plan(file, optics__wavelengt=3.0)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        *(
            (lambda s=s: wq.plan("lens-experiment", s), "seconds is .* positive")
            for s in (0, -1, np.nan, "x")
        ),
        *((lambda r=r: wq.run("lens-experiment", recheck=r), "is no share") for r in (5.0, np.nan, "x")),
        (lambda: wq.info(wq.load_system("euv"), glass="a.agf"), "A system has its glasses"),
        (lambda: wq.info(wq.load_system("euv"), system__stop=3), "A system has its glasses"),
        (lambda: wq.build_firmware(boards="no"), "no board 'no'"),
        (lambda: wq.report("nowhere", "study.toml"), "study.toml must end in .html"),
        (lambda: wq.animate("nowhere", 0, file="film.mp4"), "film.mp4 does not end in .gif, the format"),
        (lambda: wq.export("nowhere", "all.csv", case=3), "all cases; --case belongs to .zmx and .txt"),
    ],
)
def test_what_would_be_passed_over_is_told(call, words):
    with pytest.raises(UserError, match=words):
        call()


def test_importing_loads_nothing_heavy():
    heavy = "{'numpy', 'xarray', 'matplotlib', 'IPython'}"
    code = f"import sys, wavequake; print(sorted({heavy} & set(sys.modules)))"
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert said.strip() == "[]"


def test_every_function_has_an_example():
    functions = [one for name in wq.__all__ if name.islower() and callable(one := getattr(wq, name))]
    functions += [getattr(plot, name) for name in plot.__all__]
    assert len(functions) > 20
    assert [repr(one) for one in functions if ">>> " not in (one.__doc__ or "")] == []


@pytest.mark.parametrize(
    "module",
    [models, plot, studies, store_doors, zernike_arrays, study, system_source, export],
    ids=lambda module: module.__name__,
)
def test_examples_give_what_they_print(module):
    failed, tried = doctest.testmod(module)
    assert (failed, tried > 0) == (0, True)


def test_objects_print_one_line():
    for thing in (
        wq.load_system("euv"),
        wq.load_study("euv"),
        wq.load_model("circular", core=2, rings=2),
        wq.reduce(wq.load_model("circular", core=2, rings=2), "craigb36"),
    ):
        assert len(repr(thing)) < 110, repr(thing)
        assert str(thing) == repr(thing)
    assert repr(wq.load_system("euv")) == "<OpticalSystem euv: 7 surfaces, 3 fields, 1 wavelength>"


def test_stores_are_compared_judged_exported_and_verified(stores, tmp_path):
    one, two = stores
    table = wq.compare(one, two).set_index("measure")
    row = table.loc["wfe_rms_raw"]
    each = [wq.open_store(store).wfe_rms_raw.load() for store in stores]
    means = [float(np.sqrt((values**2).mean("time")).mean()) for values in each]
    assert [row["first"], row["second"]] == pytest.approx(means)
    assert row["mean"] == pytest.approx(means[1] - means[0])
    assert 1.5 * means[0] < means[1]
    assert wq.verify(one).ok
    assert wq.export(one, tmp_path / "one.csv").read_text().count("\n") == 7
    assert wq.report(one) == studies.report(one)
    assert wq.report(one).stat().st_size > 10_000
    with pytest.raises(UserError, match="at least two stores"):
        wq.compare(one)
    with pytest.raises(UserError, match="cases"):
        wq.tail(one)


def test_a_store_is_watched_ranked_and_passed_on(stores, tmp_path):
    one = shutil.copytree(stores[0], tmp_path / "one")
    found = wq.status(one)
    assert (found.counts[1], found.quarantined, found.chunks_done) == (6, 0, 2)
    assert "6 cases in 2 chunks of 4; 2 are done" in repr(found)
    assert (wq.retry(one).chunks, wq.retry(one, "crashed").quarantined) == (0, 0)
    again = wq.rerun(one, 4, tmp_path / "four.nc")
    assert (again.differing, again.status) == ((), 1)
    assert xr.open_dataset(tmp_path / "four.nc")["wfe_rms_raw"].shape == (2,)
    (row,) = wq.rank(one, "wfe_rms_raw").to_dict("records")
    each = np.sqrt((wq.open_store(one)["wfe_rms_raw"].to_numpy() ** 2).mean(axis=1))
    assert (row["median"], row["worst"]) == pytest.approx((np.median(each), each.max()))
    assert wq.profile(one)["all chunks"].endswith(" s CPU")
    drawn = wq.compare(*stores, figure=tmp_path / "both.svg")
    assert drawn.equals(wq.compare(*stores))
    assert "<svg" in (tmp_path / "both.svg").read_text()
    with pytest.raises(UserError, match="say --case ID"):
        wq.export(one, tmp_path / "one.zmx")
    with pytest.raises(UserError, match="no status of a failed case"):
        wq.retry(one, "done")


def test_a_report_goes_elsewhere_and_leaves_its_store_alone(stores, tmp_path, wavequake):
    one = shutil.copytree(stores[0], tmp_path / "one")
    (one / "report.html").unlink(missing_ok=True)
    before = {path: path.stat().st_mtime_ns for path in one.rglob("*")}
    file = wq.report(one, tmp_path / "elsewhere.html")
    code, said, _ = wavequake("report", one, "-o", tmp_path / "again.html")
    assert (code, "again.html" in said) == (0, True)
    assert file.read_text() == (tmp_path / "again.html").read_text()
    assert {path: path.stat().st_mtime_ns for path in one.rglob("*")} == before
    with pytest.raises(UserError, match="cannot be written"):
        wq.report(one, tmp_path / "again.html" / "report.html")


def test_studies_are_begun_and_boards_get_their_gains(tmp_path):
    assert wq.load_study(wq.new("euv", tmp_path / "own.toml")).study.workflow == "system-disturbance"
    assert wq.info("euv") == wq.info(wq.load_system("euv"))
    assert wq.devices()["kind"].iloc[-1] == "numpy"
    (header,) = wq.build_firmware(to=tmp_path, boards=())
    assert "WQ_SAMPLE_TIME_US" in header.read_text()
    with pytest.raises(UserError, match="boards uno"):
        wq.flash_firmware("uno", to=tmp_path)
    with pytest.raises(UserError, match="made from one of lens-experiment"):
        wq.try_firmware("euv", tmp_path)


def test_drawings_are_written_as_their_names_say(tmp_path):
    assert "<svg" in wq.write_drawing("euv", tmp_path / "euv.svg").read_text()
    assert "<script" in wq.write_drawing("euv", tmp_path / "euv.html", solid=True).read_text()
    with pytest.raises(UserError, match="is no picture"):
        wq.write_drawing("euv", tmp_path / "euv.doc")


def test_a_tail_is_that_of_the_command(stores, monkeypatch):
    """Of an exponential distribution, exceeded with 1e-4: scale ln(1e4), by 4000 cases to 15 %."""
    values = np.random.default_rng(1).exponential(50.0, 4000)
    fake = xr.Dataset(
        {"wfe_rms_raw": ("case", values, {"units": "nm"}), "status": ("case", np.ones(4000, dtype=np.int8))},
        {"case": np.arange(4000), "disturbance": ("case", np.full(4000, "wind"))},
    )
    monkeypatch.setattr("wavequake.report.answers.tail.open_store", lambda store: fake)
    (row,) = wq.tail("anywhere", limit=300.0).to_dict("records")
    assert row["value"] == pytest.approx(50.0 * np.log(1e4), rel=0.15)
    assert row["low"] < row["value"] < row["high"]
    assert row["odds"] == pytest.approx(np.exp(-6.0), rel=0.4)
    assert (row["population"], row["units"]) == ("wind", "nm")


def test_a_shaken_mirror_follows_slow_mounts_as_a_rigid_body():
    """At a tenth of the first resonance, swung in smoothly, all nodes move as the mounts do, to 2 %."""
    model = wq.load_model("circular", core=2, rings=2)
    shaker = {"kind": "sinusoid", "frequency_hz": 8.0, "amplitude": 1e-6, "ramp_s": 0.25}
    moved = wq.respond(model, shaker, duration=0.5, step=1e-3)["displacement"].sel(direction="z")
    at = moved.sel(time=slice(0.3, 0.5))
    expected = 1e-6 * np.sin(2 * np.pi * 8.0 * at["time"])
    assert float(np.abs(at - expected).max()) < 2e-8
    system = wq.plant(model)
    gain = -system.c @ np.linalg.pinv(system.a) @ system.b
    assert gain.shape == (9, 9)
    for excitation, words in (
        ({"kind": "sinus"}, "kind"),
        ({"kind": "sinusoid", "frequency": 3.0}, "frequency: Extra inputs"),
    ):
        with pytest.raises(UserError, match=words):
            wq.respond(model, excitation)
    with pytest.raises(UserError, match="no instants"):
        wq.respond(model, {"kind": "sinusoid"}, duration=0.1, step=1.0)
    with pytest.raises(UserError, match="unexpected keyword argument 'diam'"):
        wq.load_model("circular", diam=2.0)


def test_plots_show_the_numbers_of_a_store(stores):
    ds = wq.open_store(stores[0]).load()
    drawn, share = wq.plot.distribution(ds.wfe_rms_raw).lines[0].get_data()
    expected = np.sort(np.sqrt((ds.wfe_rms_raw.to_numpy() ** 2).mean(axis=1)))
    np.testing.assert_allclose(drawn, [expected[0], *expected])
    np.testing.assert_allclose(share, np.arange(7) / 6)
    lines = wq.plot.history(ds.los.sel(case=0)).lines
    np.testing.assert_array_equal(lines[1].get_ydata(), ds.los.sel(case=0, axis="y"))
    axes = wq.plot.image(ds.exposure.sel(case=0))
    shown = axes.images[0].get_array()
    assert shown.max() == ds.exposure.sel(case=0).max()
    assert axes.images[0].get_extent()[0] == pytest.approx(float(ds.x[0] - (ds.x[1] - ds.x[0]) / 2))
    with pytest.raises(UserError, match="at least 16 instants"):
        wq.plot.spectrum(ds.los.sel(case=0))
    own = wq.plot.aperture("tmt-18")
    assert wq.plot.section("tmt-18", own) is own
    for call in (
        lambda: wq.plot.image(ds.exposure),
        lambda: wq.plot.history(ds.zernike),
        lambda: wq.plot.distribution(ds.los),
        lambda: wq.plot.section("mirror-mor"),
        lambda: wq.plot.aperture("euv"),
        lambda: wq.plot.image(0.0 * ds.exposure.sel(case=0)),
    ):
        with pytest.raises(UserError):
            call()


def test_progress_comes_to_the_one_who_asks(tmp_path):
    (tmp_path / "tiny.toml").write_text(STUDY)
    told = []
    wq.run(
        tmp_path / "tiny.toml", cases=8, store=tmp_path / "s", progress=lambda *numbers: told.append(numbers)
    )
    assert told[-1] == (8, 8, 0)
    assert json.loads((tmp_path / "s" / "manifest.json").read_text())["cases"] == 8


def test_a_response_that_takes_long_says_so(monkeypatch, capsys):
    mirror, shaker = wq.load_model("circular", core=2, rings=2), {"kind": "sinusoid", "frequency_hz": 300.0}
    wq.respond(mirror, shaker)
    assert not capsys.readouterr().err
    monkeypatch.setattr("wavequake.doors.models._LONG", 100)
    wq.respond(mirror, shaker)
    assert f"all {mirror.order} modes of circular mirror are computed, some 1 s" in capsys.readouterr().err


def test_a_title_of_ones_own_stands_beside_no_legend():
    names = xr.DataArray(["alignment", "edge-sensors", "wind", "wind-shake"] * 3, dims="case")
    values = xr.DataArray(np.arange(12.0), dims="case", name="peak", coords={"disturbance": names})
    axes = wq.plot.distribution(values)
    axes.set_title("Peak of the exposure, 1 = perfect image")
    axes.figure.draw_without_rendering()
    legend = axes.get_legend().get_window_extent()
    for text in (axes.title, axes.xaxis.label, *axes.get_xticklabels()):
        assert not legend.overlaps(text.get_window_extent())
