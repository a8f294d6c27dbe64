"""Numbers and sections that make no sense: one sentence, and no warning of a library, where they are used."""

import warnings

import numpy as np
import pytest
from small_bodies import ELASTIC, OPTICS, RIGID, SLOW

from wavequake.errors import UserError
from wavequake.report.table import difference
from wavequake.words import MOST, plain
from wavequake.workflows.run import kind_of
from wavequake.workflows.study import load_study

NEWTON = """
[study]
name = "newton"
workflow = "system-disturbance"
[system]
name = "newton"
entrance_diameter_mm = 200.0
wavelengths_nm = [550.0]
[[system.surface]]
name = "M1"
radius_mm = -2000.0
conic = -1.0
glass = "mirror"
semi_diameter_mm = 100.0
stop = true
{keys}
[[system.surface]]
name = "flat"
distance_mm = 800.0
tilt_deg = [45.0, 0.0, 0.0]
glass = "mirror"
fold = true
[[system.surface]]
name = "image"
distance_mm = 200.0
[[disturbance]]
name = "shift"
model = "surface-random"
of = ["M1"]
rms = {{ dx_um = 1.0 }}
[optics]
rays = 60
[wavefront]
zernike_terms = 11
[campaign]
cases = 1
device = "numpy"
"""
TELESCOPE = """
[study]
name = "telescope"
workflow = "{workflow}"
[telescope]
name = "{name}"
[[disturbance]]
name = "one"
model = "{model}"
[optics]
rays_per_segment = 6
{optics}
[wavefront]
zernike_terms = 11
[imaging]
pixels = 8
[campaign]
cases = 1
device = "numpy"
{more}
"""


def attempt(path):
    """Prepare a study and compute its first case."""
    warnings.simplefilter("error")
    study = load_study(path)
    kind, identity = kind_of(study), study.identity_text()
    kind.check(identity)
    list(kind.notices(identity))
    found = kind.compute(identity, np.arange(1), "numpy")
    raise UserError("; ".join(message for message in found.messages if message))


