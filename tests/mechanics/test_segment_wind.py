import numpy as np
import pytest
from pydantic import ValidationError
from scipy import integrate, signal, stats

from wavequake.mechanics.disturbances.registry import analytic_rms, draw_case, draw_cases, generator
from wavequake.mechanics.disturbances.sources.segment_wind import (
    SegmentWind,
    compliance,
    gusts_of,
    segment_wind_rms_nm,
)
from wavequake.mechanics.disturbances.spectra import frequencies
from wavequake.mechanics.disturbances.streams import own_streams
from wavequake.mechanics.disturbances.supports import Supports

WIND = SegmentWind(name="wind")


def drawn(parameters, layout, time, random):
    return parameters.draw(layout, time, lambda _: random)


def force_to_piston(p, f, area):
    """PSD of piston of a segment in m^2/Hz, written out in full, independently of the package."""
    turn = p.length_scale_m / p.mean_speed_m_s
    gust = (
        4 * (p.turbulence_intensity * p.mean_speed_m_s) ** 2 * turn / (1 + 70.7 * (f * turn) ** 2) ** (5 / 6)
    )
    force = p.air_density_kg_m3 * p.drag_coefficient * area * p.mean_speed_m_s
    averaged = (1 + (2 * f * np.sqrt(area) / p.mean_speed_m_s) ** (4 / 3)) ** -2 if p.area_filter else 1.0
    squares = [1 / mode**2 for mode in p.modes_hz]
    response = sum(
        square / sum(squares) / (1 - (f / mode) ** 2 + 2j * damping * f / mode)
        for square, mode, damping in zip(squares, p.modes_hz, p.damping_ratios, strict=True)
    )
    return gust * averaged * force**2 * abs(response / (p.stiffness_n_um * 1e6)) ** 2


def integral(p, function):
    ends = 1e-3 * p.mean_speed_m_s / p.length_scale_m, 360.0
    return integrate.quad(
        lambda x: function(np.exp(x)) * np.exp(x), *np.log(ends), epsabs=0, epsrel=1e-8, limit=2000
    )[0]


def test_static_compliance_is_one_over_the_stiffness_and_modes_resonate():
    assert compliance(WIND, np.array([0.0]))[0] == pytest.approx(1e-7, rel=1e-12, abs=0)
    assert compliance(WIND, np.array([1.0]))[0].real == pytest.approx(1e-7, rel=0.01, abs=0)
    f = np.geomspace(1, 1000, 20001)
    gain = np.abs(compliance(WIND, f))
    peaks = f[signal.find_peaks(gain)[0]]
    for mode in (40.0, 90.0, 120.0):
        assert np.abs(peaks / mode - 1).min() < 0.01
    # Far above all modes the segment is a free mass: slope -2.
    assert np.log10(gain[-1] / np.interp(500, f, gain)) / np.log10(2) == pytest.approx(-2, abs=0.05)


def test_analytic_rms_is_the_integral_of_the_piston_spectrum(few):
    area = few.areas_m2[0]
    expected = np.sqrt(integral(WIND, lambda f: force_to_piston(WIND, f, area))) * 1e9
    rms = segment_wind_rms_nm(WIND, few)
    assert rms == pytest.approx(expected, rel=1e-5)
    assert analytic_rms(WIND, few) == (pytest.approx(expected, rel=1e-5), "nm")


def test_rms_grows_as_speed_squared_at_quasi_static_frequencies(few):
    # Slow, large eddies, no area filter: rms = rho C A U (I U) / k.
    still_air = {"length_scale_m": 1000.0, "area_filter": False}
    for speed in (1.0, 3.0):
        wind = SegmentWind(name="wind", mean_speed_m_s=speed, **still_air)
        expected = 0.79 * 1.0 * few.areas_m2 * speed * (0.5 * speed) / 10e6 * 1e9
        assert segment_wind_rms_nm(wind, few) == pytest.approx(expected, rel=5e-3)


def test_sampled_rms_and_correlation_are_those_of_the_spectrum_and_the_coherence(few):
    cases = 4000
    at = np.array([17.3])
    pistons = np.array(
        [drawn(WIND, few, at, generator(1, "wind", case)).segment_motion[0, :, 2] for case in range(cases)]
    )
    ratio = np.mean(pistons**2, axis=0) * 1e18 / segment_wind_rms_nm(WIND, few) ** 2
    low, high = stats.chi2.ppf([1e-5, 1 - 1e-5], cases) / cases
    assert np.all((low < ratio) & (ratio < high))
    sampled = np.corrcoef(pistons.T)
    expected = expected_correlation(few, WIND)
    assert np.abs(np.arctanh(sampled[UPPER]) - np.arctanh(expected[UPPER])).max() < 4.5 / np.sqrt(cases - 3)


