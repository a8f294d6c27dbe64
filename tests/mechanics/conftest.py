import csv
from pathlib import Path

import numpy as np
import pytest

from wavequake.mechanics.disturbances.layout import SegmentLayout

DATA = Path(__file__).parents[1] / "data"


def rotation_about_z(angle):
    return np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])


def polygon_areas(corners):
    x, y = corners[..., 0], corners[..., 1]
    return 0.5 * np.sum(x * np.roll(y, -1, axis=1) - np.roll(x, -1, axis=1) * y, axis=1)


def build_tmt_layout():
    """The 492 segments of the TMT from sector A of the published segmentation, repeated every 60 degrees."""
    with open(DATA / "tmt_sector.csv", newline="") as file:
        rows = [{key: value for key, value in row.items() if key != "id"} for row in csv.DictReader(file)]
    table = np.array([[float(value) for value in row.values()] for row in rows])
    center, normal, x_axis = table[:, 0:3], table[:, 3:6], table[:, 6:9]
    corners = table[:, 9:21].reshape(-1, 6, 2)
    axes = np.stack([x_axis, np.cross(normal, x_axis), normal], axis=2)
    turns = [rotation_about_z(np.pi / 3 * sector) for sector in range(6)]
    all_corners = np.concatenate([corners @ turn[:2, :2].T for turn in turns])
    return SegmentLayout(
        names=tuple(f"{sector}{index}" for sector in "ABCDEF" for index in range(1, 83)),
        centers_m=np.concatenate([center @ turn.T for turn in turns]),
        axes=np.concatenate([turn @ axes for turn in turns]),
        corners_m=all_corners,
        areas_m2=polygon_areas(all_corners),
    )


def build_hexagons(centers, side=0.716):
    """Flat regular hexagons at (x, y)."""
    centers = np.asarray(centers, dtype=float)
    angles = np.arange(6) * np.pi / 3
    corners = centers[:, None] + side * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    count = len(centers)
    return SegmentLayout(
        names=tuple(str(index) for index in range(count)),
        centers_m=np.column_stack([centers, np.zeros(count)]),
        axes=np.tile(np.eye(3), (count, 1, 1)),
        corners_m=corners,
        areas_m2=polygon_areas(corners),
    )


@pytest.fixture(scope="session")
def tmt():
    return build_tmt_layout()


@pytest.fixture(scope="session")
def hexagons():
    return build_hexagons


@pytest.fixture(scope="session")
def few():
    return build_hexagons([(0.0, 0.0), (1.2402, 0.0), (0.0, 2.5), (-5.0, 3.0), (9.0, -2.0)])
