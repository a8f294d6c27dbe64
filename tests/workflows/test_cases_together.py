"""Cases whose chief rays are traced at once give the bits that each gives alone."""

import numpy as np
import pytest
from test_system_disturbance import study_of

from wavequake.campaign.contract import DONE
from wavequake.workflows.systems.disturbance import KIND

MOVED = """
[study]
name = "moved"
workflow = "system-disturbance"
[system]
name = "NAME"
[optics]
rays = 40
[wavefront]
zernike_terms = 6
[[disturbance]]
name = "askew"
model = "surface-random"
of = ["SURFACE"]
rms = { dx_um = 2.0, dz_um = 3.0, rx_urad = 5.0, rz_urad = 5.0 }
[[disturbance]]
name = "hum"
model = "surface-vibration"
of = ["SURFACE"]
instants = 19
lines = [{ frequency_hz = 10.0, amplitude = { dx_um = 2.0, ry_urad = 3.0 } }]
[[disturbance]]
name = "figure"
model = "surface-deformation"
of = ["SURFACE"]
rms_nm = { 5 = 10.0, 8 = 10.0 }
"""


@pytest.mark.parametrize(
    ("name", "surface"), [("double-gauss", "surface 3"), ("six-lens", "L2 front"), ("euv", "M1")]
)
def test_light_that_follows_the_stop_of_a_case_depends_on_no_other(tmp_path, name, surface):
    text = study_of(tmp_path, MOVED.replace("NAME", name).replace("SURFACE", surface)).identity_text()
    chunk = KIND.compute(text, np.arange(9), "auto")
    assert (chunk.status == DONE).all(), chunk.messages
    for case in (0, 1, 4, 8):
        alone = KIND.compute(text, np.array([case]), "auto").arrays
        for label, values in alone.items():
            assert values[0].tobytes() == chunk.arrays[label][case].tobytes()
