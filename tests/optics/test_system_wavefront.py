import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from wavequake.errors import UserError
from wavequake.kernels.device.devices import NUMPY
from wavequake.optics.catalog.names import optical_system
from wavequake.optics.media.glasses import constant
from wavequake.optics.rays.pupils import sunflower
from wavequake.optics.segments.catalog import telescope
from wavequake.optics.segments.parent import parent_system
from wavequake.optics.shapes.shapes import Conic, Opening, ZernikeDeformation
from wavequake.optics.systems.kinematics import SurfaceRow, rest_states, sequential
from wavequake.optics.systems.system import OpticalSystem, Pupil, States, Surface
from wavequake.optics.wavefronts.fits import fit_instants
from wavequake.optics.wavefronts.wavefront import measure_system, prepare_system, trace_system

DATA = json.loads((Path(__file__).parents[1] / "data" / "tmt_optics.json").read_text())
FOCAL_LENGTH, RADIUS = 1700.0, 500.0


def quadrature(obscuration, radii=24, azimuths=96):
    """Gauss-Legendre in r^2 and even azimuths over the unit annulus."""
    node, weight = np.polynomial.legendre.leggauss(radii)
    inner = obscuration**2
    r = np.sqrt(inner + (1 - inner) * (node + 1) / 2)
    angle = 2 * np.pi * (np.arange(azimuths) + 0.5) / azimuths
    x, y = np.outer(r, np.cos(angle)).ravel(), np.outer(r, np.sin(angle)).ravel()
    return x, y, np.repeat(weight, azimuths)


def parabola(deformation=None, opening=None):
    mirror = Surface(
        "mirror",
        Conic(-2 * FOCAL_LENGTH, -1.0),
        action="reflect",
        opening=opening,
        deformation=deformation,
    )
    image = Surface("image", position=np.array([0.0, 0.0, -FOCAL_LENGTH]))
    return OpticalSystem("parabola", (mirror, image), 0, Pupil("entrance_diameter", 2 * RADIUS))


@pytest.fixture(scope="module")
def tmt():
    arcmin = np.pi / 180 / 60
    system = replace(parent_system(telescope("tmt-thesis")), fields=np.array([[0.0, 0.0], [5 * arcmin, 0.0]]))
    return [prepare_system(system, *quadrature(system.pupil.obscuration), 45, field) for field in (0, 1)]


@pytest.mark.parametrize("field", [0, 1])
def test_fields_of_the_tmt(tmt, field):
    truth = DATA["fields"][field]
    found = measure_system(tmt[field], rest_states(tmt[field].system), NUMPY)
    assert found.zernike[0] == pytest.approx(truth["c_noll_annular"], abs=1e-6)
    assert found.rms[0] == pytest.approx(truth["wfe_rms_j4up"], abs=1e-6)
    assert found.rms_raw[0] == pytest.approx(truth["wfe_rms_piston_removed"], abs=1e-6)
    assert found.chief[0, 0] == pytest.approx(1e3 * truth["chief_x_m"], abs=1e-7)
    assert found.spot_rms[0] == pytest.approx(1e3 * truth["rms_spot_radius_m"], rel=2e-6)
    assert found.lost[0] == 0


@pytest.mark.parametrize(("name", "dof", "step"), [("alpha", 3, 1e-6), ("dz", 2, 1e-3)])
def test_motions_of_m2_move_image_and_wavefront(tmt, name, dof, step):
    prepared, truth = tmt[0], DATA["m2_rigid_per_m_or_rad"][name]
    states = rest_states(prepared.system, 2)
    place = [surface.name for surface in prepared.system.surfaces].index("M2")
    states.surface_motion[:, place, dof] = step, -step
    found = measure_system(prepared, states, NUMPY)
    slope = {key: (getattr(found, key)[0] - getattr(found, key)[1]) / (2 * step) for key in ("chief", "los")}
    zernike = (found.zernike[0] - found.zernike[1]) / (2 * step)
    per_m = 1e3 if dof < 3 else 1.0  # steps are in mm and rad
    scale = np.abs(truth["c_noll_annular_waves"]).max()
    assert zernike * per_m == pytest.approx(np.array(truth["c_noll_annular_waves"]), abs=3e-6 * scale)
    to_m = 1e-3 * per_m
    assert slope["chief"] * to_m == pytest.approx(truth["chief"], abs=1e-5)
    # Eq. 4.24: 85460 mm/rad.
    assert slope["los"] * to_m == pytest.approx(truth["LOS_339_annular_over_sqrt1pe2"], abs=2e-5)


