"""Lens files of public repositories against a tracer that shares no code with ours.

`tests/data/lenses/expected.csv` says where they are from.
"""

import csv
from pathlib import Path

import numpy as np
import pytest

from wavequake.errors import UserError
from wavequake.kernels.trace.sequence import Rays
from wavequake.kernels.trace.sequential_numpy import trace_sequence_numpy
from wavequake.kernels.trace.status import OK
from wavequake.optics.rays.packing import moving, pack
from wavequake.optics.systems.info import info
from wavequake.optics.systems.kinematics import rest_states
from wavequake.optics.systems.paraxial import paraxial
from wavequake.optics.zemax.read import read_zmx

FOLDER = Path(__file__).parents[1] / "data" / "lenses"
# The tracer takes first-order data as if nothing were tilted, ours follow the axis: by 1.5e-6.
TILTED = {"skzemax_e07_tiltdecenterandmfoperand": 2e-6}


def expected():
    lines = (FOLDER / "expected.csv").read_text(encoding="utf-8").splitlines()
    return list(csv.DictReader(line for line in lines if not line.startswith("#")))


def end(system, row, k):
    """Where the ray k of a row ends: image x and y, path."""
    numbers = {name: float(row[f"{name}{k}"]) for name in ("nm", *"xyzlmn")}
    start = np.array([[numbers[name]] for name in "xyz"])
    direction = np.array([[numbers[name]] for name in "lmn"])
    sequence, rest = pack(system, numbers["nm"] * 1e-6), moving(system, rest_states(system))
    traced = trace_sequence_numpy(sequence, Rays(start, direction, np.zeros(1)), rest, True)
    assert traced.status[0, 0] == OK
    return traced.x[0, 0], traced.y[0, 0], traced.path[0, 0]


@pytest.mark.parametrize("row", expected(), ids=lambda row: row["file"])
def test_a_file_is_traced_as_by_another_tracer(row):
    path = FOLDER / f"{row['file']}.zmx"
    if row["refused"]:
        with pytest.raises(UserError) as refused:
            info(read_zmx(path))
        told = f"{refused.value} {refused.value.details}"
        assert row["refused"] in told.replace(",", " ") or row["refused"] in told
        return
    system = read_zmx(path)
    focal = paraxial(system).focal_length
    theirs = float(row["focal_length"] or focal)  # not by thicknesses and powers where the axis ray bends
    assert (
        focal == pytest.approx(theirs, rel=TILTED.get(row["file"], 1e-6)) or np.isinf([focal, theirs]).all()
    )
    for k in (1, 2):
        x, y, way = end(system, row, k)
        assert [x, y] == pytest.approx([float(row[f"image_x{k}"]), float(row[f"image_y{k}"])], abs=1e-9)
        waves = (way - float(row[f"path{k}"])) / (float(row[f"nm{k}"]) * 1e-6)
        assert abs(waves) < 1e-5
    assert row["file"] in info(system) or system.name in info(system)


def test_the_collection_holds_what_it_says():
    rows = expected()
    assert {row["file"] for row in rows} == {path.stem for path in FOLDER.glob("*.zmx")}
    read = [row for row in rows if not row["refused"]]
    assert len(rows) >= 50
    assert len(read) >= 50
