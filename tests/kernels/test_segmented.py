from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from matplotlib.path import Path
from rotations import rotations
from segmented_cases import NAMES, OPENCL, assert_close, assert_same, one_mirror, poses

from wavequake.kernels.device.devices import NUMPY
from wavequake.kernels.device.example import two_mirrors
from wavequake.kernels.device.tiles import TILE
from wavequake.kernels.trace import segmented
from wavequake.kernels.trace.segmented import trace_segmented
from wavequake.kernels.trace.status import GAP, MISS, lost_at
from wavequake.optics.shapes.polygons import edge_spans

IN_GAP, MISSES_M2, MISSES_SPHERE = lost_at(GAP, -1), lost_at(MISS, 0), lost_at(MISS, 2)


@pytest.mark.parametrize("device", **NAMES)
def test_a_paraboloid_focuses_every_ray_in_one_point_with_one_path_length(device):
    traced = trace_segmented(**one_mirror(-1.0 / 2000.0, -1.0), device=device)
    assert (traced.status == 0).all()
    assert np.abs(traced.x).max() < 1e-11
    assert np.abs(traced.y).max() < 1e-11
    assert np.abs(traced.opd).max() < 2e-12


@pytest.mark.parametrize("device", **NAMES)
def test_a_plane_mirror_moved_along_the_light_changes_the_opd_by_twice_its_piston(device):
    arguments = one_mirror()
    piston = np.linspace(-1e-3, 2e-3, TILE)
    moved = arguments["segment_poses"].copy()
    moved[0, 0, 11] = -piston
    rest = trace_segmented(**arguments, device=device)
    traced = trace_segmented(**arguments | {"segment_poses": moved}, device=device)
    np.testing.assert_allclose(
        traced.opd - rest.opd, np.broadcast_to(-2.0 * piston, rest.opd.shape), rtol=0, atol=1e-12
    )


@pytest.mark.parametrize("device", **NAMES)
def test_a_constant_figure_is_a_piston_and_a_linear_one_a_tilt(device):
    arguments = one_mirror(degree=1)
    figure = arguments["figure"].copy()
    figure[0, 0, 0] = 1e-3
    rest = trace_segmented(**arguments, device=device)
    lifted = trace_segmented(**arguments | {"figure": figure}, device=device)
    np.testing.assert_allclose(lifted.opd - rest.opd, -2e-3, rtol=0, atol=1e-12)

    # z = slope (y - y_c): a ray parallel to z at height y is turned towards +y by twice
    # the slope's angle.
    slope = 1e-4
    figure[0, 0] = np.array([0.0, 0.0, slope / 0.01])[:, None]
    tilted = trace_segmented(**arguments | {"figure": figure}, device=device)
    y = arguments["ray_y"]
    height = slope * (y + 2.0)
    expected = y + np.tan(2.0 * np.arctan(slope)) * (1000.0 + height)
    np.testing.assert_allclose(
        tilted.y[0], np.broadcast_to(expected[:, None], tilted.y[0].shape), rtol=0, atol=1e-12
    )
    np.testing.assert_allclose(tilted.x, rest.x, rtol=0, atol=1e-12)


@pytest.mark.parametrize("device", **NAMES)
def test_a_parabolic_figure_on_a_plane_focuses(device):
    # z = -((x + 3)^2 + (y - 2)^2) / (4 f) about the center of the figure's frame, turned by 0.6 rad.
    focal_length = 250e3
    arguments = one_mirror(degree=4, image_z=-focal_length, sphere_radius=focal_length)
    scale, angle = 0.01, 0.6
    frames = np.array([[3.0, -2.0, scale * np.cos(angle), scale * np.sin(angle)]])
    arguments["train"] = replace(arguments["train"], figure_frames=frames)
    arguments["figure"][0, 0, 3] = arguments["figure"][0, 0, 5] = -1.0 / (4.0 * focal_length * scale**2)
    traced = trace_segmented(**arguments, device=device)
    assert np.abs(traced.x - 3.0).max() < 1e-9
    assert np.abs(traced.y + 2.0).max() < 1e-9


