"""Fits of many Zernike polynomials against 120-digit Gram-Schmidt, and what they say of too few rays."""

from decimal import Decimal, localcontext
from math import sqrt

import numpy as np
import pytest
from gram_schmidt import gram_schmidt
from hypothesis import given
from hypothesis import strategies as st

from wavequake.errors import UserError
from wavequake.optics.polynomials.indices import nm_to_noll
from wavequake.optics.polynomials.transforms import transform_coefficients
from wavequake.optics.polynomials.zernike import annular_zernike_gradient, noll_to_nm
from wavequake.optics.rays.pupils import sunflower
from wavequake.optics.wavefronts.fits import fit_instants, pupil_fit

PUPIL = sunflower(0.0, 1.0, 60)
EXACT = 120  # digits: the moments' matrix of 32 powers costs 50


def polynomials(m, count, eps, radii):
    """R(rho) and dR/drho (count, radii) of degrees m, m + 2, ..., floats of exact numbers."""
    with localcontext() as context:
        context.prec = EXACT
        found = []
        for coefficients in gram_schmidt(m, count, eps):
            powers = [(m + 2 * i, c) for i, c in enumerate(coefficients)]
            found.append(
                (
                    [sum(c * rho**p for p, c in powers) for rho in radii],
                    [sum(p * c * rho ** (p - 1) for p, c in powers if p) for rho in radii],
                )
            )
    return np.moveaxis(np.array(found, dtype=float), 1, 0)


@pytest.mark.parametrize("eps", [0.0, 0.1008133, 0.4])
@pytest.mark.parametrize("m", [0, 1, 14, 35, 62])
def test_values_and_slopes_to_degree_62_equal_gram_schmidt(m, eps):
    count = (62 - m) // 2 + 1
    radii = [Decimal(eps) + (1 - Decimal(eps)) * step / 5 for step in range(0 if eps else 1, 6)]
    values, slopes = polynomials(m, count, eps, radii)
    rho = np.array(radii, dtype=float)
    found, by_x, _ = annular_zernike_gradient(
        rho, np.zeros_like(rho), 2016, eps
    )  # cosines have crests at y = 0
    cosines = [nm_to_noll(n, m) - 1 for n in range(m, 63, 2)]
    assert cosines[-1] < 2016
    scale = sqrt(2) if m else 1.0
    for got, exact in ((found, values), (by_x, slopes)):
        exact = scale * exact
        assert (np.abs(got[:, cosines].T - exact) <= 1e-12 * np.abs(exact).max(axis=1, keepdims=True)).all()


