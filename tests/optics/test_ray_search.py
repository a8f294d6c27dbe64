"""Every ray that exists is found: against a spherical tracer of its own, started from a scan."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from wavequake.errors import UserError
from wavequake.kernels.device.devices import NUMPY
from wavequake.kernels.trace.status import TOTAL_REFLECTION, VIGNETTED
from wavequake.optics.catalog.names import optical_system
from wavequake.optics.media.glasses import Medium, refractive_index
from wavequake.optics.rays.aiming import aimed_rays, pupil_rays
from wavequake.optics.rays.pupils import sunflower
from wavequake.optics.shapes.shapes import Conic, Opening
from wavequake.optics.systems.kinematics import SurfaceRow, rest_states, sequential
from wavequake.optics.systems.paraxial import paraxial
from wavequake.optics.systems.system import OpticalSystem, Pupil
from wavequake.optics.wavefronts.wavefront import (
    measure_system,
    prepare_system,
    with_fitted_sphere,
    with_slopes,
)
from wavequake.optics.zemax.read import read_zmx

TRIPLET = read_zmx(Path(__file__).parents[1] / "data" / "cooke_triplet.zmx")
GLASS = Medium("glass", "constant", (1.5,))


def spheres_to_stop(system, wavelength, field, start):
    """Return x and y (2, N) on the stop of rays through points (2, N) at z = 0, NaN where they end."""
    tangent = np.array([*np.tan(field), 1.0])
    n, d = 1.0, np.repeat(tangent[:, None] / np.linalg.norm(tangent), start.shape[1], axis=1)
    p = np.concatenate([start, np.zeros((1, start.shape[1]))])
    with np.errstate(invalid="ignore"):
        for surface in system.surfaces[: system.stop + 1]:
            c, q = 1.0 / surface.shape.radius, p - surface.position[:, None]
            b, e = d[2] - c * np.sum(q * d, axis=0), c * np.sum(q * q, axis=0) - 2.0 * q[2]
            q = q + e / (b + np.sqrt(b * b - c * e)) * d
            p = q + surface.position[:, None]
            if surface is not system.surfaces[system.stop]:
                after = refractive_index(surface.medium, wavelength)
                normal = np.stack([-c * q[0], -c * q[1], 1.0 - c * q[2]])
                cosine, ratio = np.sum(d * normal, axis=0), n / after
                bent = np.sqrt(1.0 - ratio**2 * (1.0 - cosine**2))
                n, d = after, ratio * d + (bent - ratio * cosine) * normal
    return q[:2]


def scanned(system, wavelength, field, target):
    """Return where rays of a scan that come nearest to targets start, moved on by Newton steps of our own."""
    grid = np.linspace(-30.0, 30.0, 601)
    scan = np.stack(np.meshgrid(grid, grid)).reshape(2, -1)
    met = spheres_to_stop(system, wavelength, field, scan)
    found, h = [], 1e-5
    for goal in target.T:
        number = scan[:, [np.nanargmin(np.sum((met - goal[:, None]) ** 2, axis=0))]]
        for _ in range(12):
            probes = number + h * np.array([[0, 1, -1, 0, 0], [0, 0, 0, 1, -1]])
            ends = spheres_to_stop(system, wavelength, field, probes)
            slope = np.stack([ends[:, 1] - ends[:, 2], ends[:, 3] - ends[:, 4]], axis=1) / (2.0 * h)
            number = number + np.linalg.solve(slope, goal - ends[:, 0])[:, None]
        found.append(number[:, 0])
    return np.array(found).T


@pytest.mark.parametrize(("diameter", "rays"), [(22.0, 500), (24.0, 2000), (24.0, 5000)])
def test_rays_far_outside_the_lenses_are_found(diameter, rays):
    """At 22 mm one of 500, at 20 degrees, starts at (1.901, -14.845); its first lens ends at 9.5 mm."""
    system = replace(TRIPLET, pupil=Pupil("entrance_diameter", diameter))
    field, wavelength = system.fields[2], float(system.wavelengths[1])
    points = sunflower(0.0, 1.0, rays)
    aimed = pupil_rays(system, field, wavelength, points.x, points.y)
    target = paraxial(system, wavelength).stop_radius * np.stack([points.x, points.y])
    met = spheres_to_stop(system, wavelength, field, aimed.position[:2])
    assert np.abs(met - target).max() < 2e-9
    hard = np.argsort(np.hypot(*aimed.position[:2]))[-3:]
    own = scanned(system, wavelength, field, target[:, hard])
    np.testing.assert_allclose(aimed.position[:2, hard], own, rtol=0, atol=1e-7)
    if diameter == 22.0:
        np.testing.assert_allclose(aimed.position[:2, 489], [1.901, -14.845], rtol=0, atol=1e-3)


def test_rays_of_the_double_gauss_beyond_total_reflection_are_those_that_cannot_be_aimed():
    """On the axis: the largest height in the stop of a dense scan of our own, up to its first lost ray."""
    system = replace(optical_system("double-gauss"), pupil=Pupil("f_number", 1.2))
    wavelength, points = float(system.wavelengths[0]), sunflower(0.0, 1.0, 500)
    heights = np.linspace(0.0, 60.0, 60001)
    met = spheres_to_stop(system, wavelength, np.zeros(2), np.stack([0.0 * heights, heights]))[1]
    reached = met[: np.flatnonzero(np.isnan(met))[0]].max()
    beyond = np.hypot(points.x, points.y) > reached / paraxial(system, wavelength).stop_radius
    aimed = aimed_rays(system, np.zeros(2), wavelength, points.x, points.y, openings=False)
    np.testing.assert_array_equal(aimed.lost, beyond)
    assert set(aimed.status[beyond].tolist()) == {TOTAL_REFLECTION}
    assert {system.surfaces[index].name for index in aimed.surface[beyond]} == {"surface 5"}
    assert np.isnan(aimed.rays.position[:2, beyond]).all()
    message = rf"at field \(0, 0\) deg and 486.133 nm {beyond.sum()} of 500 rays .*surface 5: th"
    with pytest.raises(UserError, match=message):
        pupil_rays(system, np.zeros(2), wavelength, points.x, points.y)


def ball_lens(opening=None):
    """A sphere's cap as thick as its radius, whose flat face totally reflects the outermost light; a stop."""
    rows = [
        SurfaceRow("front", Conic(10.0), 10.0, "refract", GLASS, opening=opening),
        SurfaceRow("flat", Conic(), 0.0, "refract"),
        SurfaceRow("stop", thickness=40.0 / 3.0),
        SurfaceRow("image"),
    ]
    return OpticalSystem("ball", sequential(rows), 2, Pupil("stop", 9.0))


