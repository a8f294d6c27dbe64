from math import cos, pi, sin, sqrt

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from wavequake.errors import UserError
from wavequake.optics.polynomials.indices import (
    ansi_to_nm,
    convert_coefficients,
    fringe_to_nm,
    nm_to_ansi,
    nm_to_fringe,
    nm_to_noll,
    peak_amplitude,
)
from wavequake.optics.polynomials.zernike import annular_zernike, noll_to_nm

# As tabulated by the standards, m < 0 for the sine.
NOLL = "0,0 1,1 1,-1 2,0 2,-2 2,2 3,-1 3,1 3,-3 3,3 4,0 4,2 4,-2 4,4 4,-4 5,1 5,-1 5,3 5,-3 5,5 5,-5 6,0"
ANSI = "0,0 1,-1 1,1 2,-2 2,0 2,2 3,-3 3,-1 3,1 3,3 4,-4 4,-2 4,0 4,2 4,4 5,-5 5,-3 5,-1 5,1 5,3 5,5"
ARIZONA = (
    "0,0 1,1 1,-1 2,0 2,2 2,-2 3,1 3,-1 4,0 3,3 3,-3 4,2 4,-2 5,1 5,-1 6,0 4,4 4,-4 5,3 5,-3 6,2 6,-2 7,1 "
    "7,-1 8,0 5,5 5,-5 6,4 6,-4 7,3 7,-3 8,2 8,-2 9,1 9,-1 10,0 12,0"
)
INDICES = [(noll_to_nm, nm_to_noll, 1), (ansi_to_nm, nm_to_ansi, 0), (fringe_to_nm, nm_to_fringe, 1)]
SCHEMES = st.sampled_from(["noll", "ansi", "fringe"])

# Fringe polynomials 1..16 as printed by optical design programs.
FRINGE_POLYNOMIALS = [
    lambda r, t: 1,
    lambda r, t: r * cos(t),
    lambda r, t: r * sin(t),
    lambda r, t: 2 * r**2 - 1,
    lambda r, t: r**2 * cos(2 * t),
    lambda r, t: r**2 * sin(2 * t),
    lambda r, t: (3 * r**2 - 2) * r * cos(t),
    lambda r, t: (3 * r**2 - 2) * r * sin(t),
    lambda r, t: 6 * r**4 - 6 * r**2 + 1,
    lambda r, t: r**3 * cos(3 * t),
    lambda r, t: r**3 * sin(3 * t),
    lambda r, t: (4 * r**2 - 3) * r**2 * cos(2 * t),
    lambda r, t: (4 * r**2 - 3) * r**2 * sin(2 * t),
    lambda r, t: (10 * r**4 - 12 * r**2 + 3) * r * cos(t),
    lambda r, t: (10 * r**4 - 12 * r**2 + 3) * r * sin(t),
    lambda r, t: 20 * r**6 - 30 * r**4 + 12 * r**2 - 1,
]


def table(text):
    return [tuple(map(int, pair.split(","))) for pair in text.split()]


@pytest.mark.parametrize(
    ("text", "to_nm", "from_nm", "first"),
    [
        (NOLL, noll_to_nm, nm_to_noll, 1),
        (ANSI, ansi_to_nm, nm_to_ansi, 0),
        (ARIZONA, lambda j: fringe_to_nm(j, arizona=True), lambda n, m: nm_to_fringe(n, m, arizona=True), 1),
    ],
)
def test_indices_are_those_of_the_standards(text, to_nm, from_nm, first):
    for j, (n, m) in enumerate(table(text), start=first):
        assert to_nm(j) == (n, m)
        assert from_nm(n, m) == j


@pytest.mark.parametrize(("to_nm", "from_nm", "first"), INDICES)
@given(offset=st.integers(0, 10**6), n=st.integers(0, 300), step=st.integers(0, 300))
def test_indices_and_orders_go_round(to_nm, from_nm, first, offset, n, step):
    j = first + offset % 50_000
    assert from_nm(*to_nm(j)) == j
    m = n - 2 * (step % (n + 1))  # -n, -n + 2, ..., n
    assert from_nm(n, m) >= first
    if from_nm(n, m) <= 50_000:
        assert to_nm(from_nm(n, m)) == (n, m)


