import csv
from pathlib import Path

import numpy as np
import pytest

from wavequake.errors import UserError
from wavequake.optics.media.glasses import AIR, ALIASES, Medium, constant, glass, glasses, refractive_index

D_LINE, F_LINE, C_LINE = 587.5618e-6, 486.1327e-6, 656.2725e-6
BK7_1980 = (2.2718929, -1.0108077e-2, 1.0592509e-2, 2.0816965e-4, -7.6472538e-6, 4.9240991e-7)


def published():
    rows = []
    for name in ("glass_indices.csv", "glass_indices_ohara.csv"):
        lines = (Path(__file__).parents[1] / "data" / name).read_text().splitlines()
        rows += csv.DictReader(line for line in lines if not line.startswith("#"))
    return rows


def abbe(medium):
    n_d, n_f, n_c = (refractive_index(medium, line) for line in (D_LINE, F_LINE, C_LINE))
    return (n_d - 1) / (n_f - n_c)


@pytest.mark.parametrize("row", published(), ids=lambda row: row["name"])
def test_every_index_of_the_data_sheets(row):
    """Each to the last printed digit and a half."""
    medium = glass(row["name"])
    for line, text in row.items():
        if line not in ("name", "vd") and text:
            index = refractive_index(medium, float(line) * 1e-6)
            assert index == pytest.approx(float(text), abs=1e-5), f"at {line} nm"
    assert abbe(medium) == pytest.approx(float(row["vd"]), abs=0.01)


def test_every_glass_of_the_catalogue_is_checked():
    crystals = {"SILICA", "CAF2", "BAF2", "SILICON", "ZNSE", "GERMANIUM", "BK7"}
    assert {row["name"] for row in published()} | crystals == set(glasses())
    assert len(glasses()) >= 200


def test_silica_against_measured_indices():
    """Malitson 1965, Table I, to 1e-5; Abbe number of the material."""
    table = {365.0146: 1.47454, 435.8343: 1.46669, 486.1327: 1.46313, 546.0740: 1.46008, 587.5618: 1.45846}
    table |= {656.2725: 1.45637, 1013.98: 1.45024}
    for line, index in table.items():
        assert refractive_index(glass("SILICA"), line * 1e-6) == pytest.approx(index, abs=1e-5)
    assert abbe(glass("SILICA")) == pytest.approx(67.82, abs=0.01)


def test_calcium_fluoride_against_a_later_measurement():
    """Daimon and Masumura 2002, four terms fitted at 20 degrees C; ours is of 24, and dn/dT = -1.06e-5."""
    b = np.array([0.443749998, 0.444930066, 0.150133991, 8.85319946])
    c = np.array([0.00178027854, 0.00788536061, 0.0124119491, 2752.28175])
    for um in (0.24, 0.4, 0.5876, 1.0, 2.3):
        index = np.sqrt(1 + np.sum(b * um**2 / (um**2 - c))) - 4 * 1.06e-5
        assert refractive_index(glass("CaF2"), um * 1e-3) == pytest.approx(index, abs=3e-5)
    assert abbe(glass("CaF2")) == pytest.approx(95.0, abs=0.01)


def test_barium_fluoride_against_a_critical_review():
    """Li 1980, his own formula fitted to several measurements; he states 1e-4 in the visible."""
    for um in (0.3, 0.5876, 1.0, 3.0, 8.0):
        index = np.sqrt(
            1.33973
            + 0.81070 * um**2 / (um**2 - 0.10065**2)
            + 0.19652 * um**2 / (um**2 - 29.87**2)
            + 4.52469 * um**2 / (um**2 - 53.82**2)
        )
        assert refractive_index(glass("BAF2"), um * 1e-3) == pytest.approx(index, abs=2e-4)
    assert abbe(glass("BAF2")) == pytest.approx(81.61, abs=0.01)


