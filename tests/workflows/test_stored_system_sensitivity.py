import numpy as np
import pytest

import wavequake as wq
from wavequake import cli, terminal
from wavequake.kernels.device.devices import NUMPY
from wavequake.optics.derivatives.sensitivity import rigid_sensitivity
from wavequake.optics.rays.pupils import sunflower
from wavequake.optics.systems.bodies import rigid_body
from wavequake.optics.wavefronts.wavefront import prepare_system

STUDY = """
[study]
name = "relay"
workflow = "system-disturbance"
[campaign]
device = "numpy"
[system]
name = "six-lens"
[optics]
rays = 40
[wavefront]
zernike_terms = 6
[[body]]
name = "L3"
surfaces = ["L3 front", "L3 back"]
[[disturbance]]
name = "askew"
model = "surface-random"
of = ["L3"]
rms = { dx_um = 2.0 }
"""


@pytest.fixture
def study(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "relay.toml"
    path.write_text(STUDY)
    return path


def test_what_is_stored_is_what_the_optics_say_in_si_units(study):
    found = wq.sensitivity(study, store="here")
    system = wq.load_system(study)
    rays = sunflower(0.0, 1.0, 40)
    body = rigid_body(system, "L3", ["L3 front", "L3 back"])
    wave = float(system.wavelengths[0])
    for field in (0, 1):
        prepared = prepare_system(system, rays.x, rays.y, rays.weight, 6, field, wave)
        direct = rigid_sensitivity(prepared, [body], NUMPY)
        scale = np.array([1e3, 1e3, 1e3, 1.0, 1.0, 1.0])[:, None]
        los = found["sensitivity_los_surface"].values[field]
        np.testing.assert_allclose(los, direct.los[:-1] * scale, rtol=1e-9, atol=1e-6)
        zernike = found["sensitivity_zernike_body"].values[field, 0]
        expected = direct.zernike[-1] * scale * wave * 1e6
        np.testing.assert_allclose(zernike, expected, rtol=1e-9, atol=1e-6 * np.abs(expected).max())
    assert found["sensitivity_los_body"].dims == ("field", "body", "dof", "axis")
    assert found["sensitivity_los_body"].attrs["units"] == "mm per m or rad"
    assert found["body"].values.tolist() == ["L3"]
    assert found["term"].values.tolist() == list(range(1, 12))  # figures, without being asked for
    assert found["surface"].values.tolist() == [surface.name for surface in system.surfaces]
    # Störkle 2018, Table 5.1: 1.303 mm of image per mm of lens.
    assert found["sensitivity_los_body"].values[0, 0, 0, 0] == pytest.approx(1303.0, abs=2.0)
    assert found.attrs["steps_agree"] == 1


def test_it_is_computed_once_and_prints_its_tables(study, wavequake):
    def run(*words):
        return wavequake("sensitivity", study, "--store", "here", *words)

    code, out, err = run("--mirror-terms", "0")
    assert (code, "Figures of surfaces" in out) == (0, False), err
    code, out, err = run("--mirror-terms", "3")
    assert code == 0, err
    for words in ("L3 front", "Bodies", "Figures of surfaces", "1.30", "Written"):
        assert words in out, out
    code, out, _ = run("--mirror-terms", "3")
    assert "nothing was computed" in out
    code, _, err = run("optics.rays=50")
    assert code == cli.EXIT_BAD_INPUT
    assert "belongs to another study" in err
    code, _, err = run("--figure-terms", "3")
    assert code == cli.EXIT_BAD_INPUT
    assert "no segments" in err


def test_every_row_keeps_its_name_and_term_in_a_narrow_terminal(study, wavequake, monkeypatch):
    monkeypatch.setattr(terminal.out, "_width", 60)
    code, out, err = wavequake("sensitivity", study, "--store", "here")
    assert code == 0, err
    lines = [line.rstrip() for line in out.splitlines()]
    assert "…" not in out
    assert any(line.startswith(" L3 front") and " Z1 " in line for line in lines)
    assert sum(line.lstrip().startswith("Z11 ") for line in lines) > 1
    assert max(map(len, lines[:-1])) <= 60  # the last one is a path


def test_figures_of_lens_faces_act_by_their_index(study):
    """A face of index n is worth (n - 1) of its height; both faces of a lens, one n - 1, one 1 - n."""
    found = wq.sensitivity(study, store="here", mirror_terms=5)
    assert found["sensitivity_zernike_deformation"].dims == ("field", "deformed", "term", "noll")
    deformed = found["deformed"].values.tolist()
    assert "stop" not in deformed
    bend = found["sensitivity_zernike_deformation"].sel(field="(0, 0) mm", term=5, noll=5).values * 1e-9
    by_name = dict(zip(deformed, bend, strict=True))
    index = 1.5168  # of N-BK7 at the d line
    for lens in range(1, 7):
        front, back = by_name[f"L{lens} front"], by_name[f"L{lens} back"]
        assert front * back < 0
        assert max(abs(front), abs(back)) <= 1.02 * (index - 1)


def test_other_workflows_say_that_they_have_none(tmp_path):
    with pytest.raises(wq.UserError, match="mirror-mor of mirror-mor has no sensitivities"):
        wq.sensitivity("mirror-mor", store=tmp_path / "here")


def test_an_exposure_study_has_those_of_its_telescope(tmp_path):
    keys = {"telescope__name": "tmt-thesis", "optics__rays": 300, "wavefront__zernike_terms": 11}
    exposure, plain = (
        wq.sensitivity(name, store=tmp_path / name, optics__sampling="sunflower", **keys)
        for name in ("tmt-exposure", "tmt-segments")
    )
    np.testing.assert_array_equal(exposure.sensitivity_los_surface, plain.sensitivity_los_surface)
