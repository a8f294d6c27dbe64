"""Spectra, transfer functions, titles on marks and words of reports against closed forms."""

import io
import re
from pathlib import Path

import numpy as np
import pytest
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from rich.console import Console

import wavequake as wq
from wavequake.drawing.periodogram import spectrum
from wavequake.drawing.style import hover, svg_text
from wavequake.drawing.ticks import number_powers
from wavequake.imaging.engines.matrix_fourier import matrix_fourier, psf
from wavequake.imaging.exposures.mtf import ideal_mtf
from wavequake.imaging.pupils.pupil_function import annular_pupil
from wavequake.mechanics.disturbances.folded import folded_lines, has_spectrum
from wavequake.report.answers.sensitivity import conclusion
from wavequake.report.exposures.psf_figures import annulus, frame_mtf, image_row, perfect_mtf, polygons
from wavequake.report.figures import distributions
from wavequake.report.page import VIEWED, inline_svg
from wavequake.report.table import radius
from wavequake.report.vibration import histories_and_spectra
from wavequake.viewer.view import _MAKERS
from wavequake.words import unsaid
from wavequake.workflows.early_notices import folded_notices
from wavequake.workflows.study import load_study, study_with


@pytest.mark.parametrize("count", [64, 65])
def test_a_spectrum_sums_to_the_variance(count):
    values = np.random.default_rng(1).normal(size=count).cumsum()
    hertz, density = spectrum(np.arange(count) * 0.01, values)
    assert np.sum(density) * hertz[0] == pytest.approx(values.var(), rel=1e-12)


def test_a_sine_is_one_line_of_half_its_squared_amplitude():
    time = np.arange(200) * 1e-3
    hertz, density = spectrum(time, 3.0 * np.sin(2.0 * np.pi * 50.0 * time) + 7.0)
    assert hertz[np.argmax(density)] == pytest.approx(50.0)
    assert density.max() * hertz[0] == pytest.approx(4.5)
    assert np.sort(density)[-2] < 1e-20


LINE = """
[study]
name = "folded"
workflow = "system-disturbance"
[system]
name = "gregorian"
[optics]
rays = 40
[[disturbance]]
name = "hum"
model = "surface-vibration"
of = ["M2"]
lines = [{ frequency_hz = 310.0, amplitude = { dx_um = 0.1 } }]
instants = 32
[campaign]
cases = 1
"""


def test_lines_above_half_the_rate_are_said_to_be_folded(tmp_path, monkeypatch):
    """310 Hz at 320 instants a second looks like 10 Hz; as many instants as are asked for show it."""
    monkeypatch.chdir(tmp_path)
    Path("folded.toml").write_text(LINE)
    study = load_study("folded.toml")
    said = folded_lines(study.disturbance, "hum")
    assert list(folded_notices(study)) == [said]
    assert "up to 310 Hz, above half the rate of its instants (160 Hz)" in said
    report = wq.report(_run(study, "few")).read_text()
    assert said in report
    enough = int(re.search(r"instants = (\d+)", said)[1])
    more = study_with(study, {"disturbance.hum.instants": enough})
    assert folded_lines(more.disturbance, "hum") == ""
    assert f"instants = {2 * enough} show" in folded_lines(more.disturbance, "hum", every=2)
    assert list(folded_notices(study_with(study, {"store.reduce": "summary"}))) == []  # nothing is drawn
    assert "folded to lower" not in wq.report(_run(more, "more")).read_text()
    for store, hertz in (("few", 10.0), ("more", 310.0)):
        one = wq.open_store(store).isel(case=0)
        at, density = spectrum(
            one.time_s.to_numpy(), one.los_mm.isel(field=0, wavelength=0, axis=0).to_numpy()
        )
        assert at[density.argmax()] == pytest.approx(hertz, abs=at[0])
    one_less = study_with(study, {"disturbance.hum.instants": enough - 1})
    assert folded_lines(one_less.disturbance, "hum") == ""  # half the rate is the line: it is not folded
    assert folded_lines(study_with(study, {"disturbance.hum.instants": enough - 2}).disturbance, "hum")
    assert folded_lines(study_with(study, {"disturbance.hum.instants": 15}).disturbance, "hum") == ""


@pytest.mark.parametrize(
    ("study", "name", "words"),
    [
        ("jwst-segments", "jitter", "up to 30 Hz"),  # listed lines
        ("tmt-segments", "wind", "up to 120 Hz.*shorten duration_s, as 14401"),  # modes of the supports
        ("tmt-segments", "wind-shake", "up to 0.65 Hz"),  # a mode of the structure
        ("telescope-structure", "wheel", "up to 352 Hz"),  # 5.28 times 4000 rpm
        ("telescope-structure", "all", "up to 352 Hz"),  # what it holds
    ],
)
def test_lines_of_every_source_are_known(study, name, words):
    assert re.search(words, folded_lines(load_study(study).disturbance, name))


def _run(study, store):
    wq.run(study, store=store, on="serial")
    return store


