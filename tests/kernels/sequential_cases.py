"""What tests of the sequential trace share: devices, poses, rays, one paraboloid made in every way."""

from dataclasses import replace

import numpy as np

from wavequake.kernels.device.devices import NUMPY, Device, list_devices
from wavequake.kernels.trace.sequence import Element, Grid, Polynomial, Rays, Ring

OPENCL = [device for device in list_devices() if device.kind != "numpy"]
# Processors also run the variant for GPUs: one ray per work-item, copied buffers.
OPENCL += [Device(device.name, "gpu", device.platform, 1) for device in OPENCL if device.kind == "cpu"]
ALL = [NUMPY, *OPENCL]
NAMES = {"argvalues": ALL, "ids": lambda device: f"{device.kind}-{device.vector_width}"}
IMAGE = Element()


def shifts(*steps):
    """Poses of elements of which each stands `step` (a z, or x, y, z) from the one before; one instant."""
    packed = [
        [*np.eye(3).ravel(), *(-np.broadcast_to(step, 3) * ([0, 0, 1] if np.ndim(step) == 0 else 1))]
        for step in steps
    ]
    return np.array([packed])


def turned(angle, shift=(0.0, 0.0, 0.0)):
    """Pose of an element turned by `angle` about the y axis and then shifted in the frame before."""
    turn = np.array([[np.cos(angle), 0, -np.sin(angle)], [0, 1, 0], [np.sin(angle), 0, np.cos(angle)]])
    return np.array([*turn.ravel(), *(-turn @ np.asarray(shift))])


def collimated(radius=90.0, z=-20.0, count=37, angle=0.0):
    """Rays along z, or turned by `angle` towards x; their path counts from z."""
    random = np.random.default_rng(2)
    r, phi = radius * np.sqrt(random.uniform(0, 1, count)), random.uniform(0, 2 * np.pi, count)
    direction = np.tile(np.array([[np.sin(angle)], [0.0], [np.cos(angle)]]), (1, count))
    return Rays(np.stack([r * np.cos(phi), r * np.sin(phi), np.full(count, z)]), direction, np.zeros(count))


def from_point(point, half_angle, sense=1.0, count=37):
    """Rays from a point with directions within `half_angle` of the z axis."""
    random = np.random.default_rng(3)
    sine, phi = np.sin(half_angle) * random.uniform(0, 1, count), random.uniform(0, 2 * np.pi, count)
    direction = np.stack([sine * np.cos(phi), sine * np.sin(phi), sense * np.sqrt(1.0 - sine * sine)])
    return Rays(np.tile(np.reshape(point, (3, 1)), (1, count)).astype(float), direction, np.zeros(count))


def paraboloids():
    """The same paraboloid z = -(x^2 + y^2) / (4 f), f = 1000 mm, made in every way."""
    power = -1.0 / 4000.0
    square = np.zeros(6)
    square[[3, 5]] = power * 100.0**2
    zernike = np.zeros(6)
    zernike[4:] = power * 100.0**2 * np.array([0.5 / np.sqrt(3.0), 0.5])  # defocus and piston come last
    place = -120.0 + 8.0 * np.arange(31)
    # The B-spline of x^2 has the coefficients x_k^2 - dx^2 / 3.
    nodes = power * (place[:, None] ** 2 + place**2 - 2.0 * 8.0**2 / 3.0)
    mirror = Element(action="reflect")
    return {
        "conic": (Element(-1.0 / 2000.0, -1.0, "reflect"), None, None),
        "even": (replace(mirror, even=(power,)), None, None),
        "polynomial": (replace(mirror, polynomial=Polynomial(2, 100.0, square)), None, None),
        "ring": (
            replace(mirror, polynomial=Polynomial(2, 100.0, zernike, Ring())), None, None
        ),
        "grid": (replace(mirror, grid=Grid(-120.0, -120.0, 8.0, 8.0, nodes)), None, None),
        "moving": (replace(mirror, deformation_degree=2, deformation_radius=100.0), square[None], None),
        "moving ring": (
            replace(mirror, deformation_degree=2, deformation_radius=100.0, deformation_basis=Ring()),
            zernike[None],
            None,
        ),
        "moving grid": (
            replace(mirror, deformation_grid=Grid(-120.0, -120.0, 8.0, 8.0, np.zeros((4, 4)))),
            None,
            nodes[None],
        ),
        "all together": (
            Element(
                -1.0 / 8000.0, -1.0, "reflect", even=(power / 4,),
                polynomial=Polynomial(2, 100.0, square / 8),
                grid=Grid(-120.0, -120.0, 8.0, 8.0, nodes / 8),
                deformation_degree=2, deformation_radius=100.0, deformation_basis=Ring(),
                deformation_grid=Grid(-120.0, -120.0, 8.0, 8.0, np.zeros((4, 4))),
            ),
            zernike[None] / 8,
            nodes[None] / 8,
        ),
    }  # fmt: skip
