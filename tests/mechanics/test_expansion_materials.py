"""Thermal expansion of bodies of several materials, given in a study or by decks, against closed forms."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from wavequake.errors import UserError
from wavequake.mechanics.nodal.expansion import Material, Solid, expanded
from wavequake.mechanics.nodal.solids import KINDS
from wavequake.mechanics.nodal.temperatures import thermal_displacements
from wavequake.mechanics.nodal.thermal import Thermal

ALPHA = 2e-5


def bricks(counts, sizes):
    """Quadratic bricks in rows, and the layer (along z, from 0) of each."""
    lattice = np.stack(np.meshgrid(*(np.arange(2 * n + 1) for n in counts), indexing="ij"), axis=-1)
    kept = (lattice % 2).sum(axis=-1) < 2  # corners and middles of edges
    number = np.where(kept, np.cumsum(kept).reshape(kept.shape) - 1, -1)
    local = np.rint(KINDS["hexahedron20"][0]).astype(int) + 1
    first = 2 * np.stack(np.meshgrid(*map(np.arange, counts), indexing="ij"), axis=-1).reshape(-1, 3)
    elements = number[tuple(np.moveaxis(first[:, None] + local, -1, 0))]
    points = lattice[kept] * (np.array(sizes) / 2.0 / counts)
    return points, elements, first[:, 2] // 2


# A strip of two metals, Timoshenko, J. Opt. Soc. Am. 11, 233 (1925), Eq. 4, without Poisson's ratio.
BRASS, INVAR = Material(19e-6, 0.0, 105.0), Material(1e-6, 0.0, 140.0)
LENGTH, WIDTH, THICK = 0.06, 0.002, (0.0006, 0.0004)


def timoshenko(below, above, rise):
    m, n = THICK[0] / THICK[1], below.modulus / above.modulus
    head = 6 * (below.expansion - above.expansion) * rise * (1 + m) ** 2
    return head / (sum(THICK) * (3 * (1 + m) ** 2 + (1 + m * n) * (m**2 + 1 / (m * n))))


def strip():
    points, elements, layer = bricks((30, 1, 2), (LENGTH, WIDTH, 2.0))
    points[:, 2] = np.interp(points[:, 2], [0.0, 1.0, 2.0], [0.0, THICK[0], sum(THICK)])
    return points, elements, layer


def strip_curvature(points, moved):
    """That of the lower edge, away from the ends."""
    x, y, z = points.T
    edge = (y == 0.0) & (z == 0.0) & (np.abs(x - LENGTH / 2) < LENGTH / 4)
    return 2.0 * np.polyfit(x[edge], moved[edge, 2], 2)[0]


def test_a_strip_of_two_metals_curves_as_timoshenko_says():
    points, elements, layer = strip()
    body = Solid("strip", points, {"hexahedron20": elements}, {"hexahedron20": layer})
    warmer = np.full((1, len(points)), 50.0)
    (found,) = expanded(body, warmer, [BRASS, INVAR])
    exact = timoshenko(BRASS, INVAR, 50.0)
    assert abs(exact) > 1e-2  # 1/m: the strip bends by 0.3 mm
    assert strip_curvature(points, found) == pytest.approx(exact, rel=1e-7)
    # The sides of equal expansion stay straight, whatever their moduli.
    (found,) = expanded(body, warmer, [BRASS, Material(19e-6, 0.0, 1.0)])
    assert abs(strip_curvature(points, found)) < 1e-9


def test_the_center_of_mass_of_several_materials_stays():
    """Of a heavy and a light half, each of which grows about the other."""
    points, elements, layer = bricks((1, 1, 2), (0.1, 0.1, 0.2))
    body = Solid("halves", points, {"hexahedron20": elements}, {"hexahedron20": layer})
    heavy, light = Material(ALPHA, 0.3, density=3.0), Material(ALPHA, 0.3, density=1.0)
    (found,) = expanded(body, np.full((1, len(points)), 30.0), [heavy, light])
    center = np.array([0.05, 0.05, (3.0 * 0.05 + 0.15) / 4.0])
    assert_allclose(found, 30.0 * ALPHA * (points - center), rtol=0, atol=1e-15)


def write_strip(folder, form):
    """The strip as a deck, its upper metal a set (or property 2) of elements, warm by 50 K."""
    points, elements, layer = strip()
    if form == ".inp":
        lines = ["*NODE", *(f"{k}, {x!r}, {y!r}, {z!r}" for k, (x, y, z) in enumerate(points.tolist(), 1))]
        for number in (0, 1):
            lines.append(f"*ELEMENT, TYPE=C3D20R, ELSET=LAYER{number}")
            for k in np.flatnonzero(layer == number):
                nodes = [str(node + 1) for node in elements[k]]
                lines += [f"{k + 1}, {', '.join(nodes[:10])},", ", ".join(nodes[10:])]
        lines += ["*ELSET, ELSET=UPPER", "LAYER1", "*ELSET, ELSET=BOTH, GENERATE", f"1, {len(elements)}"]
        lines += ["*ELSET, ELSET=NONE", "9999"]
    else:
        order = [*range(12), 16, 17, 18, 19, 12, 13, 14, 15]  # Nastran's, see its CHEXA
        lines = ["BEGIN BULK"]
        lines += [f"GRID,{k},,{x:.9f},{y:.9f},{z:.9f}" for k, (x, y, z) in enumerate(points.tolist(), 1)]
        for k, nodes in enumerate(elements):
            fields = [k + 1, layer[k] + 1, *(nodes[order] + 1)]
            rows = [",".join(map(str, fields[i : i + 8])) for i in range(0, len(fields), 8)]
            lines += [f"CHEXA,{rows[0]}", *(f",{row}" for row in rows[1:])]
        lines.append("ENDDATA")
    (folder / f"strip{form}").write_text("\n".join(lines) + "\n")
    rows = [f"{k},70" for k in range(1, len(points) + 1)]
    (folder / "warm.csv").write_text("\n".join(["node,temperature_c", *rows]) + "\n")
    return folder / "warm.csv", folder / f"strip{form}"


def of_metals(upper, **changed):
    first = {"expansion_per_k": 19e-6, "poisson_ratio": 0.0, "youngs_modulus_gpa": 105.0, "reference": 20.0}
    second = {"elements": upper, "expansion_per_k": 1e-6, "poisson_ratio": 0.0, "youngs_modulus_gpa": 140.0}
    return Thermal(**first, material=[second | changed])


@pytest.mark.parametrize(("form", "upper"), [(".inp", "upper"), (".inp", ["LAYER1"]), (".bdf", 2)])
def test_materials_of_element_sets_of_a_deck(tmp_path, form, upper):
    warm, mesh = write_strip(tmp_path, form)
    found = thermal_displacements(warm, "m", mesh, of_metals(upper))
    assert strip_curvature(found.points, found.motions[0]) == pytest.approx(
        timoshenko(BRASS, INVAR, 50.0), rel=1e-7
    )


@pytest.mark.parametrize(
    ("thermal", "words"),
    [
        (of_metals("UPER"), "strip.inp has no element set 'UPER' .thermal.material., did you mean UPPER"),
        (
            of_metals("UPPER", youngs_modulus_gpa=None),
            "youngs_modulus_gpa is needed of each of several materials",
        ),
        (of_metals("UPPER", density_kg_m3=8100.0), "density_kg_m3 is needed of each of several materials"),
        (of_metals("NONE"), "NONE of strip.inp .thermal.material. holds none of its solid elements"),
    ],
)
def test_materials_that_are_not_known_are_said(tmp_path, thermal, words):
    warm, mesh = write_strip(tmp_path, ".inp")
    with pytest.raises(UserError, match=words):
        thermal_displacements(warm, "m", mesh, thermal)


# The same metals as each program writes them, in N, m and kg; densities only say where the strip stays.
OWN = {
    ".inp": "*MATERIAL, NAME=Brass\n*ELASTIC\n105e9, 0.\n*EXPANSION, ZERO=20.\n19e-6,\n*DENSITY\n8500.\n"
    "*MATERIAL, NAME=Invar\n*ELASTIC, TYPE=ISO\n140e9, 0., 0.\n140e9, 0., 100.\n*EXPANSION\n1e-6, 100.\n"
    "*DENSITY\n8100.\n*SOLID SECTION, ELSET=Layer0, MATERIAL=brass\n"
    "*SOLID SECTION, MATERIAL=Invar, ELSET=LAYER1\n",
    ".bdf": "PSOLID,1,7\nPSOLID,2,8\nMAT1,7,105.+9,52.5+9,,8500.,1.9-5\nMAT1,8,,70.+9,0.,8100.,1.-6,20.\n",
}


def with_materials(mesh, form, old="", new=""):
    assert old in OWN[form]
    text = mesh.read_text().removesuffix("ENDDATA\n")
    mesh.write_text(text + OWN[form].replace(old, new) + "ENDDATA\n" * (form == ".bdf"))
    return mesh


@pytest.mark.parametrize("form", OWN)
def test_materials_of_a_deck_itself_curve_a_strip_as_timoshenko_says(tmp_path, form):
    warm, mesh = write_strip(tmp_path, form)
    found = thermal_displacements(warm, "m", with_materials(mesh, form), Thermal(reference=20))
    exact = timoshenko(BRASS, INVAR, 50.0)
    assert strip_curvature(found.points, found.motions[0]) == pytest.approx(exact, rel=1e-7)
    assert "has expansion 1.9e-05, Poisson's ratio 0, E 1.05e+11, density 8500; " in found.note


@pytest.mark.parametrize(("form", "upper"), [(".inp", "UPPER"), (".bdf", 2)])
def test_what_a_study_says_of_elements_counts_before_their_deck(tmp_path, form, upper):
    """Copper (17e-6/K) in the place of the invar's expansion; all else stays the deck's."""
    warm, mesh = write_strip(tmp_path, form)
    given = Thermal(reference=20, material=[{"elements": upper, "expansion_per_k": 17e-6}])
    found = thermal_displacements(warm, "m", with_materials(mesh, form), given)
    exact = timoshenko(BRASS, Material(17e-6, 0.0, 140.0), 50.0)
    assert strip_curvature(found.points, found.motions[0]) == pytest.approx(exact, rel=1e-7)
    assert "1e-06" not in found.note


@pytest.mark.parametrize(
    ("form", "old", "new", "given", "words"),
    [
        (".inp", "1e-6, 100.", "1e-6, 0.\n2e-6, 100.", {}, "expansion_per_k is missing: that of INVAR in "
         "strip.inp depends on the temperature"),
        (".inp", "*EXPANSION, ZERO=20.\n19e-6,\n", "", {}, "that of BRASS in strip.inp is not there"),
        (".inp", "TYPE=ISO", "TYPE=ORTHO", {}, "youngs_modulus_gpa .* INVAR .* is of the type ORTHO"),
        (".inp", "*SOLID SECTION, ELSET=Layer0, MATERIAL=brass\n", "", {}, "has no material of some of its"),
        (".inp", "8100.", "0.", {}, "INVAR has density_kg_m3 = 0, which must be between 0 and inf"),
        (".inp", "1e-6, 100.", "", {}, "EXPANSION has no numbers"),
        (".inp", "", "", {"youngs_modulus_gpa": 100.0, "elements": "UPPER"}, "given and of others the deck"),
        (".bdf", "MAT1,8", "MATT1,8,,,,,3\nMAT1,8", {}, "MAT1 8 in strip.bdf depends on the temperature"),
        (".bdf", "MAT1,8", "MAT9,8", {}, "that of MAT9 8 in strip.bdf is not of an isotropic material"),
        (".bdf", "1.9-5", "1.9x", {}, "'1.9X' is not a number"),
    ],
)  # fmt: skip
def test_materials_of_a_deck_that_do_not_say_enough(tmp_path, form, old, new, given, words):
    warm, mesh = write_strip(tmp_path, form)
    thermal = Thermal(reference=20, material=[given] if given else [])
    with pytest.raises(UserError, match=words):
        thermal_displacements(warm, "m", with_materials(mesh, form, old, new), thermal)