def test_uneven_or_few_instants_have_no_spectrum():
    assert has_spectrum(np.arange(16) * 0.1)
    assert not has_spectrum(np.arange(15) * 0.1)
    assert not has_spectrum(np.arange(16.0) ** 2)
    figure = histories_and_spectra(np.arange(32.0), {"still": ("nm", {"x": np.ones(32)})})
    assert len(figure.axes) == 2


@pytest.mark.parametrize(
    ("limits", "words"),
    [
        ((0.05, 60.0), ["10⁻¹", "10⁰", "10¹"]),
        ((2e-7, 2.5e-5), ["10⁻⁶", "10⁻⁵"]),
        ((4e-8, 1.5e-6), ["5·10⁻⁸", "10⁻⁷", "2·10⁻⁷", "5·10⁻⁷", "10⁻⁶"]),
        ((0.3, 6.0), ["0.5", "1", "2", "5"]),
        ((39.0, 161.0), ["40", "60", "80", "100", "120", "140", "160"]),
        ((3.05, 3.45), ["3.05", "3.1", "3.15", "3.2", "3.25", "3.3", "3.35", "3.4", "3.45"]),
    ],
)
def test_numbers_of_logarithmic_axes_are_plain_text(limits, words):
    axes = Figure().add_subplot(xscale="log", xlim=limits)
    number_powers(axes.xaxis)
    low, high = limits
    ticks = [tick for tick in axes.xaxis.get_majorticklocs() if low * 0.999 < tick < high * 1.001]
    assert axes.xaxis.get_major_formatter().format_ticks(ticks) == words


def test_what_hardly_changes_is_drawn_as_still_and_spectra_span_a_decade():
    time = np.arange(32.0)
    ripple = np.random.default_rng(0).standard_normal(32)
    still, moving = (
        histories_and_spectra(
            time, {"WFE": ("nm", {"x": 54.75 + size * ripple}), "LOS": ("mas", {"x": ripple})}
        )
        for size in (1e-4, 10.0)
    )
    heights = [axes.get_position().height for axes in still.axes]
    assert np.ptp(heights) < 1e-9
    low, high = still.axes[0].get_ylim()
    assert high - low == pytest.approx(0.01 * 54.75, rel=1e-3)
    assert "e1" not in svg_text(still)  # no number is to be added to those of the axis
    low, high = still.axes[1].get_ylim()
    assert high >= 9.99 * low
    low, high = moving.axes[0].get_ylim()
    assert high - low < 1.2 * 10.0 * np.ptp(ripple)


def test_spectra_say_their_powers_without_formulas():
    time = np.arange(32.0)
    curve = 1e-6 * np.random.default_rng(0).standard_normal(32)
    svg = svg_text(histories_and_spectra(time, {"line of sight": ("mas", {"x": curve})}))
    assert {"1e−6", "10⁻⁶", "frequency (Hz)", "mas / √Hz"} <= set(re.findall(r">([^<>]+)</text>", svg))
    assert "tspan" not in svg  # of which formulas are made


def test_the_mtf_of_a_round_pupil_is_its_closed_form():
    frequency, mtf = perfect_mtf(annulus(0.0))
    np.testing.assert_allclose(mtf, ideal_mtf(frequency), atol=2e-3)
    _, annular = perfect_mtf(annulus(0.5))
    middle = len(annular) // 2  # a hole costs at middle frequencies and gains at high ones
    assert annular[middle] < ideal_mtf(0.5)
    assert annular[int(0.85 * len(annular))] > mtf[int(0.85 * len(annular))]
    square = np.array([[[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]]])
    frequency, mtf = perfect_mtf(polygons(square, 1.0))
    np.testing.assert_allclose(mtf, 1.0 - frequency, atol=3e-3)


@pytest.mark.parametrize(("pixels", "obscuration"), [(24, 0.0), (64, 0.3)])
def test_no_image_has_more_contrast_than_its_pupil_allows(pixels, obscuration):
    """Also where the frame cuts much of its light: over its own sum the curve would be too high."""
    pupil = annular_pupil(128, obscuration)
    image = psf(matrix_fourier(pupil, pixels, 0.25), np.zeros((1, len(pupil.cells))))[0]
    frequency, mtf = frame_mtf(image, 0.25, annulus(obscuration))
    at, perfect = perfect_mtf(annulus(obscuration))
    limit = np.interp(frequency, at, perfect)
    assert (mtf <= limit + 0.03).all()
    assert mtf[-1] < 0.03
    wide = frequency * pixels * 0.25 > 3.0  # finer than what the frame's edge blurs
    np.testing.assert_allclose(mtf[wide], limit[wide], atol=0.05)


