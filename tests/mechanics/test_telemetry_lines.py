"""Lines in telemetry come back as often within their intervals as these say, as narrow as theory allows."""

import time

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.optimize import minimize
from scipy.signal.windows import tukey
from scipy.stats import binom
from shaken import oscillator_series, records, signals

from wavequake.mechanics.disturbances.spectra import resonance
from wavequake.mechanics.telemetry.floor import floor_of
from wavequake.mechanics.telemetry.lines import find_lines
from wavequake.mechanics.telemetry.spectra import freedom, welch
from wavequake.mechanics.telemetry.whittle import Fit, Window, _loss, _modelled, _scores, oscillator

STEP = 1 / 200


def off(line, natural, damping, shape):
    """Return how many standard deviations a line is off: frequency, damping, rms of each signal."""
    shape = np.asarray(shape, dtype=float)
    sign = np.sign(line.rms @ shape)
    away = np.append(
        [np.log(line.frequency_hz / natural), np.log(line.damping / damping)], sign * line.rms - shape
    )
    return away / line.deviations


def holds(line, natural, damping, shape):
    """Return whether the intervals of a line hold frequency, damping, and rms of each signal."""
    shape = np.asarray(shape, dtype=float)
    truth = np.append([natural, damping], np.sign(line.rms @ shape) * shape)
    low, high = line.interval.T
    return (low <= truth) & (truth <= high)


def test_the_density_is_the_transform_of_the_autocorrelation():
    natural, damping, step = 31.0, 0.03, 0.01  # close to half the sampling frequency: much is folded back
    omega, lags = 2 * np.pi * natural, step * np.arange(4000)
    root = np.sqrt(1 - damping**2)
    correlation = np.exp(-damping * omega * lags) * (
        np.cos(omega * root * lags) + damping / root * np.sin(omega * root * lags)
    )
    frequency = np.array([3.0, 25.0, 31.0, 47.0])
    waves = np.cos(2 * np.pi * np.outer(frequency, lags))
    exact = 2 * step * (2 * waves @ correlation - 1.0)
    np.testing.assert_allclose(oscillator(frequency, natural, damping, step), exact, rtol=1e-9)
    whole = quad(
        lambda f: oscillator(np.array([f]), natural, damping, step)[0], 0, 50, points=[31.0], limit=400
    )
    assert whole[0] == pytest.approx(1.0, rel=1e-8)


def test_the_density_is_that_of_sources_where_samples_are_dense():
    frequency = np.array([5.0, 19.0, 20.0, 30.0])
    line = resonance(20.0, 0.4, 1.0)
    mine = oscillator(frequency, 20.0, 0.4 / 40.0, 1e-4)
    np.testing.assert_allclose(mine, line.density(frequency), rtol=2e-3)


def test_slopes_and_information_are_those_of_the_likelihood():
    """The slope by differences; the information as the variance of the slope over draws of the model."""
    random = np.random.default_rng(4)
    frequency = np.linspace(18.0, 22.0, 60)
    fit = Fit(
        np.log([[19.8, 0.01], [20.4, 0.006]]),
        np.array([[1.0, 0.4], [-0.5, 0.8]]),
        np.array([[0.1, -0.2], [0.05, 0.1]]),
    )
    window = Window(frequency, np.zeros((60, 2, 2)), np.ones(60), STEP, np.zeros((60, 2, 2)))
    total = np.linalg.cholesky(_modelled(window, fit).total)

    def drawn():
        values = random.standard_normal((60, 2, 2)) @ [1.0, 1j] / np.sqrt(2.0)
        values = np.einsum("bij,bj->bi", total, values)
        power = np.einsum("bi,bj->bij", values, values.conj()).real
        return Window(frequency, power, np.ones(60), STEP, window.known)

    one = drawn()
    slope, information = _scores(one, fit, _modelled(one, fit))
    point = np.concatenate([fit.logs.ravel(), fit.shapes.ravel(), fit.noise.ravel()])

    def loss(at):
        made = Fit(at[:4].reshape(2, 2), at[4:8].reshape(2, 2), at[8:].reshape(2, 2))
        return _loss(one, _modelled(one, made, slopes=False))

    for k in range(len(point)):
        step = 1e-6 * np.eye(len(point))[k]
        by_difference = (loss(point + step) - loss(point - step)) / 2e-6
        assert slope[k] == pytest.approx(by_difference, rel=1e-4, abs=1e-3)
    slopes = np.array(
        [_scores(each, fit, _modelled(each, fit))[0] for each in (drawn() for _ in range(4000))]
    )
    spread = np.cov(slopes.T) / np.sqrt(np.outer(np.diag(information), np.diag(information)))
    wanted = information / np.sqrt(np.outer(np.diag(information), np.diag(information)))
    np.testing.assert_allclose(spread, wanted, atol=0.1)


