"""A disturbed case as a lens file, traced anew, against what the store holds of it."""

import numpy as np
import pytest

import wavequake as wq
from wavequake.errors import UserError
from wavequake.report.case_lens_file import export_case

STUDY = """
[study]
name = "shaken"
workflow = "system-disturbance"

[system]
name = "custom"
entrance_diameter_mm = 10.0
fields_deg = [[0.0, 0.0], [0.0, 2.0]]
wavelengths_nm = [550.0]

[[system.surface]]
name = "front"
radius_mm = 60.0
glass = "HOYA:BAF2"
deformation_terms = 15
semi_diameter_mm = 8.0

[[system.surface]]
name = "back"
distance_mm = 5.0
radius_mm = -50.0
glass = "air"

[[system.surface]]
name = "stop"
distance_mm = 2.0
stop = true

[[system.surface]]
name = "image"
distance_mm = 44.0

[[body]]
name = "lens"
surfaces = ["front", "back"]

[[disturbance]]
name = "assembly"
model = "surface-random"
of = ["lens", "image"]
rms = { dx_um = 8.0, dz_um = 5.0, ry_urad = 90.0 }
share = 0

[[disturbance]]
name = "polishing"
model = "surface-deformation"
of = ["front"]
rms_nm = { 5 = 200.0, 8 = 100.0 }
share = 0

[[disturbance]]
name = "shake"
model = "surface-vibration"
of = ["stop", "lens"]
instants = 4
lines = [{ frequency_hz = 85.0, amplitude = { dy_um = 3.0, dx_um = 2.0 } }]
share = 0

[[disturbance]]
name = "sky"
model = "line-of-sight"
rms_mas = 5000.0
share = 0

[[disturbance]]
name = "all"
model = "combine"
of = ["assembly", "polishing", "shake", "sky"]
"""


AGAIN = """
[study]
name = "again"
workflow = "system-disturbance"

[system]
file = "case.zmx"

[[disturbance]]
name = "nothing"
model = "surface-vibration"
of = ["image"]
instants = 4
lines = [{ frequency_hz = 85.0, amplitude = { dz_um = 1e-9 } }]
"""


def test_a_case_as_a_lens_file_has_the_wavefronts_of_the_store(tmp_path):
    (tmp_path / "study.toml").write_text(STUDY)
    (tmp_path / "again.toml").write_text(AGAIN)
    options = {"optics__rays": 200, "wavefront__zernike_terms": 28}
    store = tmp_path / "store"
    cases = wq.run(tmp_path / "study.toml", store=store, cases=3, **options)
    for case, instant in ((0, 0), (2, 3)):
        export_case(store, tmp_path / "case.zmx", case, instant, overwrite=True)
        again = wq.run(tmp_path / "again.toml", store=tmp_path / f"again{case}", cases=1, **options)
        stored = cases.zernike.sel(case=case).isel(time=instant).transpose("field", "wavelength", "noll")
        static = again.zernike_static.transpose("field", "wavelength", "noll")
        undisturbed = cases.zernike_static.transpose("field", "wavelength", "noll")
        # Piston and tilts are about the chief ray; rays follow the stop to the distortion of the pupil.
        terms = slice(3, None)
        np.testing.assert_allclose(static.values[..., terms], stored.values[..., terms], rtol=0, atol=0.1)
        assert np.abs(stored.values - undisturbed.values)[..., terms].max() > 100.0  # nm
    with pytest.raises(UserError, match="exists already"):
        export_case(store, tmp_path / "case.zmx", 0)
    with pytest.raises(UserError, match="cases 0 to 2"):
        export_case(store, tmp_path / "new.zmx", 99)
    with pytest.raises(UserError, match="no instant 7"):
        export_case(store, tmp_path / "new.zmx", 0, instant=7)
