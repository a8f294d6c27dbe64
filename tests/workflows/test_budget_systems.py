"""Budgets of lenses: elements that move, on, off and drawn again."""

import re

import numpy as np
import pytest

from wavequake import cli
from wavequake.chain.sampling import slot
from wavequake.mechanics.disturbances.layout import NO_SEGMENTS
from wavequake.mechanics.disturbances.registry import draw_case
from wavequake.optics.rays.pupils import sunflower
from wavequake.report.answers.budget import budget_figure, explanations
from wavequake.workflows.budgets.budget import budget, stored_budget, summed
from wavequake.workflows.budgets.elements import Factors, variants
from wavequake.workflows.study import load_study
from wavequake.workflows.systems.bench import system_bench
from wavequake.workflows.systems.disturbance import KIND

STUDY = """
[study]
name = "lens"
workflow = "system-disturbance"
seed = 5
[system]
name = "double-gauss"
f_number = 8.0
fields_deg = [[0.0, 5.0]]
[campaign]
device = "numpy"
[optics]
rays = 60
[[body]]
name = "L1"
surfaces = ["surface 1", "surface 2"]
[[body]]
name = "L4"
surfaces = ["surface 10", "surface 11"]
[[disturbance]]
name = "coarse"
model = "surface-random"
of = ["L1", "L4"]
rms = { dx_um = 2.0 }
[[disturbance]]
name = "fine"
model = "surface-random"
of = ["L1"]
rms = { dx_um = 1.0 }
"""


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    path = tmp_path_factory.mktemp("budget") / "lens.toml"
    path.write_text(STUDY)
    return load_study(path)


@pytest.fixture(scope="module")
def found(study):
    return budget(study, 30)


def test_a_factor_is_taken_away_or_drawn_again_and_the_others_stay(study):
    sources = study.disturbance
    one, other, only_fine, only_coarse, *rest = variants(
        summed(study, None), Factors(sources, surfaces=("L1", "L4")), NO_SEGMENTS, 5, 3
    )
    direct = [draw_case(sources, entry, NO_SEGMENTS, 5, 3).rigid["L1"] for entry in sources]
    np.testing.assert_array_equal(one.rigid["L1"], direct[0] + direct[1])
    np.testing.assert_array_equal(only_fine.rigid["L1"], direct[1])
    np.testing.assert_array_equal(only_coarse.rigid["L1"], direct[0])
    assert "L4" not in only_fine.rigid
    without_l1, without_l4, coarse_again, fine_again, l1_again, l4_again = rest
    assert set(without_l1.rigid) == {"L4"}
    assert set(without_l4.rigid) == {"L1"}
    np.testing.assert_array_equal(coarse_again.rigid["L4"], other.rigid["L4"])
    np.testing.assert_allclose(
        coarse_again.rigid["L1"] + fine_again.rigid["L1"], one.rigid["L1"] + other.rigid["L1"], rtol=1e-13
    )
    np.testing.assert_array_equal(l1_again.rigid["L1"], other.rigid["L1"])
    np.testing.assert_array_equal(l1_again.rigid["L4"], one.rigid["L4"])
    np.testing.assert_array_equal(l4_again.rigid["L4"], other.rigid["L4"])
    assert not np.any(one.rigid["L1"] == other.rigid["L1"], where=direct[0] != 0.0)


def test_small_shifts_of_lenses_move_the_image_in_proportion(study, found):
    # Lenses move by c + f and by d along x: the image by a (c + f) + b d, with constant a, b.
    drawn = [
        [draw_case(study.disturbance, entry, NO_SEGMENTS, 5, case) for entry in study.disturbance]
        for case in range(30)
    ]
    c, d, f = (
        np.array([case[source].rigid[name][0, 0] for case in drawn])
        for source, name in ((0, "L1"), (0, "L4"), (1, "L1"))
    )
    moved = {
        str(name): found["value"].sel(quantity="image_motion", variant=name).to_numpy()
        for name in found["variant"].to_numpy()
    }
    a, b = np.median(moved["without coarse"] / np.abs(f)), np.median(moved["without L1"] / np.abs(d))
    np.testing.assert_allclose(moved["without coarse"], a * np.abs(f), rtol=1e-4)
    np.testing.assert_allclose(moved["without L1"], b * np.abs(d), rtol=1e-4)
    np.testing.assert_allclose(moved["without L4"], a * np.abs(c + f), rtol=1e-4)
    sign = -1.0 if moved["all"][0] < moved["without L4"][0] + moved["without L1"][0] - 1e-6 else 1.0
    sign *= np.sign((c + f)[0] * d[0])
    np.testing.assert_allclose(moved["all"], np.abs(a * (c + f) + sign * b * d), rtol=1e-3)
    share = found["share"].sel(quantity="image_motion", factor="L4")
    assert float(share) == pytest.approx(
        1.0 - np.sum((c + f) ** 2) * a**2 / np.sum(moved["all"] ** 2), rel=1e-3
    )
    assert found["kind"].to_numpy().tolist() == ["source", "source", "element", "element"]
    assert np.isfinite(found["total"]).all()