def seldom(count):
    """Return how many of so many intervals of 95 % hold the truth at least, but for once in 2000 times."""
    return binom.ppf(5e-4, count, 0.95)


def test_a_line_comes_back_as_often_as_its_intervals_say():
    """Of 100 records of 60 s (`make soak`) at least 87 hold, and not all: intervals are not too wide."""
    count, truth = records(30, 100), (20.0, 0.01, (3.0, 4.0))
    away, widths, held = [], [], []
    for seed in range(count):
        values = signals(np.random.default_rng(seed), 12000, STEP, [truth], 1.0)
        lines, _ = find_lines(values, STEP)
        assert len(lines) == 1, seed
        away.append(off(lines[0], *truth))
        held.append(holds(lines[0], *truth))
        widths.append(lines[0].deviations)
    away, held = np.array(away), np.sum(held, axis=0)
    assert (held >= seldom(count)).all(), held
    assert (held <= binom.ppf(0.994, count, 0.95)).all(), held
    # Cramér-Rao for a line far above the noise: var(ln f) = D / (w T), var(ln D) = 1 / (D w T).
    bound = np.sqrt(np.array([0.01, 1 / 0.01]) / (2 * np.pi * 20.0 * 60.0))
    ratio = np.mean(widths, axis=0)[:2] / bound
    assert (ratio > 1.0).all(), ratio
    assert (ratio < 1.2).all(), ratio
    np.testing.assert_allclose(away.std(axis=0), 1.0, atol=1.7 / np.sqrt(2 * count))


TWINS = [(20.0, 0.002, (3.0, 1.0)), (20.2, 0.002, (2.0, -2.0))]


def test_two_lines_one_percent_apart_come_back_as_often_as_their_intervals_say():
    """Of 400 records (`make soak`, eight minutes) each of the eight numbers reaches 372, which is 93 %.

    Damping is missed where the line that was drawn is off by itself: alone and without noise, where a
    separate fit finds its damping as far from what was asked for.
    """
    count = records(8, 400)
    held, found, alone = [], [], []
    for seed in range(count):
        lines, _ = find_lines(signals(np.random.default_rng(seed), 24000, STEP, TWINS, 2.0), STEP)
        assert len(lines) == 2, seed
        held.append([holds(line, *one) for line, one in zip(lines, TWINS, strict=True)])
        found.append([np.log(line.damping / 0.002) for line in lines])
        alone.append([np.log(damping / 0.002) for damping in damping_alone(seed)])
    away, alone, missed = np.subtract(found, alone), np.array(alone), ~np.array(held)[:, :, 1]
    assert (np.abs(alone[missed]) > 0.25).all(), alone[missed]  # which one of six lines is, by chance
    error = away.std(axis=0, ddof=1) / np.sqrt(count)
    assert (np.abs(away.mean(axis=0)) < 3.3 * error).all(), away.mean(axis=0)
    assert (error * np.sqrt(count) < 0.08).all(), error  # what noise and the other line add to 0.18
    first, held = np.sum(held[:200], axis=0), np.sum(held, axis=0)
    print(f"of the first {min(count, 200)}:", *first.ravel(), f"; of {count}:", *held.ravel())
    assert (held >= binom.ppf(0.001, count, 0.95)).all(), held
    assert 0.875 * 8 * count <= held.sum() <= 0.99 * 8 * count, held  # those of a record are not independent
    if count == 400:
        assert (held >= 372).all(), held
        assert (held <= 392).all(), held


def damping_alone(seed):
    """Return the damping ratios that the two lines of a record have, each without noise and the other."""
    random = np.random.default_rng(seed)
    random.standard_normal((24000, 2))  # the noise, which is drawn first
    for natural, damping, _ in TWINS:
        series = oscillator_series(random, 24000, STEP, natural, damping)
        yield damping_by_a_separate_fit(series, lambda f: 0.0, np.array([natural, damping, 1.0]), 0.05)


