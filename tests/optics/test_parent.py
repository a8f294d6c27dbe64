import numpy as np
import pytest

from wavequake.kernels.trace.sequential_numpy import trace_sequence_numpy
from wavequake.optics.rays.aiming import pupil_rays
from wavequake.optics.rays.packing import moving, pack
from wavequake.optics.segments.catalog import telescope
from wavequake.optics.segments.layout import segments_on_conic
from wavequake.optics.segments.parent import parent_system
from wavequake.optics.segments.telescope import Row, first_order, segmented_telescope, sequential_surfaces
from wavequake.optics.systems.kinematics import rest_states
from wavequake.optics.systems.paraxial import paraxial
from wavequake.optics.zemax.export import write_zmx
from wavequake.optics.zemax.read import read_zmx


@pytest.mark.parametrize("name", ["tmt", "tmt-18", "tmt-thesis", "jwst"])
def test_parents_have_the_first_order_data_of_their_telescopes(name):
    segmented = telescope(name)
    expected, data = first_order(segmented), paraxial(parent_system(segmented))
    assert data.focal_length == pytest.approx(expected.focal_length, rel=1e-12)
    assert data.back_focus == pytest.approx(expected.back_focus, rel=1e-9)
    assert data.defocus == pytest.approx(expected.defocus, abs=1e-6)
    assert -data.exit_pupil == pytest.approx(expected.exit_pupil_distance, rel=1e-12)
    assert data.entrance_pupil_diameter == pytest.approx(2 * segmented.annulus.outer, rel=1e-12)
    assert data.image_na == pytest.approx(expected.numerical_aperture, rel=5e-3)


def test_only_light_of_the_annulus_passes():
    segmented = telescope("jwst")
    system = parent_system(segmented, 2000e-6)
    assert system.wavelengths[0] == 2000e-6
    inner = segmented.annulus.inner / segmented.annulus.outer
    x = np.array([0.0, 0.99 * inner, 1.01 * inner, 0.999, 1.001])
    rays = pupil_rays(system, np.zeros(2), 2000e-6, x, np.zeros(5))
    traced = trace_sequence_numpy(pack(system, 2000e-6), rays, moving(system, rest_states(system)))
    np.testing.assert_array_equal(traced.status[0], [1, 1, 0, 0, 1])


def test_mirrors_keep_their_edges_and_stop_the_light_that_they_stop_in_the_telescope(tmp_path):
    """M2 stops what meets it beyond 120 mm: by a hyperbola in polar coordinates about the shared focus."""
    rows = [Row("M2", -2500.0, -2.25, 4000.0, semi_diameter=120.0), Row("image", np.inf, 0.0, 5000.0)]
    corners = np.array([[[-1e3, -1e3], [1e3, -1e3], [1e3, 1e3], [-1e3, 1e3]]])
    segments = segments_on_conic(["1"], corners, -10000.0, -1.0)
    segmented = segmented_telescope(
        "one", segments, -10000.0, -1.0, sequential_surfaces(rows), -50.0, 0.0, 1000.0
    )
    system = parent_system(segmented)
    x = np.linspace(0.0, 1.0, 1001)
    rays = pupil_rays(system, np.zeros(2), 550e-6, x, np.zeros_like(x))
    traced = trace_sequence_numpy(pack(system, 550e-6), rays, moving(system, rest_states(system)))
    angle = np.arctan2(1e3 * x, 5000.0 - (1e3 * x) ** 2 / 20000.0)
    height = 2500.0 / (1.0 + 1.5 * np.cos(angle)) * np.sin(angle)
    stopped = height > 120.0
    assert 400 < np.count_nonzero(stopped) < 600
    np.testing.assert_array_equal(traced.status[0], np.where(stopped, 1, 0))
    assert np.unique(traced.surface[0, stopped]).tolist() == [2]
    again = read_zmx(write_zmx(system, tmp_path / "one.zmx"))
    assert [one.opening and one.opening.outer for one in again.surfaces][1:] == [None, 120.0, None]
