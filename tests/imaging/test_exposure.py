import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import j0, j1

from wavequake.errors import UserError
from wavequake.imaging.engines.polygon_transform import polygon_areas, polygon_transform
from wavequake.imaging.engines.segment_basis import segment_basis
from wavequake.imaging.engines.segment_psf import psf
from wavequake.imaging.exposures.exposure import (
    centroid,
    encircled_energy,
    encircled_energy_radius,
    exposure,
    radial_profile,
)

DISC = np.pi / 4  # area / diameter² of a circular pupil
EE50, EE80 = 0.534832148, 0.896942103  # of the Airy pattern: roots of airy_energy


def airy(pixels, sampling, x=0.0, y=0.0):
    axis = (np.arange(pixels) - pixels // 2) * sampling
    v = np.maximum(np.pi * np.hypot(axis - x, (axis - y)[:, None]), 1e-9)
    return (2 * j1(v) / v) ** 2


def airy_energy(radii):
    return 1 - j0(np.pi * np.asarray(radii)) ** 2 - j1(np.pi * np.asarray(radii)) ** 2


@pytest.mark.parametrize(
    ("sampling", "pixels", "error"), [(0.1, 160, 1e-7), (0.25, 64, 1e-7), (0.4, 40, 5e-6), (0.5, 32, 3e-3)]
)
def test_encircled_energy_of_an_airy_pattern(sampling, pixels, error):
    radii = np.array([0.0, 0.05, 0.3, 0.5, 1.0, 1.22, 2.0, 3.0, 5.0])
    found = encircled_energy(airy(pixels, sampling), sampling, DISC, 1.0, radii, "origin")
    np.testing.assert_allclose(found, airy_energy(radii), rtol=0, atol=error)


def test_the_radii_are_the_roots():
    np.testing.assert_allclose(airy_energy([EE50, EE80]), [0.5, 0.8], rtol=0, atol=1e-9)


@settings(max_examples=20, deadline=None)
@given(st.floats(-1.5, 1.5), st.floats(-1.5, 1.5))
def test_radii_do_not_depend_on_the_place_of_the_image(x, y):
    image = airy(64, 0.25, x, y)
    assert encircled_energy_radius(image, 0.5, 0.25, DISC, 1.0) == pytest.approx(EE50, abs=2e-4)
    assert encircled_energy_radius(image, 0.8, 0.25, DISC, 1.0, (x, y)) == pytest.approx(EE80, abs=3e-4)
    np.testing.assert_allclose(centroid(image, 0.25), [x, y], rtol=0, atol=1e-3)


def test_the_center_is_a_choice():
    image = airy(64, 0.25, 1.0, 0.0)
    about_origin = encircled_energy(image, 0.25, DISC, 1.0, [0.5], "origin")
    np.testing.assert_allclose(about_origin, encircled_energy(image, 0.25, DISC, 1.0, [0.5], (0.0, 0.0)))
    assert about_origin < 0.2 < encircled_energy(image, 0.25, DISC, 1.0, [0.5], (1.0, 0.0))
    with pytest.raises(UserError, match='"centroid", "origin"'):
        encircled_energy(image, 0.25, DISC, 1.0, [0.5], "peak")


def test_profile_of_an_airy_pattern():
    radii = np.array([0.2, 0.9, 1.22, 1.63, 4.0])
    exact = (2 * j1(np.pi * radii) / (np.pi * radii)) ** 2
    np.testing.assert_allclose(radial_profile(airy(64, 0.25), 0.25, radii), exact, rtol=0, atol=1e-7)


def test_batches_equal_single_images():
    images = np.stack([airy(48, 0.25), 0.3 * airy(48, 0.25, 0.4, -0.2), airy(48, 0.25, 2.0, 1.0)]).reshape(
        3, 1, 48, 48
    )
    together = encircled_energy_radius(images, 0.25, 0.25, DISC, 1.0)
    assert together.shape == (3, 1)
    assert np.array_equal(
        together[:, 0], [encircled_energy_radius(i[0], 0.25, 0.25, DISC, 1.0) for i in images]
    )


def test_energy_outside_the_frame_is_infinite_and_missing_numbers_stay_missing():
    image = airy(32, 0.25)
    assert encircled_energy_radius(image, 0.99, 0.25, DISC, 1.0) == np.inf
    assert encircled_energy_radius(np.zeros((32, 32)), 0.5, 0.25, DISC, 1.0) == np.inf
    assert encircled_energy_radius(airy(32, 0.25, 3.5), 0.8, 0.25, DISC, 1.0, (3.5, 0.0)) == np.inf
    image[3, 3] = np.nan
    assert np.isnan(encircled_energy_radius(image, 0.5, 0.25, DISC, 1.0))
    assert np.isnan(encircled_energy(airy(32, 0.25), 0.25, DISC, 1.0, [3.9, 4.1, 1e9])[1:]).all()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"sampling": 0.6}, "at most 0.5"),
        ({"sampling": np.nan}, "at most 0.5"),
        ({"area": 0.0}, "above 0"),
        ({"diameter": np.inf}, "above 0"),
        ({"radii": [-1.0]}, "radii"),
        ({"radii": []}, "radii"),
    ],
)
def test_impossible_measures_are_refused(change, message):
    arguments = {"sampling": 0.25, "area": DISC, "diameter": 1.0, "radii": [1.0]}
    with pytest.raises(UserError, match=message):
        encircled_energy(airy(8, 0.25), **{**arguments, **change})


