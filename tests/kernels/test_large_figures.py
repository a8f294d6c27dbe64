"""Figures of mirrors of any size, against one ray at a time traced with a root finder of SciPy."""

from math import comb

import numpy as np
import pytest
from scipy.optimize import brentq
from segmented_cases import NAMES, OPENCL, assert_same, poses

from wavequake.kernels.device.devices import NUMPY
from wavequake.kernels.device.example import two_mirrors
from wavequake.kernels.device.tiles import TILE
from wavequake.kernels.trace.figure_limits import figure_limits, train_limits
from wavequake.kernels.trace.ring import ring_order
from wavequake.kernels.trace.segmented import SegmentedTrain, trace_chief, trace_segmented
from wavequake.kernels.trace.sequence import Ring
from wavequake.kernels.trace.status import MISS, lost_at

MISSES_M2 = lost_at(MISS, 0)
RADIUS, GAP, STEP = 600.0, 150.0, 1e-20
CONICS = [(1.0 / 4000.0, -1.0), (-1.0 / 3000.0, 0.5)]  # curvature and conic constant of M1 and M2
FRAME = (30.0, -20.0, 0.8 / RADIUS, 0.6 / RADIUS)
SIZES = [1e-6, 1e-3, 0.1, 1.0, 10.0]
ROUNDING = 1e-11  # mm of path
ZERNIKE = {
    (0, 0): lambda u, v: 1.0 + 0.0 * u,
    (1, 1): lambda u, v: 2.0 * u,
    (1, -1): lambda u, v: 2.0 * v,
    (2, 2): lambda u, v: np.sqrt(6.0) * (u * u - v * v),
    (2, -2): lambda u, v: np.sqrt(6.0) * 2.0 * u * v,
    (2, 0): lambda u, v: np.sqrt(3.0) * (2.0 * (u * u + v * v) - 1.0),
}


def turned(x, y):
    """A rotation about x, then about y."""
    about_x = [[1.0, 0.0, 0.0], [0.0, np.cos(x), np.sin(x)], [0.0, -np.sin(x), np.cos(x)]]
    about_y = [[np.cos(y), 0.0, -np.sin(y)], [0.0, 1.0, 0.0], [np.sin(y), 0.0, np.cos(y)]]
    return np.array(about_y) @ np.array(about_x)


def telescope(size, degree=6, basis="monomial", seed=0, tiles=1):
    """Two oblique mirrors close to one another, both with random figures of `size` mm per coefficient."""
    random = np.random.default_rng(seed)
    terms = (degree + 1) * (degree + 2) // 2
    train = SegmentedTrain(
        *CONICS[0], np.zeros((1, 0, 3)), np.array([FRAME]), degree, np.array([CONICS[1][0], 0.0]),
        np.array([CONICS[1][1], 0.0]), 1000.0, mirror_degree=degree, mirror_radii=np.array([RADIUS]),
        figure_basis=basis, mirror_basis=basis,
    )  # fmt: skip
    arguments = {
        "train": train,
        "ray_x": random.uniform(-300.0, 300.0, 12),
        "ray_y": random.uniform(-300.0, 300.0, 12),
        "start_z": -20.0,
        "candidates": np.zeros((12, 1), dtype=np.int32),
        "segment_poses": poses((turned(0.1, -0.05), np.array([2.0, 1.0, 3.0])), tiles=tiles),
        "figure": random.normal(0.0, size, (tiles, 1, terms, TILE)),
        "surface_poses": poses(
            (turned(-0.1, 0.2), [0.0, 0.0, GAP]), (turned(0.2, 0.1), [0.0, 0.0, -2.0 * GAP]), tiles=tiles
        ),
        "directions": np.tile(np.array([0.1, -0.2, np.sqrt(0.95)])[:, None], (tiles, 1, 1)) * np.ones(TILE),
        "mirror_figure": random.normal(0.0, size, (tiles, 1, terms, TILE)),
    }
    return with_chief(arguments)


def with_chief(arguments):
    chief = trace_chief(
        *(arguments[name] for name in ("train", "surface_poses", "directions", "start_z")),
        mirror_figure=arguments["mirror_figure"],
    )
    return arguments | {"chief": chief}


def figure_of(coefficients, frame, degree, basis):
    """The figure, term by term, as a function of x and y."""
    x0, y0, e_x, e_y = frame

    def height(x, y):
        u, v = e_x * (x - x0) + e_y * (y - y0), e_x * (y - y0) - e_y * (x - x0)
        if basis != "monomial":
            terms = [ZERNIKE[order](u, v) for order in ring_order(degree)]
        else:
            terms = [u ** (n - j) * v**j for n in range(degree + 1) for j in range(n + 1)]
        return sum(c * term for c, term in zip(coefficients, terms, strict=True))

    return height


