"""Ray slopes and best-fit spheres of any system, against path lengths and closed forms."""

from dataclasses import replace

import numpy as np
import pytest

from wavequake.kernels.device.devices import NUMPY
from wavequake.kernels.trace.sequential import trace_sequence
from wavequake.kernels.trace.status import MISS
from wavequake.optics.catalog.names import optical_system, system_names
from wavequake.optics.media.glasses import constant
from wavequake.optics.polynomials.zernike import annular_zernike
from wavequake.optics.shapes.shapes import Conic, Opening
from wavequake.optics.systems.kinematics import rest_states
from wavequake.optics.systems.system import OpticalSystem, Pupil, Surface
from wavequake.optics.wavefronts.sphere_fit import fit_sphere
from wavequake.optics.wavefronts.wavefront import (
    analyse_system,
    incoming_light,
    line_of_sight,
    measure_system,
    prepare_system,
    trace_system,
    with_fitted_sphere,
    with_slopes,
)

SEMI_MAJOR, ECCENTRICITY, INDEX, RADIUS = 100.0, 0.5, 1.5, 30.0
NEAR = SEMI_MAJOR * (1 - ECCENTRICITY)  # of the mirror's vertex from its second focus: the image


def quadrature(obscuration, radii=24, azimuths=72):
    """Gauss-Legendre in r^2 and even azimuths over the unit annulus."""
    node, weight = np.polynomial.legendre.leggauss(radii)
    r = np.sqrt(obscuration**2 + (1 - obscuration**2) * (node + 1) / 2)
    angle = 2 * np.pi * (np.arange(azimuths) + 0.5) / azimuths
    x, y = np.outer(r, np.cos(angle)).ravel(), np.outer(r, np.sin(angle)).ravel()
    return x, y, np.repeat(weight / 2 / azimuths, azimuths)


def ellipsoid(opening=None):
    """A mirror in glass that images its one focus onto the other, with a numerical aperture of 0.85."""
    shape = Conic(-SEMI_MAJOR * (1 - ECCENTRICITY**2), -(ECCENTRICITY**2))
    mirror = Surface("mirror", shape, action="reflect", opening=opening)
    image = Surface("image", position=np.array([0.0, 0.0, -NEAR]))
    return OpticalSystem(
        "ellipsoid",
        (mirror, image),
        0,
        Pupil("stop", RADIUS),
        object_distance=SEMI_MAJOR * (1 + ECCENTRICITY),
        medium=constant(INDEX),
    )


def toward_focus(prepared):
    """Unit vectors (N, 3) along the light from the mirror to its focus."""
    x, y = RADIUS * prepared.pupil.T
    c = 1 / (SEMI_MAJOR * (1 - ECCENTRICITY**2))
    square = x**2 + y**2
    sag = -c * square / (1 + np.sqrt(1 - (1 - ECCENTRICITY**2) * c**2 * square))
    ray = np.stack([-x, -y, -NEAR - sag], axis=1)
    return ray / np.linalg.norm(ray, axis=1, keepdims=True)


@pytest.mark.parametrize(
    "motion", [[0, 0, 0.05, 0, 0, 0], [0, 0, -0.05, 0, 0, 0], [0.3, -0.2, 0.05, 0.02, -0.03, 0.1]]
)
def test_an_image_out_of_place_in_closed_form(motion):
    """All light meets in the focus; an image surface that is not there sees a sphere about the focus.

    OPD = n |P - focus| + constant at the points P of the reference sphere, whose center is where the chief
    ray, which follows the axis, meets the image surface. No small angle: the rays are 34 degrees steep.
    """
    prepared = with_slopes(prepare_system(ellipsoid(), *quadrature(0.0), 66))
    states = rest_states(prepared.system)
    states.surface_motion[0, -1] = motion
    x, y, z, alpha, beta, _ = motion
    height = z + (np.tan(beta) / np.cos(alpha) * x - np.tan(alpha) * y)
    center = np.array([0.0, 0.0, height])
    ray = toward_focus(prepared)
    projection = ray @ center
    back = np.sqrt(projection**2 - height**2 + NEAR**2) - projection  # |P - focus|
    basis = annular_zernike(*prepared.pupil.T, 66, 0.0)
    expected = basis.T @ (prepared.fit.weight * INDEX * back) / prepared.wavelength
    found = measure_system(prepared, states, NUMPY)
    assert np.abs(expected[3]) > 5.0
    np.testing.assert_allclose(found.zernike[0, 1:], expected[1:], rtol=0, atol=1e-7)
    assert np.isnan(found.zernike[0, 0])