@pytest.mark.parametrize("shape", [(1, 1), (4, 6)])
def test_images_that_hold_no_circle_are_refused(shape):
    with pytest.raises(UserError, match=f"at least 2 x 2 pixels, not {shape[0]} x {shape[1]}"):
        encircled_energy(np.ones(shape), 0.25, DISC, 1.0, [0.1])


@pytest.mark.parametrize("fraction", [0.0, 1.0, np.nan])
def test_impossible_fractions_are_refused(fraction):
    with pytest.raises(UserError, match="between 0 and 1"):
        encircled_energy_radius(airy(8, 0.25), fraction, 0.25, DISC, 1.0)


def test_an_exposure_is_the_mean_of_its_valid_instants():
    images = np.arange(2 * 4 * 3, dtype=np.float32).reshape(2, 4, 3)
    images[0, 3] = np.nan
    valid = np.array([[True, True, False, False], [False] * 4])
    mean = exposure(images, valid)
    assert mean.dtype == np.float64
    np.testing.assert_array_equal(mean[0], images[0, :2].mean(axis=0))
    assert np.isnan(mean[1]).all()


@pytest.mark.parametrize(("case", "rms"), [("perfect", 0.0), ("opd35nm", 1.0), ("opd70nm", 2.0)])
def test_energies_of_the_tmt_are_those_of_a_quadrature(tmt, case, rms):
    """Elsewhere integrated to 1e-6 over circles; trapezia of 0.05 wavelength/D are 5e-4 to 1.3e-3 low."""
    basis = segment_basis(tmt.corners, tmt.centers, 64, 0.25, tmt.diameter, 1, np.complex128)
    image = psf(basis, rms * tmt.pistons[None])[0].reshape(64, 64)
    place = 0.25, polygon_areas(tmt.corners).sum(), tmt.diameter
    reference = tmt.reference[case]
    if energies := reference.get("EE_at_lamD"):
        found = encircled_energy(image, *place, [float(radius) for radius in energies], "origin")
        np.testing.assert_allclose(found, list(energies.values()), rtol=0, atol=1e-6)
    radii = {percent: reference.get(f"EE{percent}_radius_lamD") for percent in (50, 80)}
    for percent, radius in radii.items():
        if radius:
            found = encircled_energy_radius(image, percent / 100, *place, "origin")
            assert found == pytest.approx(radius, abs=6e-5)


def test_radii_of_the_tmt_equal_polar_quadrature_of_exact_transforms(tmt):
    basis = segment_basis(tmt.corners, tmt.centers, 64, 0.25, tmt.diameter, 1)
    images = psf(basis, np.stack([0 * tmt.pistons, tmt.pistons])).reshape(2, 64, 64)
    area = polygon_areas(tmt.corners).sum()
    coefficients = np.stack([np.ones(492), np.exp(2j * np.pi * tmt.pistons)], axis=1) / area
    t, w = np.polynomial.legendre.leggauss(12)
    azimuth = 2 * np.pi * np.arange(36) / 36
    for image, column in zip(images, coefficients.T, strict=True):
        radius = encircled_energy_radius(image, 0.5, 0.25, area, tmt.diameter, "origin")
        f = np.outer(0.5 * radius * (t + 1), np.ones(36)) / tmt.diameter
        fx, fy = (f * np.cos(azimuth)).ravel(), (f * np.sin(azimuth)).ravel()
        ring = (np.abs(polygon_transform(tmt.corners, fx, fy) @ column) ** 2).reshape(12, 36).mean(axis=1)
        energy = (0.5 * radius * w) @ (2 * np.pi * 0.5 * radius * (t + 1) * ring) * area / tmt.diameter**2
        # The energy rises by more than 1 per wavelength/D here, so that this is the radius to 2e-4.
        assert energy == pytest.approx(0.5, abs=2e-4)
