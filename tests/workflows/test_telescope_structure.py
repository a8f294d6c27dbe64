"""Bodies of mass in studies of optical systems, against closed forms, dense sums and geometry."""

import numpy as np
import pytest
from small_bodies import (
    CAMERA,
    CELL,
    ELASTIC,
    FEET,
    OPTICS,
    RIGID,
    SLOW,
    SPRINGS,
    WELD,
    Z_FORCE,
    amplitude,
    drawn,
    floor,
    shaken,
    study_of,
)

from wavequake.errors import UserError
from wavequake.kernels.device.devices import NUMPY
from wavequake.mechanics.assembly.answers import STANDARD_GRAVITY
from wavequake.workflows.systems.bench import system_bench
from wavequake.workflows.systems.disturbance import KIND, prepare
from wavequake.workflows.systems.draws import slot_of
from wavequake.workflows.systems.measure import measured


def test_a_telescope_on_a_floor_that_tilts_slowly_points_elsewhere(tmp_path):
    """All turns as one: the star's image moves by the angle times the focal length, undistorted.

    At f/100, where the tilt of a coma is small.
    """
    study = study_of(tmp_path, OPTICS, RIGID, SLOW, system__entrance_diameter_mm=10.0)
    time, motion = drawn(study)
    turn = motion.rigid["cell"][:, 3]
    assert 0.0 < np.abs(turn).max() <= 3.001e-6
    np.testing.assert_allclose(motion.rigid["camera"][:, 3], turn, rtol=1e-6)
    # At z = -1 m the turn e about x moves the camera by e x a: its y part is e.
    np.testing.assert_allclose(motion.rigid["camera"][:, 1], turn, rtol=1e-5)
    found, trouble = measured(system_bench(study.identity_text()), time, motion, NUMPY)
    assert not trouble
    np.testing.assert_allclose(np.abs(found["los_mm"][:, 0, 0, 1]), 1000.0 * np.abs(turn), rtol=1e-5)
    assert found["wfe_change"].max() < 0.01  # nm: coma of a field angle of 3 urad


def test_the_floor_drags_springs_and_dampers_along(tmp_path):
    """Transmissibility (k + i w c) / (k - m w^2 + i w c) of 10 kg on springs of 1.6 MN/m in all."""
    study = study_of(tmp_path, OPTICS, RIGID, floor("dz_um = 5.0", 70.0))
    time, motion = drawn(study)
    own, omega = np.sqrt(4 * 4e5 / 10.0), 2.0 * np.pi * 70.0
    drag = own**2 + 2j * 0.02 * own * omega
    expected = 5e-6 * abs(drag / (drag - omega**2))
    for name in ("cell", "camera"):
        assert abs(amplitude(time, motion.rigid[name][:, 2], 70.0)) == pytest.approx(
            expected, rel=1e-9, abs=0.0
        )


def test_a_force_on_a_body_is_the_closed_form_of_an_oscillator(tmp_path):
    time, motion = drawn(study_of(tmp_path, OPTICS, RIGID, Z_FORCE))
    own, omega = np.sqrt(4 * 4e5 / 10.0), 2.0 * np.pi * 30.0
    expected = 0.5 / 10.0 / (own**2 - omega**2 + 2j * 0.02 * own * omega)
    assert abs(amplitude(time, motion.rigid["cell"][:, 2], 30.0)) == pytest.approx(
        abs(expected), rel=1e-9, abs=0.0
    )


def test_random_shaking_has_the_variance_of_the_spectrum_times_the_response(tmp_path):
    """Flat acceleration between 10 and 120 Hz, through a resonance at 64 Hz, summed densely by hand."""
    keys = 'model = "base-motion"\naxes = ["z"]\nspectrum = { rms = 0.3, low_hz = 10.0, high_hz = 120.0 }'
    study = study_of(tmp_path, OPTICS, RIGID, shaken(keys), campaign__cases=400)
    values = np.array([drawn(study, case)[1].rigid["cell"][:, 2] for case in range(400)])
    frequency = np.linspace(10.0, 120.0, 400_001)
    omega, own = 2.0 * np.pi * frequency, np.sqrt(4 * 4e5 / 10.0)
    drag = own**2 + 2j * 0.02 * own * omega
    density = 0.3**2 / 110.0 * np.abs(drag / (drag - omega**2)) ** 2 / omega**4
    expected = np.trapezoid(density, frequency)
    of_cases = np.mean(values**2, axis=1)
    error = of_cases.std(ddof=1) / np.sqrt(len(of_cases))
    assert abs(of_cases.mean() - expected) < 3.0 * error
    assert error < 0.06 * expected