def heights_at_stop():
    """Heights of parallel rays that leave the flat face, and their heights in the stop, by Snell's law."""
    h = np.linspace(0.0, 10.0, 1_000_001)
    slope = np.arcsin(h / 10.0) - np.arcsin(h / 15.0)  # in glass, towards the axis
    passes = 1.5 * np.sin(slope) < 1.0
    at_stop = h - np.sqrt(100.0 - h**2) * np.tan(slope)
    assert (np.diff(at_stop) > 0.0).all()
    return h[passes], at_stop[passes]


@pytest.mark.parametrize("edge", [5.0, 9.99])
def test_light_ends_at_the_opening_or_else_where_it_is_totally_reflected(edge):
    """That is at 9.93 mm, inside of an opening of 9.99 mm."""
    system, points = ball_lens(Opening(edge)), sunflower(0.0, 1.0, 300)
    h, at_stop = heights_at_stop()
    away = 9.0 * np.hypot(points.x, points.y)
    aimed = aimed_rays(system, np.zeros(2), 550e-6, points.x, points.y)
    np.testing.assert_array_equal(aimed.lost, away > at_stop[-1])
    prepared = prepare_system(system, points.x, points.y, points.weight, 6)
    found = measure_system(prepared, rest_states(system), NUMPY)
    assert 300 - found.lost[0] == np.sum(away <= np.interp(edge, h, at_stop))
    inside = edge > h[-1]
    assert found.vignetted[0] == (0 if inside else found.lost[0])
    ends = (TOTAL_REFLECTION, 1) if inside else (VIGNETTED, 0)
    assert set(zip(aimed.status[aimed.lost], aimed.surface[aimed.lost], strict=True)) == {ends}


def test_numbers_of_the_light_that_arrives_are_those_of_a_smaller_pupil():
    """The same rays by themselves: raw error, spot and centroid; slopes and spheres leave the others out."""
    system, points = ball_lens(Opening(3.0)), sunflower(0.0, 1.0, 800)
    whole = prepare_system(system, points.x, points.y, points.weight, 6)
    found = measure_system(whole, rest_states(system), NUMPY)
    h, at_stop = heights_at_stop()
    inside = 9.0 * np.hypot(points.x, points.y) <= np.interp(3.0, h, at_stop)
    assert found.lost[0] == found.vignetted[0] == np.sum(~inside)
    share = float(np.hypot(points.x, points.y)[inside].max())
    small = replace(system, pupil=Pupil("stop", 9.0 * share))
    few = prepare_system(small, points.x[inside] / share, points.y[inside] / share, np.ones(inside.sum()), 6)
    alone = measure_system(few, rest_states(small), NUMPY)
    for name in ("rms_raw", "spot_rms"):
        np.testing.assert_allclose(getattr(found, name), getattr(alone, name), rtol=1e-9)
    for method in (with_slopes, with_fitted_sphere):
        other = measure_system(method(whole), rest_states(system), NUMPY)
        assert other.lost[0] == found.lost[0]
        assert np.isfinite(other.zernike[:, 1:]).all()


def test_where_no_light_arrives_the_chief_ray_or_the_counts_are_named():
    points = sunflower(0.0, 1.0, 50)
    with pytest.raises(UserError, match=r"at field \(68.75, 0\) deg and 550 nm the chief ray of ball cannot"):
        pupil_rays(ball_lens(), np.array([1.2, 0.0]), 550e-6, points.x, points.y)
    angle = np.linspace(0.0, 6.0, 12)
    with pytest.raises(
        UserError, match=r"no ray of ball reaches .* stop: they are lost, at flat: they are tot"
    ):
        prepare_system(ball_lens(), 0.99 * np.cos(angle), 0.99 * np.sin(angle), np.ones(12), 3)