def test_beyond_the_37_terms_fringe_goes_on_in_order():
    assert [fringe_to_nm(j) for j in range(36, 50)] == table(
        "10,0 6,6 6,-6 7,5 7,-5 8,4 8,-4 9,3 9,-3 10,2 10,-2 11,1 11,-1 12,0"
    )
    assert fringe_to_nm(49) == fringe_to_nm(37, arizona=True)


@given(st.floats(0, 1), st.floats(0, 2 * pi))
def test_converted_fringe_coefficients_give_the_printed_polynomials(r, t):
    noll = convert_coefficients(np.eye(16), "fringe", "noll")
    basis = annular_zernike(np.array([r * cos(t)]), np.array([r * sin(t)]), noll.shape[1])[0]
    printed = [polynomial(r, t) for polynomial in FRINGE_POLYNOMIALS]
    np.testing.assert_allclose(noll @ basis, printed, rtol=0, atol=1e-13)


def test_ansi_keeps_unit_rms():
    ansi = convert_coefficients(np.eye(6), "ansi", "noll")  # 0,0 1,-1 1,1 2,-2 2,0 2,2
    np.testing.assert_array_equal(np.argmax(ansi, axis=1) + 1, [1, 3, 2, 5, 4, 6])
    np.testing.assert_array_equal(ansi.max(axis=1), np.ones(6))


@given(st.integers(1, 45), SCHEMES, SCHEMES)
def test_conversions_go_round(terms, source, target):
    coefficients = np.random.default_rng(terms).normal(size=(2, 3, terms))
    there = convert_coefficients(coefficients, source, target)
    back = convert_coefficients(there, target, source)
    np.testing.assert_allclose(back[..., :terms], coefficients, rtol=1e-15)
    assert not back[..., terms:].any()


def test_lists_are_coefficients_too():
    listed = convert_coefficients([[0, 1, 2.0]], "noll", "fringe")
    np.testing.assert_array_equal(listed, convert_coefficients(np.array([[0, 1, 2.0]]), "noll", "fringe"))


def test_peaks_of_the_unit_rms_polynomials():
    assert [peak_amplitude(n, m) for n, m in [(0, 0), (1, -1), (2, 0), (2, 2)]] == pytest.approx(
        [1, 2, sqrt(3), sqrt(6)]
    )


def test_no_terms_convert_to_no_terms():
    assert convert_coefficients(np.zeros((4, 0)), "noll", "fringe").shape == (4, 0)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: nm_to_noll(2, 1), "no Zernike polynomial"),
        (lambda: nm_to_ansi(2, -4), "no Zernike polynomial"),
        (lambda: nm_to_fringe(-1, 1), "no Zernike polynomial"),
        (lambda: peak_amplitude(1, 0), "no Zernike polynomial"),
        (lambda: ansi_to_nm(-1), "ANSI index -1"),
        (lambda: fringe_to_nm(0), "Fringe index 0"),
        (lambda: fringe_to_nm(38, arizona=True), "Fringe index 38"),
        (lambda: nm_to_fringe(6, 6, arizona=True), "not in the set"),
        (lambda: convert_coefficients(np.zeros(3), "nol", "ansi"), "'nol' is unknown"),
        (lambda: convert_coefficients(np.zeros(3), ["noll"], "ansi"), "is unknown"),
        (lambda: convert_coefficients(["x"], "noll", "ansi"), "coefficients must be an array of numbers"),
        (lambda: convert_coefficients(1.0, "noll", "ansi"), r"are the number 1\.0; give a list"),
        (lambda: ansi_to_nm("x"), "ANSI index is 'x'; it must be a whole number"),
        (lambda: ansi_to_nm(1.5), "ANSI index is 1.5; it must be a whole number"),
        (lambda: fringe_to_nm(1.5), "Fringe index is 1.5; it must be a whole number"),
        (lambda: fringe_to_nm(None, arizona=True), "Fringe index is None"),
    ],
)
def test_bad_input_is_named(call, message):
    with pytest.raises(UserError, match=message):
        call()
