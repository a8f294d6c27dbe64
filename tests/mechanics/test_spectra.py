from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import integrate, signal, special, stats

from wavequake.errors import UserError
from wavequake.mechanics.disturbances.motion import RAD_PER_MAS
from wavequake.mechanics.disturbances.spectra import (
    Spectrum,
    band_variance,
    banded,
    frequencies,
    power_and_floor,
    resonance,
    scaled,
    split,
    synthesize,
    tabulated,
    total,
    variance,
    von_karman,
    windshake,
)

# All in mas^2/Hz, so that the absolute part of a tolerance means nothing.
TMT_WINDSHAKE = scaled(windshake(1.158e-11, 0.08, 0.65, 0.25), RAD_PER_MAS**-2)
TMT_VIBRATION = scaled(power_and_floor(1.56789e-14, 3.07142e-19, 1.0, 50.0), RAD_PER_MAS**-2)
KECK_LINE = resonance(29.71, 6.77, 6.7)


def rms_mas(spectrum):
    return np.sqrt(variance(spectrum))


def test_tmt_windshake_has_its_published_rms_and_energy_distribution():
    assert rms_mas(TMT_WINDSHAKE) == pytest.approx(18.96, abs=0.005)
    assert rms_mas(scaled(TMT_WINDSHAKE, 28 / 13)) == pytest.approx(27.83, abs=0.01)
    edges = np.array([1e-3, 0.1, 0.401, 0.732, 1e3])
    expected = [integrate.quad(TMT_WINDSHAKE.density, *band, epsrel=1e-9)[0] for band in pairwise(edges)]
    assert band_variance(TMT_WINDSHAKE, edges) == pytest.approx(expected, rel=1e-7)
    assert np.cumsum(expected)[1:3] / sum(expected) == pytest.approx([0.50, 0.95], abs=0.001)
    slope = np.log(TMT_WINDSHAKE.density(np.array([200.0])) / TMT_WINDSHAKE.density(np.array([100.0])))
    assert slope / np.log(2) == pytest.approx(-6, abs=1e-3)


def test_tmt_vibration_has_its_published_rms_and_energy_distribution():
    assert rms_mas(TMT_VIBRATION) == pytest.approx(14.93, abs=0.005)
    below, above = band_variance(TMT_VIBRATION, np.array([1.0, 2.0, 50.0]))
    assert below / (below + above) == pytest.approx(0.87, abs=0.02)


@pytest.mark.parametrize(("center", "width"), [(29.71, 6.77), (5.99, 0.5), (100.0, 60.0), (12.0, 0.01)])
def test_resonance_has_its_rms_its_width_and_its_place(center, width):
    line = resonance(center, width, 6.7)
    everywhere = (
        integrate.quad(lambda f: line.density(f), 0, np.inf, points=None, epsrel=1e-10, limit=2000)[0]
        if width > 1
        else 6.7**2
    )
    assert everywhere == pytest.approx(6.7**2, rel=1e-8)
    assert variance(line) == pytest.approx(6.7**2, rel=0.02 * width / center + 1e-7)
    frequency = np.linspace(center - 1.5 * width, center + 1.5 * width, 300001)
    density = line.density(frequency)
    above = frequency[density >= density.max() / 2]
    assert above[-1] - above[0] == pytest.approx(width, rel=1e-4)
    assert frequency[density.argmax()] == pytest.approx(center, abs=0.6 * width**2 / center + 1e-4 * width)


def test_von_karman_holds_the_variance_of_the_gusts_and_has_the_kolmogorov_tail():
    gusts = von_karman(0.7, 5.0, 2.0)
    everything = integrate.quad(lambda f: gusts.density(f), 0, np.inf, epsrel=1e-9)[0]
    closed = 0.49 * 2 * np.sqrt(np.pi / 70.7) * special.gamma(1 / 3) / special.gamma(5 / 6)
    assert everything == pytest.approx(closed, rel=1e-6)
    assert everything == pytest.approx(0.49, rel=6e-4)
    assert variance(gusts) == pytest.approx(everything, rel=7e-3)
    f = np.array([1e2, 1e3])
    assert np.diff(np.log(gusts.density(f))) / np.diff(np.log(f)) == pytest.approx(-5 / 3, abs=1e-4)
    # Above f the tail holds 4 sigma^2 (L/U) (70.7 (L/U)^2)^(-5/6) 3/2 f^(-2/3).
    tail = 4 * 0.49 * 2.5 * (70.7 * 2.5**2) ** (-5 / 6) * 1.5 * (10 ** (-2 / 3) - 2000 ** (-2 / 3))
    assert band_variance(gusts, np.array([10.0, 2000.0]))[0] == pytest.approx(tail, rel=1e-4)


