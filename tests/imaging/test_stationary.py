"""Long exposures of wavefronts that move at random: closed forms, and means over drawn wavefronts."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from wavequake.imaging.exposures.stationary import Beams, mean_coherence, mean_image

AT = np.linspace(-0.5, 0.5, 21)
X, Y = (one.ravel() for one in np.meshgrid(AT, AT))
INSIDE = np.hypot(X, Y) <= 0.5
PLACES = np.stack([X[INSIDE], Y[INSIDE]], axis=1)
BEAMS = Beams(PLACES, np.full(len(PLACES), 1.0 / len(PLACES)))
ANGLES = 0.5 * (np.arange(8) - 4)


def instant(wavefront, wavelength):
    """Return the image of one wavefront, pixel by pixel."""
    field = BEAMS.weights * np.exp(2j * np.pi * wavefront / wavelength)
    return np.array(
        [[abs(np.sum(field * np.exp(-2j * np.pi * (PLACES @ [u, v])))) ** 2 for u in ANGLES] for v in ANGLES]
    )


def test_what_stands_still_is_the_image_of_the_pupil_and_piston_does_nothing():
    still = mean_image(BEAMS, mean_coherence(np.zeros((len(PLACES),) * 2), 550.0), ANGLES)
    assert_allclose(still, instant(np.zeros(len(PLACES)), 550.0), atol=1e-12)
    assert still.max() == pytest.approx(1.0)
    piston = mean_coherence(np.full((len(PLACES),) * 2, 300.0**2), 550.0)
    assert_allclose(mean_image(BEAMS, piston, ANGLES), still, atol=1e-12)


def test_points_that_move_alone_lose_what_marechal_says():
    rms, wavelength = 40.0, 550.0
    alone = mean_coherence(rms**2 * np.eye(len(PLACES)), wavelength)
    left = np.exp(-((2 * np.pi * rms / wavelength) ** 2))
    dots = np.sum(BEAMS.weights**2)
    assert mean_image(BEAMS, alone, ANGLES).max() == pytest.approx(left * (1 - dots) + dots, rel=1e-12)


def test_exposures_are_the_mean_of_drawn_ones():
    """Tilt along x, and a bit of defocus that goes with it; three standard errors."""
    wavelength, random = 550.0, np.random.default_rng(1)
    shapes = np.stack([400.0 * PLACES[:, 0], 200.0 * np.sum(PLACES**2, axis=1), 150.0 * PLACES[:, 1]])
    mixed = np.array([[1.0, 0.0, 0.0], [0.6, 0.8, 0.0], [0.0, 0.0, 1.0]])
    root = shapes.T @ mixed
    drawn = np.stack([instant(root @ random.standard_normal(3), wavelength) for _ in range(600)])
    exact = mean_image(BEAMS, mean_coherence(root @ root.T, wavelength), ANGLES)
    error = drawn.std(axis=0, ddof=1) / np.sqrt(len(drawn))
    assert np.abs(drawn.mean(axis=0) - exact).max() < 3.5 * error.max()
    assert np.mean(np.abs(drawn.mean(axis=0) - exact) < 3 * error) > 0.95
    assert exact.max() < 0.8
    # It is wider along x.
    across, along = exact[4, 4:], exact[4:, 4]
    assert across[1] / across[0] > 1.05 * along[1] / along[0]
