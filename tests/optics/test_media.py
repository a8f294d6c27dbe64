import pytest

from wavequake.errors import UserError
from wavequake.optics.media import AIR, Medium, glass, refractive_index

D_LINE = 587.5618e-6


def test_published_indices():
    assert refractive_index(glass("N-BK7"), D_LINE) == pytest.approx(1.5168, abs=5e-6)
    assert refractive_index(glass("fused_silica"), D_LINE) == pytest.approx(1.45846, abs=5e-6)
    assert refractive_index(AIR, D_LINE) == 1.0


def test_schott_formula_of_the_old_bk7_sheet():
    """a0 ... a5 of BK7 as printed in Schott's catalogue before 1992, n_d = 1.51680."""
    bk7 = Medium(
        "BK7", "schott", (2.2718929, -1.0108077e-2, 1.0592509e-2, 2.0816965e-4, -7.6472538e-6, 4.9240991e-7)
    )
    assert refractive_index(bk7, D_LINE) == pytest.approx(1.5168, abs=5e-6)


def test_wavelength_out_of_range_names_glass_wavelength_and_range():
    with pytest.raises(UserError, match=r"N-BK7 is known from 300 to 2500 nm, not at 200 nm"):
        refractive_index(glass("N-BK7"), 200e-6)


@pytest.mark.parametrize("wavelength", [float("nan"), 0.0, -500e-6])
def test_a_wavelength_is_a_positive_number(wavelength):
    with pytest.raises(UserError, match="not at"):
        refractive_index(AIR, wavelength)


def test_range_includes_its_ends():
    assert refractive_index(glass("N-BK7"), 300e-6) > refractive_index(glass("N-BK7"), 2500e-6) > 1.4


def test_unknown_glass_suggests_the_nearest():
    with pytest.raises(UserError, match=r"no glass 'N-BK77' .* did you mean N-BK7"):
        glass("N-BK77")


@pytest.mark.parametrize(
    ("medium", "match"),
    [
        (Medium("x", "constant", (float("nan"),)), "no real refractive index"),
        (Medium("x", "constant", (-1.5,)), "no real refractive index"),
        (Medium("x", "constant", (1.5, 2.0)), "takes 1 coefficients, not 2"),
        (Medium("x", "sellmeier", (1.0, 0.25, 0.0, 0.0, 0.0, 0.0)), "no real refractive index"),
    ],
)
def test_bad_coefficients_are_refused(medium, match):
    with pytest.raises(UserError, match=match):
        refractive_index(medium, 500e-6)
