"""The viewer's film of edge sensors' loops: facing corners of segments move alike in a smooth shape."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

import wavequake as wq
from wavequake.viewer.film import displacements
from wavequake.viewer.view import film_of

KEYS = {"mirror.telescope": "tmt-18", "campaign.cases": 2, "control.bandwidths_hz": [0.3]}


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    folder = tmp_path_factory.mktemp("control") / "store"
    wq.run("tmt-m1-control", store=folder, on="serial", **{k.replace(".", "__"): v for k, v in KEYS.items()})
    return folder


def test_modes_of_the_structure_and_of_the_mirror(store):
    study, found = wq.load_study("tmt-m1-control", KEYS), film_of(store, [])
    stage, count = found.stages[0], 18
    takes = {take.of: take for take in found.takes}
    assert len(takes) == len(found.takes) == len(study.mode) + 8
    for one in study.mode:
        take = takes[f"structure, {one.name}"]
        assert take.time[-1] * one.hz == pytest.approx(47 / 48)
        moved = 1e9 * displacements(stage, take)[0]
        segments = stage.body < count
        heights, flat = moved[segments, 2], stage.points[segments, :2]
        pairs = cKDTree(flat).query_pairs(0.02, output_type="ndarray")
        body = stage.body[segments]
        facing = pairs[body[pairs[:, 0]] != body[pairs[:, 1]]]
        assert len(facing) > 40
        jumps = heights[facing[:, 0]] - heights[facing[:, 1]]
        # A plane per segment follows a curved shape to second order; slopes of the wrong sign do not.
        if max(one.zernike) <= 6:
            assert np.sqrt(np.mean(jumps**2)) < 0.3 * np.sqrt(np.mean(heights**2))
    centers = np.stack([stage.pivots[:count, 0], stage.pivots[:count, 1]])
    astigmatism = next(one for one in study.mode if set(one.zernike) == {6})
    pistons = takes[f"structure, {astigmatism.name}"].poses[0, :count, 2]
    shape = centers[0] ** 2 - centers[1] ** 2  # Noll's j = 6
    assert abs(np.corrcoef(pistons, shape)[0, 1]) > 0.99


def test_of_the_mirror_that_seen_least_moves_most(store):
    takes = [take for take in film_of(store, [1]).takes if take.of.startswith("mirror")]
    sizes = [float(take.note.split(" nm rms")[0]) for take in takes]
    assert sizes == sorted(sizes, reverse=True)
    multipliers = wq.open_store(store)["multiplier"].to_numpy()[:8]
    np.testing.assert_allclose(np.array(sizes) / sizes[0], multipliers / multipliers[0], rtol=5e-3)
    assert {take.case for take in takes} == {1}
    page = wq.view(store).read_text(encoding="utf-8")
    assert "the least seen first" in page
    assert wq.animate(store, 1, of="mirror, mode 1").stat().st_size > 1000
