"""A small segmented telescope and a lens for the self test of devices."""

from typing import Any

import numpy as np

from wavequake.kernels.device.tiles import TILE
from wavequake.kernels.trace.segmented import SegmentedTrain, trace_chief
from wavequake.kernels.trace.sequence import Element, Moving, Polynomial, Rays, Sequence

_SIDE = 1000.0
_ANGLES = np.pi / 6.0 + np.pi / 3.0 * np.arange(6)


def two_mirrors(tiles: int = 1, degree: int = 3, seed: int = 0) -> dict[str, Any]:
    """Return arguments of `trace_segmented`, all but the device: six moving hexagons, a secondary, an image.

    A Cassegrain telescope: parabolic segments of radius -20 m about a hole, a hyperboloid 8 m before them.
    Segments move by some 10 nm and 10 nrad and carry a figure of `degree` (-1: none) of some 10 nm.
    """
    random = np.random.default_rng(seed)
    centers = np.sqrt(3.0) * _SIDE * np.stack([np.cos(_ANGLES), np.sin(_ANGLES)], axis=-1)
    normals = np.stack([np.cos(_ANGLES), np.sin(_ANGLES)], axis=-1)
    offsets = centers @ normals.T + 0.5 * np.sqrt(3.0) * _SIDE - 1.0
    edges = np.concatenate([np.broadcast_to(normals, (6, 6, 2)), offsets[..., None]], axis=-1)
    frames = np.concatenate([centers, np.full((6, 1), 1.0 / _SIDE), np.zeros((6, 1))], axis=-1)
    # The secondary's foci are the primary's focus, 2 m behind it, and the image, 10 m before it.
    conic = -((12.0 / 8.0) ** 2)
    train = SegmentedTrain(
        -1.0 / 20e3, -1.0, edges, frames, degree, np.array([-1.0 / 5e3, 0.0]), np.array([conic, 0.0]), 10e3
    )
    around = random.uniform(-0.6, 0.6, (6, 12, 2)) * _SIDE
    ray_x, ray_y = (centers[:, None] + around).reshape(-1, 2).T
    candidates = np.repeat(np.arange(6, dtype=np.int32), 12)[:, None]

    segment_poses = np.zeros((tiles, 6, 12, TILE))
    turn = random.normal(0.0, 1e-8, (3, tiles, 6, TILE))
    segment_poses[:, :, [0, 4, 8]] = 1.0
    segment_poses[:, :, [5, 6, 1]] = np.moveaxis(turn, 0, 2)
    segment_poses[:, :, [7, 2, 3]] = -np.moveaxis(turn, 0, 2)
    segment_poses[:, :, 9:] = random.normal(0.0, 1e-5, (tiles, 6, 3, TILE))
    terms = (degree + 1) * (degree + 2) // 2
    figure = None if degree < 0 else random.normal(0.0, 1e-5, (tiles, 6, terms, TILE))
    surface_poses = np.zeros((tiles, 2, 12, TILE))
    surface_poses[:, :, [0, 4, 8]] = 1.0
    surface_poses[:, 0, 11], surface_poses[:, 1, 11] = 8e3, -10e3
    surface_poses[:, 0, 9:] += random.normal(0.0, 1e-4, (tiles, 3, TILE))
    directions = np.zeros((tiles, 3, TILE))
    directions[:, :2] = random.normal(0.0, 1e-6, (tiles, 2, TILE))
    directions[:, 2] = np.sqrt(1.0 - np.sum(directions[:, :2] ** 2, axis=1))
    chief = trace_chief(train, surface_poses, directions, -100.0)
    return {
        "train": train,
        "ray_x": ray_x.copy(),
        "ray_y": ray_y.copy(),
        "start_z": -100.0,
        "candidates": candidates,
        "segment_poses": segment_poses,
        "figure": figure,
        "surface_poses": surface_poses,
        "directions": directions,
        "chief": chief,
    }


def lens(instants: int = 2, seed: int = 0) -> tuple[Sequence, Rays, Moving]:
    """Return arguments of `trace_sequence`, all but the device: an asphere, a deformed sphere and an image.

    The first surface is an even asphere, the second one deforms from instant to instant by some 100 nm.
    """
    random = np.random.default_rng(seed)
    front = Element(1.0 / 80.0, -0.6, "refract", 1.5, even=(0.0, 1e-8))
    rear = Element(
        -1.0 / 200.0,
        0.0,
        "refract",
        1.0,
        polynomial=Polynomial(3, 20.0, random.normal(0.0, 1e-4, 10)),
        deformation_degree=4,
        deformation_radius=20.0,
    )
    poses = np.zeros((instants, 3, 12))
    poses[..., [0, 4, 8]] = 1.0
    poses[..., 9:] = random.normal(0.0, 1e-4, (instants, 3, 3))
    poses[:, 1:, 11] -= np.array([8.0, 110.0])
    square, azimuth = random.uniform(0.0, 1.0, 48), random.uniform(0.0, 2.0 * np.pi, 48)
    radius = 15.0 * np.sqrt(square)
    position = np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), np.full(48, -10.0)])
    direction = np.broadcast_to(np.array([[0.0], [0.0], [1.0]]), (3, 48))
    moving = Moving(poses, deformations=(None, random.normal(0.0, 1e-4, (instants, 15)), None))
    return Sequence((front, rear, Element())), Rays(position, direction, np.zeros(48)), moving
