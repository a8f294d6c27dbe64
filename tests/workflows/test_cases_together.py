"""Cases whose chief rays are traced at once give the bits that each gives alone."""

import numpy as np
import pytest
from small_system import hum
from study_text import part
from test_system_disturbance import study_of

from wavequake.campaign.contract import DONE
from wavequake.workflows.systems.disturbance import KIND

STUDY = """
[study]
name = "moved"
workflow = "system-disturbance"
[system]
name = "NAME"
[optics]
rays = 40
[wavefront]
zernike_terms = 6
"""


def moved(surface):
    """Return a surface's three disturbances, one of which takes 19 instants."""
    rms = {"dx_um": 2.0, "dz_um": 3.0, "rx_urad": 5.0, "rz_urad": 5.0}
    askew = part("disturbance", name="askew", model="surface-random", of=[surface], rms=rms)
    bent = {"5": 10.0, "8": 10.0}
    figure = part("disturbance", name="figure", model="surface-deformation", of=[surface], rms_nm=bent)
    return askew + hum(surface, 19, dx_um=2.0, ry_urad=3.0) + figure


@pytest.mark.parametrize(
    ("name", "surface"), [("double-gauss", "surface 3"), ("six-lens", "L2 front"), ("euv", "M1")]
)
def test_light_that_follows_the_stop_of_a_case_depends_on_no_other(tmp_path, name, surface):
    text = study_of(tmp_path, STUDY.replace("NAME", name) + moved(surface)).identity_text()
    chunk = KIND.compute(text, np.arange(9), "auto")
    assert (chunk.status == DONE).all(), chunk.messages
    for case in (0, 1, 4, 8):
        alone = KIND.compute(text, np.array([case]), "auto").arrays
        for label, values in alone.items():
            assert values[0].tobytes() == chunk.arrays[label][case].tobytes()
