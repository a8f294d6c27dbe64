"""What `wavequake sensitivity` and `wavequake.sensitivity` take beside studies."""

import numpy as np
import pytest

import wavequake as wq
from wavequake.chain.sensitivities import open_sensitivity
from wavequake.optics.catalog.names import system_names
from wavequake.optics.segments.catalog import telescope
from wavequake.optics.systems.paraxial import paraxial
from wavequake.workflows.sensitivity_source import TELESCOPES, sensitivity_study
from wavequake.workflows.study import bundled_studies, load_study

SMALL = {"optics.rays": 40, "wavefront.zernike_terms": 6, "campaign.device": "numpy"}


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize("name", sorted({*system_names(), *TELESCOPES}))
def test_every_bundled_system_has_a_study(name):
    study = sensitivity_study(name)
    if name in bundled_studies():
        assert study == load_study(name)
    elif name in TELESCOPES:
        assert study.telescope.name == name
    else:
        assert (study.study.name, study.system.name) == (name, name)


def test_a_file_in_the_way_changes_nothing(folder):
    for name in ("jwst", "gregorian"):
        (folder / name).touch()
        assert sensitivity_study(name).study.name.startswith(name)


def test_segmented_telescopes_are_those_of_their_studies():
    assert sensitivity_study("jwst") == load_study("jwst-segments")
    assert sensitivity_study("tmt-18", ["optics.rays_per_segment=6"]) == load_study(
        "tmt-segments", {"telescope.name": "tmt-18", "optics.rays_per_segment": 6}
    )


def test_a_lone_mirror_moves_its_image_by_its_focal_length(folder):
    """A turn of the mirror by a turns light by 2 a; its image follows a shift."""
    (folder / "lone mirror.zmx").write_text(lens_file())
    keys = {key.replace(".", "__"): value for key, value in SMALL.items()}
    found = wq.sensitivity("lone mirror.zmx", **keys)
    focal = abs(paraxial(wq.load_system("lone mirror.zmx")).focal_length)
    assert focal == pytest.approx(1000.0)
    los = found["sensitivity_los_surface"].sel(field=found["field"][0], surface="M1")
    assert abs(los.sel(dof="rx", axis="y").item()) == pytest.approx(2.0 * focal, rel=1e-3)
    assert los.sel(dof="dx", axis="x").item() == pytest.approx(
        1000.0, rel=1e-3
    )  # mm per m: the image follows
    assert len(list((folder / "runs").glob("lone-mirror-*/sensitivity.zarr"))) == 1


def lens_file():
    """A paraboloid of 1 m focal length, 100 mm wide, and its image."""
    return """VERS 190513 80 123457 L123457
MODE SEQ
UNIT MM X W X CM MR CPMM
ENPD 100
FTYP 0 0 1 1 0 0 0
XFLN 0
YFLN 0
WAVM 1 0.55 1
PWAV 1
SURF 0
  TYPE STANDARD
  CURV 0.0
  DISZ INFINITY
SURF 1
  STOP
  TYPE STANDARD
  COMM M1
  CURV -0.0005
  CONI -1
  DISZ -1000
  GLAS MIRROR 0 0 1.5 40
SURF 2
  TYPE STANDARD
  COMM image
  CURV 0.0
  DISZ 0
"""


def test_the_command_takes_a_bare_name_and_says_where_it_wrote(folder, wavequake):
    words = [f"{key}={value}" for key, value in SMALL.items()]
    code, out, err = wavequake("sensitivity", "gregorian", *words)
    assert code == 0, err
    assert "Written" in out
    (made,) = (folder / "runs").glob("gregorian-*/sensitivity.zarr")
    assert made.is_dir()
    code, out, _ = wavequake("sensitivity", "gregorian", *words)
    assert (code, "nothing was computed" in out) == (0, True)


