"""Indices at other temperatures and pressures, against data sheets and published tables."""

import numpy as np
import pytest

from wavequake.errors import UserError
from wavequake.optics.media.agf import parse_agf
from wavequake.optics.media.environment import Environment, air_index
from wavequake.optics.media.glasses import (
    AIR,
    catalogues,
    constant,
    glass,
    in_environment,
    refractive_index,
    thermal_of,
)
from wavequake.optics.systems.paraxial import paraxial
from wavequake.optics.zemax.export import zmx_text
from wavequake.optics.zemax.read import parse_zmx

# Data sheet of Schott N-BK7: change of the index per K, 1e-6, from and to these temperatures, at the lines
# 1060.0, e and g; against air of the same temperature, and absolute.
N_BK7 = {
    (-40.0, -20.0): ((2.4, 2.9, 3.3), (0.3, 0.8, 1.2)),
    (20.0, 40.0): ((2.4, 3.0, 3.5), (1.1, 1.6, 2.1)),
    (60.0, 80.0): ((2.5, 3.1, 3.7), (1.5, 2.1, 2.7)),
}
LINES = (1060.0e-6, 546.0740e-6, 435.8343e-6)


def index_in(name, temperature, pressure, wavelength=550e-6):
    return refractive_index(in_environment(glass(name), Environment(temperature, pressure)), wavelength)


@pytest.mark.parametrize("span", N_BK7)
def test_coefficients_of_temperature_are_those_of_the_data_sheet(span):
    relative, absolute = N_BK7[span]
    for pressure, wanted in ((1.0, relative), (0.0, absolute)):
        for line, value in zip(LINES, wanted, strict=True):
            low, high = (index_in("N-BK7", one, pressure, line) for one in span)
            # Printed with one digit; of a wavelength in vacuum, whose line is the same.
            assert 1e6 * (high - low) / (span[1] - span[0]) == pytest.approx(value, abs=0.07)


@pytest.mark.parametrize(
    ("celsius", "kilopascal", "excess"),
    [(20, 80, 21458.0), (20, 100, 26824.4), (20, 120, 32191.6), (10, 100, 27774.7), (30, 100, 25937.2)],
)
def test_air_is_that_of_ciddor(celsius, kilopascal, excess):
    """Ciddor 1996, Table 1: dry air at 633 nm, 1e8 times n - 1."""
    found = air_index(0.633, Environment(celsius, kilopascal / 101.325))
    assert found - 1 == pytest.approx(1e-8 * excess, abs=5e-8)


def test_where_a_glass_was_measured_nothing_changes():
    for name in ("N-BK7", "OHARA:S-BSL7", "NIKON:J-BK7A", "HOYA:FCD1", "SUMITA:K-CAFK95", "CDGM:H-K9L"):
        medium = glass(name)
        at = thermal_of(medium).at_c
        here = in_environment(medium, Environment(at))
        assert refractive_index(here, 550e-6) == pytest.approx(refractive_index(medium, 550e-6), abs=1e-15)
        colder = refractive_index(in_environment(medium, Environment(at - 50.0)), 550e-6)
        assert 1e-7 < abs(colder - refractive_index(medium, 550e-6)) < 2e-3


def test_in_vacuum_an_index_is_that_against_air_times_that_of_air():
    """At the temperature of the glass; the wavelength is longer by the index of air."""
    glassy = glass("N-SF6")
    air = air_index(0.55, Environment())
    wanted = air * refractive_index(glassy, 550e-6 / air)
    assert index_in("N-SF6", 20.0, 0.0) == pytest.approx(wanted, rel=1e-8)
    assert in_environment(AIR, Environment(-80.0, 0.0)) == AIR


def test_all_makers_glasses_change_by_what_glasses_do():
    """From 20 to 40 degrees at the d line indices change as those of fluorides to heavy flints do."""
    rates = []
    for table in catalogues().values():
        for medium in table.values():
            if thermal_of(medium) is None or not medium.range_nm[0] < 587.0 < medium.range_nm[1]:
                continue
            places = (in_environment(medium, Environment(one)) for one in (40.0, 20.0))
            warm, cold = (refractive_index(one, 587.5618e-6) for one in places)
            rates.append(1e6 * (warm - cold) / 20)
    assert len(rates) > 1200
    # Calcium fluoride falls by 1e-5 per K, most glasses rise by a few 1e-6.
    assert -11 < min(rates) < -9.5
    assert 2 < np.median(rates) < 5
    assert max(rates) < 30