def said(folder, text):
    """What a study of this text is refused with, before or in its first case; no warning is given."""
    path = folder / "senseless.toml"
    path.write_text(text)
    with warnings.catch_warnings(), pytest.raises(UserError) as error:
        attempt(path)
    words = str(error.value)
    assert words
    assert len(words) <= MOST
    assert plain(words) == words
    return words


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ("phase = { lines_per_mm = 1e300, order = 1.0 }", "choose another order or fewer grooves"),
        ("phase = { lines_per_mm = 1.0, order = -1e300 }", "choose another order or fewer grooves"),
        ("phase = { radial_rad = [1e300], radius_mm = 10.0 }", "they miss it; make the field smaller"),
        ("phase = { focal_length_mm = 1e-320 }", "its size must be 1e-09 mm at least"),
        ("tilt_deg = [1e300, 0.0, 0.0]", "less than or equal to 360"),
        ("even_asphere = [nan]", "should be a finite number"),
        ("even_asphere = 3.0", "even_asphere: input should be a list"),
        ("zernike_nm = { 5 = 1.0 }", "zernike_nm: input should be a list"),
        ("biconic_radius_mm = 1e-320", "the size of the radius must be 1e-09 mm at least"),
        ("toroid_radius_mm = -1.0", "folds over"),
        ("toroid_coefficients = [1.0]", "the key 'system.surface.M1.toroid_radius_mm' is missing"),
        ("sag_file = '/dev/zero'\nsag_spacing_mm = [1.0, 1.0]", "must be a .csv, .npy or .dat file"),
        ("qbfs_mm = [1e300]\nnormalization_radius_mm = 100.0", ""),
        ("gradient_radial = [0.1]", "needs the glass, or the index, to which its gradient adds"),
        ("arms = 5.0", "arms: input should be a list"),
        ("decenter_mm = [1e300, 0.0]", ""),
    ],
)
def test_surfaces_that_cannot_be(tmp_path, keys, words):
    assert words in said(tmp_path, NEWTON.format(keys=keys))


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ({"name": "gmt", "model": "edge-sensor-noise"}, "leave the sensors out, or take another telescope"),
        ({"optics": "fields_arcmin = [[500.0, 0.0]]"}, "bring optics.fields_arcmin nearer"),
        ({"optics": "field_arcmin = [500.0, 0.0]"}, "bring optics.field_arcmin nearer"),
        ({"optics": "light = 'modal'"}, "set imaging.enabled = false"),
        ({"more": "[segment]\nthickness_m = 0.05"}, "add such a disturbance"),
        ({"more": "[system]\nname = 'euv'"}, "the key 'system' is unknown"),
        ({"more": "[[body]]\nname = 'b'"}, "'b' has neither surfaces nor one of"),
        ({"more": "[structure]\nfile = 'x'"}, "the key 'structure.file' is unknown"),
        ({"more": "[detector]\npixel_um = 1e-320"}, "detector.photons"),
        ({"workflow": "telescope-loop"}, "the key 'controller' is missing"),
        ({"workflow": "segment-control"}, "the key 'mode' is missing"),
        ({"name": "keck-3"}, "'keck', 'gtc', 'het', 'gmt'"),
        ({"model": "segment-shaking"}, "shakes nothing"),
        ({"model": "pattern-vibration"}, "pattern' is missing"),
    ],
)
def test_telescopes_with_what_does_not_belong_to_them(tmp_path, keys, words):
    usual = {"workflow": "segment-disturbance", "name": "gtc", "model": "static-random"}
    assert words in said(tmp_path, TELESCOPE.format(**{**usual, "optics": "", "more": "", **keys}))


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("mass_kg = 8.0", "mass_kg = 1e300", "less than or equal to 1000000000"),
        (
            "[2.0, 3.0, 4.0]",
            "[1e300, 1e300, 1e300]",
            "inertia_kg_m2.0: input should be less than or equal to",
        ),
        ("[2.0, 3.0, 4.0]", "[2.0, 1e9, 4.0]", "belong to no mass"),
        ("a = [300.0, 0.0, 0.0]", "a = [-1e300, 0.0, 0.0]", "greater than or equal to -10000000"),
        (
            "mass_kg = 8.0",
            "mass_kg = 8.0\ncenter_mm = [1e300, 0.0, 0.0]",
            "center_mm.0: input should be less",
        ),
        (
            'surfaces = ["M1"]',
            'surfaces = ["M1"]\nabout_mm = [0.0, 1e300, 0.0]',
            "about_mm.1: input should be",
        ),
        ("[2e5, 3e5, 4e5]", "[1e300, 3e5, 4e5]", "'feet' needs stiffnesses and dampings from 0 to 1e+18"),
        ("[2e5, 3e5, 4e5]", "1e5\ndamping_n_s_m = -1.0", "'feet' needs stiffnesses and dampings from 0 to"),
        ("thickness_m = 0.004", "thickness_m = 1e300", "less than or equal to 100"),
        ("thickness_m = 0.004", "thickness_m = 0.004\nyoungs_modulus_pa = 1e300", "less than or equal to"),
        ("thickness_m = 0.004", "thickness_m = 0.004\ndensity_kg_m3 = 1e-320", "greater than or equal to"),
    ],
)
def test_bodies_that_cannot_be(tmp_path, old, new, words):
    bodies = ELASTIC if old in ELASTIC and old not in RIGID else RIGID
    assert words in said(tmp_path, OPTICS + bodies.replace(old, new, 1) + SLOW)


@pytest.mark.parametrize("key", ["actuator_radius_m", "arm_m", "offset_m", "servo_hz", "sensor_nm"])
@pytest.mark.parametrize("value", ["nan", "-1", "1e300", "[]", "'x'"])
def test_mirrors_that_edge_sensors_cannot_hold(key, value):
    if (key, value) in {("offset_m", "1e300"), ("servo_hz", "1e300"), ("sensor_nm", "1e300")}:
        pytest.skip("refused where the mirror is made, which takes seconds")
    with pytest.raises(UserError, match=f"mirror.{key}"):
        load_study("tmt-m1-control", [f"mirror.{key}={value}"])


def test_equal_cases_do_not_differ_by_a_negative_nothing():
    assert difference(-1e-15, 0.0, 5.0, 1e-15) == ("none", "none")
    assert difference(-1e-6, 2e-6, 5.0, 1e-5) == ("-1.00e-06 ± 2.00e-06", "< 0.01%")
    assert difference(0.5, np.nan, 5.0, 0.6) == ("0.500", "+10.00%")
