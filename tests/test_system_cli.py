"""Optical systems at the command line: what a user gets, and what a user gets wrong."""

import csv
import re

import numpy as np
import pytest

import wavequake as wq
from wavequake import cli
from wavequake.workflows.systems.disturbance import KIND

STUDY = """
[study]
name = "newton"
workflow = "system-disturbance"
[campaign]
cases = 12
device = "numpy"
[store]
chunk_cases = 4
[optics]
rays = 40
[wavefront]
zernike_terms = 6
[system]
entrance_diameter_mm = 100.0
fields_deg = [[0.0, 0.0], [0.0, 0.1]]
wavelengths_nm = [550.0]
[[system.surface]]
name = "mirror"
radius_mm = -2000.0
conic = -1.0
glass = "mirror"
semi_diameter_mm = 51.0
stop = true
[[system.surface]]
name = "window"
distance_mm = 800.0
glass = "N-BK7"
semi_diameter_mm = 20.0
[[system.surface]]
name = "back"
distance_mm = 4.0
glass = "air"
semi_diameter_mm = 20.0
[[system.surface]]
name = "image"
distance_mm = 197.4
[[body]]
name = "plate"
surfaces = ["window", "back"]
[[disturbance]]
name = "askew"
model = "surface-random"
of = ["mirror", "plate"]
rms = { dx_um = 2.0, ry_urad = 5.0 }
[[disturbance]]
name = "hum"
model = "surface-vibration"
of = ["plate"]
instants = 2
lines = [{ frequency_hz = 100.0, amplitude = { rx_urad = 50.0 } }]
"""


@pytest.fixture
def newton(tmp_path):
    path = tmp_path / "newton.toml"
    path.write_text(STUDY)
    return path