@pytest.mark.parametrize(
    ("name", "keys", "words"),
    [
        (
            "jwsst",
            [],
            "There is no study and no optical system 'jwsst': did you mean 'jwst'[?] `wavequake",
        ),
        ("", [], "There is no study and no optical system ''[.] `wavequake studies` lists all"),
        ("nosuch", [], "There is no study and no optical system 'nosuch'[.] `wavequake studies` lists all"),
        ("gone.zmx", [], "The lens file gone.zmx cannot be read"),
        (
            "herschel",
            ["optics.rais=3"],
            "herschel, overridden by optics.rais=...: the key 'optics.rais' is unknown",
        ),
        ("herschel", ["nonsense"], "'nonsense' is not an override"),
        ("jwst", ["telescope.name=vlt"], "telescope.name"),
        ("jwst", ["telescope.name=tmt"], "'telescope.name' puts something else in the place of jwst; give"),
        (
            "tmt-18",
            {"telescope.name": "tmt-18"},
            "'telescope.name' puts something else in the place of tmt-18",
        ),
        ("gregorian", {"system.name": "euv"}, "'system.name' puts something else in the place of gregorian"),
        (
            "gregorian",
            ["study.workflow=lens-experiment"],
            "'study.workflow' puts something else in the place",
        ),
        ("gregorian", {"system.file": "a.zmx"}, "'system.file' puts something else in the place"),
        ("gregorian", {"system.surface": []}, "'system.surface' puts something else in the place"),
        ("lens.zmx", ["system.name=euv"], "'system.name' puts something else in the place of lens.zmx"),
        ("gregorian", {1: 2}, "The key 1 is no text"),
        ("jwst", {None: 2}, "The key None is no text"),
        ("gone.toml", [], "There is no study and no optical system 'gone.toml'"),
    ],
)
def test_bad_names_and_keys_are_one_sentence(folder, name, keys, words):
    with pytest.raises(wq.UserError, match=words):
        sensitivity_study(name, keys)


def test_a_study_may_be_given_another_system_or_telescope(folder):
    """It is named after itself, not after its system; what a named system keeps may be changed, too."""
    study = sensitivity_study("tmt-segments", {"telescope.name": "tmt-18"})
    assert (study.study.name, study.telescope.name) == ("tmt-segments", "tmt-18")
    assert sensitivity_study("euv", ["system.name=gregorian"]).system.name == "gregorian"  # the study euv
    bare = sensitivity_study("gregorian", {"system.entrance_diameter_mm": 50.0})
    assert (bare.system.name, bare.system.entrance_diameter_mm) == ("gregorian", 50.0)


def test_sensitivities_of_the_bare_system_are_those_of_a_study_of_it(folder):
    (folder / "mine.toml").write_text(
        """[study]
name = "mine"
workflow = "system-disturbance"
[system]
name = "gregorian"
[[disturbance]]
name = "shake"
model = "surface-random"
of = ["M2"]
rms = { dx_um = 1.0 }
"""
    )
    keys = {key.replace(".", "__"): value for key, value in SMALL.items()}
    bare, mine = (wq.sensitivity(name, **keys) for name in ("gregorian", "mine.toml"))
    for name in mine.data_vars:
        np.testing.assert_array_equal(bare[name].values, mine[name].values)


@pytest.mark.parametrize("name", ["gregorian", "herschel", "jwst", "tmt-18"])
def test_what_is_assumed_of_a_system_is_printed_and_kept(folder, wavequake, name):
    of_study = name in TELESCOPES
    note = (telescope(name) if of_study else wq.load_system(name)).note
    assert ("assumed" in note) == (name in ("herschel", "jwst"))
    words = ["optics.rays_per_segment=6"] if of_study else ["optics.rays=100", "--mirror-terms", "0"]
    for _ in range(2):  # made, and read again
        code, out, err = wavequake(
            "sensitivity", name, "wavefront.zernike_terms=6", "campaign.device=numpy", *words
        )
        assert code == 0, err
        assert note in " ".join(out.split())
    (made,) = (folder / "runs").glob("*/sensitivity.zarr")
    assert open_sensitivity(made.parent).attrs.get("note", "") == note


def test_rays_that_openings_stop_are_counted(folder, wavequake):
    """A ring of the rim is stopped at the lone mirror: as many of even rays as the share of its area."""
    (folder / "stopped.zmx").write_text(lens_file().replace("SURF 2", "  CLAP 0 40 0\nSURF 2"))
    words = ["optics.rays=100", "wavefront.zernike_terms=6", "campaign.device=numpy"]
    code, out, err = wavequake("sensitivity", "stopped.zmx", *words)
    assert code == 0, err
    assert "At rest openings stop 36 of 100 rays of (0, 0) deg; the numbers are those" in " ".join(
        out.split()
    )
    code, out, _ = wavequake("sensitivity", "gregorian", *words)
    assert (code, "openings stop" in out) == (0, False)