@given(st.floats(-6, 3), st.floats(1e-3, 10), st.floats(1.01, 1e4))
@settings(deadline=None, max_examples=50, derandomize=True)
def test_band_variance_of_a_power_law_is_its_closed_form(exponent, low, ratio):
    spectrum = Spectrum(lambda f: f**exponent, low, low * ratio)
    edges = low * np.array([1.0, ratio**0.3, ratio])
    one = exponent + 1
    exact = np.diff(np.log(edges)) if abs(one) < 1e-9 else np.diff(edges**one) / one
    np.testing.assert_allclose(band_variance(spectrum, edges), exact, rtol=1e-8 if abs(one) > 1e-4 else 1e-3)


def test_band_variance_is_zero_outside_the_spectrum_and_adds_up():
    edges = np.array([0.1, 0.5, 1.0, 3.0, 50.0, 80.0])
    parts = band_variance(TMT_VIBRATION, edges)
    assert np.all(parts[[0, 1, 4]] == 0)
    assert parts.sum() == pytest.approx(variance(TMT_VIBRATION), rel=1e-12)


def test_a_table_is_integrated_as_the_polygon_that_it_is():
    text = "frequency_hz,psd\n# comment\n1,0\n2,3\n\n5,1.5\n9,0\n"
    spectrum = tabulated(text, "psd.csv")
    assert variance(spectrum) == pytest.approx(1.5 + 6.75 + 3.0, rel=1e-12)
    assert split(spectrum).variances.sum() == pytest.approx(11.25, rel=1e-12)


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("", "psd.csv has 0 rows"),
        ("1,2\n", "psd.csv has 1 rows"),
        ("frequency_hz,psd\n1,2\n", "has 1 rows"),
        ("1,2\n2,nan\n", "line 2: '2,nan' has a value that is not finite"),
        ("nan,2\n2,1\n", "line 1: 'nan,2' has a value that is not finite"),
        ("1,2\n2,inf\n", "line 2: .* not finite"),
        ("1,2\n2,-1\n", "line 2: the psd -1 is negative"),
        ("f,S\n1,2\n3,1\n2,1\n", "line 4: the frequency 2 Hz is not above the previous 3 Hz"),
        ("1,2\n1,1\n", "line 2: the frequency 1 Hz is not above"),
        ("0,2\n1,1\n", "line 1: the frequency 0 Hz is not above 0"),
        ("1,2\n2\n", "line 2: '2' is not two numbers"),
        ("1,2\n2,3,4\n", "line 2: .* is not two numbers"),
        ("1,2\n2,x\n", "line 2: '2,x' is not two numbers"),
        ("1,0\n2,0\n", "holds no power"),
        ("1,1e-320\n2,0\n", "holds no power"),
    ],
)
def test_a_bad_table_is_named_with_its_line(text, complaint):
    with pytest.raises(UserError, match=complaint):
        tabulated(text, "psd.csv")


@pytest.mark.parametrize("spectrum", [TMT_WINDSHAKE, TMT_VIBRATION, KECK_LINE])
def test_bands_hold_the_whole_variance_and_none_holds_much(spectrum):
    bands = split(spectrum, 128)
    assert bands.variances.sum() == pytest.approx(variance(spectrum), rel=1e-9)
    assert bands.variances.max() < 2.2 * variance(spectrum) / 64
    assert np.all(np.diff(bands.edges_hz) > 0)


@pytest.mark.parametrize("spectrum", [TMT_WINDSHAKE, TMT_VIBRATION, KECK_LINE])
def test_short_cases_have_the_rms_of_the_spectrum_over_realizations(spectrum):
    # 100 ms of a spectrum whose power lies below 1 Hz: an offset in each case, the full rms over cases.
    bands, time = split(spectrum), 0.1 * np.arange(1, 17) / 16
    rng = np.random.default_rng(3)
    first = np.array([synthesize(bands, time, rng)[0, 0] for _ in range(3000)])
    ratio = np.mean(first**2) / variance(spectrum)
    low, high = stats.chi2.ppf([1e-5, 1 - 1e-5], 3000) / 3000
    assert low < ratio < high
    assert stats.kstest(first / np.sqrt(variance(spectrum)), "norm").pvalue > 1e-4