@pytest.mark.parametrize("device", **NAMES)
def test_a_ray_beside_the_glass_is_in_a_gap(device):
    arguments = two_mirrors()
    train, far = arguments["train"], arguments["train"].edges[0, 0]
    beyond = (far[2] + np.array([-0.01, 0.01]))[:, None] * far[:2]
    rays = {
        "ray_x": beyond[:, 0].copy(),
        "ray_y": beyond[:, 1].copy(),
        "candidates": np.zeros((2, 1), np.int32),
    }
    parallel = np.zeros((1, 3, TILE))
    parallel[0, 2] = 1.0
    traced = trace_segmented(**arguments | rays | {"directions": parallel}, device=device)
    assert train.edges.shape == (6, 6, 3)
    assert (traced.status[0, 0] == 0).all()
    assert (traced.status[0, 1] == IN_GAP).all()
    assert np.isnan([traced.opd[0, 1], traced.x[0, 1], traced.y[0, 1]]).all()


@pytest.mark.parametrize("device", **NAMES)
def test_glass_that_is_not_convex_holds_what_an_even_odd_rule_says(device):
    """Arrowheads about each center: rays in their notches and beside their barbs meet nothing."""
    arguments = two_mirrors(degree=2)
    train = arguments["train"]
    arrow = 700.0 * np.array([[-1.0, -0.9], [1.0, 0.1], [-0.8, 1.0], [-0.2, 0.0]])
    corners = train.figure_frames[:, None, :2] + arrow
    sharp = replace(train, edges=edge_spans(corners))
    traced = trace_segmented(**arguments | {"train": sharp}, device=device)
    rays = np.stack([arguments["ray_x"], arguments["ray_y"]], axis=1)
    own = arguments["candidates"][:, 0]
    inside = [Path(corners[segment]).contains_point(ray) for segment, ray in zip(own, rays, strict=True)]
    hull = [Path(corners[segment][:3]).contains_point(ray) for segment, ray in zip(own, rays, strict=True)]
    assert 5 < np.count_nonzero(inside) < np.count_nonzero(hull) < len(rays) - 5
    np.testing.assert_array_equal((traced.status[0] == 0).all(axis=1), inside)
    np.testing.assert_array_equal((traced.status[0] == IN_GAP).all(axis=1), ~np.array(inside))
    whole = trace_segmented(**arguments, device=device)
    np.testing.assert_array_equal(traced.opd[:, inside], whole.opd[:, inside])


@pytest.mark.parametrize("device", **NAMES)
def test_the_candidates_order_does_not_matter_and_none_is_a_gap(device):
    arguments = two_mirrors()
    own = arguments["candidates"][:, 0]
    expected = trace_segmented(**arguments, device=device)
    several = np.stack([(own + 1) % 6, np.full_like(own, -1), own, (own + 3) % 6], axis=1).astype(np.int32)
    assert_same(trace_segmented(**arguments | {"candidates": several}, device=device), expected)
    for columns in (0, 2):
        none = np.full((own.size, columns), -1, dtype=np.int32)
        assert (trace_segmented(**arguments | {"candidates": none}, device=device).status == IN_GAP).all()


@pytest.mark.parametrize("device", **NAMES)
def test_where_glass_overlaps_the_first_candidate_counts(device):
    arguments = one_mirror()
    train = replace(arguments["train"], edges=np.zeros((2, 0, 3)), figure_frames=np.zeros((2, 4)))
    arguments["train"] = train
    arguments["segment_poses"] = poses((np.eye(3), np.zeros(3)), (np.eye(3), [0.0, 0.0, -1.0]))
    first, second = (np.full((30, 1), segment, np.int32) for segment in (0, 1))
    piston = trace_segmented(**arguments | {"candidates": second}, device=device)
    both = trace_segmented(**arguments | {"candidates": np.hstack([second, first])}, device=device)
    assert_same(both, piston)
    # In half of the instants the first candidate is lost: the second counts there.
    arguments["segment_poses"][:, 1, :, ::2] = np.nan
    rest = trace_segmented(**arguments, device=device)
    both = trace_segmented(**arguments | {"candidates": np.hstack([second, first])}, device=device)
    np.testing.assert_array_equal(both.opd[..., ::2], rest.opd[..., ::2])
    np.testing.assert_array_equal(both.opd[..., 1::2], piston.opd[..., 1::2])


