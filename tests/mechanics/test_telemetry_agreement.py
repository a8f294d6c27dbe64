"""Equal spectra are called unequal as seldom as stated; what differs is found."""

import numpy as np
from scipy.stats import binom
from shaken import records, signals

from wavequake.mechanics.telemetry.agreement import agreement, independent_pieces, overlapping_pieces

STEP, LENGTH, CASES = 1 / 128, 1024, 60
LINE = (20.0, 0.004, (3.0, 2.0))


def sides(seed, line=LINE, level=1.0):
    """Return cases of a model and a record of something else, of 8 s pieces."""
    random = np.random.default_rng(seed)
    cases = np.stack([signals(random, LENGTH, STEP, [LINE]) for _ in range(CASES)])
    record = level * signals(random, 60 * LENGTH, STEP, [line])
    return independent_pieces(cases, STEP), overlapping_pieces(record, STEP, LENGTH)


def test_equal_spectra_are_called_unequal_at_the_stated_rate():
    count = records(25, 100)
    bands = [agreement(*sides(seed)) for seed in range(count)]
    alarms = sum(any(not band.agrees for band in found) for found in bands)
    assert binom.ppf(0.005, count, 0.05) <= alarms <= binom.ppf(0.995, count, 0.05), alarms
    held = np.array([[band.low <= 1.0 <= band.high for band in found] for found in bands])
    for scale in ("line", "octave", "whole"):
        mine = held[:, [band.scale == scale for band in bands[0]]]
        assert 0.93 < mine.mean() < 0.97, (scale, mine.mean())


def test_a_line_that_moved_by_two_percent_is_found_where_it_moved():
    for seed in range(8):
        wrong = [band for band in agreement(*sides(seed, (20.4, 0.004, (3.0, 2.0)))) if not band.agrees]
        lines = [band for band in wrong if band.scale == "line"]
        assert lines, seed
        most, least = (pick(lines, key=lambda band: band.ratio) for pick in (max, min))
        assert most.low_hz - 0.3 < 20.4 < most.high_hz + 0.3, seed
        assert least.high_hz < 20.3, seed


def test_a_level_that_rose_by_thirty_percent_is_found():
    for seed in range(8):
        found = agreement(*sides(seed, level=np.sqrt(1.3)))
        wrong = [band for band in found if not band.agrees]
        assert wrong, seed
        whole = [band for band in found if band.scale == "octave" and band.low_hz > 30.0]
        assert all(band.low < 1.3 < band.high or abs(band.ratio - 1.3) < 0.15 for band in whole)


def test_one_in_every_fourth_sample_folds_as_the_model_does():
    random = np.random.default_rng(3)
    record = signals(random, 120 * LENGTH, STEP / 4, [(150.0, 0.01, (1.0, 2.0))])
    cases = np.stack(
        [signals(random, 4 * 256, STEP / 4, [(150.0, 0.01, (1.0, 2.0))])[::4] for _ in range(80)]
    )
    found = agreement(independent_pieces(cases, STEP), overlapping_pieces(record, STEP / 4, 256, 4))
    assert all(band.agrees for band in found)
    assert found[-1].data_rms > 2.0  # beyond half the sampling frequency, and seen all the same
