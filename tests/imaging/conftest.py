import csv
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

DATA = Path(__file__).parents[1] / "data"


@dataclass(frozen=True)
class Pupil:
    corners: np.ndarray
    centers: np.ndarray
    pistons: np.ndarray  # waves, those of the 35 nm reference
    reference: dict
    diameter: float = 30000.0


@pytest.fixture(scope="session")
def tmt():
    """The 492 segments of the TMT: one published sector, repeated every 60 degrees."""
    with open(DATA / "psf_tmt_sector.csv", newline="") as file:
        table = np.array([[float(value) for value in row[1:]] for row in list(csv.reader(file))[1:]]) * 1e3
    angles = np.arange(6) * np.pi / 3
    turns = [np.array([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]]) for a in angles]
    corners = np.concatenate([table[:, 2:].reshape(-1, 6, 2) @ turn.T for turn in turns])
    centers = np.concatenate([table[:, :2] @ turn.T for turn in turns])
    with open(DATA / "psf_tmt492.json") as file:
        reference = json.load(file)
    pistons = 35.0 / 550.0 * np.random.default_rng(492).normal(0, 1, 492)
    return Pupil(corners, centers, pistons, reference)


@pytest.fixture(scope="session")
def flower():
    """Seven hexagons of different sizes and orientations, one of them far from the lattice."""
    rng = np.random.default_rng(5)
    centers = 900.0 * np.array([[0, 0], *[[np.cos(a), np.sin(a)] for a in np.arange(6) * np.pi / 3]])
    centers += rng.normal(0, 15, centers.shape)
    angles = np.arange(6) * np.pi / 3 + rng.uniform(0, 1, (7, 1))
    sizes = rng.uniform(300, 430, (7, 1))
    corners = centers[:, None] + np.stack([sizes * np.cos(angles), sizes * np.sin(angles)], axis=2)
    return Pupil(corners, centers + rng.normal(0, 10, centers.shape), rng.normal(0, 0.1, 7), {}, 2600.0)
