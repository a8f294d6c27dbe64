"""What shook a telescope comes back from what its light did, by full traces; what is written runs."""

import csv

import numpy as np
import pytest
from small_bodies import OPTICS, RIGID
from small_system import SYSTEM
from tests.mechanics.shaken import oscillator_series

import wavequake as wq
from wavequake.campaign.stopwatch import Stopwatch
from wavequake.errors import UserError
from wavequake.kernels.device.devices import NUMPY
from wavequake.mechanics.disturbances.motion import still
from wavequake.mechanics.disturbances.registry import draw_case
from wavequake.mechanics.telemetry.line import Line
from wavequake.mechanics.telemetry.record import record_of
from wavequake.workflows.identify.explain import MeasuredMode
from wavequake.workflows.identify.identify import doubts, identified
from wavequake.workflows.identify.study_text import study_text
from wavequake.workflows.study import load_study
from wavequake.workflows.systems.bench import system_bench
from wavequake.workflows.systems.measure import measured_cases

STUDY = (
    """# A comment that stays.
[study]
name = "two-mirrors"
workflow = "system-disturbance"
"""
    + SYSTEM.replace("[[0.0, 0.0]]", "[[0.0, 3.0]]").replace("cases = 2", "cases = 16")
    + """
# What is replaced.
[[disturbance]]
name = "guess"
model = "surface-random"
of = ["M1"]
rms = { dx_um = 1.0 }
"""
)
STEP = 1 / 64
FORCE = 'name = "one"\nmodel = "body-force"\nat = ["cell"]\nspectrum = { rms = 0.5 }\n'
COLUMNS = [f"wavefront.z{term}_nm" for term in (4, 5, 6, 7, 8)] + ["line_of_sight.x_um", "line_of_sight.y_um"]
NOISE = [0.2] * 5 + [0.02] * 2


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    path = tmp_path_factory.mktemp("study") / "two-mirrors.toml"
    path.write_text(STUDY)
    return path


def swinging(random, count, natural, damping):
    return oscillator_series(random, count, STEP, natural, damping)


def traced(study, motions):
    """Return the change of the signals (n, 7) by motions of surfaces (n, 6) in m and rad, by full traces."""
    bench = system_bench(load_study(study).identity_text())
    count = len(next(iter(motions.values())))
    moved = still(count, rigid=motions)
    rest = bench.static[0][0].zernike[0] * 550.0
    ((numbers, trouble),) = measured_cases(bench, [(np.arange(count) * STEP, moved)], NUMPY, Stopwatch())
    assert not trouble
    figure, sight = numbers["zernike"][:, 0, 0], numbers["los_mm"][:, 0, 0]
    return np.hstack([(figure - rest)[:, 3:8], 1e3 * sight])


@pytest.fixture(scope="module")
def shaken(study):
    """M2 shifts along y and turns about x at 9 Hz, M1 shifts along x at 21 Hz, traced."""
    random, count = np.random.default_rng(2), 6000
    first, second = swinging(random, count, 9.0, 0.01), swinging(random, count, 21.0, 0.01)
    motions = {"M1": np.zeros((count, 6)), "M2": np.zeros((count, 6))}
    motions["M2"][:, 1], motions["M2"][:, 3] = 2e-6 * first, 3e-6 * first
    motions["M1"][:, 0] = 1.5e-6 * second
    values = traced(study, motions)
    return record_of(COLUMNS, STEP, values + random.standard_normal(values.shape) * NOISE), motions


def test_the_element_that_moves_is_found_and_by_how_much(study, shaken):
    record, _ = shaken
    found = identified(record, load_study(study))
    assert [round(line.frequency_hz) for line in found.lines] == [9, 21]
    m2, m1 = found.explanations
    assert m2.alone == (("M2",),)
    assert m2.share > 0.95
    # dy and rx of M2 each come back: coma and line of sight tell them apart.
    rms = {axis: abs(value) for (_, axis), value in m2.motion.items()}
    assert rms["dy"] == pytest.approx(2e-6, rel=0.1)
    assert rms["rx"] == pytest.approx(3e-6, rel=0.1)
    assert ("M1",) in m1.alone
    assert ("M2",) not in m1.alone or len(m1.alone) > 1
    assert {"M1.rz", "M2.rz"} <= set(found.dark)
    assert found.rank < 18


def test_what_is_written_runs_and_does_what_was_measured(study, shaken, tmp_path):
    """The covariance of coma and line of sight, by traces of drawn cases, is that of the record."""
    record, _ = shaken
    found = identified(record, load_study(study))
    path = tmp_path / "measured.toml"
    path.write_text(study_text(found, str(study), "record.csv", tmp_path))
    text = path.read_text()
    assert "# A comment that stays." in text
    assert "What is replaced" not in text
    assert "guess" not in text
    loaded = load_study(path)
    assert loaded.study.name == "two-mirrors-measured"
    bench = system_bench(loaded.identity_text())
    together, covariance = loaded.disturbance[-1], np.zeros((4, 4))
    for realization in range(60):
        drawn = draw_case(
            loaded.disturbance, together, bench.layout, 0, realization, time=np.arange(16) * 0.77
        )
        values = traced(path, drawn.rigid)[:, 3:]
        covariance += values.T @ values / (16 * 60)
    values = record.values[:, 3:]  # other terms are noise of the sensor, which no motion explains
    scale = values.std(axis=0)
    wanted = np.cov(values.T) / np.outer(scale, scale)
    np.testing.assert_allclose(covariance / np.outer(scale, scale), wanted, atol=0.2)
    assert wq.run(path, cases=4, store__path=str(tmp_path / "store")).sizes["case"] == 4