def test_a_line_of_six_coefficients_is_no_sinusoid_however_narrow_it_comes_out():
    """Of records of 30 s: a narrow estimate has a wide interval, not the tiny one of a sinusoid."""
    truth, count = (20.0, 0.005, (3.0, 4.0)), records(20, 60)
    held = []
    for seed in range(1000, 1000 + count):
        lines, _ = find_lines(signals(np.random.default_rng(seed), 6000, STEP, [truth], 1.0), STEP)
        assert len(lines) == 1, seed
        assert lines[0].resolved, seed
        held.append(holds(lines[0], *truth))
    assert (np.sum(held, axis=0) >= seldom(count)).all(), np.sum(held, axis=0)


def test_of_two_dozen_signals_lines_come_back_and_noise_has_none():
    """Records of 60 s at 200 Hz: lines 1 % apart, noise that neighbors share; and of noise alone."""
    random = np.random.default_rng(99)
    truth = [(9.0, 0.01, random.normal(size=24)), (24.0, 0.004, random.normal(size=24))]
    truth += [(24.24, 0.004, random.normal(size=24))]
    mixing = np.eye(24) + 0.3 * np.eye(24, k=1)
    held, spent, count = [], 0.0, records(2, 8)
    for seed in range(count):
        values = signals(np.random.default_rng(seed), 12000, STEP, truth, 1.0) @ mixing
        began = time.process_time()
        lines, _ = find_lines(values, STEP)
        spent += time.process_time() - began
        assert len(lines) == 3, seed
        held += [
            holds(line, hz, damping, shape @ mixing)
            for line, (hz, damping, shape) in zip(lines, truth, strict=True)
        ]
    held = np.array(held)
    assert spent < 10.0 * count
    assert held[:, :2].sum() >= seldom(6 * count), held[:, :2]
    assert held[:, 2:].mean() > 0.75, held[:, 2:].mean(axis=1)  # 24 of a line have its strength in common
    for seed in range(records(10, 60)):
        values = np.random.default_rng(seed).standard_normal((12000, 24)) @ mixing
        assert not find_lines(values, STEP)[0], seed


def damping_by_a_separate_fit(values, known, about, reach):
    """Return the damping ratio of one signal's line with the background `known`.

    Near `about` (frequency, damping ratio, variance), up to `reach` of the frequency to both sides.
    """
    count = len(values)
    window = tukey(count, 0.1)
    power = np.abs(np.fft.rfft(values * window)) ** 2 * 2 * STEP / (window @ window)
    frequency = np.arange(len(power)) / (count * STEP)
    near = np.abs(frequency - about[0]) < reach * about[0]

    def loss(at):
        natural, damping, square = np.exp(at)
        density = known(frequency[near]) + square * peak(frequency[near], natural, damping)
        return np.sum(np.log(density) + power[near] / density)

    start = np.log(about) + np.vstack([np.zeros(3), np.diag([0.1 * about[1], 0.2, 0.2])])
    return np.exp(minimize(loss, start[0], method="Nelder-Mead", options={"initial_simplex": start}).x[1])


def peak(frequency, natural, damping):
    """Return the PSD of an oscillator of unit variance under white noise (closed form)."""
    ratio = frequency / natural
    return 4 * damping / (np.pi * natural) / ((1 - ratio**2) ** 2 + (2 * damping * ratio) ** 2)


def test_a_background_that_flanks_drown_takes_nothing_of_the_damping():
    """Nowhere near 12 Hz is the background seen along that line; it is across. 31 Hz lies apart."""
    truth = [(12.0, 0.01, (3.0, 4.0)), (31.0, 0.004, (2.0, -1.0))]
    along, noise = np.array([0.6, 0.8]), 0.5
    away, found, separate, count = [], [], [], records(8, 60)
    for seed in range(count):
        values = signals(np.random.default_rng(seed), 24000, STEP, truth, noise)
        lines, _ = find_lines(values, STEP)
        assert len(lines) == 2, seed
        away.append([off(line, *one)[1] for line, one in zip(lines, truth, strict=True)])
        found.append([line.damping for line in lines])
        separate.append(
            damping_by_a_separate_fit(
                values @ along,
                lambda f: 0.4**2 * peak(f, 31.0, 0.004) + 2 * noise**2 * STEP,
                np.array([12.0, 0.01, 25.0]),
                1 / 3,
            )
        )
    found, away = np.array(found), np.array(away)
    error = found.std(axis=0, ddof=1) / np.sqrt(len(found))
    assert (np.abs(found.mean(axis=0) - [0.01, 0.004]) < 3 * error).all(), found.mean(axis=0)
    assert np.sum(np.abs(away) <= 1.96) >= seldom(2 * count), away
    parts = np.log(found[:, 0] / separate)
    assert abs(parts.mean()) < 0.03, parts.mean()  # a quarter of what one record scatters


