"""Gratings and diffractive lenses of CODE V's sequence files against the grating equation."""

import numpy as np
import pytest

from wavequake.errors import UserError
from wavequake.kernels.device.devices import NUMPY
from wavequake.kernels.trace.sequence import Rays
from wavequake.kernels.trace.sequential import trace_sequence
from wavequake.optics.rays.packing import moving, pack
from wavequake.optics.systems.kinematics import rest_states
from wavequake.optics.systems.paraxial import paraxial
from wavequake.optics.zemax.codev import sequence_file
from wavequake.optics.zemax.read import system_of


def read(text):
    return system_of(sequence_file(text, "lens.seq"))


GRATING = """RDM;LEN
DIM {unit}
EPD 1.0
WL 500
SO 0.0 0.1e14
S {radius} {distance} {glass}
  DIF GRT
  GRO {order}; GRS {spacing}{more}
  STO
SI 0.0 0.0
"""


@pytest.mark.parametrize("glass", ["", "REFL"])
@pytest.mark.parametrize(
    ("more", "turned"),
    [("", 0.0), ("; GRX 3; GRY 4; GRZ 0", np.arctan2(3, 4)), ("; GRX 1; GRY 0", np.pi / 2)],
)
@pytest.mark.parametrize(("unit", "mm"), [("M", 1.0), ("I", 25.4)])
def test_gratings_bend_light_by_their_order(glass, more, turned, unit, mm):
    """sin = order wavelength / spacing along the vector across the grooves."""
    distance = -100.0 if glass else 100.0
    words = {"radius": 0.0, "distance": distance / mm, "glass": glass, "unit": unit, "more": more}
    system = read(GRATING.format(order=-2, spacing=1 / 300 / mm, **words))
    x, y = np.array([0.1, -0.2]), np.array([0.3, 0.05])
    start = Rays(np.stack([x, y, [-5.0, -5.0]]), np.array([[0.0], [0.0], [1.0]]) * np.ones(2), np.zeros(2))
    found = trace_sequence(pack(system, 500e-6), start, moving(system, rest_states(system)), NUMPY)
    away = 100.0 * np.tan(np.arcsin(-2 * 500e-6 * 300.0))
    np.testing.assert_allclose(found.x[0], x + away * np.sin(turned), rtol=0, atol=1e-11)
    np.testing.assert_allclose(found.y[0], y + away * np.cos(turned), rtol=0, atol=1e-11)


def test_a_grating_without_an_order_is_refused():
    words = {"radius": 0.0, "distance": 9.0, "glass": "", "unit": "M", "spacing": 0.01, "more": ""}
    text = GRATING.format(order=1, **words).replace("GRO 1; ", "")
    with pytest.raises(UserError, match=r"is a grating without an order \(GRO\)"):
        read(text)


def test_a_grating_on_an_asphere_keeps_its_powers():
    text = GRATING.format(
        radius=50.0, distance=30, glass="N-BK7", unit="M", order=1, spacing=0.01, more="; ASP; A 1e-6"
    )
    surface = read(text).surfaces[0]
    np.testing.assert_allclose(surface.shape.coefficients, [0.0, 1e-6], rtol=1e-15)
    np.testing.assert_allclose(surface.phase.polynomial, [0.0, 2 * np.pi / 0.01], rtol=1e-15)


@pytest.mark.parametrize(("unit", "mm"), [("M", 1.0), ("I", 25.4)])
def test_diffractive_lenses_focus_by_their_paths(unit, mm):
    """A path C1 r^2 at its wavelength is a lens of f = -1 / (2 C1), shorter for longer waves."""
    text = GRATING.format(radius=0.0, distance=80 / mm, glass="", unit=unit, order=1, spacing=1, more="")
    text = text.replace("DIF GRT", "DIF DOE").replace("GRO 1; GRS 1", f"HWL 400; HCT R; HCO C1 {-mm / 200!r}")
    assert paraxial(read(text)).focal_length == pytest.approx(100.0 * 400 / 500, rel=1e-12)


def test_a_public_hybrid_lens_focuses_where_its_file_has_the_image():
    """Number 65988 of a catalogue, a test of ray-optics (CODV_65988.seq, BSD): E48R has the index 1.53116."""
    text = """RDM;LEN
EPD 12.0
DIM M
WL 587.5618
XAN 0.0
SO 0.0 0.1e14
S 9.93 3.7 1.53116:56.0
  STO
  CIR 6.0
  ASP
  K -0.71
  A -0.1581980090969e-4; B -0.2770951746068999e-6; C -0.1216086045095e-8; D 0.0
  DIF DOE
  HOR 1.0
  HWL 587.5618; HCT R
  HCO C1 -0.001807322521767816; HCC C1 100
S -48.3 12.94603127272
SI 0.0 0.0
"""
    system = read(text)
    assert paraxial(system).back_focus == pytest.approx(12.94603127272, abs=1e-5)
    y = np.linspace(0.5, 5.5, 6)
    rays = Rays(np.stack([0 * y, y, 0 * y - 1.0]), np.array([[0.0], [0.0], [1.0]]) * np.ones(6), np.zeros(6))
    found = trace_sequence(pack(system, 587.5618e-6), rays, moving(system, rest_states(system)), NUMPY)
    assert np.abs(found.y).max() < 3e-5