# Largest difference in waves, at rest and where all surfaces have moved.
AGREE = dict.fromkeys(system_names(), 1e-7) | {"double-gauss": 4e-7, "hsc": 4e-7}


# Not the curved image of the SDSS, which has no slopes, nor the edge of HSC's field, where lenses stop light.
FIELDS = [(name, field) for name in system_names() for field in range(len(optical_system(name).fields))]
FIELDS = [one for one in FIELDS if one[0] != "sdss" and one != ("hsc", 1)]


@pytest.mark.parametrize(("name", "field"), FIELDS)
def test_slopes_and_path_lengths_agree(name, field):
    """As many polynomials as describe the wavefronts, to which both are fits: then nothing is left out."""
    system, random = optical_system(name), np.random.default_rng(1)
    terms, radii = (231, 24) if name in ("euv", "rubin", "hsc", "decam") else (91, 16)
    size = 1e-2 if name == "euv" else 1.0
    prepared = prepare_system(system, *quadrature(system.pupil.obscuration, radii, 48), terms, field)
    states = rest_states(system, 3)
    motion = random.normal(size=(2, len(system.surfaces), 6)) * [*[0.02] * 3, *[1e-4] * 3]
    states.surface_motion[1:] = size * motion
    paths, slopes = (measure_system(one, states, NUMPY) for one in (prepared, with_slopes(prepared)))
    np.testing.assert_allclose(slopes.zernike[:, 1:], paths.zernike[:, 1:], rtol=0, atol=AGREE[name])
    np.testing.assert_allclose(slopes.rms, paths.rms, rtol=0, atol=AGREE[name])
    assert np.abs(paths.zernike[1:, 1:] - paths.zernike[0, 1:]).max() > 300 * AGREE[name]
    np.testing.assert_allclose(slopes.los, paths.los, rtol=0, atol=1e-7)
    for same in ("rms_raw", "rms_flat", "pv", "chief", "strehl", "spot_rms", "lost"):
        np.testing.assert_array_equal(getattr(slopes, same), getattr(paths, same))


def test_few_polynomials_weigh_what_they_leave_out_differently():
    """The price of slopes, so that nobody takes 28 terms of a camera lens for those of path lengths."""
    system = optical_system("double-gauss")
    prepared = prepare_system(system, *quadrature(0.0), 28, field=2)
    states = rest_states(system)
    paths, slopes = (measure_system(one, states, NUMPY) for one in (prepared, with_slopes(prepared)))
    apart = np.abs(slopes.zernike - paths.zernike)[0, 1:].max()
    residual = paths.rms_raw[0] ** 2 - np.sum(paths.zernike[0, 1:] ** 2)
    assert 1e-4 < apart < 3 * np.sqrt(residual)


def test_an_instant_does_not_depend_on_its_batch():
    system = optical_system("six-lens")
    prepared = with_fitted_sphere(with_slopes(prepare_system(system, *quadrature(0.0, 8, 24), 28)))
    states = rest_states(system, 19)
    states.surface_motion[:] = 1e-3 * np.random.default_rng(2).normal(size=states.surface_motion.shape)
    traced = trace_system(prepared, states, NUMPY)
    together = analyse_system(prepared, *traced)
    for part in (slice(0, 1), slice(3, 8)):
        one = replace(states, **{k: getattr(states, k)[part] for k in ("surface_motion", "line_of_sight")})
        alone = analyse_system(prepared, *trace_system(prepared, one, NUMPY))
        np.testing.assert_array_equal(alone.zernike, together.zernike[part])
        np.testing.assert_array_equal(alone.los, together.los[part])


