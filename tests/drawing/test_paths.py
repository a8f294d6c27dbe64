"""Points of rays at every surface against the laws of reflection and refraction, and the trace itself."""

import numpy as np
import pytest

from wavequake.kernels.device.devices import choose_device
from wavequake.kernels.trace.paths import trace_paths
from wavequake.kernels.trace.sequence import Rays
from wavequake.kernels.trace.sequential import trace_sequence
from wavequake.kernels.trace.status import MISS, TOTAL_REFLECTION, VIGNETTED
from wavequake.optics.catalog.names import optical_system, system_names
from wavequake.optics.media.glasses import AIR, constant, refractive_index
from wavequake.optics.media.gradients import selfoc
from wavequake.optics.rays.aiming import pupil_rays
from wavequake.optics.rays.packing import moving, pack
from wavequake.optics.shapes.sag import shape_sag
from wavequake.optics.shapes.shapes import Conic, Opening
from wavequake.optics.systems.kinematics import Break, SurfaceRow, rest_states, sequential
from wavequake.optics.systems.system import OpticalSystem, Pupil, wavelength_of

FOLDED = OpticalSystem(
    name="out of one plane",
    surfaces=sequential(
        [
            SurfaceRow("front", Conic(120.0), 6.0, "refract", constant(1.6)),
            SurfaceRow("back", Conic(-200.0), 40.0, "refract"),
            Break(tilt=(0.0, np.radians(40.0), 0.0)),
            SurfaceRow("fold 1", action="reflect"),
            Break(tilt=(0.0, np.radians(40.0), 0.0), thickness=-30.0),
            Break(tilt=(np.radians(-35.0), 0.0, 0.0)),
            SurfaceRow("fold 2", action="reflect"),
            Break(tilt=(np.radians(-35.0), 0.0, 0.0), thickness=60.0),
            SurfaceRow("image"),
        ]
    ),
    stop=0,
    pupil=Pupil("entrance_diameter", 16.0),
    fields=np.array([[0.0, 0.0], [0.01, 0.02]]),
)
SYSTEMS = [*map(optical_system, system_names()), FOLDED]


def paths_of(system, field=-1, **options):
    angle = np.linspace(0.0, 2.0 * np.pi, 9)
    rays = pupil_rays(
        system, system.fields[field], wavelength_of(system), 0.9 * np.cos(angle), 0.9 * np.sin(angle)
    )
    at_rest = moving(system, rest_states(system))
    return rays, trace_paths(pack(system, wavelength_of(system)), rays, at_rest, **options)


@pytest.mark.parametrize("system", SYSTEMS, ids=lambda system: system.name)
def test_rays_obey_the_laws_of_light_at_every_surface(system):
    """n s x N is kept by refraction, s - 2 (s N) N is what a mirror makes, and points lie on the shapes."""
    rays, found = paths_of(system, -2 if system.name == "hsc" else -1, ignore_apertures=True)
    points = np.stack([rays.position, *(part[-1, :, 0] for part in found.points)])
    assert np.isfinite(points).all()  # at the edge of its field, HSC's lenses do not let all light through
    way = np.diff(points, axis=0)
    # Light that starts on the first surface has no way to it, but a direction.
    size = np.linalg.norm(way, axis=1, keepdims=True)
    unit = np.where(size > 1e-6, way / np.maximum(size, 1e-300), np.nan)
    unit[0] = rays.direction
    index = refractive_index(system.medium, wavelength_of(system))
    for number, surface in enumerate(system.surfaces[:-1]):
        x, y, z = surface.rotation.T @ (points[number + 1] - surface.position[:, None])
        sag, slope_x, slope_y = shape_sag(surface.shape, x, y)
        scale = np.abs(points).max()
        np.testing.assert_allclose(z, sag, rtol=0, atol=1e-13 * scale)
        normal = surface.rotation @ np.stack([-slope_x, -slope_y, np.ones_like(sag)])
        normal /= np.linalg.norm(normal, axis=0)
        s, after = np.where(np.isnan(unit[number]), rays.direction, unit[number]), unit[number + 1]
        # Directions are differences of points, so they are as exact as the shortest way is long.
        rough = 1e-12 * scale / max(np.nanmin(size[number + 1]), 1e-3) + 1e-12
        if surface.action == "reflect":
            np.testing.assert_allclose(after, s - 2 * np.sum(s * normal, axis=0) * normal, atol=rough)
        elif surface.action == "refract":
            behind = refractive_index(surface.medium, wavelength_of(system))
            tangential = [n * np.cross(d.T, normal.T) for n, d in ((index, s), (behind, after))]
            np.testing.assert_allclose(*tangential, atol=rough)
            index = behind
        elif np.isfinite(after).all():
            np.testing.assert_allclose(after, s, atol=rough)