UPPER = np.triu_indices(5, 1)


def expected_correlation(layout, p):
    """Zero-lag correlation of pistons by quadrature of cross-spectra."""
    area = layout.areas_m2.mean()
    separation = np.linalg.norm(layout.centers_m[:, None] - layout.centers_m, axis=2)
    power = integral(p, lambda f: force_to_piston(p, f, area))
    expected = np.eye(len(layout))
    for i, j in zip(*UPPER, strict=True):
        decay = p.coherence_decay * separation[i, j] / p.mean_speed_m_s
        cross = integral(p, lambda f, decay=decay: force_to_piston(p, f, area) * np.exp(-decay * f))
        expected[i, j] = expected[j, i] = cross / power
    return expected


@pytest.mark.parametrize("speed", [0.5, 1.0, 5.0])
def test_the_model_covariance_is_the_integral_of_the_cross_spectra(few, speed):
    p = SegmentWind(name="wind", mean_speed_m_s=speed)
    gusts = gusts_of(p, few)
    covariance = np.einsum("bik,bjk->ij", gusts.factors, gusts.factors)
    covariance[np.diag_indices(5)] += gusts.apart.variances.sum()
    power = covariance[0, 0]
    np.testing.assert_allclose(np.diag(covariance), power, rtol=1e-10)
    np.testing.assert_allclose(covariance / power, expected_correlation(few, p), rtol=0, atol=3e-4)


def test_coherence_of_two_segments_is_the_exponential_one(few):
    rate, samples = 2.0, 256
    at = np.arange(samples) / rate
    series = np.array(
        [drawn(WIND, few, at, generator(2, "wind", case)).segment_motion[:, :2, 2] for case in range(200)]
    )
    spectra = np.fft.rfft(series * signal.windows.hann(samples)[:, None], axis=1)
    f = np.fft.rfftfreq(samples, 1 / rate)
    for low, high in ((0.02, 0.04), (0.06, 0.1), (0.15, 0.25)):
        inside = spectra[:, (f >= low) & (f < high)]
        cross = np.mean(inside[..., 0] * np.conj(inside[..., 1]))
        measured = abs(cross) / np.sqrt(
            np.mean(np.abs(inside[..., 0]) ** 2) * np.mean(np.abs(inside[..., 1]) ** 2)
        )
        bins = f[(f >= low) & (f < high)]
        weight = np.mean(np.abs(inside) ** 2, axis=(0, 2))
        expected = np.sum(weight * np.exp(-10 * bins * 1.2402)) / weight.sum()
        assert measured == pytest.approx(expected, abs=0.08)


def test_welch_finds_the_resonances(few):
    p = SegmentWind(name="wind", modes_hz=(20.0,), damping_ratios=(0.1,), area_filter=False)
    rate = 100.0
    at = np.arange(4096) / rate
    series = np.concatenate(
        [drawn(p, few, at, generator(3, "wind", case)).segment_motion[..., 2] for case in range(8)],
        axis=1,
    )
    f, psd = signal.welch(series, rate, nperseg=512, axis=0)
    measured = psd.mean(axis=1)
    for low, high in ((3.0, 8.0), (15.0, 25.0), (30.0, 45.0)):
        inside = (f >= low) & (f < high)
        expected = np.mean([force_to_piston(p, x, few.areas_m2[0]) for x in f[inside]])
        assert measured[inside].mean() == pytest.approx(expected, rel=0.35, abs=0)


def test_numbers_do_not_depend_on_the_instants(few):
    long, short = WIND.model_copy(update={"instants": 64}), WIND.model_copy(update={"instants": 16})
    fine, coarse = (draw_case([WIND], entry, few, 1, 3).segment_motion for entry in (long, short))
    np.testing.assert_allclose(fine[3::4], coarse, rtol=1e-12, atol=1e-20)


