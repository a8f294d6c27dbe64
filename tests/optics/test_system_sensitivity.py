import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from wavequake.errors import UserError
from wavequake.kernels.device.devices import NUMPY
from wavequake.optics.catalog.lenses import TABLE_5_1
from wavequake.optics.catalog.names import optical_system
from wavequake.optics.derivatives.central import DOFS, Steps
from wavequake.optics.derivatives.sensitivity import figure_sensitivity, rigid_sensitivity
from wavequake.optics.rays.pupils import sunflower
from wavequake.optics.shapes.shapes import Conic, Opening, ZernikeDeformation
from wavequake.optics.systems.bodies import rigid_body
from wavequake.optics.systems.system import OpticalSystem, Pupil, Surface
from wavequake.optics.wavefronts.wavefront import prepare_system
from wavequake.workflows.systems.bench import deformable

DATA = json.loads((Path(__file__).parents[1] / "data" / "tmt_optics.json").read_text())


def prepared(system, rays=200, terms=21, field=0):
    pupil = sunflower(system.pupil.obscuration, 1.0, rays)
    return prepare_system(system, pupil.x, pupil.y, pupil.weight, terms, field)


@pytest.fixture(scope="module")
def gauss():
    system = replace(optical_system("double-gauss"), pupil=Pupil("f_number", 8.0))
    return prepared(system, field=1)


def test_decentered_lenses_move_the_image_as_table_5_1_says():
    system = optical_system("six-lens")
    bodies = [rigid_body(system, f"L{i}", [f"L{i} front", f"L{i} back"]) for i in range(1, 7)]
    found = rigid_sensitivity(prepared(system, 60, 10), bodies, NUMPY)
    moved = found.los[-6:, 0, 0]
    assert found.elements[-6:] == ("L1", "L2", "L3", "L4", "L5", "L6")
    assert moved == pytest.approx(TABLE_5_1, abs=2e-3)
    np.testing.assert_allclose(found.los[-6:, 1, 1], moved, rtol=1e-6)
    assert found.agrees, found.worst


def test_tilts_of_the_tmt_m2():
    """Störkle 2018, Eq. 4.24: 85460 mm/rad."""
    system = optical_system("tmt-thesis")
    node, weight = np.polynomial.legendre.leggauss(24)
    inner = system.pupil.obscuration**2
    r = np.sqrt(inner + (1 - inner) * (node + 1) / 2)
    angle = 2 * np.pi * (np.arange(96) + 0.5) / 96
    x, y = np.outer(r, np.cos(angle)).ravel(), np.outer(r, np.sin(angle)).ravel()
    found = rigid_sensitivity(prepare_system(system, x, y, np.repeat(weight, 96), 45), [], NUMPY)
    truth = DATA["m2_rigid_per_m_or_rad"]
    m2 = found.elements.index("M2")
    for name, dof, per_m in (("alpha", 3, 1.0), ("dz", 2, 1e3)):
        expected = np.array(truth[name]["c_noll_annular_waves"])
        tolerance = 1e-6 * np.abs(expected).max()
        assert found.zernike[m2, dof] * per_m == pytest.approx(expected, abs=tolerance)
    assert np.abs(found.los[m2, 3]).max() == pytest.approx(85460.0, rel=1e-6)  # 85460.02
    los = truth["alpha"]["LOS_339_annular_over_sqrt1pe2"]
    assert found.los[m2, 3] * 1e-3 == pytest.approx(los, rel=1e-6, abs=1e-6)


def parabola(deformation=None, opening=None):
    mirror = Surface("mirror", Conic(-1e4, -1.0), action="reflect", opening=opening, deformation=deformation)
    image = Surface("image", position=np.array([0.0, 0.0, -5e3]))
    return OpticalSystem("parabola", (mirror, image), 0, Pupil("entrance_diameter", 100.0))


def test_moving_everything_changes_nothing():
    """A star does not see a whole telescope shift, so the columns of all elements add up to zero."""
    found = rigid_sensitivity(prepared(parabola()), [], NUMPY)
    for dof in (0, 1, 2):
        for values in (found.zernike[..., 1:], found.los, found.centroid):
            column = values[:, dof]
            assert column.sum(axis=0) == pytest.approx(0.0, abs=1e-6 * max(np.abs(values).max(), 1.0))
    np.testing.assert_allclose(found.los[:, :2, :], [np.eye(2), -np.eye(2)], rtol=0, atol=1e-6)
    assert found.agrees, found.worst


