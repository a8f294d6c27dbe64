"""A study of eighteen segments: five populations, small images; and its first dozen cases."""

import numpy as np
import pytest

from wavequake.kernels.device.devices import list_devices
from wavequake.workflows.segments import disturbance
from wavequake.workflows.study import load_study

OPENCL = [device.name for device in list_devices() if device.kind != "numpy"]
DEVICE = OPENCL[0] if OPENCL else "numpy"

HEAD = """
[study]
name = "small"
workflow = "segment-disturbance"
seed = 7
[telescope]
name = "tmt-18"
gap_mm = 20.0
"""
# Without images, traced by few rays.
TRACED = (
    HEAD
    + """[optics]
rays_per_segment = 6
[wavefront]
zernike_terms = 21
[imaging]
enabled = false
"""
)
STUDY = (
    HEAD
    + """[imaging]
pixels = 32
[[disturbance]]
name = "pistons"
model = "static-random"
piston_nm = 20.0
tip_nrad = 5.0
tilt_nrad = 5.0
instants = 3
share = 2
[[disturbance]]
name = "mount"
model = "line-of-sight"
act = "mount"
instants = 20
duration_s = 60.0
[[disturbance]]
name = "m2"
model = "line-of-sight"
act = "m2"
instants = 5
duration_s = 60.0
[[disturbance]]
name = "figure"
model = "static-random"
instants = 2
figure_nm = { 4 = 20.0, 6 = 10.0 }
[[disturbance]]
name = "both"
model = "combine"
of = ["pistons", "figure"]
instants = 2
"""
)


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    path = tmp_path_factory.mktemp("study") / "small.toml"
    path.write_text(STUDY)
    return load_study(path)


@pytest.fixture(scope="module")
def text(study):
    return study.identity_text()


@pytest.fixture(scope="module")
def chunk(text):
    return disturbance.KIND.compute(text, np.arange(12), DEVICE)


def only_pistons(study):
    """The study without figures, so that its images are polygon transforms."""
    return study.model_copy(update={"disturbance": study.disturbance[:1]})