@pytest.mark.parametrize(
    ("name", "table", "tolerance"),
    [
        # Measured points of Salzberg and Villa, which their formula fits to some 1e-4.
        ("Si", {1.357: 3.4975, 2.4373: 3.4408, 3.5: 3.4284, 5.5: 3.4213, 10.0: 3.4179}, 4e-4),
        # Maker's table of chemical-vapor-deposited material.
        ("ZnSe", {0.6328: 2.591, 3.0: 2.4376, 8.0: 2.4173, 10.6: 2.4028}, 2e-4),
    ],
)
def test_infrared_crystals_against_measured_indices(name, table, tolerance):
    for um, index in table.items():
        assert refractive_index(glass(name), um * 1e-3) == pytest.approx(index, abs=tolerance)


def test_germanium_against_an_earlier_measurement():
    """Icenogle et al. 1976, two terms; samples of germanium differ by up to 1e-3."""
    for um in (2.5, 4.0, 8.0, 10.6):
        square = 9.28156 + 6.72880 * um**2 / (um**2 - 0.44105) + 0.21307 * um**2 / (um**2 - 3870.1)
        assert refractive_index(glass("Ge"), um * 1e-3) == pytest.approx(np.sqrt(square), abs=1.5e-3)


def test_aliases_are_the_same_glass():
    assert glass("fused_silica") == glass("F_SILICA") == glass("silica")
    assert glass("N-SF6HTultra") == glass("N-SF6HT") == glass("N-SF6")
    assert set(ALIASES.values()) <= set(glasses())
    assert not set(ALIASES) & set(glasses())


def test_published_indices():
    assert refractive_index(glass("N-BK7"), D_LINE) == pytest.approx(1.5168, abs=5e-6)
    assert refractive_index(glass("fused_silica"), D_LINE) == pytest.approx(1.45846, abs=5e-6)
    assert refractive_index(AIR, D_LINE) == 1.0


def test_bk7_by_the_other_formula():
    """a0 ... a5 of BK7 as printed before 1992 and the Sellmeier coefficients printed since."""
    old = Medium("BK7", "schott", BK7_1980)
    for nm in (365.0, 435.8, 546.1, 587.6, 656.3, 1014.0):
        index = refractive_index(glass("BK7"), nm * 1e-6)
        assert refractive_index(old, nm * 1e-6) == pytest.approx(index, abs=1e-5)


def test_wavelength_out_of_range_names_glass_wavelength_and_range():
    with pytest.raises(UserError, match=r"N-BK7 is known from 312 to 2326 nm, not at 200 nm"):
        refractive_index(glass("N-BK7"), 200e-6)


@pytest.mark.parametrize("wavelength", [float("nan"), 0.0, -500e-6])
def test_a_wavelength_is_a_positive_number(wavelength):
    with pytest.raises(UserError, match="not at"):
        refractive_index(AIR, wavelength)


def test_range_includes_its_ends():
    assert refractive_index(glass("N-BK7"), 312e-6) > refractive_index(glass("N-BK7"), 2326e-6) > 1.4


def test_unknown_glass_suggests_the_nearest():
    with pytest.raises(UserError, match=r"no glass 'N-BK77' .* nearest .* N-BK7"):
        glass("N-BK77")


@pytest.mark.parametrize(
    ("medium", "match"),
    [
        (Medium("x", "constant", (float("nan"),)), "no real refractive index"),
        (Medium("x", "constant", (-1.5,)), "no real refractive index"),
        (constant(1e200), "no real refractive index"),
        (constant(1500.0), r"n=1500\.0 at 500 nm would be 1500; it must lie between 0\.01 and 100"),
        (constant(1e-5), "between"),
        (Medium("x", "schott", (2.0, 0.0, 0.0, 0.0, 0.0, 1e308)), "no real refractive index"),
        (Medium("x", "constant", (1.5, 2.0)), "takes 1 coefficients, not 2"),
        (Medium("x", "sellmeier", (1.0, 0.25, 0.0, 0.0, 0.0, 0.0)), "no real refractive index"),
    ],
)
def test_bad_coefficients_are_refused(medium, match):
    with pytest.raises(UserError, match=match):
        refractive_index(medium, 500e-6)


def test_a_wavelength_beyond_all_light_is_no_crash():
    with pytest.raises(UserError, match="no real refractive index"):
        refractive_index(Medium("x", "schott", (2.0, 0.0, 0.0, 0.0, 0.0, 0.0)), 1e200)
