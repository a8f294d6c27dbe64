"""Glasses of lens files that are written: those of no catalogue stand in one beside the file."""

from dataclasses import replace

import pytest

from wavequake.errors import UserError
from wavequake.optics.catalog.names import optical_system
from wavequake.optics.media.agf import read_agf
from wavequake.optics.media.dispersion import AGF_FORMULAS
from wavequake.optics.media.environment import Thermal
from wavequake.optics.media.glasses import Medium, glass
from wavequake.optics.shapes.shapes import Conic
from wavequake.optics.systems.paraxial import paraxial
from wavequake.optics.systems.system import OpticalSystem, Pupil, Surface
from wavequake.optics.zemax.export import write_zmx, zmx_text
from wavequake.optics.zemax.read import read_zmx


def lens(medium):
    first = Surface("first", Conic(100.0), action="refract", medium=medium)
    return OpticalSystem("lens", (first, Surface("image")), 0, Pupil("entrance_diameter", 10.0))


@pytest.mark.parametrize("formula", sorted({*AGF_FORMULAS.values()}))
def test_glasses_of_no_catalogue_stand_beside_the_lens(tmp_path, formula):
    """Their indices come back through the catalogue; without it the file says what is missing."""
    kind, count = formula
    coefficients = (1.5, *[1e-3] * (count - 1)) if kind != "sellmeier" else (1.1, 0.01) * (count // 2)
    thermal = Thermal((1e-6, 0.0, 0.0, 0.0, 0.0, 0.2), 22.0)
    own = Medium("my own glass", kind, coefficients, (400.0, 900.0), "", thermal)
    system = lens(own)
    path = write_zmx(system, tmp_path / "case 7.zmx")
    again = read_zmx(path, glasses=read_agf(tmp_path / "case 7.agf")).surfaces[0].medium
    assert (again.formula, again.coefficients, again.thermal) == (kind, coefficients, own.thermal)
    assert again.range_nm == pytest.approx(own.range_nm)
    with pytest.raises(UserError) as refused:
        read_zmx(path)
    assert "no glass 'MY_OWN_GLASS' in the catalogue" in f"{refused.value} {refused.value.details}"


def test_hsc_comes_back_with_its_glasses(tmp_path):
    system = optical_system("hsc")
    path = write_zmx(system, tmp_path / "hsc.zmx")
    again = read_zmx(path, glasses=read_agf(tmp_path / "hsc.agf"))
    assert paraxial(again).focal_length == pytest.approx(paraxial(system).focal_length, rel=1e-12)


def test_glasses_replace_those_of_an_export_and_no_catalogue_of_a_user(tmp_path):
    system, catalogue = optical_system("hsc"), tmp_path / "hsc.agf"
    write_zmx(system, write_zmx(system, tmp_path / "hsc.zmx"))
    for mine in ("CC of mine\nNM MELT 1 0 1.5 50 0 0 0\n".encode("utf-16"), b"", b"CC of mine"):
        catalogue.write_bytes(mine)
        with pytest.raises(UserError, match=r"hsc\.agf is a catalogue that another lens file may need"):
            write_zmx(system, tmp_path / "hsc.zmx")
        assert catalogue.read_bytes() == mine


@pytest.mark.parametrize("other", [glass("F2"), Medium("F2", "conrady", (1.5, 1e-3, 1e-4))])
def test_own_glasses_of_equal_names_are_refused(other):
    mine = Medium("F2", "conrady", (1.6, 1e-3, 1e-4))
    first, image = lens(mine).surfaces
    with pytest.raises(UserError, match="cannot tell apart"):
        zmx_text(replace(lens(mine), surfaces=(first, replace(first, medium=other), image)))
