"""The bundled systems against batoid, a ray tracer that shares no code with this one."""

import numpy as np
import pytest

from wavequake.kernels.trace.sequential_numpy import trace_sequence_numpy
from wavequake.optics.catalog.names import optical_system
from wavequake.optics.rays.aiming import pupil_rays
from wavequake.optics.rays.packing import moving, pack
from wavequake.optics.rays.pupils import sunflower
from wavequake.optics.systems.kinematics import rest_states
from wavequake.optics.systems.system import wavelength_of

batoid = pytest.importorskip("batoid", reason="batoid is the extra 'bench'")


def shape_of(element):
    """Return a packed conic or even asphere as batoid's surface, which is in meters."""
    if not element.curvature:
        return batoid.Plane()
    radius = 1e-3 / element.curvature
    if not element.even:
        return batoid.Quadric(radius, element.conic)
    assert element.even[0] == 0.0
    powers = 2 * np.arange(2, len(element.even) + 1)
    return batoid.Asphere(radius, element.conic, np.array(element.even[1:]) * 1e3 ** (powers - 1.0))


def traced_by_batoid(system, sequence, rays):
    """Return x, y and path length in mm at the image."""
    position, velocity = 1e-3 * rays.position, rays.direction / sequence.index
    bundle = batoid.RayVector(*(np.ascontiguousarray(a) for a in (*position, *velocity)), 0.0, 550e-9)
    index = sequence.index
    for element, surface in zip(sequence.elements, system.surfaces, strict=True):
        shape, frame = shape_of(element), batoid.CoordSys(1e-3 * surface.position, surface.rotation)
        if element.action == "refract":
            shape.refract(
                bundle, batoid.ConstMedium(index), batoid.ConstMedium(element.index), coordSys=frame
            )
            index = element.index
        elif element.action == "reflect":
            shape.reflect(bundle, coordSys=frame)
        else:
            shape.intersect(bundle, coordSys=frame)
    return 1e3 * bundle.x, 1e3 * bundle.y, 1e3 * bundle.t


@pytest.mark.parametrize(
    ("name", "nanometers", "waves"),
    # batoid itself errs by 2e-5 waves off the axis of the TMT.
    [
        ("double-gauss", 1e-6, 1e-8),
        ("six-lens", 1e-6, 1e-8),
        ("euv", 1e-5, 1e-5),
        ("jwst", 0.05, 1e-5),
        ("tmt-thesis", 0.2, 3e-5),
    ],
)
def test_batoid_agrees(name, nanometers, waves):
    system = optical_system(name)
    wavelength = wavelength_of(system)
    points = sunflower(system.pupil.obscuration, 1.0, 300)
    rays = pupil_rays(system, system.fields[-1], wavelength, points.x, points.y)
    sequence = pack(system, wavelength)
    ours = trace_sequence_numpy(sequence, rays, moving(system, rest_states(system)))
    x, y, path = traced_by_batoid(system, sequence, rays)
    assert np.abs(np.stack([ours.x[0] - x, ours.y[0] - y])).max() < 1e-6 * nanometers
    assert np.abs(ours.path[0] - rays.path - path).max() < waves * wavelength