def test_a_parabola_is_perfect_on_axis():
    system = parabola()
    prepared = prepare_system(system, *quadrature(0.0), 21)
    found = measure_system(prepared, rest_states(system), NUMPY)
    assert found.rms_raw[0] < 1e-8
    assert found.pv[0] < 1e-8
    assert np.abs(found.los).max() < 1e-9
    assert found.spot_rms[0] < 1e-9


def test_a_focus_that_moves_is_the_closed_form():
    """Focus and image apart by d along the light: OPD = -d (1 - cos) of the ray's angle, to first order."""
    system, shift = parabola(), 1e-3
    prepared = prepare_system(system, *quadrature(0.0), 21)
    states = rest_states(system)
    states.surface_motion[0, 0, 2] = -shift  # the light comes back along -z
    opd, traced, _ = trace_system(prepared, states, NUMPY)
    t = np.hypot(*prepared.pupil.T) * RADIUS / (2 * FOCAL_LENGTH)
    expected = -shift * 2 * t**2 / (1 + t**2) / prepared.wavelength
    assert opd[0] == pytest.approx(expected, abs=1e-5)
    assert np.isfinite(traced.path).all()


def test_a_tilted_parabola_moves_its_image_by_twice_the_angle():
    system, angle = parabola(), 1e-7
    prepared = prepare_system(system, *quadrature(0.0), 21)
    states = rest_states(system, 2)
    states.surface_motion[:, 0, 3:5] = [[angle, 0.0], [0.0, angle]]
    found = measure_system(prepared, states, NUMPY)
    assert found.chief == pytest.approx(
        np.array([[0.0, 1.0], [-1.0, 0.0]]) * 2 * angle * FOCAL_LENGTH * np.sign(found.chief[0, 1]), abs=1e-9
    )
    # Coma makes the best-fit plane differ from the chief ray, but only by a few percent of it.
    assert np.abs(found.los - found.chief).max() < 0.05 * np.abs(found.chief).max()


def test_a_line_of_sight_on_the_sky_is_seen_in_the_image():
    system, angle = parabola(), 1e-6
    prepared = prepare_system(system, *quadrature(0.0), 21)
    states = replace(rest_states(system, 2), line_of_sight=np.array([[angle, 0.0], [0.0, angle]]))
    found = measure_system(prepared, states, NUMPY)
    assert np.abs(found.chief) == pytest.approx(angle * FOCAL_LENGTH * np.eye(2), rel=1e-6, abs=1e-12)


def test_a_deformation_lengthens_paths_by_twice_its_height_along_the_normal():
    """A height h along z is h cos(a) along the normal of a slope a, which is the angle of incidence, too."""
    terms, height = 15, 1e-6
    system = parabola(ZernikeDeformation(terms, RADIUS))
    prepared = prepare_system(system, *quadrature(0.0), terms)
    states = rest_states(system, terms + 1)
    for j in range(terms):
        states.deformations[0][j, j] = height
    opd, *_ = trace_system(prepared, states, NUMPY)
    square = np.sum(prepared.pupil**2, axis=1) * (RADIUS / (2 * FOCAL_LENGTH)) ** 2
    change = opd[:terms] - opd[terms]
    for j in (j for j in range(3, terms) if j not in (6, 7)):  # coma turns the chief ray: a tilt of its own
        basis = prepared.fit.basis[:, j]
        # z grows with the light: where the surface recedes, the way is longer and the OPD smaller.
        expected = -basis / (1 + square) * 2 * height / prepared.wavelength
        assert change[j] - change[j].mean() == pytest.approx(expected - expected.mean(), abs=2e-6)


def test_rays_that_an_opening_stops_are_counted_and_left_out():
    system = parabola(opening=Opening(outer=0.9 * RADIUS))
    prepared = prepare_system(system, *quadrature(0.0), 10)
    found = measure_system(prepared, rest_states(system), NUMPY)
    outside = int(np.sum(np.hypot(*prepared.pupil.T) > 0.9))
    assert found.lost[0] == found.vignetted[0] == outside
    assert found.rms[0] < 1e-9