def test_a_sinusoid_comes_back_by_the_bound_of_cramer_and_rao():
    count, rms, noise = 8000, np.array([0.5, 0.3]), 1.0
    time_s, away, seeds = STEP * np.arange(count), [], records(40, 100)
    for seed in range(seeds):
        random = np.random.default_rng(seed)
        swing = np.sqrt(2.0) * np.sin(2 * np.pi * 33.3333 * time_s + random.uniform(0, 6.28))
        lines, _ = find_lines(np.outer(swing, rms) + noise * random.standard_normal((count, 2)), STEP)
        assert len(lines) == 1, seed
        assert not lines[0].resolved
        assert lines[0].fwhm_hz == 0.0
        error = lines[0].deviations
        away.append(
            [(lines[0].frequency_hz - 33.3333) / (33.3333 * error[0]), *((lines[0].rms - rms) / error[2:])]
        )
        # Of a real sinusoid of amplitude A in white noise (Kay 1993): var(w) = 24 s^2 / (A^2 n^3).
        bound = np.sqrt(24 * noise**2 / (2 * (rms @ rms) * count**3)) / STEP / (2 * np.pi)
    held = np.sum(np.abs(away) <= 1.96, axis=0)
    assert (held >= seldom(seeds)).all(), held
    assert (held <= binom.ppf(0.994, seeds, 0.95)).all(), held
    assert 33.3333 * error[0] == pytest.approx(bound, rel=0.15)


def test_noise_has_no_lines_and_its_level_comes_back():
    mixing = np.array([[1.0, 0.0], [0.6, 0.8]])
    for seed in range(records(10, 20)):
        values = np.random.default_rng(seed).standard_normal((20000, 2)) @ mixing.T
        lines, rest = find_lines(values, STEP)
        assert not lines, seed
        floor = floor_of(rest, lines)
        power = np.einsum(
            "kc,kd,k->cd", floor.directions, floor.directions, floor.densities @ np.diff(floor.edges_hz)
        )
        np.testing.assert_allclose(power, mixing @ mixing.T, atol=0.06)


def test_noise_that_a_line_drowns_is_the_same_in_any_unit_of_time():
    """A line of 3 mas and none of its noise, over 0.3 mas of noise; samples 10 ms and 10 s apart."""
    random = np.random.default_rng(1)
    line = oscillator_series(random, 6000, 0.01, 12.0, 0.03)
    values = np.stack([3.0 * line, 1.5 * line + 0.3 * random.standard_normal(6000)], axis=1)
    for step in (0.01, 10.0):
        lines, rest = find_lines(values, step)
        floor = floor_of(rest, lines)
        power = floor.directions.T**2 @ (floor.densities @ np.diff(floor.edges_hz))
        assert power == pytest.approx([0.0, 0.09], abs=0.03)


def test_averaged_spectra_hold_white_noise_as_often_as_they_say():
    found = welch(np.random.default_rng(0).standard_normal((200_000, 10)), STEP, 1024)
    low, high = found.interval()
    held = np.mean((low <= 2 * STEP) & (high >= 2 * STEP))
    assert 0.942 < held < 0.958
    spread = found.density.std() / found.density.mean()
    assert spread == pytest.approx(np.sqrt(2 / found.freedom), rel=0.1)
    assert freedom(np.ones(8), 8, 5) == pytest.approx(10.0)  # apart: two for each piece


def test_ten_minutes_at_a_kilohertz_take_seconds():
    truth = [
        (8.0, 0.01, (5, 2)),
        (24.2, 0.003, (0, 3)),
        (45.2, 0.01, (2, 2)),
        (72.5, 0.05, (6, 1)),
        (300.0, 0.001, (1, 1)),
    ]
    values = signals(np.random.default_rng(1), 600_000, 1e-3, truth, 3.0)
    began = time.process_time()
    lines, rest = find_lines(values, 1e-3)
    floor_of(rest, lines)
    assert time.process_time() - began < 10.0
    np.testing.assert_allclose([line.frequency_hz for line in lines], [8, 24.2, 45.2, 72.5, 300], rtol=5e-3)


def test_a_sine_without_noise_is_one_line_and_its_rounding_none():
    time_s = np.arange(4000) / 500.0
    found, _ = find_lines(np.sin(2.0 * np.pi * 48.0 * time_s)[:, None], 0.002)
    assert len(found) == 1
    assert found[0].frequency_hz == pytest.approx(48.0, rel=1e-9)
    assert found[0].rms == pytest.approx(np.sqrt(0.5), rel=1e-6)
