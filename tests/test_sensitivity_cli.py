"""``wavequake sensitivity`` as a user meets it."""

import subprocess
import sys
from functools import partial

import pytest
import xarray as xr

from wavequake.optics.segments import sensitivity as optics
from wavequake.report.answers.sensitivity import zernike_name

WORDS = [
    "tmt-segments",
    "telescope.name=tmt-18",
    "optics.rays_per_segment=6",
    "wavefront.zernike_terms=11",
    "campaign.device=numpy",
]


@pytest.fixture
def sensitivity(wavequake, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    return partial(wavequake, "sensitivity")


def test_it_loads_no_library_that_it_does_not_need(tmp_path):
    """They took a third of its time."""
    heavy = ["dask", "distributed", "jinja2", "matplotlib", "pandas", "xarray"]
    words = ["sensitivity", *WORDS, "--store", str(tmp_path / "s")]
    code = (
        f"import sys; sys.argv[1:] = {words}; from wavequake import cli\ntry: cli.main()\n"
        f"finally: print([one for one in {heavy} if one in sys.modules], file=sys.stderr)"
    )
    told = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "Written" in told.stdout
    assert told.stderr.strip() == "[]"


def test_it_prints_and_keeps_the_matrices(sensitivity, tmp_path):
    code, out, err = sensitivity(*WORDS, "--store", "here")
    assert code == 0, err
    assert "M2  dx" in out
    assert "coma y (c7)" in out
    assert "M1, 18 segments" in out
    assert "Figures of mirrors" in out
    assert "M2  Z1" in out
    words = " ".join(out.split())
    assert "Eq. 3.39, annular tilt / sqrt(1 + eps^2)" in words
    assert "steps 1e-06 m and 1e-06 rad" in words
    assert "Written" in out
    found = xr.open_zarr(tmp_path / "here" / "sensitivity.zarr")
    assert "M1  dx" in out
    assert "M1 among the surfaces: all its segments as one rigid body" in words
    tilts = found.sensitivity_los_surface.sel(surface=["M1", "M2"], dof="rx", axis="y").values
    rows = [line.split() for line in out.splitlines() if line.split()[:1] == ["rx"] and "coma" in line]
    assert [float(row[2]) for row in rows] == pytest.approx(tilts.tolist(), rel=1e-4)
    assert abs(tilts[0]) == pytest.approx(2 * 450e3, rel=0.03)  # twice the focal length
    code, again, _ = sensitivity(*WORDS, "--store", "here")
    assert code == 0
    assert "nothing was computed" in again
    assert again.splitlines()[:30] == out.splitlines()[:30]


def test_the_default_folder_is_that_of_the_runs(sensitivity, tmp_path):
    code, out, err = sensitivity(*WORDS, "--figure-terms", 4, "--mirror-terms", 5)
    assert "Figures of mirrors" in out
    assert "M2  Z1" in out
    assert code == 0, err
    (made,) = (tmp_path / "runs").glob("tmt-segments-*/sensitivity.zarr")
    assert str(made) in out
    assert "figure Z4" in out
    assert xr.open_zarr(made).sizes["term"] == 4


def test_one_piece_of_glass_has_no_spread_and_its_zeros_are_zero(sensitivity):
    words = ["telescope.name=tmt-thesis", "optics.sampling=sunflower", "optics.rays=200", "--figure-terms", 4]
    code, out, err = sensitivity("tmt-segments", *words, *WORDS[3:])
    assert code == 0, err
    rows = {
        line.split()[0]: line.split()[1:]
        for line in out.split("M1, one piece")[1].splitlines()
        if line.split()
    }
    assert rows["dz"][0] == "0"
    assert rows["rz"] == ["0", "0", "0"]
    # A mirror that turns by a about its vertex turns the image by 2 a f minus what M2 makes of its shift.
    assert float(rows["rx"][0]) == pytest.approx(2 * 450e3, rel=0.03)


def test_steps_that_disagree_are_told(sensitivity, monkeypatch):
    monkeypatch.setattr(
        optics.Steps,
        "__init__",
        lambda self: self.__dict__.update(translation=1e-3, rotation=3e-3, figure=1e-5),
    )
    code, out, _ = sensitivity(*WORDS)
    assert code == 0
    assert "Not to be trusted" in out


def test_bad_input_is_one_sentence(sensitivity):
    for words in (["no-such-study"], [*WORDS, "optics.rais=3"], [*WORDS, "telescope.name=vlt"]):
        code, _, err = sensitivity(*words)
        assert code == 2
        assert err.startswith("Error: ")


def test_names_of_noll_terms():
    low = (
        "piston, tilt x, tilt y, defocus, astigmatism y, astigmatism x, coma y, coma x, trefoil y, trefoil x"
    )
    names = dict(enumerate([*low.split(", "), "spherical", "2nd astigmatism x"], start=1))
    names |= {14: "tetrafoil x", 17: "2nd coma y", 22: "2nd spherical", 28: "6-foil x", 29: "3rd coma y"}
    assert {j: zernike_name(j) for j in names} == names