def test_an_instant_does_not_depend_on_its_batch():
    system = parabola(ZernikeDeformation(10, RADIUS))
    prepared = prepare_system(system, *quadrature(0.0, 8, 24), 10)
    states = rest_states(system, 37)
    states.deformations[0][:] = 1e-5 * np.random.default_rng(3).normal(size=(37, 10))
    opd, *_ = trace_system(prepared, states, NUMPY)
    together = fit_instants(prepared.fit, opd)
    alone = np.concatenate([fit_instants(prepared.fit, row[None]) for row in opd])
    assert np.array_equal(together, alone)


def test_no_instants_give_no_numbers():
    system = optical_system("gregorian")
    pupil = sunflower(0.0, 1.0, 40)
    prepared = prepare_system(system, pupil.x, pupil.y, pupil.weight, 11)
    none = States(np.zeros((0, 4, 6)), (None,) * 4, np.zeros((0, 2)))
    found = measure_system(prepared, none, NUMPY)
    assert found.zernike.shape == (0, 11)
    assert found.los.shape == found.centroid.shape == (0, 2)
    assert found.rms.shape == found.strehl.shape == found.lost.shape == (0,)


def test_bad_input():
    with pytest.raises(UserError, match="no field 1"):
        prepare_system(parabola(), *quadrature(0.0), 10, field=1)
    flat = OpticalSystem("plate", (Surface("M"), Surface("image")), 0, Pupil("entrance_diameter", 10.0))
    with pytest.raises(UserError, match="rays of plate arrive parallel to each other, so it has no image"):
        prepare_system(flat, *quadrature(0.0), 10)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"fields": np.array([[0.0, np.pi]])}, "a field of .* 90 degrees or more off the axis"),
        ({"pupil": Pupil("entrance_diameter", 1e300)}, "is 1e.300; it must be positive, from 1e-09 to 1e.12"),
        ({"pupil": Pupil("entrance_diameter", np.nan)}, "is nan; it must be positive"),
        ({"surfaces": (Surface("M", Conic(1e-300)), Surface("I"))}, "surface M of .* radius of a Conic"),
        (
            {"surfaces": (Surface("M", position=np.array([0.0, 0.0, 1e308])), Surface("I"))},
            "position of the surface M .* at most 1e.12 mm",
        ),
        (
            {"surfaces": (Surface("M", opening=Opening(corners=((0, 0), (0, 1), (1, 1)))), Surface("I"))},
            "the surface M of .*: the corners of a polygonal opening",
        ),
    ],
)
def test_what_no_light_passes_or_overflows_is_refused(change, message):
    with pytest.raises(UserError, match=message):
        prepare_system(replace(parabola(), **change), *quadrature(0.0), 10)


def test_coma_moves_the_chief_ray_and_not_the_line_of_sight_in_glass():
    """Noll's coma has no tilt about the pupil; the image lies in glass, in a frame turned about the axis."""
    index, turn = 1.5, 0.5
    oval = Surface(  # stigmatic: an ellipsoid of eccentricity 1 / n
        "oval",
        Conic(50.0, -1.0 / index**2),
        action="refract",
        medium=constant(index),
        deformation=ZernikeDeformation(8, 3.0),
    )
    turned = np.array([[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1.0]])
    image = Surface("image", position=np.array([0.0, 0.0, 150.0]), rotation=turned)
    system = OpticalSystem("immersed", (oval, image), 0, Pupil("entrance_diameter", 6.0))
    prepared = prepare_system(system, *quadrature(0.0), 15)
    states = rest_states(system, 3)
    states.deformations[0][1, 7] = states.deformations[0][2, 6] = 2e-5
    opd, _, chief = trace_system(prepared, states, NUMPY)
    found = measure_system(prepared, states, NUMPY)
    assert np.abs(opd[0]).max() < 1e-6  # piston, too
    # Slope of 2 sqrt(8) a / radius at the center, times n - 1 of glass over n, over 150 mm.
    size = 2 * np.sqrt(8) * 2e-5 / 3.0 * (index - 1) / index * 150.0
    assert np.hypot(*(chief[1:] - chief[0]).T) == pytest.approx(size, rel=1e-3)
    assert np.hypot(*(found.los[1:] - found.los[0]).T).max() < 2e-3 * size


