"""How sharp an image is along x and along y: widths, two-point distances, contrast by frequency.

Lengths are in wavelengths / diameter. Lines run through the brightest point of the image, which is found
between the pixels: an irradiance is band-limited, so that its Fourier series says what stands there.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from wavequake.imaging.exposures.mtf import modulation_transfer

Real = NDArray[np.float64]

# Points by pixel of a line at which crossings are looked for; between them lines are straight.
_FINE = 64
# Irradiance between two stars over that at the stars at Rayleigh's distance (Störkle 2018, Eq. 3.76).
RAYLEIGH_DIP = 0.735
# Farthest from a border outside of which an image is that its rings are brightest inside; their distance.
_RING = 1.22


def sharpness(image: Real, sampling: float) -> dict[str, Real]:
    """Return how sharp an image is, along x and along y.

    Parameters
    ----------
    image : ndarray, shape (n, n)
        Irradiance of a star; the last axis is x.
    sampling : float
        Distance of the pixels, at most 0.5 wavelengths / diameter.

    Returns
    -------
    dict of str to ndarray, shape (2,)
        ``fwhm``: full width at half maximum; ``two_point``: distance of two equal stars whose saddle is
        0.735 (Rayleigh, 1.22 for a perfect round pupil); ``sparrow``: distance at which there is no saddle
        any more (0.947); ``mtf50``: cycles per wavelength / diameter at which half of the contrast is left
        (0.404). NaN where the frame is too small for it, the image has no light, or it is brightest within
        1.22 of the border (a quarter of the frame at most): it may be the ring of an image outside.
    """
    names = ("fwhm", "two_point", "sparrow", "mtf50")
    if not (np.isfinite(image).all() and image.sum() > 0.0 and _is_inside(image, sampling)):
        return {name: np.full(2, np.nan) for name in names}
    lines = _lines(image)
    frequency, transfer = modulation_transfer(image, sampling)
    middle = len(image) // 2
    contrasts = transfer[middle, middle:], transfer[middle:, middle]
    step = sampling / _FINE
    found = [
        (
            _width(line) * step,
            _first_below(_saddle(line), RAYLEIGH_DIP) * 2.0 * step,
            _first_below(-_curvature(line), 0.0) * 2.0 * step,
            _first_below(contrast, 0.5) * (frequency[1] - frequency[0]),
        )
        for line, contrast in zip(lines, contrasts, strict=True)
    ]
    return dict(zip(names, np.array(found).T, strict=True))


def _is_inside(image: Real, sampling: float) -> bool:
    """Return whether an image is brightest so far inside that this is no ring of one outside."""
    margin = min(int(np.ceil(_RING / sampling)), len(image) // 4)
    inside = image[margin:-margin, margin:-margin] if margin else image
    return bool(inside.max(initial=0.0) == image.max())


def _lines(image: Real) -> tuple[Real, Real]:
    """Return the image along x and along y through its brightest point, that point first.

    Lines go round: behind the last point of a line come those before the first one.
    """
    row, column = np.unravel_index(int(image.argmax()), image.shape)
    y, x = float(row), float(column)
    for _ in range(3):  # each time along the other axis, at a place between the pixels
        x = _summit(_series(image, y, axis=0), x)
        y = _summit(_series(image, x, axis=1), y)
    return (
        _fine(_series(image, y, axis=0), x),
        _fine(_series(image, x, axis=1), y),
    )


def _series(image: Real, place: float, axis: int) -> Real:
    """Return the line (n,) of an image at a place between the rows (axis 0) or columns (axis 1)."""
    count = image.shape[axis]
    weights = _kernel(place - np.arange(count, dtype=np.float64), count)
    return np.asarray(np.tensordot(weights, image, axes=(0, axis)))


def _kernel(distance: Real, count: int) -> Real:
    """Return what a sample of a band-limited series of `count` adds at a distance in samples."""
    k = np.fft.fftfreq(count) * count
    return np.asarray(np.cos(2.0 * np.pi * np.multiply.outer(distance, k) / count).sum(axis=-1) / count)


def _summit(line: Real, near: float) -> float:
    """Return the place of the maximum of a band-limited line within a sample of `near`."""
    values = _fine(line, near - 1.0)[: 2 * _FINE + 1]
    best = int(np.clip(values.argmax(), 1, len(values) - 2))
    before, top, after = values[best - 1 : best + 2]
    bend = before - 2.0 * top + after
    return near - 1.0 + (best + (0.5 * (before - after) / bend if bend < 0.0 else 0.0)) / _FINE


def _fine(line: Real, first: float) -> Real:
    """Return a band-limited line at `_FINE` points by sample, one period from `first` on."""
    spectrum = np.fft.rfft(line) * np.exp(2j * np.pi * np.fft.rfftfreq(len(line)) * first)
    return np.asarray(np.fft.irfft(spectrum, len(line) * _FINE) * _FINE)


def _width(line: Real) -> float:
    """Return the steps between the nearest places to both sides where half of the maximum is left."""
    half = 0.5 * line[0]
    return _first_below(line[: len(line) // 2], half) + _first_below(
        np.roll(line[::-1], 1)[: len(line) // 2], half
    )


def _about(line: Real, combine: Callable[[Real, Real, Real], Real]) -> Real:
    """Combine a line's values at 0, at +-s and at +-2 s, where s is half of a distance of two stars."""
    s = np.arange(len(line) // 4)
    return combine(np.full(len(s), line[0]), line[s] + line[-s], line[2 * s] + line[-2 * s])


def _saddle(line: Real) -> Real:
    """Return the irradiance midway between two stars over that at them, by half their distance."""
    return _about(line, lambda top, middle, far: 2.0 * middle / (2.0 * top + far))


def _curvature(line: Real) -> Real:
    """Return the curvature midway between two stars, by half their distance: below 0 without a saddle."""
    second = np.fft.irfft(-(np.fft.rfftfreq(len(line)) ** 2) * np.fft.rfft(line), len(line))
    return _about(second, lambda top, middle, far: middle)


def _first_below(values: Real, level: float) -> float:
    """Return the place at which values fall to a level, straight between two; NaN if they do not."""
    below = np.flatnonzero(values <= level)
    if not below.size or not below[0]:
        return float("nan")
    last = int(below[0])
    high, low = values[last - 1], values[last]
    return float(last - 1 + (high - level) / (high - low))