def test_a_body_moves_as_the_sum_of_its_surfaces(gauss):
    """To first order: shifts add, and a turn about a point beside a vertex shifts it."""
    system = gauss.system
    body = rigid_body(system, "L1", ["surface 1", "surface 2"])
    found = rigid_sensitivity(gauss, [body], NUMPY)
    one, two, both = found.zernike[0], found.zernike[1], found.zernike[-1]
    np.testing.assert_allclose(both[:3], (one + two)[:3], rtol=0, atol=1e-6 * np.abs(one).max())
    half = 4.375  # of the lens' thickness of 8.75 mm
    # rx turns the front vertex (behind the middle, at -half) towards +y, the back one towards -y.
    turned = one[3] + two[3] + half * (one[1] - two[1])
    np.testing.assert_allclose(both[3], turned, rtol=0, atol=1e-6 * np.abs(turned).max())


def test_a_figure_appears_twice_and_tilts_move_the_image():
    """Over the pupil itself, at f/50: Z_j of a mirror is 2 / wavelength of Z_j in the wavefront."""
    surface = Surface("mirror", Conic(-1e4, -1.0), action="reflect", deformation=ZernikeDeformation(11, 50.0))
    image = Surface("image", position=np.array([0.0, 0.0, -5e3]))
    system = OpticalSystem("parabola", (surface, image), 0, Pupil("entrance_diameter", 100.0))
    found = figure_sensitivity(prepared(system, 300, 15), [0], 11, NUMPY)
    assert found.dofs == tuple(f"Z{j}" for j in range(1, 12))
    scale = 2.0 / float(system.wavelengths[0])
    # Piston and tilt of the wavefront are those about the chief ray, which meets the figure's center.
    np.testing.assert_allclose(
        np.abs(found.zernike[0, 3:, 3:11]), scale * np.eye(8), rtol=0, atol=2e-4 * scale
    )
    assert np.abs(found.zernike[0, 3, 0]) == pytest.approx(np.sqrt(3) * scale, rel=1e-4)
    # Z2 = 2 x / r: the mirror turns by 2 / r per mm, the image moves by 2 f times that.
    assert np.abs(found.los[0, 1]) == pytest.approx([5e3 * 2 * 2 / 50.0, 0.0], rel=1e-4, abs=1e-4)
    coma = np.array([1, 1, 1, 3, 3, 1, 1, 1])  # rms of 3 sqrt(8) rho^3 cos(theta)
    assert found.rms_raw[0, 3:] == pytest.approx(scale * coma, rel=1e-2)
    assert found.agrees, found.worst


@pytest.mark.parametrize("field", [0, 1])
def test_steps_of_figures_suit_small_lenses(field):
    """10 nm on lenses behind a stop of 1.7 mm act nonlinearly: too much for two steps to agree."""
    system = optical_system("six-lens")
    acting = [i for i, one in enumerate(system.surfaces) if one.action != "pass"]
    system = deformable(system, dict.fromkeys(acting, 11))
    found = figure_sensitivity(prepared(system, 100, 15, field), acting, 11, NUMPY)
    assert found.worst[2] < 2e-6


def test_a_motion_that_loses_rays_is_not_trusted():
    edge = np.sqrt((200 - 0.5) / 200) * 50.0  # the outermost ray of a sunflower
    system = parabola(opening=Opening(edge + 5e-4))
    # Light would follow a mirror that is the stop itself.
    system = replace(system, surfaces=(Surface("stop"), *system.surfaces))
    found = rigid_sensitivity(prepared(system, 200, 6), [], NUMPY)
    assert np.isinf(found.disagreement[1, 0])
    assert np.isinf(found.disagreement[0, 0])  # the stop takes the light to the mirror's edge, too
    assert np.isfinite(found.disagreement[2]).all()
    assert not found.agrees
    assert found.worst[0] in ("stop", "mirror")


def test_steps_and_surfaces_that_cannot_be():
    system = optical_system("double-gauss")
    with pytest.raises(UserError, match="positive"):
        rigid_sensitivity(prepared(system), [], NUMPY, Steps(rotation=0.0))
    with pytest.raises(UserError, match=r"surface 1 .* cannot deform by 4"):
        figure_sensitivity(prepared(system), [0], 4, NUMPY)
    assert DOFS[:3] == ("dx", "dy", "dz")