@pytest.mark.parametrize(
    ("spectrum", "rate_hz", "edges"),
    [
        (TMT_WINDSHAKE, 8.0, [0.05, 0.2, 0.4, 0.6, 0.7, 1.0, 2.0]),
        (TMT_VIBRATION, 128.0, [1.2, 1.6, 2.5, 4.0, 8.0, 16.0, 32.0]),
        (KECK_LINE, 256.0, [5.0, 20.0, 26.0, 29.0, 32.0, 36.0, 50.0, 90.0]),
    ],
)
def test_welch_finds_the_shape_of_the_spectrum(spectrum, rate_hz, edges):
    samples = 2048 * 8
    time = np.arange(samples) / rate_hz
    rng = np.random.default_rng(11)
    series = np.concatenate([synthesize(split(spectrum), time, rng, channels=3) for _ in range(6)], axis=1)
    frequency, psd = signal.welch(
        series, rate_hz, window="blackmanharris", nperseg=2048, axis=0, detrend=False
    )
    measured = psd.mean(axis=1)
    step = frequency[1]
    for low, high in pairwise(edges):
        inside = (frequency >= low) & (frequency < high)
        band = np.array([frequency[inside][0] - step / 2, frequency[inside][-1] + step / 2])
        expected = band_variance(spectrum, band)[0]
        assert measured[inside].sum() * step == pytest.approx(expected, rel=0.35)
    both = (frequency >= edges[0]) & (frequency < edges[-1])
    band = np.array([frequency[both][0] - step / 2, frequency[both][-1] + step / 2])
    assert measured[both].sum() * step == pytest.approx(band_variance(spectrum, band)[0], rel=0.12)


def test_numbers_do_not_depend_on_the_time_axis():
    bands = split(KECK_LINE)
    time = np.linspace(0, 3, 40)
    whole = synthesize(bands, time, np.random.default_rng(5), channels=2)
    part = synthesize(bands, time[7:9], np.random.default_rng(5), channels=2)
    np.testing.assert_allclose(whole[7:9], part, rtol=1e-12, atol=1e-12 * np.abs(whole).max())


def test_a_long_series_equals_its_pieces():
    bands = split(KECK_LINE)
    time = np.arange(20000) / 100
    whole = synthesize(bands, time, np.random.default_rng(5))
    last = synthesize(bands, time[-3:], np.random.default_rng(5))
    np.testing.assert_allclose(whole[-3:], last, rtol=0, atol=1e-10)


@pytest.mark.parametrize("count", [256, 1000, 1024])
def test_evenly_spaced_instants_are_those_in_any_order(count):
    bands, time = split(KECK_LINE), 3.0 + np.arange(count) * 0.007
    order = np.random.default_rng(1).permutation(count)
    evenly = synthesize(bands, time, np.random.default_rng(5), channels=2)
    one_by_one = synthesize(bands, time[order], np.random.default_rng(5), channels=2)
    np.testing.assert_allclose(evenly[order], one_by_one, rtol=0, atol=1e-12 * np.abs(evenly).max())


def test_frequencies_are_distributed_as_the_power():
    bands = banded(TMT_VIBRATION, np.array([1.0, 4.0, 50.0]))
    rng = np.random.default_rng(1)
    drawn = np.array([frequencies(bands, rng) for _ in range(4000)])
    assert np.all((drawn >= [1, 4]) & (drawn <= [4, 50]))
    below = [(1 - f**-3) / (1 - 4.0**-3) for f in np.sort(drawn[:, 0])]
    assert stats.kstest(below, "uniform").pvalue > 1e-4


def test_the_sum_of_spectra_has_the_sum_of_variances():
    both = total([KECK_LINE, resonance(60.0, 2.0, 3.0)])
    assert variance(both) == pytest.approx(
        variance(KECK_LINE) + variance(resonance(60.0, 2.0, 3.0)), rel=1e-9
    )
