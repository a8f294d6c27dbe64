"""The OpenCL kernel against its NumPy twin on random systems of every kind of surface."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rotations import rotations

from wavequake.kernels.device.devices import NUMPY, Device, list_devices
from wavequake.kernels.trace.sequence import (
    Element,
    Gradient,
    Grid,
    Moving,
    Polynomial,
    Rays,
    Region,
    Ring,
    Sequence,
    terms,
)
from wavequake.kernels.trace.sequential import trace_sequence
from wavequake.kernels.trace.status import DIVERGED, MISS, OK, TOTAL_REFLECTION, VIGNETTED
from wavequake.optics.shapes.polygons import edge_spans

OPENCL = [device for device in list_devices() if device.kind != "numpy"]
OPENCL += [Device(device.name, "gpu", device.platform, 1) for device in OPENCL if device.kind == "cpu"]
INSTANTS, RAYS = 3, 45

# What the elements of a system are made of; each system is one kernel, in which every third index is 1.
SYSTEMS = {
    "lens": [
        "conic refract circle",
        "even refract",
        "plane",
        "conic refract",
        "even polynomial refract",
        "plane",
    ],
    "mirrors": ["conic reflect", "moving reflect polygon", "plane reflect", "moving grid reflect", "plane"],
    "high": [
        "ring moving refract outline",
        "ring grid reflect blocked",
        "moving moving grid refract",
        "conic",
    ],
    "rods": [
        "conic refract varying circle",
        "plane",
        "moving reflect circle",
        "even polynomial refract varying circle",
        "moving grid refract circle",
        "plane",
    ],
    "image in a rod": ["ring refract varying", "moving grid pass polygon"],
}


def random_element(words, random, scale, index):
    """An element of the parts that `words` name and its moving coefficients; `scale` is its deformation."""
    parts, deformation, heights = {}, None, None
    if "plane" not in words:
        parts |= {"curvature": 1.0 / random.choice([-1, 1]) / random.uniform(11, 150)}
        parts |= {"conic": random.uniform(-2.0, 1.0)}
    if "even" in words:
        parts["even"] = tuple(random.normal(size=3) * scale / 10.0 ** np.array([2, 4, 6]))
    grid = Grid(-12.0, -13.0, 4.0, 5.0, scale * random.normal(size=(7, 8)))
    if "polynomial" in words or "ring" in words:
        basis, degree = (Ring(random.choice([0.0, 0.2])), 24) if "ring" in words else ("monomial", 5)
        coefficients = scale * random.normal(size=terms(degree)) / (1.0 + np.arange(terms(degree)))
        coefficients = coefficients[::-1].copy() if "ring" in words else coefficients
        parts["polynomial"] = Polynomial(degree, 20.0, coefficients, basis)
    if "moving" in words:
        parts |= {"deformation_degree": 4, "deformation_radius": 20.0}
        parts["deformation_basis"] = Ring() if "grid" in words else "monomial"
        deformation = scale * random.normal(size=(INSTANTS, 15))
    if "grid" in words:
        parts |= {"grid": grid}
        if words.count("moving") == 2 or "moving grid" in words:
            parts["deformation_grid"] = grid
            heights = scale * random.normal(size=(INSTANTS, 7, 8))
    regions = []
    if "circle" in words:
        regions = [Region("circle", (0.3, -0.2, random.uniform(4.0, 12.0)))]
    if "polygon" in words:
        regions = [Region("polygon", (1.0, 0.2, 7.0, -1.0, 0.1, 8.0, 0.0, 1.0, 8.0, 0.1, -1.0, 7.0))]
    if "outline" in words:
        arrow = np.array([[-8.0, -6.0], [9.0, 0.5], [-7.0, 8.0], [-2.0, 0.0]])
        regions = [Region("outline", tuple(edge_spans(arrow[None]).ravel().tolist()))]
    if words in ("plane", ["plane"]):
        # A finite image, since a ray along the plane of an infinite one multiplies rounding without bound.
        regions = [Region("circle", (0.0, 0.0, 150.0))]
    if "blocked" in words:
        regions = [Region("circle", (1.0, 0.0, 1.5), blocks=True)]
    parts["action"] = next((word for word in ("reflect", "refract") if word in words), "pass")
    parts["index"] = index
    if "varying" in words:
        radial, axial = random.normal(size=2) * [3e-4, 1e-6], random.normal(size=1) * 3e-3
        parts["gradient"] = Gradient(tuple(radial.tolist()), tuple(axial.tolist()), random.uniform(1.0, 4.0))
    return Element(**parts, regions=tuple(regions)), deformation, heights


def random_system(descriptions, seed, scale):
    random = np.random.default_rng(seed)
    indices = [1.0 if place % 3 == 2 else random.choice([1.4, 3.0]) for place in range(len(descriptions))]
    parts = [
        random_element(words.split() if "moving grid" not in words else words, random, scale, index)
        for words, index in zip(descriptions, indices, strict=True)
    ]
    elements, deformations, grids = zip(*parts, strict=True)
    sense, poses = 1.0, []
    for element in elements:
        turn = rotations(random.normal(0.0, 0.02, (INSTANTS, 3)))
        shift = random.normal(0.0, 0.1, (INSTANTS, 3)) - [0.0, 0.0, sense * random.uniform(8.0, 25.0)]
        poses.append(np.concatenate([turn.reshape(INSTANTS, 9), shift], axis=1))
        sense = -sense if element.action == "reflect" else sense
    angles = random.normal(0.0, 0.05, (2, RAYS))
    direction = np.stack([*angles, np.sqrt(1.0 - np.sum(angles**2, axis=0))])
    position = np.stack([*random.uniform(-7.0, 7.0, (2, RAYS)), random.uniform(-3.0, 3.0, RAYS)])
    spheres = np.concatenate([random.normal(0.0, 1.0, (INSTANTS, 3)), [[40.0], [60.0], [-50.0]]], axis=1)
    moving = Moving(np.stack(poses, axis=1), deformations, grids, spheres)
    rays = Rays(position, direction, random.normal(size=RAYS))
    return Sequence(elements, 1.0 if len(elements) % 2 else 1.8), rays, moving


@pytest.mark.skipif(not OPENCL, reason="there is no device of OpenCL")
@pytest.mark.parametrize("name", sorted(SYSTEMS))
@given(seed=st.integers(0, 2**32 - 1), scale=st.sampled_from([0.0, 1e-8, 1e-4, 1e-2, 0.1]))
def test_the_kernel_agrees_with_its_twin_on_random_systems(name, seed, scale):
    arguments = random_system(SYSTEMS[name], seed, scale)
    expected = trace_sequence(*arguments, NUMPY)
    for device in OPENCL:
        traced, said = trace_sequence(*arguments, device), f"{device.kind}-{device.vector_width}"
        for key in ("status", "surface", "w_sign", "vignetted"):
            np.testing.assert_array_equal(getattr(traced, key), getattr(expected, key), said)
        for key in ("path", "x", "y", "u", "v"):
            found, wanted = getattr(traced, key), getattr(expected, key)
            np.testing.assert_allclose(found, wanted, rtol=0.0, atol=1e-9, err_msg=said)


def test_the_random_systems_lose_rays_in_every_way():
    """What the test above compares is there to be compared."""
    found = np.zeros(5, dtype=int)
    for seed in range(25):
        for name in SYSTEMS:
            traced = trace_sequence(*random_system(SYSTEMS[name], seed, 0.1), NUMPY)
            found += np.bincount(traced.status.ravel(), minlength=5)
    assert found[[OK, VIGNETTED, MISS, TOTAL_REFLECTION]].min() > 20, found
    assert found[DIVERGED] > 0, found
    assert found[OK] > 0.2 * found.sum(), found
