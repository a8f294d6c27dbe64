"""Bodies from files: matrices and tables of modes against the beams that they are of, an imported plate."""

from pathlib import Path

import numpy as np
import pytest
import scipy.linalg
from small_bodies import OPTICS, SLOW, drawn, shaken, study_of

from wavequake.errors import UserError
from wavequake.mechanics.assembly.answers import STANDARD_GRAVITY
from wavequake.mechanics.assembly.beams import Tube, beam_frame
from wavequake.mechanics.mirrors.material import Material
from wavequake.workflows.systems.disturbance import prepare

# A camera on a mast of one tube, given as beams, as their matrices, and as all of their modes.
MAST = """
[[body]]
name = "mast"
[body.beams]
diameter_mm = 40.0
wall_mm = 2.0
members = [["foot", "top"]]
pieces = 2
masses_kg = { top = 1.5 }
carries = { image = "top" }
[body.beams.nodes_mm]
foot = [50.0, 0.0, 200.0]
top = [50.0, 0.0, -1000.0]
[[link]]
name = "weld"
kind = "rigid"
joins = [["mast.foot", "ground"]]
"""
TOP = shaken(
    'model = "body-force"\nat = ["mast.top"]\ndirection = [1.0, 2.0, 3.0]\n'
    "lines = [{ frequency_hz = 20.0, force_n = 0.5 }]"
)


def mast_matrices():
    points = {"foot": np.array([0.05, 0.0, 0.2]), "top": np.array([0.05, 0.0, -1.0])}
    model = beam_frame(
        "mast", points, [("foot", "top")], Tube(0.04, 0.002), Material(70e9, 0.33, 2700.0), 2, {"top": 1.5}
    )
    return model.mass.toarray(), model.stiffness.toarray(), 1e3 * np.array(list(points.values()))


def as_matrices(mass, stiffness, nodes):
    moves = np.hstack([np.eye(18)[:, :3], np.eye(18)[:, 6:9]])
    turns = np.hstack([np.eye(18)[:, 3:6], np.eye(18)[:, 9:12]])
    return {"mass": mass, "stiffness": stiffness, "nodes_mm": nodes, "inputs": moves, "turns": turns}


def as_modes(mass, stiffness, nodes):
    squared, shapes = scipy.linalg.eigh(stiffness, mass)
    squared[:6] = 0.0
    shown = shapes[:12].T.reshape(18, 2, 6)
    return {
        "frequencies_hz": np.sqrt(squared) / (2.0 * np.pi),
        "damping_ratios": np.array(0.0),
        "nodes_mm": nodes,
        "shapes": shown,
    }


@pytest.mark.parametrize(("kind", "made"), [("matrices", as_matrices), ("modes", as_modes)])
def test_own_matrices_and_tables_of_modes_are_the_beams_that_they_are_of(tmp_path, kind, made):
    beams = drawn(study_of(tmp_path, OPTICS, MAST, TOP))[1].rigid["image"]
    np.savez(tmp_path / "mast.npz", names=np.array(["foot", "top"]), **made(*mast_matrices()))
    body = f'[[body]]\nname = "mast"\n[body.{kind}]\nfile = "mast.npz"\ncarries = {{ image = "top" }}\n'
    weld = MAST[MAST.index("[[link]]") :]
    found = drawn(study_of(tmp_path, OPTICS, body, weld, TOP))[1].rigid["image"]
    np.testing.assert_allclose(found, beams, rtol=1e-6, atol=1e-8 * np.abs(beams).max())


def test_a_surface_moves_with_a_node_beside_it(tmp_path):
    """The image stands 50 mm beside the top of the mast: turns about z move it along y by the lever."""
    moved = drawn(study_of(tmp_path, OPTICS, MAST, TOP))[1].rigid["image"]
    keys = 'model = "base-motion"\nlines = [{ frequency_hz = 1e-3, amplitude = { rz_urad = 2.0 } }]'
    slow = drawn(study_of(tmp_path, OPTICS, MAST, shaken(keys)))[1].rigid["image"]
    assert np.abs(moved).max() > 0.0
    np.testing.assert_allclose(slow[:, :3], 0.0, atol=1e-12)  # the vertex is on the axis of the turn
    assert np.abs(slow[:, 5]).max() <= 2.0001e-6


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"mass": None}, "lacks the array 'mass'"),
        ({"extra": np.zeros(3)}, "holds 'extra', which means nothing"),
        ({"stiffness": np.eye(17)}, "'stiffness' of the body 'mast' has the shape"),
        ({"stiffness": np.triu(np.ones((18, 18)))}, "'stiffness' of the body 'mast' is not symmetric"),
        ({"mass": -np.eye(18)}, "is not positive definite"),
        ({"inputs": np.full((18, 6), np.nan)}, "no finite number"),
        ({"names": np.array(["top", "top"])}, "must be 2 different ones"),
        ({"turns": None}, "'top', which has no rotations"),
    ],
)
def test_bad_arrays_are_said(tmp_path, change, words):
    arrays = as_matrices(*mast_matrices()) | {"names": np.array(["foot", "top"])} | change
    np.savez(tmp_path / "mast.npz", **{name: one for name, one in arrays.items() if one is not None})
    body = '[[body]]\nname = "mast"\n[body.matrices]\nfile = "mast.npz"\ncarries = { image = "top" }\n'
    with pytest.raises(UserError, match=words):
        prepare(study_of(tmp_path, OPTICS, body, MAST[MAST.index("[[link]]") :], TOP))


DATA = Path(__file__).parents[1] / "data"
PLATE = f"""
[[body]]
name = "plate"
surfaces = ["M1"]
[body.imported]
file = "{DATA / "plate.sti"}"
units = "m,kg,s,N"
interfaces = "INTERFACES"
surface = "SURFACE"
figure_terms = 4
[[link]]
name = "feet"
kind = "springs"
joins = [["plate.1", "ground"], ["plate.2", "ground"], ["plate.3", "ground"]]
stiffness_n_m = 1e4
"""


def test_an_imported_plate_hangs_on_its_springs(tmp_path):
    """20 mm of aluminum, 1 m wide: m g / 3 k; what it bends beside that is a thousand times less."""
    wide = OPTICS.replace("-2000.0", "-20000.0").replace("= 1000.0", "= 10000.0").replace("55.0", "500.0")
    keys = 'model = "gravity"\nelevation_deg = [90.0, 80.0]\naligned_deg = 0.0\ndown = [1.0, 0.0, 0.0]'
    study = study_of(tmp_path, wide, PLATE, shaken(keys), system__entrance_diameter_mm=900.0)
    sag = drawn(study)[1].rigid["plate"][0]
    weight = 2700.0 * np.pi / 4.0 * 0.02 * STANDARD_GRAVITY
    assert sag[2] == pytest.approx(weight / 3e4, rel=2e-3)
    assert abs(sag[0]) == pytest.approx(weight / 3e4, rel=0.05)  # at its rim, and it tilts


def test_what_is_wrong_with_an_imported_body_is_said(tmp_path):
    for change, words in (
        (
            {"units": "unit"},
            "'body.plate.imported.unit' is unknown; the nearest valid key is 'units'",
        ),
        ({'units = "m,kg,s,N"': ""}, "body.plate.imported.units: is missing"),
        ({"plate.sti": "plat.sti"}, "plat.sti"),
    ):
        text = PLATE
        for old, new in change.items():
            text = text.replace(old, new)
        with pytest.raises(UserError, match=words):
            study_of(tmp_path, OPTICS, text, SLOW)