@pytest.mark.parametrize("eps", [0.0, 0.4])
def test_a_fit_of_496_terms_finds_exact_polynomials(eps):
    """Rays on few circles, so that exact radial polynomials are few."""
    nodes, _ = np.polynomial.legendre.leggauss(16)  # products of degree 60 in rho are exact
    rings = np.sqrt(eps**2 + (1 - eps**2) * (nodes + 1) / 2)
    theta = 2 * np.pi * np.arange(64) / 64
    weights = np.repeat(np.polynomial.legendre.leggauss(16)[1], 64)
    x, y = (np.outer(rings, wave).ravel() for wave in (np.cos(theta), np.sin(theta)))
    fit = pupil_fit(x, y, weights, 496, eps)
    wanted = np.zeros((3, 496))
    opd = np.zeros((3, len(x)))
    for row, (n, m) in enumerate([(30, 0), (29, -11), (30, 30)]):
        radial = polynomials(abs(m), (n - abs(m)) // 2 + 1, eps, [Decimal(float(r)) for r in rings])[0, -1]
        wave = 1.0 if m == 0 else sqrt(2) * (np.cos(m * theta) if m > 0 else np.sin(-m * theta))
        opd[row] = np.outer(radial, wave * np.ones(64)).ravel()
        wanted[row, nm_to_noll(n, m) - 1] = 1.0
    np.testing.assert_allclose(fit_instants(fit, opd), wanted, rtol=0, atol=2e-13)


def test_496_terms_survive_the_way_to_circular_coefficients():
    """The sum of both series is the same wavefront; the coefficients grow by as much as the hole demands."""
    random = np.random.default_rng(5).normal(size=496)
    rho = np.linspace(0.4, 1.0, 9)
    x, y = rho * np.cos(2.0), rho * np.sin(2.0)
    circular = transform_coefficients(random, 0.4, 0.0)
    annular, plain = (annular_zernike_gradient(x, y, 496, eps)[0] for eps in (0.4, 0.0))
    np.testing.assert_allclose(
        plain @ circular, annular @ random, rtol=0, atol=1e-13 * 496 * np.abs(circular).max()
    )


def test_all_fields_of_a_system_share_one_fit():
    pupil = sunflower(0.2, 1.0, 200)
    fit = pupil_fit(pupil.x, pupil.y, pupil.weight, 28, 0.2)
    assert pupil_fit(pupil.x.copy(), pupil.y, 4.0 * pupil.weight, 28, 0.2) is fit
    assert pupil_fit(pupil.x, pupil.y, pupil.weight, 28, 0.3) is not fit
    whole = pupil_fit(np.array([1, 0, -1, 0]), np.array([0, 1, 0, -1]), np.ones(4, int), 3, 0.0)
    np.testing.assert_allclose(whole.basis[:, 1:], [[2, 0], [0, 2], [-2, 0], [0, -2]], rtol=0, atol=1e-15)


@pytest.mark.parametrize(
    ("rays", "terms", "words"),
    [
        (
            100,
            231,
            "100 rays do not determine 231 wavefront terms; raise optics.rays, or lower zernike_terms",
        ),
        (300, 231, "300 rays are too few for 231 wavefront terms: .* times larger between the rays than at"),
        (1000, 496, "1000 rays are too few for 496 wavefront terms"),
    ],
)
def test_too_few_rays_are_said(rays, terms, words):
    pupil = sunflower(0.0, 1.0, rays)
    with pytest.raises(UserError, match=words):
        pupil_fit(pupil.x, pupil.y, pupil.weight, terms, 0.0)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"weight": np.ones(59)}, r"have the shapes \(60,\), \(60,\), \(59,\); each must be \(N,\)"),
        ({"x": np.zeros((60, 1))}, "each must be"),
        ({"weight": "a"}, "must be an array of numbers, not 'a'"),
        ({"weight": np.zeros(60)}, "weights of the rays must all be positive"),
        ({"weight": -np.ones(60)}, "weights of the rays must all be positive"),
        ({"weight": np.where(np.arange(60) == 7, np.nan, 1.0)}, "weights of the rays must all be positive"),
        ({"weight": np.where(np.arange(60) == 7, np.inf, 1.0)}, "weights of the rays must all be positive"),
        ({"x": np.where(np.arange(60) == 7, np.nan, 0.1)}, "rays must lie in the pupil, .* NaN"),
        ({"y": np.full(60, -np.inf)}, "rays must lie in the pupil"),
        ({"y": np.linspace(-700.0, 700.0, 60)}, "units of its radius .not mm"),
        ({"x": np.full(60, 0.3), "y": np.full(60, 0.3)}, "60 rays .* terms; they lie on each"),
        ({"x": np.linspace(-1, 1, 60), "y": np.linspace(-0.5, 0.5, 60)}, "; they .* on a line: spread"),
        (
            {"x": np.repeat(PUPIL.x[:4], 15), "y": np.repeat(PUPIL.y[:4], 15)},
            "; they lie on each other .*: spread them over the",
        ),
        ({"terms": "6"}, "Zernike terms is '6'; it must be a whole number"),
        ({"obscuration": [0.1]}, "the obscuration is .0.1.; it must be a number"),
        ({"x": [], "y": [], "weight": []}, "0 rays do not determine 6 wavefront terms; raise optics.rays"),
    ],
)
def test_rays_that_no_fit_takes_are_told(changes, words):
    rays = {"x": PUPIL.x, "y": PUPIL.y, "weight": PUPIL.weight, "terms": 6, "obscuration": 0.0} | changes
    with pytest.raises(UserError, match=words):
        pupil_fit(**rays)


@given(st.integers(-1060, 1023))
def test_weights_count_by_their_ratios_only(power):
    """Factors of two change no bits, however large or small the weights become."""
    fit = pupil_fit(PUPIL.x, PUPIL.y, np.ones(60), 6, 0.0)
    scaled = pupil_fit(PUPIL.x.tolist(), PUPIL.y, np.full(60, 2.0**power), 6, 0.0)
    np.testing.assert_array_equal(scaled.matrix, fit.matrix)
    assert fit.weight.sum() == pytest.approx(1.0)


@pytest.mark.parametrize(("terms", "per_term"), [(28, 2), (231, 2), (496, 3)])
def test_rays_that_the_documentation_asks_for_are_enough(terms, per_term):
    pupil = sunflower(0.0, 1.0, per_term * terms)
    assert pupil_fit(pupil.x, pupil.y, pupil.weight, terms, 0.0).basis.shape == (per_term * terms, terms)


def test_noll_indices_of_degree_62_end_at_2016():
    assert {noll_to_nm(j)[0] for j in (1954, 2016)} == {62}
    assert noll_to_nm(2017)[0] == 63