def test_a_wheel_shakes_with_the_square_of_its_speed(tmp_path):
    """Imbalance m r turns as a vector across the axis: both components have the amplitude m r W^2 |H|."""
    keys = (
        'model = "reaction-wheel"\nat = "cell"\naxis = [0.0, 1.0, 0.0]\nspeed_rpm = [2100.0, 2100.0]\n'
        "harmonics = [{ number = 1.0, radial_g_mm = 50.0 }]"
    )
    time, motion = drawn(study_of(tmp_path, OPTICS, RIGID, shaken(keys)))
    own, omega = np.sqrt(4 * 4e5 / 10.0), 2.0 * np.pi * 35.0
    expected = 50e-6 * omega**2 / 10.0 / abs(own**2 - omega**2 + 2j * 0.02 * own * omega)
    along = amplitude(time, motion.rigid["cell"][:, 2], 35.0)
    across = amplitude(time, motion.rigid["cell"][:, 0], 35.0)
    assert abs(along) == pytest.approx(expected, rel=1e-9, abs=0.0)
    assert np.abs(np.real(along * np.conj(across))) < 0.9 * abs(along) * abs(across)


def test_gravity_moves_with_the_elevation(tmp_path):
    """Sag along the axis: m g (sin el - sin aligned) / k; nothing is random."""
    keys = 'model = "gravity"\nelevation_deg = [90.0, 30.0]\naligned_deg = 90.0'
    study = study_of(tmp_path, OPTICS, RIGID, shaken(keys))
    assert study.cases == 1
    _, motion = drawn(study)
    elevation = np.deg2rad(np.linspace(90.0, 30.0, 16))
    expected = 10.0 * STANDARD_GRAVITY * (np.sin(elevation) - 1.0) / (4 * 4e5)
    np.testing.assert_allclose(motion.rigid["cell"][:, 2], expected, rtol=1e-9, atol=1e-18)


def test_an_elastic_mirror_bends_under_its_weight_and_not_with_its_floor(tmp_path):
    """Slow turns strain nothing. Along its axis it sags between three mounts: trefoil, j = 10."""
    still = drawn(study_of(tmp_path, OPTICS, ELASTIC, SLOW))[1]
    assert np.abs(still.figure["M1"]).max() < 1e-12
    np.testing.assert_allclose(still.rigid["primary"][:, 4:], 0.0, atol=1e-12)
    keys = 'model = "gravity"\nelevation_deg = [90.0, 0.0]\naligned_deg = -90.0'
    figure = drawn(study_of(tmp_path, OPTICS, ELASTIC, shaken(keys)))[1].figure["M1"][0]
    trefoil = np.hypot(figure[8], figure[9])
    assert trefoil > 3.0 * np.hypot(figure[4], figure[5])
    assert figure[8] == pytest.approx(0.0, abs=1e-3 * trefoil)  # a mount lies on the x axis: cosine
    assert np.sqrt(np.sum(figure[3:] ** 2)) < 1e-6


def test_reduced_models_are_cases_beside_the_full_one(tmp_path):
    models = '[reduction]\nvariants = ["guyan", "craigb24"]\n'
    keys = 'model = "base-motion"\naxes = ["z"]\nspectrum = { rms = 1.0, low_hz = 10.0, high_hz = 600.0 }'
    study = study_of(tmp_path, OPTICS, ELASTIC, models, shaken(keys), campaign__cases=6)
    table = KIND.case_table(study.identity_text(), 0, 6)
    assert table["reduction"].tolist() == ["full", "guyan", "craigb24"] * 2
    assert table["realization"].tolist() == [0, 0, 0, 1, 1, 1]
    assert slot_of(study, 4)[1:] == (1, "guyan")
    found = KIND.compute(study.identity_text(), np.arange(6), "numpy").arrays
    wfe = found["model_error_wfe"][:, 0, 0]
    assert wfe[0] == wfe[3] == 0.0
    assert (wfe[[2, 5]] < 0.05 * wfe[[1, 4]]).all()
    full, guyan = (found["zernike"][case, :16, 0, 0] for case in (3, 4))
    by_hand = np.sqrt(np.mean(np.sum((guyan - full)[:, 3:] ** 2, axis=1)))
    assert wfe[4] == pytest.approx(by_hand, rel=1e-12)
    los = found["los_mm"][4, :16, 0, 0] - found["los_mm"][3, :16, 0, 0]
    assert found["model_error_los"][4, 0, 0] == pytest.approx(np.sqrt(np.mean(np.sum(los**2, axis=1))))


def test_all_models_of_a_draw_are_shaken_alike(tmp_path):
    """The floor moves the mirror in the same way, whichever model bends on it."""
    models = '[reduction]\nvariants = ["guyan", "craigb15"]\n'
    keys = 'model = "base-motion"\nspectrum = { rms = 1.0, low_hz = 10.0, high_hz = 1500.0 }'
    study = study_of(tmp_path, OPTICS, ELASTIC, models, shaken(keys), campaign__cases=3)
    full, *others = (drawn(study, case)[1].rigid["primary"][:, :3] for case in range(3))
    for one in others:
        np.testing.assert_allclose(one, full, atol=0.05 * np.abs(full).max())


