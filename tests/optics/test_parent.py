import numpy as np
import pytest

from wavequake.kernels.sequential_numpy import trace_sequence_numpy
from wavequake.optics.packing import moving, pack
from wavequake.optics.paraxial import paraxial
from wavequake.optics.parent import parent_system
from wavequake.optics.ray_aiming import pupil_rays
from wavequake.optics.segmented_telescope import first_order
from wavequake.optics.system_kinematics import rest_states
from wavequake.optics.telescopes import telescope


@pytest.mark.parametrize("name", ["tmt", "tmt-18", "tmt-thesis", "jwst"])
def test_parents_have_the_first_order_data_of_their_telescopes(name):
    segmented = telescope(name)
    expected, data = first_order(segmented), paraxial(parent_system(segmented))
    assert data.focal_length == pytest.approx(expected.focal_length, rel=1e-12)
    assert data.back_focus == pytest.approx(expected.back_focus, rel=1e-9)
    assert data.defocus == pytest.approx(expected.defocus, abs=1e-6)
    assert -data.exit_pupil == pytest.approx(expected.exit_pupil_distance, rel=1e-12)
    assert data.entrance_pupil_diameter == pytest.approx(2 * segmented.pupil_outer, rel=1e-12)
    assert data.image_na == pytest.approx(expected.numerical_aperture, rel=5e-3)


def test_only_light_of_the_annulus_passes():
    segmented = telescope("jwst")
    system = parent_system(segmented, 2000e-6)
    assert system.wavelengths[0] == 2000e-6
    inner = segmented.pupil_inner / segmented.pupil_outer
    x = np.array([0.0, 0.99 * inner, 1.01 * inner, 0.999, 1.001])
    rays = pupil_rays(system, np.zeros(2), 2000e-6, x, np.zeros(5))
    traced = trace_sequence_numpy(pack(system, 2000e-6), rays, moving(system, rest_states(system)))
    np.testing.assert_array_equal(traced.status[0], [1, 1, 0, 0, 1])