def test_line_of_sight_alone_says_nothing_of_elements(study):
    random = np.random.default_rng(0)
    values = np.outer(swinging(random, 6000, 9.0, 0.01), [3.0, 4.0]) + random.standard_normal((6000, 2))
    record = record_of(["line_of_sight.x_mas", "line_of_sight.y_mas"], STEP, values)
    for name in (str(study), "tmt-segments"):
        found = identified(record, load_study(name))
        assert found.explanations == (None,)
        pattern = found.pattern(0)
        assert pattern["line_of_sight.y_mas"] / pattern["line_of_sight.x_mas"] == pytest.approx(
            4 / 3, rel=0.05
        )
    assert "line-1" in study_text(found, "tmt-segments", "record.csv", study.parent)


@pytest.mark.parametrize(
    ("columns", "name", "said"),
    [
        (["wavefront.z4_nm"], "tmt-segments", "needs the sensitivities of a system-disturbance study"),
        (["wavefront.z40_nm"], None, "is of Noll term 40, but the study fits 11"),
        (["wavefront[2].z4_nm"], None, "is of field point 2; the study has 1"),
        (["M3.dx_um"], None, "is of 'M3', which is no surface, body or node of the study; there are M1, M2"),
        (["line_of_sight.x_mas"], "lens-experiment", "not of lens-experiment"),
        (["line_of_sight.x_mas"], "euv", "is an angle on the sky, but the object of"),
    ],
)
def test_columns_that_a_study_does_not_have_are_a_sentence(study, columns, name, said):
    record = record_of(columns, STEP, np.random.default_rng(0).standard_normal((600, len(columns))))
    with pytest.raises(UserError, match=said):
        identified(record, load_study(name or study))


def test_a_surface_that_a_body_carries_is_told_by_the_body(tmp_path):
    path = tmp_path / "bench.toml"
    path.write_text("\n".join([OPTICS, RIGID, "[[disturbance]]", FORCE]))
    record = record_of(["M1.dx_um"], STEP, np.random.default_rng(0).standard_normal((600, 1)))
    with pytest.raises(UserError, match=r"that a body carries; write the body's motion, cell\.dx_um"):
        identified(record, load_study(path))


def write(path, values, columns):
    with path.open("w", newline="") as out:
        rows = csv.writer(out)
        rows.writerow(["time_s", *columns])
        rows.writerows([f"{STEP * k:.9g}", *row] for k, row in enumerate(values.tolist()))


def test_commands_identify_run_and_compare(study, shaken, tmp_path, monkeypatch, wavequake):
    """What was identified agrees with what was measured; another level does not."""
    monkeypatch.chdir(tmp_path)
    values, columns = shaken[0].values[:, 3:], COLUMNS[3:]
    write(tmp_path / "record.csv", values, columns)
    code, said, complained = wavequake(
        "identify", "record.csv", "--study", str(study), *("-o", "m.toml", "-o", "m.svg", "-o", "m.html")
    )
    assert code == 0, complained
    assert "2 lines in 93.75 s of 4 signals at 64 Hz" in said
    assert (tmp_path / "m.svg").stat().st_size > 10_000
    page = (tmp_path / "m.html").read_text(encoding="utf-8")
    for words in ("Spectra of record.csv", "How strong every line is", "what moves", "M2"):
        assert words in page
    assert "view.html" not in page  # there is no store
    assert wavequake("identify", "record.csv", "--study", str(study), "-o", "m.toml")[0] == 2
    axis = ["disturbance.measured.duration_s=2.0", "disturbance.measured.instants=128"]
    words = ["run", "m.toml", *axis, "campaign.cases=40", "--store", "s", "--on", "serial"]
    code, _, complained = wavequake(*words)
    assert code == 0, complained
    code, said, complained = wavequake("compare", "s", "record.csv", "-o", "bands.csv", "--figure", "f.png")
    assert code == 0, complained
    assert "Model and data agree in all" in said
    rows = list(csv.DictReader((tmp_path / "bands.csv").open()))
    assert {row["scale"] for row in rows} == {"line", "octave", "whole"}
    write(tmp_path / "louder.csv", 1.5 * values, columns)
    code, said, _ = wavequake("compare", "s", "louder.csv")
    assert code == 0
    assert "differ in" in said
    write(tmp_path / "odd.csv", values[:, :1], ["M1.dx_um"])
    code, _, complained = wavequake("compare", "s", "odd.csv")
    assert code == 2
    assert "is not what s holds" in complained
    code, _, complained = wavequake("compare", "s", "record.csv", "--of", "none")
    assert "has no cases of 'none'" in complained