@pytest.mark.parametrize("device", **NAMES)
def test_a_ray_may_start_behind_the_mirror(device):
    # On the far pole of the sphere, where the formula that suits other rays is 0 / 0.
    arguments = one_mirror(curvature=1.0 / 500.0)
    before = trace_segmented(**arguments, device=device)
    for start_z in (600.0, 1000.0):
        behind = trace_segmented(**arguments | {"start_z": start_z}, device=device)
        np.testing.assert_allclose(behind.opd, before.opd, rtol=0, atol=5e-12)
        np.testing.assert_allclose(behind.x, before.x, rtol=0, atol=5e-12)
    pole = {"ray_x": np.zeros(1), "ray_y": np.zeros(1), "candidates": np.zeros((1, 1), np.int32)}
    at_pole = trace_segmented(**arguments | pole | {"start_z": 1000.0}, device=device)
    np.testing.assert_array_equal(at_pole.x, 0.0)
    np.testing.assert_allclose(at_pole.opd, 0.0, rtol=0, atol=1e-11)


@pytest.mark.parametrize("device", **NAMES)
def test_the_back_of_a_sphere_is_not_glass(device):
    # The ray enters the sphere about (0, 0, 100) beyond its equator.
    entry = np.array([-np.sqrt(100.0**2 - 10.0**2), 0.0, 110.0])
    direction = np.array([np.sin(1.4), 0.0, np.cos(1.4)])
    start = entry - (entry[2] + 20.0) / direction[2] * direction
    one_ray = {"ray_y": np.zeros(1), "candidates": np.zeros((1, 1), np.int32)}
    one_ray["directions"] = np.broadcast_to(direction[:, None], (1, 3, TILE)).copy()
    primary = one_mirror(curvature=1.0 / 100.0) | one_ray | {"ray_x": start[:1].copy()}
    assert (trace_segmented(**primary, device=device).status == IN_GAP).all()

    # The same after a plane primary, which the ray meets in the origin.
    flat = one_mirror() | one_ray | {"ray_x": np.array([-20.0 * np.tan(1.4)])}
    surfaces = {"surface_curvatures": np.array([1.0 / 100.0, 0.0]), "surface_conics": np.zeros(2)}
    flat["train"] = replace(flat["train"], **surfaces)
    turn = np.diag([1.0, -1.0, -1.0])
    flat["surface_poses"] = poses((turn, entry - 300.0 * direction), (np.eye(3), np.zeros(3)))
    assert (trace_segmented(**flat, device=device).status == MISSES_M2).all()