def test_a_case_is_the_sum_of_the_harmonics_that_its_numbers_make(few):
    gusts, random, time = gusts_of(WIND, few), generator(1, "wind", 21), np.array([0.0, 3.7, 41.0])
    together = random.standard_normal((len(gusts.factors), len(few), 2))
    apart = random.standard_normal((2, len(gusts.apart.variances), len(few)))
    slow, fast = frequencies(gusts.together, random), frequencies(gusts.apart, random)
    piston = np.zeros((3, len(few)))
    for factor, normals, frequency in zip(gusts.factors, together, slow, strict=True):
        turn = 2 * np.pi * frequency * time[:, None]
        piston += np.cos(turn) * (factor @ normals[:, 0]) + np.sin(turn) * (factor @ normals[:, 1])
    for variance, cosine, sine, frequency in zip(gusts.apart.variances, *apart, fast, strict=True):
        turn = 2 * np.pi * frequency * time[:, None]
        piston += np.sqrt(variance) * (np.cos(turn) * cosine + np.sin(turn) * sine)
    motion = draw_case([WIND], WIND, few, 1, 21, time=time).segment_motion
    np.testing.assert_allclose(motion[..., 2], piston * few.areas_m2, rtol=0, atol=1e-12 * motion.std())


@pytest.mark.parametrize("supports", [None, Supports(0.1, 0.2, True, (7, "~structure", 1))])
def test_each_case_alone_has_the_bits_that_it_has_beside_others(few, supports):
    import dataclasses

    layout, time = dataclasses.replace(few, supports=supports), np.linspace(0.0, 40.0, 7)
    realizations = [16, 17, 23, 31]
    several = draw_cases([WIND], WIND, [layout] * 4, 1, realizations, [own_streams] * 4, time)
    for realization, motion in zip(realizations, several, strict=True):
        alone = draw_case([WIND], WIND, layout, 1, realization, time=time)
        assert alone.segment_motion.any()
        np.testing.assert_array_equal(motion.segment_motion, alone.segment_motion)


def test_only_the_normal_moves_and_larger_segments_move_more(tmt):
    motion = draw_case([WIND], WIND, tmt, 1, 0)
    assert not motion.segment_motion[..., [0, 1, 3, 4, 5]].any()
    rms = segment_wind_rms_nm(WIND, tmt)
    np.testing.assert_allclose(rms / rms[0], tmt.areas_m2 / tmt.areas_m2[0], rtol=1e-12)


def test_492_segments_fit_into_memory(tmt):
    gusts_of.cache_clear()
    gusts = gusts_of(WIND, tmt)
    assert gusts.factors.nbytes < 50e6


def test_a_mirror_of_one_piece_moves_too(few):
    import dataclasses

    one = dataclasses.replace(
        few,
        names=("M1",),
        centers_m=few.centers_m[:1],
        axes=few.axes[:1],
        corners_m=few.corners_m[:1],
        areas_m2=few.areas_m2[:1],
    )
    motion = draw_case([WIND], WIND, one, 1, 0)
    assert np.isfinite(motion.segment_motion).all()
    assert motion.segment_motion[..., 2].any()


@pytest.mark.parametrize(
    ("change", "tolerance"),
    [
        # All segments alike, or hardly any change in a case, leave few independent samples: loose bounds.
        ({"coherence_decay": 1e-9}, 0.4),
        ({"length_scale_m": 1e5}, 0.8),
        ({"coherence_decay": 1e9}, 0.05),
        ({"mean_speed_m_s": 1e-3}, 0.05),
        ({"mean_speed_m_s": 100.0}, 0.05),
        ({"length_scale_m": 1e-3}, 0.05),
        ({"turbulence_intensity": 1e-6}, 0.05),
    ],
)
def test_extreme_air_gives_finite_motion_of_the_right_rms(tmt, change, tolerance):
    p = SegmentWind(name="wind", **change)
    motions = [draw_case([p], p, tmt, 1, case).segment_motion[..., 2] for case in range(4)]
    sampled = np.sqrt(np.mean(np.square(motions))) * 1e9
    assert sampled == pytest.approx(segment_wind_rms_nm(p, tmt).mean(), rel=tolerance)


def test_modes_without_damping_are_refused():
    with pytest.raises(ValidationError, match="2 modes_hz need as many damping_ratios, not 4"):
        SegmentWind(name="wind", modes_hz=(20.0, 40.0))
    with pytest.raises(ValidationError, match="greater than 0"):
        SegmentWind(name="wind", modes_hz=(0.0, 1.0, 2.0, 3.0))