@pytest.mark.parametrize("system", SYSTEMS, ids=lambda system: system.name)
def test_rays_end_where_the_kernel_says(system):
    """The OpenCL kernel shares no algebra with the twin; 1e-9 mm."""
    rays, found = paths_of(system)
    at_rest = moving(system, rest_states(system))
    traced = trace_sequence(pack(system, wavelength_of(system)), rays, at_rest, choose_device("auto"))
    image = system.surfaces[-1]
    x, y, _ = image.rotation.T @ (found.points[-1][-1, :, 0] - image.position[:, None])
    np.testing.assert_array_equal(found.status, traced.status)
    np.testing.assert_allclose(x, traced.x[0], rtol=0, atol=1e-9)
    np.testing.assert_allclose(y, traced.y[0], rtol=0, atol=1e-9)


def test_rays_bend_as_the_closed_form_says():
    """Parallel to a rod's axis at r0: r = r0 cos(n0 g z / n(r0)), as n dz/ds is kept along the axis."""
    n0, g, length, r0 = 1.6, 0.02, 60.0, 1.5
    rows = [
        SurfaceRow("in", thickness=length, action="refract", medium=selfoc(n0, g)),
        SurfaceRow("out", action="refract", medium=AIR, thickness=5.0),
        SurfaceRow("image"),
    ]
    system = OpticalSystem("rod", sequential(rows), 0, Pupil("entrance_diameter", 4.0))
    rays = Rays(np.array([[r0], [0.0], [0.0]]), np.array([[0.0], [0.0], [1.0]]), np.zeros(1))
    found = trace_paths(pack(system, 550e-6), rays, moving(system, rest_states(system)))
    bent = found.points[1][:, :, 0, 0]
    assert len(bent) > 20
    expected = r0 * np.cos(n0 * g * bent[:, 2] / (n0 * np.sqrt(1.0 - (g * r0) ** 2)))
    np.testing.assert_allclose(bent[:, 0], expected, rtol=0, atol=1e-9)
    assert bent[-1, 2] == pytest.approx(length, abs=1e-9)
    assert (np.diff(bent[:, 2]) >= 0.0).all()


def test_lost_rays_end_where_they_are_lost():
    glass = constant(1.8)
    rows = [
        SurfaceRow("plane", thickness=10.0, opening=Opening(3.0)),
        SurfaceRow("ball", Conic(6.0), 8.0, "refract", glass),
        SurfaceRow("steep", Conic(4.0), 5.0, "refract", AIR),
        SurfaceRow("image"),
    ]
    system = OpticalSystem("losses", sequential(rows), 0, Pupil("entrance_diameter", 2.0))
    height = np.array([0.0, 3.5, 2.9, 20.0])
    flat = np.stack([height, 0 * height, 0 * height - 1.0])
    rays = Rays(flat, np.tile([[0.0], [0.0], [1.0]], 4), np.zeros(4))
    sequence, at_rest = pack(system, 550e-6), moving(system, rest_states(system))
    found = trace_paths(sequence, rays, at_rest)
    assert found.status[0, 1] == VIGNETTED
    np.testing.assert_allclose(found.points[0][-1, :, 0, 1], [3.5, 0.0, 0.0])
    assert np.isnan(found.points[1][:, :, 0, 1]).all()
    free = trace_paths(sequence, rays, at_rest, ignore_apertures=True)
    assert free.status[0, 3] == MISS
    assert free.surface[0, 3] == 1
    assert np.isfinite(free.points[0][..., 3]).all()
    assert np.isnan(free.points[1][..., 3]).all()
    inside = np.flatnonzero(free.status[0] == TOTAL_REFLECTION)
    for ray in inside:
        assert np.isfinite(free.points[free.surface[0, ray]][..., ray]).all()
        assert np.isnan(free.points[free.surface[0, ray] + 1][..., ray]).all()