LENS = """MODE SEQ
ENPD 10
WAVM 1 0.55 1
FTYP 0 0 1 1 0 0 0
{header}
SURF 0
  DISZ INFINITY
SURF 1
  CURV 0.01
  GLAS {glass}
  DISZ 1e-9
  STOP
SURF 2
  DISZ 90
SURF 3
"""


def focal(header, name="N-BK7 0 0"):
    return paraxial(parse_zmx(LENS.format(header=header, glass=name), "lens.zmx")).focal_length


def test_a_lens_file_follows_its_environment():
    """A thin lens: f = R / (n - 1), with the index against the air around."""
    for temperature, pressure in ((-80.0, 0.0), (20.0, 1.0), (35.0, 0.6)):
        medium = in_environment(glass("N-BK7"), Environment(temperature, pressure))
        wanted = 100.0 / (refractive_index(medium, 550e-6) - 1)
        assert focal(f"ENVD {temperature} {pressure} 1") == pytest.approx(wanted, rel=1e-8)
        assert focal(f"ENVD {temperature} {pressure} 0") == pytest.approx(focal(""), rel=1e-15)
    assert focal("ENVD -80 0 1") != pytest.approx(focal(""), rel=1e-5)
    # What the file gives as numbers stays.
    assert focal("ENVD -80 0 1", "___BLANK 1 0 1.5 0") == pytest.approx(200.0, rel=1e-9)


def test_the_environment_goes_out_again_and_is_told():
    system = parse_zmx(LENS.format(header="ENVD -80 0.5 1", glass="N-BK7 0 0"), "lens.zmx")
    assert "Indices of glasses are those at -80 degrees Celsius and 0.5 atmospheres" in system.note
    text = zmx_text(system)
    assert "ENVD -80" in text
    again = parse_zmx(text, "again.zmx")
    assert again.surfaces[0].medium == system.surfaces[0].medium
    assert "ENVD" not in zmx_text(parse_zmx(LENS.format(header="", glass="N-BK7 0 0"), "lens.zmx"))


AGF = """NM MELT 2 0 1.5168 64.17
CD 1.03961212E+00 6.00069867E-03 2.31792344E-01 2.00179144E-02 1.01046945E+00 1.03560653E+02
{line}
LD 3.00000000E-01 2.50000000E+00
"""


def test_a_catalogue_of_ones_own_says_how_its_glasses_follow_temperature():
    line = "TD 1.8600E-06 1.3100E-08 -1.3700E-11 4.3400E-07 6.2700E-10 1.7000E-01 2.0000E+01"
    melt = parse_agf(AGF.format(line=line), "own.agf")["MELT"]
    cold = Environment(-100.0, 0.0)
    wanted = refractive_index(in_environment(glass("N-BK7"), cold), 550e-6)
    assert refractive_index(in_environment(melt, cold), 550e-6) == pytest.approx(wanted, rel=1e-15)
    for nothing in ("", "TD 0 0 0 0 0 0 20"):
        with pytest.raises(UserError, match="nothing is known of how the index of MELT follows temperature"):
            in_environment(parse_agf(AGF.format(line=nothing), "own.agf")["MELT"], cold)


@pytest.mark.parametrize(
    ("header", "name", "words"),
    [
        ("ENVD 1e9 1 1", "N-BK7 0 0", "1e.09 degrees Celsius and 1 atmospheres; possible are"),
        ("ENVD 20 -1 1", "N-BK7 0 0", "20 degrees Celsius and -1 atmospheres; possible are"),
        ("ENVD 30 1 1", "CAF2 0 0", r"line 10 \(GLAS\).*index of CAF2 follows temperature; give a catalogue"),
    ],
)
def test_environments_that_cannot_be_are_told(header, name, words):
    with pytest.raises(UserError, match=words):
        focal(header, name)


def test_what_has_no_dispersion_table_stays_in_its_own_air():
    """At 20 degrees a crystal's index changes with the air alone."""
    air = air_index(0.55, Environment())
    wanted = air * refractive_index(glass("CAF2"), 550e-6 / air)
    assert index_in("CAF2", 20.0, 0.0) == pytest.approx(wanted, rel=1e-8)
    assert thermal_of(constant(1.5)) is None