def test_a_system_runs_to_its_report(wavequake, newton, tmp_path):
    store = tmp_path / "store"
    code, out, err = wavequake("run", newton, "--store", store, "--on", "serial")
    assert code == 0, err
    assert "12 cases computed" in out
    assert "askew, 6 cases" in out
    assert "(0, 0.1) deg" in out
    page = (store / "report.html").read_text()
    assert "changes the wavefront most" in page
    assert page.count("<figure ") == 8  # with the layout
    ds = wq.open_store(store)
    assert ds["wfe_rms"].dims == ("case", "time", "field", "wavelength")
    assert ds["wavelength"].values.tolist() == [550.0]
    code, out, _ = wavequake("run", newton, "--store", store, "--on", "serial", "campaign.cases=16")
    assert code == 0
    assert "4 cases computed" in out
    np.testing.assert_array_equal(wq.open_store(store)["wfe_rms"].values[:12], ds["wfe_rms"].values)
    assert wavequake("verify", store)[0] == 0
    assert wavequake("export", store, tmp_path / "all.nc")[0] == 0
    assert wavequake("export", store, tmp_path / "all.csv")[0] == 0
    with (tmp_path / "all.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 16
    moved = ds["los_mm"].values[1, :, 1, 0, 1]  # hum, second field, along y
    assert float(rows[1]["los_mm_field2_wavelength1_y_mean (mm)"]) == pytest.approx(moved.mean(), rel=1e-12)
    assert rows[1]["vignetted_field1_wavelength1 (1)"] == "0.0"


def test_a_perfect_wave_has_no_error_by_rounding(wavequake, newton, tmp_path):
    """A parabola on its axis: the rest is 0 in plan and report, and stored as it rounds."""
    plate = STUDY[STUDY.index('[[system.surface]]\nname = "window"') : STUDY.index("[[disturbance]]")]
    image = '[[system.surface]]\nname = "image"\ndistance_mm = 1000.0\n'
    parabola = STUDY.replace(plate, image).replace(', "plate"', "").replace('"plate"', '"mirror"')
    newton.write_text(parabola)
    code, out, err = wavequake("plan", newton)
    assert code == 0, err
    assert re.search(r"field \(0, 0\) deg +0 nm rms at rest", out), out
    assert re.search(r"field \(0, 0\.1\) deg +[1-9][\d.]+ nm rms at rest", out), out
    store = tmp_path / "store"
    code, out, err = wavequake("run", newton, "campaign.cases=4", "--store", store, "--on", "serial")
    assert code == 0, err
    resting = out[out.index("at rest") :].splitlines()[1]
    assert resting.split()[:5] == ["(0,", "0)", "deg", "0", "0"]
    kept = wq.open_store(store)
    assert 0.0 < float(kept["wfe_rms_static"][0, 0]) < 1e-5 < float(kept["wfe_rms_static"][1, 0])


def test_the_report_says_what_is_vignetted_and_left_out(wavequake, newton, tmp_path):
    store = tmp_path / "store"
    words = ["disturbance.askew.rms.dx_um=30000", "campaign.cases=16", "--store", store, "--on", "serial"]
    code, out, _ = wavequake("run", newton, *words)
    assert code == cli.EXIT_QUARANTINED
    assert " of 40" in out
    page = (store / "report.html").read_text()
    assert "its opening stops them" in page


def test_where_light_is_stopped_the_error_of_what_arrives_stands_beside_the_fit(wavequake, newton, tmp_path):
    """A mirror of half the pupil's radius lets a quarter of its rays through."""
    newton.write_text(STUDY.replace("semi_diameter_mm = 51.0", "semi_diameter_mm = 25.0"))
    words = ["campaign.cases=4", "--store", tmp_path / "half", "--on", "serial"]
    code, out, _ = wavequake("run", newton, *words)
    assert code == 0
    said = " ".join(out.split())
    assert "no more than 25 % of the rays arrive" in said
    assert "arrived" in said
    assert "30 of 40" in said
    page = (tmp_path / "half" / "report.html").read_text()
    assert "arrived WFE P50 (nm)" in page
    assert "changes the wavefront most" not in page
    ds = wq.open_store(tmp_path / "half").isel(wavelength=0)
    arrived, fitted = (np.sqrt((ds[name] ** 2).mean("time")) for name in ("wfe_rms_raw", "wfe_rms"))
    largest = arrived.groupby("disturbance").max("case").max()
    assert fitted.max() > 3 * largest
    headline = page[page.index("Rays are missing") :].split("<")[0]
    shown = float(re.search(r"at most ([\d.]+) nm rms at field \(0, 0.1\) deg", headline)[1])
    assert 0.5 * largest < shown <= 1.001 * largest  # the 95 % quantile of few cases
    whole = wavequake(
        "run",
        newton,
        *words[:1],
        "system.surface.mirror.semi_diameter_mm=51",
        *words[3:],
        "--store",
        tmp_path / "whole",
    )[1]
    assert "arrived" not in whole


def test_plan_shows_first_order_data_and_light_at_rest(wavequake, newton):
    code, out, _ = wavequake("plan", newton)
    assert code == 0
    for words in ("focal length", " 1000 mm", "nm rms at rest", "12 in 3 chunks of 4"):
        assert words in out, out


def test_an_override_of_one_kind_of_pupil_or_field_replaces_another(wavequake, newton):
    code, out, _ = wavequake("info", "double-gauss", "system.entrance_diameter_mm=20")
    assert code == 0
    assert "diameter 20 mm" in out
    code, out, _ = wavequake("info", newton, "system.fields_arcmin=[[0.0, 3.0]]")
    assert code == 0
    assert "(0, 3) arcmin" in out
    both = wavequake("info", "double-gauss", "system.entrance_diameter_mm=20", "system.f_number=5")
    assert both[0] == cli.EXIT_BAD_INPUT
    assert "not entrance_diameter_mm and f_number" in both[2]


def test_info_refuses_what_a_run_refuses(wavequake):
    code, out, err = wavequake("info", "euv", "system.telecentric=true")
    assert code == cli.EXIT_BAD_INPUT
    assert "declared telecentric" in err
    assert not out


def test_info_of_a_system_a_lens_file_and_studies(wavequake, newton, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    code, out, _ = wavequake("info", "double-gauss")
    assert code == 0
    assert "100.00372 mm" in out
    path = wq.write_zmx(wq.load_system("double-gauss"), "lens.zmx")
    assert path.exists()
    assert "100.00372 mm" in wavequake("info", "lens.zmx")[1]
    assert "5.6" in wavequake("info", "double-gauss", "system.f_number=5.6")[1]
    assert " 1000 mm" in wavequake("info", newton)[1]
    assert "450000 mm" in wavequake("info", "tmt-segments")[1]


def test_info_takes_the_names_of_telescopes_as_sensitivity_does(wavequake):
    by_name = wavequake("info", "tmt-18", "optics.wavelength_nm=1000")
    by_study = wavequake("info", "tmt-segments", "telescope.name=tmt-18", "optics.wavelength_nm=1000")
    assert by_name == by_study
    assert "1000 nm" in by_name[1]
    assert wavequake("info", "tmt-thesis")[1] != by_name[1]


def test_info_takes_every_name_that_it_offers(wavequake):
    assert "`wavequake studies` lists all" in " ".join(wavequake("info", "nonsense")[2].split())
    listed = " ".join(wavequake("studies")[1].split())
    names = listed.rpartition("and new: ")[2].removesuffix(".").split(", ")
    assert {"tmt-18", "keck", "rubin", "euv"} < set(names)
    for name in (*names, "tmt-exposure"):
        assert wq.load_system(name).surfaces


def test_a_study_takes_a_lens_file_beside_it(wavequake, tmp_path):
    wq.write_zmx(wq.load_system("double-gauss"), tmp_path / "lens.zmx")
    path = tmp_path / "study.toml"
    start, rest = STUDY.split("[system]\n")
    path.write_text(start + '[system]\nfile = "lens.zmx"\n[[disturbance]]' + rest.split("[[disturbance]]")[1])
    study = path.read_text().replace('of = ["mirror", "plate"]', 'of = ["surface 1"]')
    path.write_text(study)
    study_of_file = wq.load_study(path)
    (tmp_path / "lens.zmx").unlink()  # it is part of the study now
    code, _, err = wavequake("plan", path)
    assert code == cli.EXIT_BAD_INPUT
    assert "lens.zmx" in err
    assert "N-SSK2" in study_of_file.system.file_text


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ('"N-BK7"', '"N-BK8"', "names are N-BK7"),
        ('of = ["plate"]', 'of = ["plane"]', "did you mean 'plate'"),
        ('surfaces = ["window", "back"]', 'surfaces = ["window", "bac"]', "did you mean 'back'"),
        ("distance_mm = 800.0", "distance_mm = 800.0\nradius_mm = 0.5", "lost, at window: they miss it"),
        ("conic = -1.0", "even_asphere = [0.0, -0.1]", "at mirror: it folds over"),
        ("conic = -1.0", "conic = inf", "system.surface.mirror.conic"),
        ("conic = -1.0", "even_asphere = [nan]", "system.surface.mirror.even_asphere"),
        ("semi_diameter_mm = 51.0", "semi_diameter_mm = 51.0\ninner_mm = 50.9", "40 of 40 rays"),
        (
            "entrance_diameter_mm = 100.0",
            "entrance_diameter_mm = 100.0\npupil_obscuration = 1.0",
            "less than 1",
        ),
        ("[550.0]", "[5500.0]", "N-BK7 is known from"),
        ("fields_deg = [[0.0, 0.0], [0.0, 0.1]]", "fields_mm = [[0.0, 1.0]]", "fields_deg or fields_arcmin"),
        ("zernike_terms = 6", "zernike_terms = 60", "40 rays"),
    ],
)
def test_bad_input_ends_with_one_sentence(wavequake, newton, tmp_path, old, new, sentence):
    assert old in STUDY
    newton.write_text(STUDY.replace(old, new, 1))
    store = tmp_path / "store"
    code, _, err = wavequake("run", newton, "--store", store, "--on", "serial")
    assert code == cli.EXIT_BAD_INPUT, err
    assert sentence in err
    assert "Traceback" not in err
    assert not store.exists()


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["dubble-gauss"], "did you mean 'double-gauss'"),
        (["tmt-19"], "did you mean 'tmt-18' or"),
        (["mirror-mo"], "'mirror-mo'. `wavequake studies` lists all"),
        (["tmt-18", "telescope.name=tmt"], "puts something else in the place of tmt-18"),
        (["nowhere.zmx"], "nowhere.zmx cannot be read"),
        (["tmt", "system.f_number=3"], "tmt is no study"),
        (["tip-tilt-vibration"], "has no optical system"),
    ],
)
def test_info_of_what_there_is_not(wavequake, words, sentence):
    code, _, err = wavequake("info", *words)
    assert code == cli.EXIT_BAD_INPUT
    assert sentence in err


@pytest.mark.parametrize("name", ["double-gauss", "euv"])
def test_bundled_systems_are_sound(name):
    study = wq.load_study(name, ["optics.rays=60"])
    KIND.check(study.identity_text())
    assert study.study.name == name