def meet(position, direction, curvature, conic, figure):
    """Path to a figured conic, found in a bracket about its vertex plane, and the unit normal there."""

    def sag(x, y):
        square = x * x + y * y
        return curvature * square / (1.0 + np.sqrt(1.0 - (1.0 + conic) * curvature**2 * square)) + figure(
            x, y
        )

    def beyond(path):
        x, y, z = position + path * direction
        return z - sag(x, y)

    plane = -position[2] / direction[2]
    path = plane + brentq(lambda way: beyond(plane + way), -120.0, 120.0, xtol=1e-15, rtol=1e-15)
    x, y, _ = position + path * direction
    # The complex step gives derivatives without cancellation.
    normal = np.array([sag(x + 1j * STEP, y).imag / STEP, sag(x, y + 1j * STEP).imag / STEP, -1.0])
    return path, normal / np.linalg.norm(normal)


def traced_alone(arguments, ray, lane):
    """OPD and image point of one ray."""
    train, (tile, at) = arguments["train"], divmod(lane, TILE)
    position = np.array([arguments["ray_x"][ray], arguments["ray_y"][ray], arguments["start_z"]])
    direction = arguments["directions"][tile, :, at]
    total = position @ direction
    forms = [(train.figure_degree, train.figure_basis), (train.mirror_degree, train.mirror_basis)]
    given = [arguments["segment_poses"][tile, 0, :, at], arguments["surface_poses"][tile, 0, :, at]]
    coefficients = [arguments["figure"][tile, 0, :, at], arguments["mirror_figure"][tile, 0, :, at]]
    frames = [train.figure_frames[0], train.mirror_frames[0]]
    for k in range(2):
        rotation, offset = given[k][:9].reshape(3, 3), given[k][9:]
        position, direction = rotation @ position + offset, rotation @ direction
        path, normal = meet(position, direction, *CONICS[k], figure_of(coefficients[k], frames[k], *forms[k]))
        position, total = position + path * direction, total + path
        direction = direction - 2.0 * (direction @ normal) * normal
        if k == 0:  # M1's figure moves with its segment, the light goes on in the optics frame
            position, direction = rotation.T @ (position - offset), rotation.T @ direction
    pose = arguments["surface_poses"][tile, 1, :, at]
    position, direction = pose[:9].reshape(3, 3) @ position + pose[9:], pose[:9].reshape(3, 3) @ direction
    path = -position[2] / direction[2]
    position, total = position + path * direction, total + path
    chief = arguments["chief"][tile, :, at]
    offset = position - [chief[0], chief[1], 0.0]
    back = offset @ direction + np.sqrt((offset @ direction) ** 2 - offset @ offset + train.sphere_radius**2)
    return chief[2] - (total - back), position[0], position[1]


@pytest.mark.parametrize("device", **NAMES)
@pytest.mark.parametrize(("degree", "basis"), [(6, "monomial"), (1, "monomial"), (2, Ring())], ids=str)
def test_figures_of_any_size_are_met_to_rounding(degree, basis, device):
    for size in SIZES:
        arguments = telescope(size, degree, basis)
        traced = trace_segmented(**arguments, device=device)
        assert (traced.status == 0).all()
        found = np.stack([traced.opd, traced.x, traced.y])[:, 0, :4, :4]
        expected = [[traced_alone(arguments, ray, lane) for lane in range(4)] for ray in range(4)]
        np.testing.assert_allclose(found, np.moveaxis(expected, -1, 0), rtol=0.0, atol=ROUNDING)


@pytest.mark.parametrize("device", OPENCL, ids=NAMES["ids"])
def test_two_steps_do_for_small_figures_only(device):
    """At every size the device agrees with its twin, whichever program it takes."""
    checked = []
    for size in 10.0 ** np.arange(-7.0, 3.0, 0.5):
        arguments = telescope(size, seed=1)
        limits = train_limits(
            *(arguments[n] for n in ("train", "segment_poses", "figure", "mirror_figure", "directions"))
        )
        checked.append([limit is not None for limit in limits])
        one, other = (trace_segmented(**arguments, device=each) for each in (device, NUMPY))
        np.testing.assert_array_equal(one.status, other.status)
        for name in ("opd", "x", "y"):
            np.testing.assert_allclose(
                getattr(one, name), getattr(other, name), rtol=1e-14 * max(1.0, size), atol=3.0 * ROUNDING
            )
    assert not np.any(checked[:5])
    assert np.all(checked[7:])