@pytest.mark.parametrize(
    ("parts", "words"),
    [
        ((CELL, SLOW), "has no elastic motion; join its bodies"),
        ((CELL, FEET.replace('["cell.b", "ground"], ["cell.c", "ground"], ', ""), SLOW), "1 motion without"),
        ((CELL, FEET, CAMERA, SLOW), "'camera' of the structure of bench has no support"),
        ((CELL, CAMERA, FEET, WELD.replace("cell.a", "cel.a"), SLOW), "no body; did you mean 'cell'"),
        ((RIGID, SLOW.replace("base-motion", "base-motions")), "there is no model 'base-motions'"),
        ((RIGID, Z_FORCE.replace('"cell"', '"cell.x"')), "acts at 'cell.x', which is no node"),
        ((Z_FORCE,), "acts on bodies with mass, but this study has none"),
        ((FEET, Z_FORCE), "is of bodies with mass, but there are none"),
        ((RIGID.replace('surfaces = ["image"]', 'surfaces = ["M1"]'), SLOW), "is carried by the bodies"),
        ((RIGID.replace('surfaces = ["image"]', 'surfaces = ["imag"]'), SLOW), "did you mean 'image'"),
        ((RIGID.replace("mass_kg = 2.0", "mass_kg = -2.0"), SLOW), "body.camera.rigid.mass_kg"),
        ((RIGID.replace("[1.0, 1.0, 1.0]", "[1.0, 1.0, 3.0]"), SLOW), "belong to no mass"),
        ((RIGID + "surfaces = 3", SLOW), "the key 'structure.surfaces' is unknown"),
        ((RIGID, '[reduction]\nvariants = ["craigb24"]\n', SLOW), "no body is a mirror or imported"),
        ((ELASTIC, '[reduction]\nvariants = ["craig24"]\n', SLOW), "no reduction method 'craig'"),
        ((ELASTIC, '[reduction]\nvariants = ["craigb4"]\n', SLOW), "The body 'primary': "),
        ((ELASTIC.replace("rings", "diameter_m = 0.05\nrings"), SLOW), "make it larger"),
        ((ELASTIC.replace("= 4\nfigure_terms = 11", "= 2\nfigure_terms = 231"), SLOW), "behind 'M1': "),
        ((ELASTIC, SLOW.replace("lines", "axes = ['z', 'z']\nlines")), "names an axis twice"),
    ],
)  # fmt: skip
def test_what_is_wrong_with_bodies_is_said(tmp_path, parts, words):
    with pytest.raises(UserError, match=words):
        prepare(study_of(tmp_path, OPTICS, *parts))


def test_what_nothing_holds_floats(tmp_path):
    """Two bodies on springs in space: a force moves them about their center of mass."""
    springs = """
[[link]]
name = "springs"
kind = "springs"
joins = [["cell.a", "camera"], ["cell.b", "camera"], ["cell.c", "camera"], ["cell.d", "camera"]]
stiffness_n_m = 1e5
"""
    study = study_of(tmp_path, OPTICS, CELL, CAMERA, springs, Z_FORCE)
    time, motion = drawn(study)
    cell, camera = (motion.rigid[name][:, 2] for name in ("cell", "camera"))
    np.testing.assert_allclose(8.0 * cell + 2.0 * camera, 0.0, atol=1e-9 * np.abs(8.0 * cell).max())
    own, omega = np.sqrt(4e5 / 1.6), 2.0 * np.pi * 30.0  # reduced mass 8 2 / 10
    stretch = 0.5 / 8.0 / abs(own**2 - omega**2 + 2j * 0.01 * own * omega)
    assert abs(amplitude(time, cell - camera, 30.0)) == pytest.approx(stretch, rel=1e-9, abs=0.0)
    with pytest.raises(UserError, match="stands on the ground"):
        prepare(study_of(tmp_path, OPTICS, CELL, CAMERA, springs, SLOW))


LENS = """
[study]
name = "lens"
workflow = "system-disturbance"
[system]
name = "double-gauss"
[[body]]
name = "L4"
surfaces = ["surface 10", "surface 11"]
[body.rigid]
mass_kg = 1.0
inertia_kg_m2 = [1e-3, 1e-3, 1e-3]
center_mm = [3.0, 40.0, 90.0]
""" + SPRINGS.replace("BODY", "L4")


@pytest.mark.parametrize(
    ("text", "name"),
    [
        (LENS, "L4"),
        (
            OPTICS + ELASTIC.replace("[body.mirror]", "about_mm = [20.0, -30.0, 40.0]\n[body.mirror]"),
            "primary",
        ),
    ],
)
def test_a_body_turns_about_its_own_point(tmp_path, text, name):
    """On a floor that turns slowly by e, every point p moves by e x p; so does where a body turns about."""
    study = study_of(tmp_path, text, floor("rx_urad = 3.0, ry_urad = 2.0, rz_urad = 1.0"))
    bench = system_bench(study.identity_text())
    point = bench.bodies[0].point / 1e3
    moved = drawn(study)[1].rigid[name]
    np.testing.assert_allclose(moved[:, :3], np.cross(moved[:, 3:], point), rtol=1e-6, atol=1e-12)
    assert np.abs(moved[:, :3]).max() > 1e-8
