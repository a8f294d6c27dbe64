from dataclasses import replace

import numpy as np
import pytest
from segmented_cases import NAMES, OPENCL, assert_close

from wavequake.kernels.device.devices import NUMPY
from wavequake.kernels.device.example import two_mirrors
from wavequake.kernels.device.tiles import TILE
from wavequake.kernels.trace.segmented import trace_chief, trace_segmented
from wavequake.kernels.trace.sequence import Ring
from wavequake.kernels.trace.status import VIGNETTED, lost_at
from wavequake.kernels.trace.train import vignetted


def with_mirror_figure(arguments, degree, size, seed=1):
    """The same telescope, whose secondary carries a random figure of `size` mm."""
    tiles, terms = len(arguments["segment_poses"]), (degree + 1) * (degree + 2) // 2
    figure = np.random.default_rng(seed).normal(0.0, size, (tiles, 1, terms, TILE))
    train = replace(arguments["train"], mirror_degree=degree, mirror_radii=np.array([900.0]))
    chief = trace_chief(
        train, arguments["surface_poses"], arguments["directions"], -100.0, mirror_figure=figure
    )
    return arguments | {"train": train, "mirror_figure": figure, "chief": chief}


@pytest.mark.parametrize("device", OPENCL, ids=NAMES["ids"])
@pytest.mark.parametrize(("segments", "mirror"), [(-1, 0), (3, 1), (-1, 4), (2, 8)])
def test_opencl_agrees_with_the_twin_on_figured_mirrors(device, segments, mirror):
    arguments = with_mirror_figure(two_mirrors(tiles=2, degree=segments), mirror, 0.01)
    assert_close(trace_segmented(**arguments, device=device), trace_segmented(**arguments, device=NUMPY))


@pytest.mark.parametrize("device", OPENCL, ids=NAMES["ids"])
def test_opencl_agrees_with_the_twin_on_figures_of_high_degree(device):
    """Recurrences on circles and rings, of both parities, beside one another and beside monomials."""
    for segments, mirror, rings in [(23, 26, (Ring(), Ring(0.1))), (22, 2, (Ring(0.1), "monomial"))]:
        arguments = with_mirror_figure(two_mirrors(tiles=2, degree=segments), mirror, 1e-6)
        train = replace(arguments["train"], figure_basis=rings[0], mirror_basis=rings[1])
        arguments["chief"] = trace_chief(
            train,
            arguments["surface_poses"],
            arguments["directions"],
            -100.0,
            mirror_figure=arguments["mirror_figure"],
        )
        arguments["train"] = train
        traced = trace_segmented(**arguments, device=device)
        assert (traced.status == 0).any()
        assert_close(traced, trace_segmented(**arguments, device=NUMPY))


@pytest.mark.parametrize("device", **NAMES)
def test_a_constant_figure_of_a_mirror_is_a_shift_of_it(device):
    arguments = with_mirror_figure(two_mirrors(), 0, 0.01)
    still = arguments | {"mirror_figure": None, "train": two_mirrors()["train"]}
    moved = still["surface_poses"].copy()
    moved[:, 0, 11] -= arguments["mirror_figure"][:, 0, 0]
    moved[:, 1, 11] += arguments["mirror_figure"][:, 0, 0]
    still["surface_poses"] = moved
    still["chief"] = trace_chief(still["train"], moved, still["directions"], -100.0)
    traced, expected = (trace_segmented(**one, device=device) for one in (arguments, still))
    assert_close(traced, expected)
    np.testing.assert_allclose(arguments["chief"], still["chief"], rtol=0, atol=1e-9)
    unmoved = trace_segmented(**two_mirrors(), device=device)
    assert np.abs(traced.opd - unmoved.opd).max() > 1e-4


@pytest.mark.parametrize("device", **NAMES)
@pytest.mark.parametrize("basis", ["monomial", Ring()], ids=str)
def test_a_parabolic_figure_makes_a_plane_mirror_a_paraboloid(basis, device):
    """A flat secondary plus c (x^2 + y^2) / 2, micrometers, against the paraboloid of curvature c."""
    arguments = two_mirrors()
    curvature, radius = 1e-8, 900.0
    flat = replace(
        arguments["train"], surface_curvatures=np.zeros(2), surface_conics=np.zeros(2),
        mirror_degree=2, mirror_radii=np.array([radius]), mirror_basis=basis,
    )  # fmt: skip
    figure = np.zeros((1, 1, 6, TILE))
    # rho^2 is x^2 + y^2, or half of piston plus defocus / sqrt(3), which come last on a ring
    shares = {3: 1.0, 5: 1.0} if basis == "monomial" else {4: 0.5 / np.sqrt(3.0), 5: 0.5}
    for term, share in shares.items():
        figure[:, :, term] = share * curvature * radius**2 / 2
    round_ = replace(
        arguments["train"],
        surface_curvatures=np.array([curvature, 0.0]),
        surface_conics=np.array([-1.0, 0.0]),
    )
    chief = trace_chief(round_, arguments["surface_poses"], arguments["directions"], -100.0)
    arguments["chief"] = chief
    expected = trace_segmented(**arguments | {"train": round_}, device=device)
    assert_close(
        trace_segmented(**arguments | {"train": flat, "mirror_figure": figure}, device=device), expected
    )
    assert (expected.status == 0).all()
    without = trace_segmented(**arguments | {"train": replace(flat, mirror_degree=-1)}, device=device)
    assert np.abs(without.x - expected.x).max() > 0.01


@pytest.mark.parametrize("device", **NAMES)
def test_light_beyond_a_mirrors_edge_is_vignetted(device):
    """Where the rays meet the vertex plane tells which of them pass an edge, but for those near it."""
    arguments = two_mirrors()
    train = arguments["train"]
    at_mirror = replace(train, surface_curvatures=np.zeros(1), surface_conics=np.zeros(1), sphere_radius=1e4)
    to_plane = arguments["surface_poses"][:, :1].copy()
    whole = trace_segmented(**arguments, device=device)
    hits = trace_segmented(
        **arguments | {"train": at_mirror, "surface_poses": to_plane, "chief": np.zeros((1, 3, TILE))},
        device=device,
    )
    radius = np.hypot(hits.x, hits.y)  # in the vertex plane: 1 mm per 10 mm from the mirror's
    edge = 0.5 * (radius.min() + radius.max())
    clear = np.abs(radius - edge) > 5.0
    assert (clear & (radius > edge)).any()
    assert (clear & (radius < edge)).any()
    edged = replace(train, semi_diameters=np.array([edge, np.inf]))
    traced = trace_segmented(**arguments | {"train": edged}, device=device)
    gone = traced.status == lost_at(VIGNETTED, 0)
    np.testing.assert_array_equal(gone, vignetted(edged, traced.status))
    assert (gone | (traced.status == 0)).all()
    np.testing.assert_array_equal(gone[clear], (radius > edge)[clear])
    np.testing.assert_array_equal(traced.opd[~gone], whole.opd[~gone])
    assert np.isnan(traced.opd[gone]).all()
    chief = trace_chief(edged, arguments["surface_poses"], arguments["directions"], -100.0)
    np.testing.assert_array_equal(chief, arguments["chief"])  # the chief ray of an annulus is virtual