@pytest.mark.parametrize("device", **NAMES)
def test_lost_rays_say_which_surface_they_miss_and_are_nan(device):
    arguments = two_mirrors()
    train, poses_ = arguments["train"], arguments["surface_poses"]
    small = replace(train, surface_curvatures=np.array([-1.0 / 100.0, 0.0]), surface_conics=np.zeros(2))
    sideways = poses_.copy()
    sideways[:, 1, :9] = np.array([0, 0, 1, 0, 1, 0, -1, 0, 0])[:, None]
    lost_pose = arguments["segment_poses"].copy()
    lost_pose[:, 2] = np.nan
    nowhere = {"chief": np.full_like(arguments["chief"], np.nan)}
    axis = np.zeros(1)
    cases = [
        ({"train": small}, MISSES_M2),
        ({"train": replace(train, sphere_radius=1e-6)}, MISSES_SPHERE),
        (nowhere, MISSES_SPHERE),
        ({"surface_poses": np.full_like(poses_, np.nan)}, MISSES_M2),
        ({"segment_poses": np.full_like(lost_pose, np.inf)}, IN_GAP),
        ({"directions": np.full_like(arguments["directions"], np.nan)}, IN_GAP),
    ]
    for change, status in cases:
        traced = trace_segmented(**arguments | change, device=device)
        assert (traced.status == status).all()
        assert np.isnan([traced.opd, traced.x, traced.y]).all()
    # A ray parallel to the image plane: along the axis, over a mirror without an edge.
    plane = one_mirror() | {"ray_x": axis, "ray_y": axis, "candidates": np.zeros((1, 1), np.int32)}
    plane["surface_poses"] = poses(([[0, 0, 1], [0, 1, 0], [-1, 0, 0]], [0.0, 0.0, 5.0]))
    assert (trace_segmented(**plane, device=device).status == MISSES_M2).all()

    traced = trace_segmented(**arguments | {"segment_poses": lost_pose}, device=device)
    own = arguments["candidates"][:, 0] == 2
    assert (traced.status[:, own] == IN_GAP).all()
    assert (traced.status[:, ~own] == 0).all()
    np.testing.assert_array_equal(np.isnan(traced.opd), traced.status != 0)


@pytest.mark.parametrize("device", **NAMES)
def test_a_tile_alone_has_the_bits_of_the_tile_in_a_batch(device, monkeypatch):
    arguments = two_mirrors(tiles=7)
    batch = trace_segmented(**arguments, device=device)
    moving = ("segment_poses", "figure", "surface_poses", "directions", "chief")
    for tile in (0, 3, 6):
        alone = arguments | {name: arguments[name][tile : tile + 1].copy() for name in moving}
        assert_same(trace_segmented(**alone, device=device), batch, tile)
    monkeypatch.setattr(segmented, "_LAUNCH_BYTES", 3 * 25 * TILE * arguments["ray_x"].size)
    assert_same(trace_segmented(**arguments, device=device), batch)


@pytest.mark.parametrize("device", OPENCL, ids=NAMES["ids"])
@pytest.mark.parametrize("degree", [-1, 6])
def test_a_ray_alone_has_the_bits_of_the_ray_among_others(device, degree):
    """Whatever its neighbors try: segments of their own, others, or none."""
    arguments = two_mirrors(degree=degree)
    own = arguments["candidates"][:, 0]
    second = np.where(np.arange(own.size) % 3 == 0, (own + 1) % 6, -1)
    random = np.random.default_rng(5).permutation(own.size)[:35]
    rays = {"ray_x": arguments["ray_x"][random], "ray_y": arguments["ray_y"][random]}
    rays["candidates"] = np.stack([second, own], axis=1).astype(np.int32)[random]
    among = trace_segmented(**arguments | rays, device=device)
    assert (among.status == 0).all()
    for ray in (0, 1, 17, 33, 34):
        one = {name: np.ascontiguousarray(values[ray : ray + 1]) for name, values in rays.items()}
        alone = trace_segmented(**arguments | one, device=device)
        for name in ("opd", "x", "y", "status"):
            np.testing.assert_array_equal(getattr(alone, name)[:, 0], getattr(among, name)[:, ray])


@pytest.mark.parametrize("device", OPENCL, ids=NAMES["ids"])
@pytest.mark.parametrize("degree", [-1, 0, 1, 6])
def test_opencl_agrees_with_the_twin(device, degree):
    arguments = two_mirrors(tiles=2, degree=degree)
    if degree > 0:
        arguments["figure"] *= 1e4  # tenths of a millimeter
    assert_close(trace_segmented(**arguments, device=device), trace_segmented(**arguments, device=NUMPY))