def test_what_is_without_a_factor_is_a_direct_trace(study, found):
    text = study.identity_text()
    slots = [slot(study.disturbance, case) for case in range(4)]
    case = next(i for i, (one, realization) in enumerate(slots) if (one.name, realization) == ("fine", 0))
    direct = KIND.compute(text, np.array([case]), "numpy")
    light = system_bench(text).system.primary_wavelength
    change = direct.arrays["wfe_change"][0, :, :, light]
    value = found["value"].sel(case=0, variant="without coarse", quantity="wfe_change")
    assert float(value) == pytest.approx(np.sqrt(np.mean(change**2)), rel=1e-6)
    assert float(found["rms_rest"].sel(quantity="wfe_change")) == pytest.approx(0.0, abs=1e-6)


def test_the_command_prints_a_table_and_a_report_has_a_figure(study, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("wavequake.workflows.budgets.budget.FEWEST", 4)
    (tmp_path / "lens.toml").write_text(STUDY)
    words = ["budget", str(tmp_path / "lens.toml"), "--cases", "4", "--store", str(tmp_path / "s")]
    monkeypatch.setattr("sys.argv", ["wavequake", *words])
    with pytest.raises(SystemExit) as end:
        cli.main()
    said = " ".join(capsys.readouterr().out.split())
    assert end.value.code in (0, None)
    for expected in ("motion of the image", "coarse", "L4", "field points at the primary wavelength"):
        assert expected in said
    assert "ring" not in said
    found, kept = stored_budget(study, tmp_path / "s", 4)
    assert kept
    assert len(budget_figure(found).axes) == 2


MIRROR = """
[study]
name = "mirror"
workflow = "system-disturbance"
[system]
name = "paraboloid"
entrance_diameter_mm = 200.0
fields_deg = [[0.0, 0.0]]
wavelengths_nm = [550.0]
[[system.surface]]
name = "stop"
stop = true
[[system.surface]]
name = "M1"
distance_mm = 500.0
radius_mm = -2000.0
conic = -1.0
glass = "mirror"
semi_diameter_mm = {edge}
[[system.surface]]
name = "image"
distance_mm = 1000.0
[campaign]
device = "numpy"
[optics]
rays = 200
[wavefront]
zernike_terms = 6
[[disturbance]]
name = "shifts"
model = "surface-random"
of = ["M1"]
rms = {{ dz_um = 1.0, dx_um = {shift} }}
"""


@pytest.mark.parametrize(
    ("edge", "shift", "words"),
    [
        (90.0, 0.0, "{} of 200 rays do not arrive at rest. All numbers are those of fits that go on over"),
        (100.0, 0.0, None),
        # The outermost ray lies 0.25 mm inside.
        (100.0, 500.0, r"up to \d of 200 do not arrive at an instant of \d+ of 16 cases\. All numbers .*"),
    ],
)
def test_light_that_an_opening_stops_is_counted(tmp_path, edge, shift, words):
    path = tmp_path / "mirror.toml"
    path.write_text(MIRROR.format(edge=edge, shift=shift))
    rays = sunflower(0.0, 1.0, 200)
    beyond = np.count_nonzero(np.hypot(rays.x, rays.y) > edge / 100.0)
    found = budget(load_study(path), 16)
    assert found["factor"].to_numpy().tolist() == ["shifts"]  # whose one element is no factor of its own
    said = found.attrs.get("vignetted")
    if words is None:
        assert beyond == 0
        assert said is None
    else:
        assert (beyond > 0) == (shift == 0.0)
        assert re.match(words.format(beyond), said)
        assert said in explanations(found)


# Static motions, and a swing that leaves a streak between its four instants.
LINE = "{ frequency_hz = 30.0, amplitude = { dx_um = 9.0 } }"
SWING = f'model = "surface-vibration"\ninstants = 4\nlines = [{LINE}]'


@pytest.mark.parametrize("fine", ['model = "surface-random"\nrms = { dx_um = 1.0 }', SWING])
def test_the_peak_of_exposures_is_a_measure_too(tmp_path, monkeypatch, fine):
    monkeypatch.setattr("wavequake.workflows.budgets.budget.FEWEST", 4)
    text, _ = STUDY.rsplit("[[disturbance]]", 1)
    entry = f'[[disturbance]]\nname = "fine"\nof = ["L1"]\n{fine}\n'
    (tmp_path / "lens.toml").write_text(text + entry + "[imaging]\npixels = 32\n")
    study = load_study(tmp_path / "lens.toml")
    found = budget(study, 4, measure="peak")
    slots = [slot(study.disturbance, case) for case in range(4)]
    case = next(i for i, (one, realization) in enumerate(slots) if (one.name, realization) == ("fine", 0))
    peak = KIND.compute(study.identity_text(), np.array([case]), "numpy").arrays["peak"][0]
    value = found["value"].sel(case=0, variant="without coarse", quantity="peak")
    assert float(value) == pytest.approx(np.sqrt(np.mean((1.0 - peak) ** 2)), rel=1e-6)