def test_strehl_of_a_deformed_parabola_is_what_its_phase_says():
    """Small aberrations: exp(-sigma^2) to fourth order (Maréchal); a tilt costs nothing."""
    form = ZernikeDeformation(11, RADIUS)
    system = parabola(form)
    prepared = prepare_system(system, *quadrature(0.0), 36)
    states = rest_states(system, 4)
    wave = prepared.wavelength
    states.deformations[0][1, 10] = 0.02 * wave
    states.deformations[0][2, 1] = 0.5 * wave
    states.deformations[0][3, 7] = 0.02 * wave
    found = measure_system(prepared, states, NUMPY)
    assert found.strehl[[0, 2]] == pytest.approx(1.0, abs=1e-5)
    sigma = 2 * np.pi * found.rms[1]
    assert found.strehl[1] == pytest.approx(1 - sigma**2 + sigma**4 / 2, abs=0.1 * sigma**4)
    # Z11 runs from sqrt(5) at center and rim down to -sqrt(5)/2; the rim's slope of f/1.7 takes 1 % of it.
    assert found.pv[1] == pytest.approx(1.5 * np.sqrt(5) * found.rms[1], rel=1e-2)
    assert found.pv[2] < 1e-2
    assert found.rms_flat[1] == pytest.approx(found.rms[1], rel=1e-6)
    # Coma about the chief ray is 3 sqrt(8) rho^3 cos(theta), of which a plane takes 2/3.
    assert found.rms_flat[3] == pytest.approx(found.rms[3], rel=1e-4)
    assert found.rms_raw[3] == pytest.approx(3 * found.rms[3], rel=1e-2)


def test_too_few_rays_for_the_terms_name_the_keys_of_a_lens():
    x, y, weight = quadrature(0.0, 2, 4)
    with pytest.raises(
        UserError, match=r"8 rays do not determine 21 wavefront terms; raise optics\.rays, or"
    ):
        prepare_system(parabola(), x, y, weight, 21)


@pytest.mark.parametrize(
    ("changes", "weights", "match"),
    [
        (
            {"primary_wavelength": 1},
            1.0,
            "primary wavelength of parabola is number 1, counted from 0; it has 1",
        ),
        ({"stop": 1}, 1.0, "stop of parabola is its image"),
        ({"telecentric": True}, 1.0, "parabola is telecentric in the object space"),
        ({}, 0.0, "weights of the rays"),
        ({}, -1.0, "weights of the rays"),
        ({}, np.nan, "weights of the rays"),
    ],
)
def test_numbers_that_leave_no_wavefront_are_refused(changes, weights, match):
    x, y, weight = quadrature(0.0, 4, 12)
    with pytest.raises(UserError, match=match):
        prepare_system(replace(parabola(), **changes), x, y, weights * weight, 4)


@pytest.mark.parametrize("beyond", [0.0, 1e-10, 1e-9, 1e-7, 1e-5, 1e-4, -1e-8, -1e-6])
def test_an_exit_pupil_nearly_at_infinity_leaves_the_wavefront_alone(beyond):
    """The stop stands in the focal plane of a sphere but for rounding: its image is 1e8 mm away, or 1e14.

    A ray at the height b, sin i = b / R, goes R cos i from the center's plane to the mirror at M, is turned
    by 2 i, and comes next to the focus F after (F - M) e: the path to a sphere about F that is far away.
    """
    rows = [
        SurfaceRow("stop", thickness=100.0 + beyond),
        SurfaceRow("M", Conic(-200.0), -100.0, "reflect"),
        SurfaceRow("image"),
    ]
    system = OpticalSystem("sphere", sequential(rows), 0, Pupil("f_number", 5.0))
    rays = sunflower(0.0, 1.0, 200)
    prepared = prepare_system(system, rays.x, rays.y, rays.weight, 11)
    opd = trace_system(prepared, rest_states(system), NUMPY)[0]
    height = 10.0 * np.hypot(rays.x, rays.y)
    i = np.arcsin(height / 200.0)
    path = 200.0 * np.cos(i) + height * np.sin(2 * i) + (200.0 * np.cos(i) - 100.0) * np.cos(2 * i)
    # A sphere of 1e5 mm is met next to that point: s^2 / (2 * 1e5) for s = 0.013 mm.
    np.testing.assert_allclose(opd[0], (300.0 - path) / prepared.wavelength, rtol=0, atol=3e-6)
