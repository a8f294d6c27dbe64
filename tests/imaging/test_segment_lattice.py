"""Images of equal segments on a lattice, against the general basis of segments and sums over polygons."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from wavequake.errors import UserError
from wavequake.imaging.engines.choice import SegmentedPupil, point_spread, prepare_psf
from wavequake.imaging.engines.polygon_transform import polygon_transform
from wavequake.imaging.engines.segment_basis import segment_basis
from wavequake.imaging.engines.segment_lattice import lattice_psf, segment_lattice
from wavequake.imaging.engines.segment_psf import psf, truncation_error
from wavequake.kernels.device.devices import Device, list_devices
from wavequake.kernels.transforms import lattice
from wavequake.optics.segments.catalog import telescope
from wavequake.optics.segments.layout import hexagon_ring_segments

RNG = np.random.default_rng(3)
_HEXAGONS = hexagon_ring_segments(700.0, 3, 5.0)
CORNERS, CENTERS = _HEXAGONS.corners, _HEXAGONS.centers[:, :2]
TURN = np.array([[0.0, 1.0], [-1.0, 0.0]])
SQUARE = 400.0 * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
_GRID = np.array([[x, y] for x in (0, 1, 3) for y in (0, 1)]) * [900.0, 1000.0] + [50.0, -300.0]
WEDGE = np.array([[-1.0, -1.0], [2.0, -1.0], [-1.0, 1.5]]) * 200.0
_ROW = np.array([[x, 0.0] for x in range(4)]) * 700.0
PUPILS = {
    "hexagons": (CORNERS, CENTERS),
    "hexagons, turned": (CORNERS @ TURN, CENTERS @ TURN),
    "squares, uncentered": (_GRID[:, None] + SQUARE, _GRID),
    "row of wedges": (_ROW[:, None] + WEDGE, _ROW),
    "one": (WEDGE[None] + 30.0, np.array([[30.0, 30.0]])),
    "a hexagon missing": (np.delete(CORNERS, 5, axis=0), np.delete(CENTERS, 5, axis=0)),
}
DIAMETER = 9000.0
DEVICES = list_devices()
DEVICES += [Device(device.name, "gpu", device.platform, 1) for device in DEVICES if device.kind == "cpu"]


@pytest.mark.parametrize("device", DEVICES, ids=lambda device: device.kind)
@pytest.mark.parametrize("pixels", [2, 16, 33])
@pytest.mark.parametrize("name", PUPILS)
def test_images_are_those_of_the_general_basis(name, pixels, device):
    corners, centers = PUPILS[name]
    piston = RNG.normal(0.0, 0.2, (19, len(centers)))
    prepared = segment_lattice(corners, centers, pixels, 0.3, DIAMETER, device=device)
    assert (prepared.kernel is None) == (device.kind != "cpu")
    found = lattice_psf(prepared, piston)
    basis = segment_basis(corners, centers, pixels, 0.3, DIAMETER, 1, np.complex128)
    assert np.abs(found.reshape(len(found), -1) - psf(basis, piston)).max() < 1e-12
    assert np.array_equal(lattice_psf(prepared, piston[17:]), found[17:])  # bits do not depend on the batch


@given(
    rings=st.integers(1, 4),
    gap=st.floats(0.0, 50.0),
    lost=st.floats(0.0, 0.6),
    pixels=st.integers(2, 40),
    sampling=st.floats(0.05, 1.0),
    turned=st.booleans(),
    seed=st.integers(0, 2**32 - 1),
)
def test_images_of_any_hexagons_are_those_of_the_general_basis(
    rings, gap, lost, pixels, sampling, turned, seed
):
    random = np.random.default_rng(seed)
    hexagons = hexagon_ring_segments(700.0, rings, gap)
    kept = random.uniform(size=len(hexagons.corners)) >= lost
    kept[random.integers(len(kept))] = True
    turn = TURN if turned else np.eye(2)
    corners, centers = hexagons.corners[kept] @ turn, hexagons.centers[kept, :2] @ turn
    piston = random.normal(0.0, 2.0, (3, len(centers)))
    prepared = segment_lattice(corners, centers, pixels, sampling, DIAMETER)
    if prepared is None:  # few of many are left: a lattice with more holes than places that are taken
        assert kept.mean() < 0.5
        return
    basis = segment_basis(corners, centers, pixels, sampling, DIAMETER, 1, np.complex128)
    found = lattice_psf(prepared, piston).reshape(3, -1)
    assert np.abs(found - psf(basis, piston)).max() < 1e-12


@pytest.mark.parametrize("moments", [6, 15])
@pytest.mark.parametrize("pixels", [2, 33])
@pytest.mark.parametrize("name", ["hexagons", "squares, uncentered", "row of wedges", "one"])
def test_tilted_segments_are_those_of_the_general_basis(name, pixels, moments):
    corners, centers = PUPILS[name]
    motion = RNG.normal(0.0, 1.0, (3, len(centers), 3)) * [0.2, 6e-5, 6e-5]
    basis = segment_basis(corners, centers, pixels, 0.3, DIAMETER, moments, np.complex128)
    tolerance = 1.001 * truncation_error(basis, motion)[-1].max()  # all moments are needed
    expected = psf(basis, motion, tolerance)
    for device in DEVICES:
        prepared = segment_lattice(corners, centers, pixels, 0.3, DIAMETER, device=device, moments=moments)
        if device.kind != "cpu":
            assert prepared is None
            continue
        found = lattice_psf(prepared, motion)
        assert np.abs(found.reshape(len(found), -1) - expected).max() < 1e-12
        bound = truncation_error(prepared, motion)
        assert np.allclose(bound, truncation_error(basis, motion), rtol=1e-9)
        motion[1, 0, 2] = np.nan
        broken = lattice_psf(prepared, motion)
        assert np.isnan(broken[1]).all()
        assert np.array_equal(broken[[0, 2]], found[[0, 2]])
        motion[1, 0, 2] = 0.0
        single = segment_lattice(corners, centers, pixels, 0.3, DIAMETER, np.float32, device, moments)
        assert np.abs(lattice_psf(single, motion[:1]) - found[0]).max() < 2e-6


def test_pixels_equal_a_direct_sum_over_polygons():
    piston, pixels, sampling = RNG.normal(0.0, 0.2, (1, len(CENTERS))), 9, 0.7
    found = lattice_psf(segment_lattice(CORNERS, CENTERS, pixels, sampling, DIAMETER), piston)[0]
    axis = (np.arange(pixels) - pixels // 2) * sampling / DIAMETER
    y, x = np.meshgrid(axis, axis, indexing="ij")
    field = polygon_transform(CORNERS, x.ravel(), y.ravel()) @ np.exp(2j * np.pi * piston[0])
    peak = polygon_transform(CORNERS, np.zeros(1), np.zeros(1)).sum().real
    assert np.abs(found.ravel() - np.abs(field / peak) ** 2).max() < 1e-13


@pytest.mark.parametrize("device", DEVICES, ids=lambda device: device.kind)
def test_single_precision(device):
    piston = RNG.normal(0.0, 0.2, (3, len(CENTERS)))
    exact = lattice_psf(segment_lattice(CORNERS, CENTERS, 32, 0.25, DIAMETER), piston)
    single = lattice_psf(segment_lattice(CORNERS, CENTERS, 32, 0.25, DIAMETER, np.float32, device), piston)
    assert single.dtype == np.float32
    assert 1e-9 < np.abs(single - exact).max() < 2e-6


@pytest.mark.parametrize("device", DEVICES, ids=lambda device: device.kind)
def test_instants_do_not_depend_on_each_other(device):
    prepared = segment_lattice(CORNERS, CENTERS, 16, 0.25, DIAMETER, device=device)
    piston = RNG.normal(0.0, 0.2, (5, len(CENTERS)))
    healthy = lattice_psf(prepared, piston)
    assert np.array_equal(healthy, [lattice_psf(prepared, row[None])[0] for row in piston])
    assert np.abs(lattice_psf(prepared, piston + 1e6) - healthy).max() < 1e-8  # whole waves are reduced first
    piston[1, 0], piston[3, 4] = np.nan, np.inf
    broken = lattice_psf(prepared, piston)
    assert np.isnan(broken[[1, 3]]).all()
    assert np.array_equal(broken[[0, 2, 4]], healthy[[0, 2, 4]])
    assert lattice_psf(prepared, piston[:0]).shape == (0, 16, 16)


def test_images_too_large_for_a_work_item_s_memory_are_left_to_numpy(monkeypatch):
    grid = 16, 0.25, DIAMETER, np.float32, DEVICES[0]
    assert (segment_lattice(CORNERS, CENTERS, *grid).kernel is None) == (DEVICES[0].kind != "cpu")
    monkeypatch.setattr(lattice, "_LOCAL_SPARE", 1 << 40)
    assert segment_lattice(CORNERS, CENTERS, *grid).kernel is None


@pytest.mark.parametrize("device", DEVICES, ids=lambda device: device.kind)
def test_local_memory_holds_what_a_device_takes(device):
    """In PoCL a kernel that asks for more ends the process."""
    hexagons = hexagon_ring_segments(700.0, 13, 5.0)
    centers = hexagons.centers[:, :2]
    given = 128, 0.3, 4e4, np.float64, device, 15
    prepared = segment_lattice(hexagons.corners, centers, *given)
    if prepared is not None:  # there is room for 2 MB
        assert np.isfinite(lattice_psf(prepared, np.zeros((1, len(centers), 3)))).all()


def test_what_is_no_lattice_of_equals_is_left_to_others():
    grid = 16, 0.25, DIAMETER
    moved, wider = CENTERS.copy(), CORNERS.copy()
    moved[4, 0] += 1e-6
    wider[7] += 1e-6 * (wider[7] - CENTERS[7])
    assert segment_lattice(CORNERS - CENTERS[:, None] + moved[:, None], moved, *grid) is None
    assert segment_lattice(wider, CENTERS, *grid) is None
    slanted = np.array([[np.cos(0.3), np.sin(0.3)], [-np.sin(0.3), np.cos(0.3)]])
    assert segment_lattice(CORNERS @ slanted, CENTERS @ slanted, *grid) is None
    close = np.concatenate([_ROW, _ROW[-1:] + 1e-5])  # of a tiny step
    assert segment_lattice(close[:, None] + WEDGE, close, *grid) is None
    scaled = telescope("tmt").segments
    assert segment_lattice(scaled.corners, scaled.centers[:, :2], 16, 0.25, 30000.0) is None


@pytest.mark.parametrize("device", DEVICES, ids=lambda device: device.kind)
def test_the_chooser_takes_lattices_for_tilted_segments_where_they_can_be(device):
    pupil = SegmentedPupil(CORNERS, CENTERS, DIAMETER)
    engine = prepare_psf(pupil, 16, 0.25, corner_phase=0.2, device=device)
    names = {"cpu": "SegmentLattice"}
    assert type(engine.basis).__name__ == names.get(device.kind, "SegmentBasis")
    motion = RNG.normal(0.0, 1.0, (4, len(CENTERS), 3)) * [0.1, 2e-5, 2e-5]
    motion[1, :, 1] = 8e-5  # too steep for its moments: sampled
    exact = psf(segment_basis(CORNERS, CENTERS, 16, 0.25, DIAMETER, 45, np.complex128), motion, 0.1)
    difference = np.abs(point_spread(engine, motion).reshape(4, -1) - exact).max(axis=1)
    assert difference[[0, 2, 3]].max() < engine.tolerance
    assert difference[1] < 1e-3


def test_the_chooser_takes_lattices_of_pistons_alone():
    pupil = SegmentedPupil(CORNERS, CENTERS, DIAMETER)
    engine = prepare_psf(pupil, 16, 0.25)
    assert (engine.name, type(engine.basis).__name__) == ("segments", "SegmentLattice")
    tilted = prepare_psf(pupil, 16, 0.25, corner_phase=1.0)
    assert type(tilted.basis).__name__ == "SegmentBasis"
    assert engine.seconds["segments"] < 0.3 * tilted.seconds["segments"]
    motion = np.zeros((4, len(CENTERS), 3))
    motion[..., 0] = RNG.normal(0.0, 0.1, motion.shape[:2])
    motion[1, :, 1:] = RNG.normal(0.0, 2e-5, (len(CENTERS), 2))  # slopes: sampled
    motion[3, 2, 0] = np.inf
    found, expected = point_spread(engine, motion), point_spread(tilted, motion[:3])
    assert np.abs(found[:3] - expected)[[0, 2]].max() < 1e-12
    assert np.abs(found[:3] - expected)[1].max() < 1e-3
    assert np.isnan(found[3]).all()
    assert not np.isnan(found[:3]).any()


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"pixels": 1}, "2 x 2 points"),
        ({"sampling": np.nan}, "sampling"),
        ({"diameter": 0.0}, "diameter"),
        ({"centers": CENTERS * np.nan}, "finite centers"),
        ({"centers": CENTERS[1:]}, "finite centers"),
        ({"corners": CORNERS[:, ::-1]}, "counter-clockwise"),
        ({"corners": CORNERS * np.nan}, "not a finite number"),
        ({"moments": 3}, "1, 6, 15, 28, 45 moments per segment, not 3"),
    ],
)
def test_impossible_lattices_are_refused(changed, words):
    good = {"corners": CORNERS, "centers": CENTERS, "pixels": 8, "sampling": 0.25, "diameter": DIAMETER}
    with pytest.raises(UserError, match=words):
        segment_lattice(**good | changed)