@pytest.mark.parametrize("device", OPENCL, ids=NAMES["ids"])
@settings(max_examples=40)
@given(
    seed=st.integers(0, 2**31),
    primary=st.tuples(st.floats(-1 / 8e3, 1 / 40e3), st.floats(-3.0, 0.5)),
    secondary=st.tuples(st.floats(1 / 5e4, 1 / 1e4), st.floats(-4.0, 0.5)),
    sign=st.sampled_from([-1.0, 1.0]),
)
def test_opencl_agrees_with_the_twin_on_any_system(device, seed, primary, secondary, sign):
    random = np.random.default_rng(seed)
    arguments = two_mirrors(seed=seed)
    train = replace(
        arguments["train"],
        primary_curvature=primary[0],
        primary_conic=primary[1],
        surface_curvatures=np.array([sign * secondary[0], 0.0]),
        surface_conics=np.array([secondary[1], 0.0]),
    )
    for name in ("segment_poses", "surface_poses"):
        turns = rotations(random.normal(0.0, 0.01, (arguments[name].shape[1] * TILE, 3)))
        turns = turns.reshape(-1, TILE, 9).transpose(0, 2, 1)
        arguments[name][0, :, :9] = turns
    arguments["surface_poses"][:, :, 11] *= 0.2
    traced, expected = (
        trace_segmented(**arguments | {"train": train}, device=where) for where in (device, NUMPY)
    )
    assert_close(traced, expected)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"ray_y": np.zeros(3)}, "ray_y"),
        ({"candidates": np.zeros((72, 1))}, "int32"),
        ({"candidates": np.full((72, 1), 6, np.int32)}, "the last segment"),
        ({"candidates": np.zeros(72, np.int32)}, "candidates"),
        ({"segment_poses": np.zeros((1, 6, 12))}, "segment_poses"),
        ({"surface_poses": np.zeros((2, 2, 12, 16))}, "surface_poses"),
        ({"figure": None}, "figure_degree"),
        ({"figure": np.zeros((1, 6, 9, 16))}, "figure"),
        ({"chief": np.zeros((1, 2, 16))}, "chief"),
        ({"mirror_figure": np.zeros((1, 1, 3, 16))}, "mirror_degree"),
        ({"ray_x": np.zeros(72, np.float32)}, "float64"),
    ],
)
def test_arrays_that_do_not_fit_are_named(change, message):
    with pytest.raises(ValueError, match=message):
        trace_segmented(**two_mirrors() | change, device=NUMPY)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"edges": np.zeros((0, 6, 3))}, "no segments"),
        ({"edges": np.zeros((6, 6))}, "edges"),
        ({"figure_frames": np.zeros((5, 4))}, "figure_frames"),
        ({"surface_conics": np.zeros(3)}, "surface_conics"),
        ({"surface_curvatures": np.ones(2)}, "image plane"),
        ({"sphere_radius": 0.0}, "sphere_radius"),
        ({"semi_diameters": np.ones(3)}, "semi_diameters"),
        ({"mirror_degree": 2}, "mirror_radii"),
    ],
)
def test_a_train_that_does_not_fit_together_is_refused(change, message):
    arguments = two_mirrors()
    with pytest.raises(ValueError, match=message):
        trace_segmented(**arguments | {"train": replace(arguments["train"], **change)}, device=NUMPY)


@pytest.mark.parametrize("device", **NAMES)
def test_no_rays_and_no_tiles_give_empty_results(device):
    arguments = two_mirrors()
    none = np.zeros(0)
    rays = {"ray_x": none, "ray_y": none, "candidates": np.zeros((0, 1), dtype=np.int32)}
    assert trace_segmented(**arguments | rays, device=device).opd.shape == (1, 0, TILE)
    moving = ("segment_poses", "figure", "surface_poses", "directions", "chief")
    no_tiles = {name: arguments[name][:0] for name in moving}
    assert trace_segmented(**arguments | no_tiles, device=device).opd.shape == (0, 72, TILE)
