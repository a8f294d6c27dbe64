"""Allowed motions during a case: white, of a spectrum, static, against closed forms and drawn time series."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from wavequake.campaign.rare.quadratic import exceedance
from wavequake.errors import UserError
from wavequake.optics.segments.modal_forms import length_form
from wavequake.report.answers.allow import allow_figure, allow_notes
from wavequake.workflows.allow import allowances
from wavequake.workflows.allow_motions import allowed_motions, of_columns
from wavequake.workflows.asked_sections import AllowedSpectrumSection
from wavequake.workflows.movable import Movable
from wavequake.workflows.study import load_study

FLAT = AllowedSpectrumSection(frequency_hz=(2.0, 6.0), psd=(3.0, 3.0))
STEEP = AllowedSpectrumSection(frequency_hz=(0.5, 2.0, 5.5), psd=(2.0, 2.0, 0.0))


def movable(elements, instants=1, duration=1.0, columns=None, rest=None):
    """Elements that shift along x, and what that does to a measure."""
    count = len(elements)
    columns = np.eye(count) if columns is None else columns
    return Movable(
        name="shaking",
        elements=elements,
        axes=("dx",),
        place=np.array([(0, k) for k in range(count)]),
        metric=np.ones(count),
        form=length_form(np.zeros(columns.shape[1]) if rest is None else rest, columns),
        moved=np.ones(count, dtype=bool),
        idle=np.zeros(count, dtype=bool),
        lasting=np.zeros(count, dtype=bool),
        time=duration * np.arange(1, instants + 1) / instants,
        seed=1,
        unit="nm",
        gaussian=lambda: None,
        drawn=lambda case: np.zeros((instants, count)),
        traced=lambda cases: np.zeros(len(cases)),
    )


def test_white_noise_of_one_element_is_chi_squared_of_its_instants():
    for instants in (5, 8):
        one = movable(("A",), instants)
        form = allowed_motions(one, np.array([2.0]), ["rms"], {}).form(one.form)
        for limit in (3.0, 6.0, 12.0):
            exact = chi2.sf(limit * instants / 4.0, instants)
            np.testing.assert_allclose(exceedance(form, limit), exact, rtol=1e-9)


def test_a_flat_spectrum_has_two_numbers_for_every_period_of_its_band():
    # Half a period around 2, 3, 4, 5, 6 periods per case: 1 + 2 + 2 + 2 + 1 quarters of the power.
    one = movable(("A",), 16)
    form = allowed_motions(one, np.array([1.0]), ["s"], {"s": FLAT}).form(one.form)
    shares = np.sort(form.curvatures)[::-1]
    np.testing.assert_allclose(shares, [0.125] * 6 + [0.0625] * 4, rtol=1e-12)


def test_a_series_has_the_spectrum_and_the_covariance_that_are_allowed():
    one = movable(("A", "B", "C"), 24, 2.0)
    motions = allowed_motions(one, np.array([1.0, 2.0, 0.5]), ["s", "rms", "static"], {"s": STEEP})
    random = np.random.default_rng(3)
    drawn = np.array([motions.drawn(random) for _ in range(20_000)])
    np.testing.assert_allclose(np.mean(drawn**2, axis=(0, 1)), [1.0, 4.0, 0.25], rtol=0.02)
    assert np.ptp(drawn[:, :, 2], axis=1).max() == 0.0
    np.testing.assert_allclose(np.mean(drawn[:, 3:, 1] * drawn[:, :-3, 1]), 0.0, atol=0.02)
    power = np.mean(np.abs(np.fft.rfft(drawn[:, :, 0], axis=1)) ** 2, axis=0) / 24**2
    power[1:] *= 2.0
    frequency = np.arange(13) / 2.0

    def below(f):  # the integral of the two straight pieces, by hand
        flat = 2.0 * np.clip(f - 0.5, 0.0, 1.5)
        left = np.clip(f, 2.0, 5.5) - 2.0
        return flat + 2.0 * left - left**2 / 3.5

    nyquist = 6.0
    wanted = below(np.minimum(frequency + 0.25, nyquist)) - below(np.maximum(frequency - 0.25, 0.0))
    np.testing.assert_allclose(power, wanted / below(nyquist), rtol=0.05, atol=1e-4)


def test_the_quantile_of_mixed_motions_is_that_of_what_is_drawn():
    columns = np.array([[1.0, 0.5], [0.3, -1.0], [0.8, 0.1]])
    one = movable(("A", "B", "C"), 12, columns=columns, rest=np.array([0.7, -0.4]))
    kinds, spectra = ["static", "rms", "s"], {"s": FLAT}
    motions = allowed_motions(one, np.array([1.0, 1.5, 0.8]), kinds, spectra)
    form = motions.form(one.form)
    random = np.random.default_rng(8)
    q = np.array([motions.drawn(random) for _ in range(20_000)])
    values = np.mean(np.sum((np.array([0.7, -0.4]) + q @ columns) ** 2, axis=2), axis=1)
    for share in (0.5, 0.1, 0.01):
        exact = exceedance(form, float(np.quantile(values, 1.0 - share)))
        assert abs(exact - share) < 4.0 * np.sqrt(share / len(values))
    np.testing.assert_allclose(form.mean, values.mean(), rtol=0.02)


@pytest.mark.parametrize(
    ("table", "wanted"),
    [
        ({"dx": 2.0}, [2.0, 2.0, 2.0]),
        ({"M*": 2.0, "M2": 3.0}, [2.0, 3.0, 1.0]),
        ({"M2": 3.0, "M* dx": 2.0}, [2.0, 2.0, 1.0]),
        ({"M1": 5.0, "?1 dx": 2.0, "M1 dx": 4.0, "L 3": 7.0}, [4.0, 1.0, 7.0]),
    ],
)
def test_the_most_definite_name_rules(table, wanted):
    assert of_columns(table, movable(("M1", "M2", "L 3")), 1.0, "allow.cost") == wanted


def test_names_that_overlap_or_name_nothing_are_sentences():
    one = movable(("M1", "M2"))
    with pytest.raises(UserError, match=r"'M\*' and '\?1' both name M1 dx and say different things"):
        of_columns({"M*": 1.0, "?1": 2.0}, one, 1.0, "allow.cost")
    assert of_columns({"M*": 2.0, "?1": 2.0}, one, 1.0, "x") == [2.0, 2.0]
    for name in ("M3", "M1 rx", "L*"):
        with pytest.raises(UserError, match=r"allow\.kind: the disturbance 'shaking' does not move"):
            of_columns({name: "rms"}, one, "static", "allow.kind")


def test_instants_that_do_not_resolve_a_motion_are_sentences():
    sizes = np.array([1.0])
    with pytest.raises(UserError, match="has one instant; give the disturbance instants"):
        allowed_motions(movable(("A",)), sizes, ["rms"], {})
    uneven = replace(movable(("A",), 3), time=np.array([0.0, 1.0, 3.0]))
    with pytest.raises(UserError, match="instants of uneven spacing"):
        allowed_motions(uneven, sizes, ["rms"], {})
    with pytest.raises(UserError, match=r"allow.spectrum.s: 50% of its power lies beyond 4 Hz"):
        allowed_motions(movable(("A",), 8), sizes, ["s"], {"s": FLAT})


DETECTOR = """
[study]
name = "detector"
workflow = "system-disturbance"
[system]
name = "double-gauss"
f_number = 8.0
[optics]
rays = 60
[wavefront]
zernike_terms = 15
[[disturbance]]
name = "detector"
model = "surface-random"
of = ["image"]
rms = { dx_um = 1.0, dy_um = 1.0 }
instants = 10
duration_s = 1.0
[allow]
measure = "los_mm.p95"
limit = "10 um"
kind = { dx = "KIND" }
spectrum = { floor = { frequency_hz = [2.0, 3.0], psd = [1.0, 1.0] } }
"""


def detector(folder, kind):
    file = folder / "detector.toml"
    file.write_text(DETECTOR.replace("KIND", kind))
    return load_study(file)


def test_a_detector_that_shakes_has_the_allowance_of_chi_squared(tmp_path):
    found = allowances(detector(tmp_path, "rms"), "los_mm[axis=x]", 0.05, 0.01, cases=100)
    np.testing.assert_allclose(found.rms[0], 1e-5 / np.sqrt(chi2.isf(0.05, 10) / 10), rtol=1e-6)
    assert found.check.low <= 0.01 <= found.check.high
    still = allowances(detector(tmp_path, "static"), "los_mm[axis=x]", 0.05, 0.01, cases=100)
    assert still.rms[0, 0] < 0.75 * found.rms[0, 0]


def test_a_spectrum_is_allowed_at_a_level_that_has_the_rms(tmp_path):
    found = allowances(detector(tmp_path, "floor"), "los_mm[axis=x]", 0.05, 0.01, cases=100)
    # Two lines of 2 and 3 Hz, half of the power each, in a case of 1 s: four equal numbers.
    np.testing.assert_allclose(found.rms[0], 1e-5 / np.sqrt(chi2.isf(0.05, 4) / 4), rtol=1e-6)
    np.testing.assert_allclose(found.levels[0], found.rms[0] ** 2, rtol=1e-12)
    assert found.kinds.tolist() == [["floor"], ["static"]]
    lines = list(allow_notes(found, "los_mm.p95", 0.01))
    assert any("Spectrum floor, at its largest (2 Hz): image dx" in line for line in lines)
    assert len(allow_figure(found, "x").axes) == 2


@pytest.mark.parametrize("span", [1.0, 1.5, 8.0, 400.0, 1e5])
def test_every_axis_of_the_figure_has_numbers(tmp_path, span):
    found = allowances(detector(tmp_path, "floor"), "los_mm[axis=x]", 0.05, 0.01, cases=100)
    shown = replace(found, rms=1.4e-8 * np.array([[1.0], [span]]))
    for axes in allow_figure(shown, "x").axes:
        low, high = axes.get_ylim()
        inside = [place for place in axes.get_yticks() if low <= place <= high]
        assert len(inside) >= 2
        assert all(axes.yaxis.get_major_formatter().format_ticks(inside))


def test_kinds_that_are_not_there_are_sentences(tmp_path):
    with pytest.raises(UserError, match="there is no 'noise'; choose one of static, rms, floor"):
        detector(tmp_path, "noise")
    study = detector(tmp_path, "rms").model_dump(mode="json")
    assert "allow" not in detector(tmp_path, "rms").identity_text()
    assert study["allow"]["kind"] == {"dx": "rms"}


def test_a_quantile_that_so_few_cases_do_not_bound_is_told_as_that():
    study = load_study("euv-allowances", {"optics.rays": 60, "wavefront.zernike_terms": 15})
    found = allowances(study, "wfe_change", 1e-6, 0.3, cases=100)
    assert not np.isfinite(found.check.high)
    said = " ".join(allow_notes(found, "wfe_change.p99.9999", 0.3))
    assert f"nm (≥ {found.check.low:.4f}: too few cases)" in said
    assert "inf" not in said