def test_a_mode_that_is_off_comes_back_and_replaces_that_of_the_model(tmp_path):
    """The vertical mode of a body on springs (63.7 Hz) at 66 Hz and 1 %, as accelerometers see it."""
    prior = "[structure.uncertain]\nfrequency = 0.05\ndamping = 0.5\n"
    path = tmp_path / "bench.toml"
    path.write_text("\n".join([OPTICS, RIGID, prior, "[[disturbance]]", FORCE]))
    plant = system_bench(load_study(path).identity_text()).plants["full"]
    vertical = int(np.argmin(np.abs(plant.omega - np.sqrt(4 * 4e5 / 10.0))))
    rows = plant.shapes[plant.outputs["rigid", "cell"], vertical]
    node = plant.modal.inputs[:, plant.places["cell.a"][0]][vertical]
    random, count, step = np.random.default_rng(0), 40_000, 1e-3
    series = oscillator_series(random, count, step, 66.0, 0.01)
    swing = np.column_stack([series * rows[2], -((2 * np.pi * 66.0) ** 2) * series * node[2]])
    swing *= 2e-6 / np.abs(rows[2])
    noise = random.standard_normal((count, 2)) * 0.05 * swing.std(axis=0)
    record = record_of(["cell.dz_um", "cell.a.az_m_s2"], step, (swing + noise) * [1e6, 1.0])
    found = identified(record, load_study(path))
    (mode,) = found.modes
    assert mode.number == vertical + 1
    assert mode.model_hz == pytest.approx(np.sqrt(4 * 4e5 / 10.0) / (2 * np.pi))
    assert mode.likeness > 0.95
    frequency, damping, covariance = mode.updated()
    measured, model = np.log([66.0, mode.model_hz])
    assert abs(np.log(frequency) - measured) < 3.0 * np.sqrt(covariance[0, 0])
    assert covariance[0, 0] < min(mode.line.covariance[0, 0], 0.05**2)
    assert abs(np.log(frequency) - measured) < abs(model - measured)
    (tmp_path / "measured.toml").write_text(study_text(found, str(path), "record.csv", tmp_path))
    loaded = load_study(tmp_path / "measured.toml")
    assert loaded.structure.uncertain.frequency == 0.05
    after = system_bench(loaded.identity_text()).plants["full"]
    assert after.omega[vertical] == pytest.approx(2 * np.pi * frequency, rel=1e-6)
    ratio = 0.5 * after.modal.damping[vertical, vertical] / after.omega[vertical]
    assert ratio == pytest.approx(damping, rel=1e-3)


@pytest.mark.parametrize(("rate", "warned"), [(90.0, True), (1000.0, False)])
def test_a_line_that_a_mode_beyond_half_the_rate_would_be_folded_to_is_doubted(tmp_path, rate, warned):
    """The vertical mode of a body on springs (63.7 Hz), half the rate being 45 Hz, or 500 Hz."""
    path = tmp_path / "bench.toml"
    path.write_text("\n".join([OPTICS, RIGID, "[[disturbance]]", FORCE]))
    plant = system_bench(load_study(path).identity_text()).plants["full"]
    natural = np.sqrt(4 * 4e5 / 10.0) / (2 * np.pi)
    vertical = int(np.argmin(np.abs(plant.omega / (2 * np.pi) - natural)))
    row = plant.shapes[plant.outputs["rigid", "cell"], vertical]
    random, count = np.random.default_rng(0), 12_000
    swing = oscillator_series(random, count, 1 / rate, natural, 0.002)
    values = np.column_stack([swing * row[2], swing * row[3]]) / np.abs(row[2]) * 2.0
    noise = 0.05 * random.standard_normal(values.shape)
    found = identified(record_of(["cell.dz_um", "cell.rx_urad"], 1 / rate, values + noise), load_study(path))
    said = [line for line in doubts(found) if "folded at" in line]
    if not warned:
        assert not said
        assert [mode.number for mode in found.modes] == [vertical + 1]
        return
    (line,) = found.lines
    assert line.frequency_hz == pytest.approx(abs(natural - rate), rel=1e-3)  # where sampling brings it
    assert f"may be mode {vertical + 1} of the structure, at {natural:.4g} Hz, folded at 45 Hz" in said[0]
    assert len(said) == 1


def test_two_gaussians_are_weighed_by_their_certainty():
    covariance = np.array([[4e-6, 1e-5], [1e-5, 1e-2]])
    line = Line(50.0, 0.01, np.ones(1), np.pad(covariance, (0, 1)), True)
    frequency, _, after = MeasuredMode(1, line, 51.0, 0.01, np.nan, (np.inf, np.inf)).updated()
    assert frequency == pytest.approx(50.0)
    np.testing.assert_allclose(after, covariance)
    alone = Line(50.0, 0.01, np.ones(1), np.diag([4e-4, 1e-2, 1.0]), True)
    frequency, _, after = MeasuredMode(1, alone, 51.0, 0.01, np.nan, (0.02, np.inf)).updated()
    assert frequency == pytest.approx(np.sqrt(50.0 * 51.0))  # as certain as each other: in the middle
    assert after[0, 0] == pytest.approx(2e-4)