def test_lost_rays_are_left_out():
    prepared = with_slopes(prepare_system(ellipsoid(), *quadrature(0.0), 45))
    stopped = with_slopes(prepare_system(ellipsoid(Opening(outer=0.9 * RADIUS)), *quadrature(0.0), 45))
    states = rest_states(prepared.system, 2)
    states.surface_motion[:, -1, 2] = 0.01, -0.02
    whole, part = (measure_system(one, states, NUMPY) for one in (prepared, stopped))
    assert (part.vignetted > 100).all()
    np.testing.assert_allclose(part.zernike[:, 1:], whole.zernike[:, 1:], rtol=0, atol=1e-6)
    opd, traced, chief = trace_system(prepared, states, NUMPY)
    opd[1], traced.x[1], traced.status[1] = np.nan, np.nan, MISS
    found = analyse_system(prepared, opd, traced, chief)
    assert np.isnan(found.zernike[1]).all()
    np.testing.assert_array_equal(found.zernike[0], whole.zernike[0])


@pytest.mark.parametrize("along", [0.0, 0.02, -0.02])
def test_a_sphere_about_another_point_is_found(along):
    """Wavefronts that are spheres about points beside the reference's center, in closed form.

    The chief ray of a field point is oblique: the image point is where the line from the pupil's center to
    the sphere's center meets the image, not the point below the center.
    """
    system = replace(ellipsoid(), fields=np.array([[0.0, 0.0], [15.0, -9.0]]))
    for field in (0, 1):
        prepared = with_fitted_sphere(prepare_system(system, *quadrature(0.0), 45, field))
        _, traced, chief = trace_system(with_slopes(prepared), rest_states(system), NUMPY)  # has directions
        points = sphere_points(prepared, traced, chief)
        shift = np.array([2e-3, -1e-3, along])
        opd = INDEX * np.linalg.norm(points - shift, axis=1)[None] / prepared.wavelength
        found = analyse_system(prepared, opd, traced, chief)
        # The pupil's center lies on the chief ray at the distance of the sphere.
        pupil = system.surfaces[-1].position * [0, 0, -1.0] - np.append(chief[0], 0.0)
        line = shift - pupil
        expected = shift[:2] - shift[2] / line[2] * line[:2]
        np.testing.assert_allclose((image_point(prepared, found) - chief)[0], expected, rtol=0, atol=3e-6)


def sphere_points(prepared, traced, chief):
    """Points (N, 3) of the first instant's rays on the reference sphere, about its center."""
    light = np.stack([traced.u, traced.v, traced.w_sign * np.sqrt(1 - traced.u**2 - traced.v**2)])[:, 0]
    image = np.stack([traced.x[0] - chief[0, 0], traced.y[0] - chief[0, 1], 0 * traced.x[0]])
    inward, radius = np.sum(image * light, axis=0), prepared.sphere_radius
    root = np.sqrt(inward**2 - np.sum(image**2, axis=0) + radius**2)
    return (image - (inward + np.copysign(root, radius)) * light).T


def image_point(prepared, found):
    """Image points (T, 2) of the best-fit spheres, from which the line of sight counts the rest of tilt."""
    return found.los - line_of_sight(prepared, np.zeros((len(found.los), 2)), found.zernike)


@pytest.mark.parametrize("name", ["double-gauss", "euv", "herschel"])
def test_the_sphere_is_that_through_the_points_of_the_wavefront(name):
    """A point of the wavefront lies its OPD beyond the reference sphere, toward the sphere's center."""
    system = optical_system(name)
    prepared = prepare_system(
        system, *quadrature(system.pupil.obscuration, 12, 36), 36, len(system.fields) - 1
    )
    states = rest_states(system)
    states.surface_motion[0, 1] = [1e-3, -2e-3, 1e-3, 1e-5, 2e-5, 0.0]
    opd, traced, chief = trace_system(with_slopes(prepared), states, NUMPY)  # has directions, too
    points, radius = sphere_points(prepared, traced, chief), prepared.sphere_radius
    points -= points / radius * (opd[0] * prepared.wavelength / prepared.image_index)[:, None]
    center = fit_sphere(points[None], prepared.fit.weight).center[0]
    leading = trace_sequence(prepared.sequence, prepared.chief, incoming_light(prepared, states), NUMPY, True)
    along = np.concatenate([leading.u[0], leading.v[0]])
    pupil = -radius * np.append(along, leading.w_sign[0] * np.sqrt(1 - along @ along))
    line = center - pupil
    expected = center[:2] - center[2] / line[2] * line[:2]
    found = analyse_system(with_fitted_sphere(prepared), opd, traced, chief)
    moved = np.linalg.norm(image_point(prepared, found) - chief)
    np.testing.assert_allclose((image_point(prepared, found) - chief)[0], expected, rtol=0, atol=1e-3 * moved)