def test_marks_say_what_they_are():
    figure = Figure(figsize=(3, 3))
    axes = figure.add_subplot()
    squares = [np.array([[k, 0], [k + 1, 0], [k + 1, 1], [k, 1]]) for k in range(3)]
    cells = PolyCollection(squares, facecolors=["#ff0000", "#00ff00", "#0000ff"])
    cells.set_gid(hover(["A: 1 nm", 'B "2" & <3>', "C\x1b"]))
    axes.add_collection(cells)
    axes.plot([0, 3], [0, 1], marker=".", label="the <line>")
    axes.autoscale_view()
    svg = inline_svg(figure, "one")
    titles = re.findall(r"<title>([^<]*)</title>", svg)
    assert titles[:3] == ["A: 1 nm", "B &quot;2&quot; &amp; &lt;3&gt;", "C\\x1b"]
    assert set(titles[3:]) == {"the &lt;line&gt;"}
    fills = re.findall(r"<path[^>]*fill: (#\w+)[^>]*><title>[ABC]", svg)
    assert fills == ["#ff0000", "#00ff00", "#0000ff"]
    assert "hover" not in svg
    assert inline_svg(figure, "one") == svg


def test_distributions_begin_at_nothing():
    (axes,) = distributions({"a": np.array([2.0, 1.0, 4.0])}, "nm").axes
    x, y = axes.lines[0].get_data()
    np.testing.assert_allclose(x, [1.0, 1.0, 2.0, 4.0])
    np.testing.assert_allclose(y, [0.0, 1 / 3, 2 / 3, 1.0])


def test_cases_that_are_alike_are_one_line_on_an_axis_without_an_offset():
    figure = distributions({"a": 1.2985 + 1e-9 * np.arange(4)}, "nm")
    (axes,) = figure.axes
    figure.draw_without_rendering()
    assert np.ptp(axes.get_xlim()) == pytest.approx(2.597e-3, rel=1e-6)
    assert axes.xaxis.get_major_formatter().get_offset() == ""


def test_counts_have_a_scale_in_electrons():
    counts = np.array([[[0.0, 16.0], [4.0, 400.0]]])
    figure = image_row(counts, ["x"], np.array([0.0, 1.0]), "µm", "electrons")
    first, bar = figure.axes
    assert (first.get_ylabel(), bar.get_ylabel()) == ("y (µm)", "electrons")
    assert [one.get_text() for one in bar.get_yticklabels()] == ["0", "100", "225", "400"]
    np.testing.assert_allclose(bar.get_yticks(), [0.0, 10.0, 15.0, 20.0])


def test_a_circle_that_leaves_the_frame_says_so():
    assert radius(np.inf, 5.25) == "> 5.25, the frame"
    assert radius(1.234, 5.25) == "1.23"


def test_what_was_said_is_not_said_again():
    said = "A moves by 0.5 nm.\n It is e.g. bad."
    assert unsaid("A moves by 0.5 nm. Over 3 cases. It is e.g. bad.", said) == "Over 3 cases."
    assert unsaid("All said.", "All said.") == ""
    two = "wind: A is best. wind, off: B is worst; C, too."  # sentences that begin with a name
    assert unsaid(f"Over 3 cases. {two}", two) == "Over 3 cases."
    assert unsaid("Over 3 cases.", "") == "Over 3 cases."


def test_reports_link_to_the_viewer_of_what_it_shows():
    assert {*_MAKERS, "sweep"} == VIEWED


def test_titles_follow_what_is_replaced():
    plain = load_study("tmt-million").study.title
    assert load_study("tmt-million", ["campaign.cases=40", "store.chunk_cases=4"]).study.title == plain
    changed = load_study("tmt-million", {"telescope.name": "tmt-18", "campaign.cases": 40})
    assert changed.study.title == f"{plain} [telescope.name = tmt-18]"
    named = load_study("tmt-million", {"telescope.name": "tmt-18", "study.title": "mine"})
    assert named.study.title == "mine"
    again = study_with(load_study("tmt-million"), {"telescope.name": "tmt-18"})
    assert again.study.title == changed.study.title
    assert changed.identity_text() == study_with(changed, {"study.title": "another"}).identity_text()


def test_the_conclusion_names_the_largest_of_shifts_and_turns():
    los, rms = np.zeros((3, 6)), np.zeros((3, 6))
    los[1, 0], los[2, 4], rms[0, 2] = 2.5, 4000.0, 0.75
    words = conclusion(["M1", "M2", "M3"], los, rms)
    assert words == (
        "What moves the image most is M2 where it shifts (dx: 2.50 µm per µm) and M3 where it turns "
        "(ry: 4.00 µm per µrad). "
        "What disturbs the wavefront most is M1 where it shifts (dz: 0.750 nm per µm)."
    )


def test_numbers_of_variants_are_whole_at_80_columns(tmp_path):
    from wavequake import run
    from wavequake.report.campaign import summary_table

    keys = {
        "model.rings": 2,
        "model.shapes": ["circular"],
        "reduction.variants": ["krylov108(200,450,700)", "craigb18"],
        "reduction.frequencies": 4,
        "reduction.spot_checks": 0,
        "time.duration_s": 0.002,
        "optics.zernike_terms": 11,
        "imaging.pupil_samples": 32,
    }
    run(load_study("mirror-mor", keys), store=tmp_path / "m", on="serial")
    console = Console(width=80, file=io.StringIO())
    console.print(summary_table(tmp_path / "m"))
    text = console.file.getvalue()
    assert "…" not in text
    row = next(line for line in text.splitlines() if "craigb18" in line)
    assert len(re.findall(r"\d\.\de[-+]\d\d\b", row)) >= 4
