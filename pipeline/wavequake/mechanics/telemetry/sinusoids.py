"""Sinusoids in records: peaks as narrow as the record allows, found and taken out."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from wavequake.mechanics.telemetry.line import RESOLVED, Line
from wavequake.mechanics.telemetry.spectra import Fourier, background, fourier

Array = NDArray[np.float64]

_DOUBT = 7.0  # logarithm of one over the probability of a false peak, all places together
_PASSES = 4
_SHARP = 6.0  # times the power beside a peak
_NEWTON = 5


def take_sinusoids(values: Array, step: float) -> tuple[list[Line], Array, Fourier, Array]:
    """Return the sinusoids of a record (n, c), and without them the record, its coefficients and floor."""
    found: list[Line] = []
    spectrum = fourier(values, step)
    floor = background(spectrum)
    for _ in range(_PASSES):
        ratio = np.sum(np.abs(spectrum.values) ** 2 / floor, axis=1)
        sharp = list(_sharp(ratio, values.shape[1]))
        for place in sharp:
            line, series = sinusoid(values, step, float(spectrum.frequency[place]), floor[place])
            values = values - series
            found.append(line)
        if not sharp:
            break
        spectrum = fourier(values, step)
        floor = background(spectrum)
    return found, values, spectrum, floor


def _sharp(ratio: Array, channels: int) -> Iterator[int]:
    """Yield where a peak is as narrow as the record allows, the highest first."""
    least = 2.0 * (np.log(len(ratio)) + _DOUBT)
    peaks = np.flatnonzero(ratio > least)
    taken = np.zeros(len(ratio), dtype=bool)
    for place in peaks[np.argsort(-ratio[peaks])].tolist():
        first, last = max(0, place - 8), place + 9
        if taken[place] or place < 8 or last > len(ratio):
            continue
        taken[first:last] = True
        near = ratio[place - 2 : place + 3].sum()
        beside = ratio[first:last].sum() - near - 12.0 * channels
        if near - 5.0 * channels > _SHARP * max(beside, 3.0 * np.sqrt(12.0 * channels)):
            yield place


def sinusoid(values: Array, step: float, about: float, floor: Array) -> tuple[Line, Array]:
    """Return the sinusoid of least squares near a frequency, and what it does to the signals (n, c).

    Its error is the bound of Cramér and Rao beside noise of the density `floor` (c,). The signals swing with
    one phase; what does not is left in the record.
    """
    count = len(values)
    time = step * (np.arange(count) - 0.5 * (count - 1))
    frequency = about
    for _ in range(_NEWTON):
        wave = np.exp(2j * np.pi * frequency * time)
        amplitude = wave.conj() @ values * (2.0 / count)
        rest = values - (wave[:, None] * amplitude).real
        # d/df of Re(A exp(2 pi i f t)), projected on what is left, all signals by their noise.
        turned = (2j * np.pi * time * wave).conj() @ rest
        gain = float(np.sum((amplitude.conj() * turned).real / floor))
        size = 0.5 * (2.0 * np.pi) ** 2 * float(time @ time) * float(np.sum(np.abs(amplitude) ** 2 / floor))
        move = gain / size
        frequency += float(np.clip(move, -0.5 / (count * step), 0.5 / (count * step)))
    wave = np.exp(2j * np.pi * frequency * time)
    amplitude = wave.conj() @ values * (2.0 / count)
    phase = 0.5 * np.angle(np.sum(amplitude**2 / floor))
    swing = (amplitude * np.exp(-1j * phase)).real
    duration = count * step
    rms = swing / np.sqrt(2.0)
    rms = rms if rms[np.argmax(np.abs(rms) / np.sqrt(floor))] >= 0.0 else -rms
    covariance = np.zeros((2 + len(rms), 2 + len(rms)))
    covariance[0, 0] = 1.5 / (np.pi**2 * duration**3 * float(np.sum(rms**2 / floor)) * frequency**2)
    covariance[2:, 2:] = np.diag(0.5 * floor / duration)
    line = Line(frequency, RESOLVED / (2.0 * frequency * duration), rms, covariance, False)
    return line, (wave[:, None] * amplitude).real
