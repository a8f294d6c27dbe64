"""First-order data in light of several colors, against thin lenses and Schott's data sheet."""

import numpy as np
import pytest

from wavequake.errors import UserError
from wavequake.optics.media.glasses import glass
from wavequake.optics.shapes.shapes import Conic
from wavequake.optics.systems.kinematics import SurfaceRow, sequential
from wavequake.optics.systems.paraxial import paraxial
from wavequake.optics.systems.system import OpticalSystem, Pupil


@pytest.mark.parametrize(
    ("kind", "value"), [("f_number", 2.5), ("image_na", 0.2), ("entrance_diameter", 20.0), ("stop", 10.0)]
)
def test_light_of_all_colors_fills_the_stop_of_the_primary_wavelength(kind, value):
    # A thin plano-convex lens of f = 50 mm / (n - 1) with the stop 20 mm behind it: the marginal ray's height
    # at the lens follows from its slope, h_lens = h_stop / (1 - 20 / f), and the NA in the image is
    # h_lens / f. Schott's data sheet: n_d = 1.51680, n_F = 1.52238, n_C = 1.51432.
    surfaces = sequential(
        [
            SurfaceRow("a", Conic(50.0), 0.0, "refract", glass("N-BK7")),
            SurfaceRow("b", thickness=20.0, action="refract"),
            SurfaceRow("stop", thickness=70.0),
            SurfaceRow("image"),
        ]
    )
    waves = np.array([486.1327e-6, 587.5618e-6, 656.2725e-6])
    system = OpticalSystem("x", surfaces, 2, Pupil(kind, value), wavelengths=waves, primary_wavelength=1)
    focal = 50.0 / (np.array([1.52238, 1.51680, 1.51432]) - 1.0)
    height = {"f_number": focal[1] / 5.0, "image_na": 0.2 * focal[1], "entrance_diameter": 10.0}.get(kind)
    stop = 10.0 if height is None else height * (1.0 - 20.0 / focal[1])
    for wavelength, f in zip(waves, focal, strict=True):
        data = paraxial(system, float(wavelength))
        assert data.stop_radius == pytest.approx(stop, rel=2e-5)
        assert data.entrance_pupil_diameter == pytest.approx(2.0 * stop / (1.0 - 20.0 / f), rel=2e-5)
        assert data.image_na == pytest.approx(stop / (1.0 - 20.0 / f) / f, rel=4e-5)


def test_dispersion_moves_the_focus():
    def bk7(wavelength):
        surfaces = sequential(
            [
                SurfaceRow("a", Conic(50.0), 0.0, "refract", glass("N-BK7")),
                SurfaceRow("b", action="refract"),
                SurfaceRow("image"),
            ]
        )
        return paraxial(OpticalSystem("x", surfaces, 0, Pupil("entrance_diameter", 10.0)), wavelength)

    # Schott's data sheet: n_d = 1.51680, n_F = 1.52238, n_C = 1.51432
    for wavelength, n in [(587.5618e-6, 1.51680), (486.1327e-6, 1.52238), (656.2725e-6, 1.51432)]:
        assert bk7(wavelength).focal_length == pytest.approx(50.0 / (n - 1), rel=2e-5)
    with pytest.raises(UserError, match="N-BK7"):
        bk7(50e-6)
