"""The bundled systems against batoid, a ray tracer that shares no code with this one."""

from dataclasses import replace

import numpy as np
import pytest

from wavequake.kernels.trace.sequential_numpy import trace_sequence_numpy
from wavequake.optics.catalog.names import optical_system, system_names
from wavequake.optics.media.glasses import refractive_index
from wavequake.optics.rays.aiming import pupil_rays
from wavequake.optics.rays.packing import moving, pack
from wavequake.optics.rays.pupils import sunflower
from wavequake.optics.segments.catalog import telescope
from wavequake.optics.segments.parent import parent_system
from wavequake.optics.shapes.sag import shape_sag
from wavequake.optics.systems.kinematics import rest_states
from wavequake.optics.systems.paraxial import paraxial
from wavequake.optics.systems.system import wavelength_of

batoid = pytest.importorskip("batoid", reason="batoid is the extra 'bench'")


def shape_of(element):
    """Return a packed conic or even asphere as batoid's surface, which is in meters."""
    if not element.curvature:
        return batoid.Plane()
    radius = 1e-3 / element.curvature
    if not element.even:
        return batoid.Quadric(radius, element.conic)
    powers = 2 * np.arange(1, len(element.even) + 1)
    return batoid.Asphere(radius, element.conic, np.array(element.even) * 1e3 ** (powers - 1.0), imin=1)


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
        ("rubin", 1e-4, 1e-5),
        ("hsc", 1e-3, 1e-5),
        ("decam", 1e-4, 1e-5),
        ("sdss", 1e-4, 1e-5),
        ("jwst", 0.05, 1e-5),
        ("tmt-thesis", 0.2, 3e-5),
        ("keck", 0.05, 2e-5),
        ("gtc", 0.05, 2e-5),
        ("het", 0.05, 2e-5),
        ("gmt", 0.05, 2e-5),
        ("elt", 0.05, 2e-5),
    ],
)
def test_batoid_agrees(name, nanometers, waves):
    if name in system_names():
        system = optical_system(name)
    else:  # from 3 arcmin beside the axis
        system = replace(parent_system(telescope(name)), fields=np.array([[0.0, np.deg2rad(0.05)]]))
    wavelength = wavelength_of(system)
    points = sunflower(system.pupil.obscuration, 1.0, 300)
    rays = pupil_rays(system, system.fields[-1], wavelength, points.x, points.y)
    sequence = pack(system, wavelength)
    ours = trace_sequence_numpy(sequence, rays, moving(system, rest_states(system)))
    x, y, path = traced_by_batoid(system, sequence, rays)
    through = np.isfinite(ours.x[0])  # clear apertures stop some at the edge of a field
    assert through.mean() > (0.5 if name == "hsc" else 0.95)
    far = np.abs(np.stack([ours.x[0] - x, ours.y[0] - y]))[:, through].max()
    late = np.abs(ours.path[0] - rays.path - path)[through].max()
    print(f"{name}: {far:.1e} mm, {late / wavelength:.1e} waves")
    assert far < 1e-6 * nanometers
    assert late < waves * wavelength


@pytest.mark.parametrize(
    ("name", "file", "focal_length", "scale"),
    # batoid has another formula for DECam's silica.
    # Published: 10.31 m and f/1.234; pixels of 15 um that see 0.168 and 0.263 arcsec; f/5 of 2.5 m.
    [
        ("rubin", "LSST_r.yaml", 10310.0, 1e-3),
        ("hsc", "HSC.yaml", 0.015 / np.deg2rad(0.168 / 3600.0), 6e-3),
        ("decam", "DECam.yaml", 0.015 / np.deg2rad(0.263 / 3600.0), 6e-3),
        ("sdss", "SDSS.yaml", 5.0 * 2500.0, 1e-2),
    ],
)
def test_surveys_are_those_of_the_public_models(name, file, focal_length, scale):
    """Heights, sags and indices of every surface; z is the other way round."""
    system = optical_system(name)
    wavelength = wavelength_of(system)
    found, rest = [], [batoid.Optic.fromYaml(file)]
    while rest:
        one = rest.pop(0)
        rest = [*one.items, *rest] if hasattr(one, "items") else rest
        if isinstance(one, batoid.Interface) and not isinstance(one, batoid.Baffle):
            found.append(one)
    assert len(found) == len(system.surfaces)
    for ours, theirs in zip(system.surfaces, found, strict=True):
        assert ours.position[2] == pytest.approx(-1e3 * theirs.coordSys.origin[2], abs=1e-6)
        x = np.linspace(0.0, 300.0, 7)
        sag = shape_sag(ours.shape, x, 0.5 * x)[0]
        np.testing.assert_allclose(sag, -1e3 * theirs.surface.sag(1e-3 * x, 0.5e-3 * x), rtol=0.0, atol=1e-9)
        if ours.action == "refract":
            index = theirs.outMedium.getN(1e-3 * wavelength)
            assert refractive_index(ours.medium, wavelength) == pytest.approx(
                index, abs=3e-6 if name == "decam" else 2e-8
            )
    optics = paraxial(system)
    assert abs(optics.focal_length) == pytest.approx(focal_length, rel=scale)