@pytest.mark.parametrize("device", **NAMES)
def test_terms_that_cancel_lose_no_light(device):
    """Of a Zernike polynomial of degree 20 monomials keep ten digits: no step becomes shorter than that."""
    half = 10
    radial = [
        (-1) ** (half - k) * comb(half + k, half - k) * comb(2 * k, k) for k in range(half + 1)
    ]  # of rho^(2 k)
    assert sum(radial) == 1
    coefficients = np.zeros((2 * half + 1) * (half + 1))
    for k, factor in enumerate(radial):
        for j in range(k + 1):
            coefficients[2 * k * (2 * k + 1) // 2 + 2 * j] = factor * comb(k, j)
    arguments = telescope(0.0, 2 * half)
    arguments |= {name: 1.6 * arguments[name] for name in ("ray_x", "ray_y")}
    for height in (1e-3, 0.1):
        figure = np.tile((height * coefficients)[:, None], (1, 1, 1, TILE))
        traced = trace_segmented(
            **with_chief(arguments | {"figure": figure, "mirror_figure": figure}), device=device
        )
        assert (traced.status == 0).all()


@pytest.mark.parametrize("device", OPENCL, ids=NAMES["ids"])
@pytest.mark.parametrize(("angle", "beside"), [(0.0, 1e-10), (4.9e-4, 1e-8), (2.4e-3, 1e-9), (0.03, 1e-9)])
def test_segments_with_large_figures(angle, beside, device):
    """Two steps do where light meets segments along their normals; beyond, rays are checked."""
    for size in (1e-3, 0.1, 1.0):
        arguments = two_mirrors(degree=6)
        arguments["figure"] = np.random.default_rng(0).normal(0.0, size, arguments["figure"].shape)
        arguments["directions"] = np.tile([[np.sin(angle)], [0.0], [np.cos(angle)]], (1, 1, TILE))
        names = ("train", "surface_poses", "directions", "start_z")
        arguments["chief"] = trace_chief(*(arguments[name] for name in names))
        one, other = (trace_segmented(**arguments, device=each) for each in (device, NUMPY))
        np.testing.assert_array_equal(one.status, other.status)
        assert (one.status == 0).any()
        np.testing.assert_allclose(one.opd, other.opd, rtol=0.0, atol=1e-10)
        for name in ("x", "y"):
            np.testing.assert_allclose(getattr(one, name), getattr(other, name), rtol=0.0, atol=beside)


@pytest.mark.parametrize("device", **NAMES)
def test_bits_do_not_depend_on_larger_figures_beside(device):
    small, large = telescope(1e-6), telescope(30.0, seed=1)
    both = {
        name: np.concatenate([value, large[name]])
        if name.endswith(("poses", "figure", "directions", "chief"))
        else value
        for name, value in small.items()
    }
    traced = trace_segmented(**both, device=device)
    assert_same(trace_segmented(**small, device=device), traced, 0)
    some = {name: both[name][3:8].copy() for name in ("ray_x", "ray_y", "candidates")}
    np.testing.assert_array_equal(trace_segmented(**both | some, device=device).opd, traced.opd[:, 3:8])


@pytest.mark.parametrize("device", **NAMES)
def test_a_mirror_that_folds_over_loses_light_at_it(device):
    """Bumps of a meter on half a meter: no ray is reflected from behind, and M2 alone is to blame."""
    arguments = telescope(1e-6, seed=2)
    arguments["mirror_figure"] = 1e9 * arguments["mirror_figure"]
    traced = trace_segmented(**with_chief(arguments), device=device)
    assert set(np.unique(traced.status)) <= {0, MISSES_M2, lost_at(MISS, 2)}
    assert (traced.status == MISSES_M2).any()
    assert np.isnan(traced.opd[traced.status == MISSES_M2]).all()


@pytest.mark.parametrize("device", **NAMES)
def test_a_figure_that_is_not_finite_loses_its_instant(device):
    arguments = telescope(1e-3)
    spoiled = arguments["mirror_figure"].copy()
    spoiled[0, 0, 3, 5] = np.nan
    traced = trace_segmented(**arguments | {"mirror_figure": spoiled}, device=device)
    assert (traced.status[0, :, 5] == MISSES_M2).all()
    rest = np.arange(TILE) != 5
    np.testing.assert_array_equal(
        traced.opd[..., rest], trace_segmented(**arguments, device=device).opd[..., rest]
    )


@pytest.mark.parametrize("basis", ["monomial", Ring(), Ring(0.5)], ids=str)
def test_limits_follow_the_bend(basis):
    """A figure twice as large bends twice as much, and so does each instant by its own."""
    frames = np.array([FRAME, FRAME]) * [[1.0], [0.5]]
    figure = np.random.default_rng(0).normal(0.0, 1.0, (3, 2, 28, TILE))
    limits = figure_limits(figure, (6, basis), frames, 1e-3, 1.0)
    assert limits.shape == (3, 2, TILE)
    twice = figure_limits(2.0 * figure[:1], (6, basis), frames, 1e-3, 1.0)
    np.testing.assert_allclose(twice, limits[:1] / 4.0, rtol=1e-12)
    alone = figure_limits(figure[:, 1:], (6, basis), frames[1:], 1e-3, 1.0)
    np.testing.assert_array_equal(alone, limits[:, 1:])


def test_figures_that_cannot_bend_have_no_limit():
    frames = np.array([FRAME])
    for terms, degree in ((1, 0), (3, 1)):
        for height in (0.0, 10.0):
            figure = np.full((1, 1, terms, TILE), height)
            assert figure_limits(figure, (degree, "monomial"), frames, 0.0, 1.0) is None
    assert np.isinf(figure_limits(figure, (1, "monomial"), frames, 1e-3, 1.0)).all()  # but the conic bends
