"""A study of segment models: coarse segments of tmt-18, two vibrations."""

from functools import lru_cache
from pathlib import Path
from tempfile import TemporaryDirectory

from wavequake.workflows.study import load_study

# Thick, so that the large segments of tmt-18 are stiff; few elements.
STUDY = """
[study]
name = "tiny"
workflow = "segment-mor"
[telescope]
name = "tmt-18"
[model]
thickness_m = 0.5
spring_n_m = [5e8, 5e8, 5e8]
divisions = 3
[segments]
name = "8"
figure_terms = 11
[reduction]
variants = ["guyan9", "craigb18", "craigb4", "modal12"]
last_hz = 400.0
frequencies = 20
spot_checks = 1
[time]
duration_s = 0.05
step_s = 1e-3
traced = 16
[optics]
rays_per_segment = 18
zernike_terms = 11
[imaging]
pixels = 16
[[excitation]]
name = "sine"
kind = "sinusoid"
amplitude = 5e-9
frequency_hz = 20.0
[[excitation]]
name = "floor"
kind = "psd"
rms = 5e-9
low_hz = 5.0
high_hz = 200.0
"""


@lru_cache
def text_of(*overrides):
    """Canonical text of the study with overrides, as its workflow gets it."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "study.toml"
        path.write_text(STUDY)
        return load_study(path, overrides).identity_text()
