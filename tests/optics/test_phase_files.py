"""Gratings and perfect lenses in lens files and study files, against another tracer; what is refused."""

import tomllib
from pathlib import Path

import numpy as np
import pytest
from test_phases import relay

from wavequake.errors import UserError
from wavequake.kernels.device.devices import NUMPY
from wavequake.kernels.trace.sequence import Rays
from wavequake.kernels.trace.sequential import trace_sequence
from wavequake.optics.media.glasses import constant
from wavequake.optics.rays.packing import moving, pack
from wavequake.optics.shapes.phases import Diffraction, PerfectLens
from wavequake.optics.shapes.shapes import Conic, EvenAsphere, GridSag
from wavequake.optics.systems.file import SystemSection, build
from wavequake.optics.systems.kinematics import SurfaceRow, rest_states
from wavequake.optics.systems.paraxial import paraxial
from wavequake.optics.zemax.export import zmx_text
from wavequake.optics.zemax.read import parse_zmx, read_zmx

LENSES = Path(__file__).parents[1] / "data" / "lenses"
# Directions behind the gratings in files of Optiland's tests, for a field (2, 8) degrees and a place
# (-0.15, 0.7) of the entrance pupil, as its own tests hold them (tests/test_grating.py, MIT).
OPTILAND = {
    "optiland_flat_transmission_grating": (0.0345602649, 0.0216899611, 0.9991672201),
    "optiland_curved_transmission_grating": (0.0229384233, 0.0764682608, 0.9968081229),
    "optiland_curved_reflective_grating": (0.0040370331, 0.4006582284, -0.9162186892),
}


@pytest.mark.parametrize("name", OPTILAND)
def test_files_with_gratings_are_traced_as_by_another_tracer(name):
    system = read_zmx(LENSES / f"{name}.zmx")
    d = np.array([*np.tan(np.deg2rad([2.0, 8.0])), 1.0])
    d /= np.linalg.norm(d)
    place = np.array([-0.15 * 7.5, 0.7 * 7.5, paraxial(system).entrance_pupil])
    start = place - (place[2] + 30.0) / d[2] * d
    rays = Rays(start[:, None], d[:, None], np.zeros(1))
    found = trace_sequence(pack(system, 587e-6), rays, moving(system, rest_states(system)), NUMPY)
    np.testing.assert_allclose([found.u[0, 0], found.v[0, 0]], OPTILAND[name][:2], rtol=0, atol=1e-10)
    assert found.w_sign[0, 0] == np.sign(OPTILAND[name][2])


WRITTEN = {
    "grating": SurfaceRow("one", Conic(-80.0, -0.3), 20.0, "reflect", phase=Diffraction(-1.0, 312.5)),
    "binary 1": SurfaceRow(
        "one", EvenAsphere(80.0, -0.3, (0.0, 1e-6)), 20.0, "refract", constant(1.5),
        phase=Diffraction(1.0, polynomial=(1.0, 2.0, 30.0), normalization_radius=12.0),
    ),
    "binary 2": SurfaceRow(
        "one", Conic(80.0), 20.0, phase=Diffraction(2.0, radial=(-300.0, 10.0), normalization_radius=12.0)
    ),
    "paraxial": SurfaceRow("one", thickness=20.0, phase=PerfectLens(-75.0)),
}  # fmt: skip


@pytest.mark.parametrize("name", WRITTEN)
def test_lens_files_hold_phases(name):
    system = relay(WRITTEN[name], SurfaceRow("image"))
    again = parse_zmx(zmx_text(system), "written").surfaces[0]
    assert (again.phase, again.shape) == (WRITTEN[name].phase, WRITTEN[name].shape)
    inches = parse_zmx(zmx_text(system).replace("UNIT MM", "UNIT IN"), "written").surfaces[0].phase
    if isinstance(inches, PerfectLens):
        assert inches.focal_length == pytest.approx(-75.0 * 25.4, rel=1e-15)
    else:
        assert inches.lines == again.phase.lines  # per micrometer in files of all units
        if inches.radial or inches.polynomial:
            assert inches.normalization_radius == pytest.approx(12.0 * 25.4, rel=1e-15)


@pytest.mark.parametrize(
    ("row", "message"),
    [
        (
            SurfaceRow("one", phase=Diffraction(1.0, 100.0, radial=(1.0,))),
            "The surface one of ideal diffracts by grooves, a radial phase and a polynomial together",
        ),
        (
            SurfaceRow(
                "one", GridSag(np.inf, 0.0, np.zeros((9, 9)), 1.0, 1.0), phase=Diffraction(1.0, 100.0)
            ),
            "or on a shape with which no surface type",
        ),
    ],
)
def test_phases_that_no_type_has_are_not_written(row, message):
    with pytest.raises(UserError, match=message):
        zmx_text(relay(row, SurfaceRow("image", thickness=1.0)))


@pytest.mark.parametrize(
    ("row", "message"),
    [
        (SurfaceRow("one", Conic(10.0), phase=PerfectLens(5.0)), "it must be a plane that neither reflects"),
        (
            SurfaceRow("one", action="reflect", phase=PerfectLens(5.0)),
            "it must be a plane that neither reflects",
        ),
        (SurfaceRow("one", phase=PerfectLens(0.0)), "the focal length 0.0 mm"),
        (SurfaceRow("one", phase=PerfectLens(np.inf)), "the focal length inf mm"),
        (SurfaceRow("one", phase=Diffraction(np.nan, 100.0)), "not finite"),
        (
            SurfaceRow("one", phase=Diffraction(1.0, radial=(1.0,), normalization_radius=0.0)),
            "radius of its phase",
        ),
    ],
)
def test_phases_that_are_none_are_refused(row, message):
    with pytest.raises(UserError, match=message):
        paraxial(relay(row, SurfaceRow("image", thickness=1.0)))


def test_the_image_cannot_diffract():
    with pytest.raises(
        UserError, match="the last surface of ideal, image, is the image: it cannot have a phase"
    ):
        paraxial(relay(SurfaceRow("one", thickness=9.0), SurfaceRow("image", phase=Diffraction(1.0, 1.0))))


STUDY = """
entrance_diameter_mm = 10.0
wavelengths_nm = [600.0]
[[surface]]
name = "one"
stop = true
phase = {phase}
[[surface]]
name = "image"
distance_mm = 50.0
"""
KEYS = {
    "{ lines_per_mm = 300.0, order = -1.0 }": Diffraction(-1.0, 300.0),
    "{ radial_rad = [5.0, 1.0], radius_mm = 4.0 }": Diffraction(
        1.0, radial=(5.0, 1.0), normalization_radius=4.0
    ),
    "{ polynomial_rad = [5.0], radius_mm = 4.0 }": Diffraction(
        1.0, polynomial=(5.0,), normalization_radius=4.0
    ),
    "{ focal_length_mm = 50.0 }": PerfectLens(50.0),
}


@pytest.mark.parametrize("text", KEYS)
def test_study_files_hold_phases(text):
    section = SystemSection.model_validate(tomllib.loads(STUDY.replace("{phase}", text)))
    assert build(section).surfaces[0].phase == KEYS[text]
    again = SystemSection.model_validate_json(section.model_dump_json(), strict=False)
    assert build(again).surfaces[0].phase == KEYS[text]


def test_records_of_studies_without_phases_are_those_of_before():
    record = tomllib.loads(STUDY.replace("phase = {phase}\n", ""))
    written = SystemSection.model_validate(record).model_dump(mode="json")
    assert all("phase" not in surface for surface in written["surface"])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{ order = 1.0 }", "give lines_per_mm, radial_rad or polynomial_rad, or else focal_length_mm"),
        ("{ lines_per_mm = 3.0, focal_length_mm = 3.0 }", "or else focal_length_mm"),
        ("{ focal_length_mm = 0.0 }", "focal_length_mm must not be 0"),
        ("{ lines = 3.0 }", "lines"),
    ],
)
def test_wrong_keys_of_phases_are_named(text, message):
    with pytest.raises(ValueError, match=message):
        SystemSection.model_validate(tomllib.loads(STUDY.replace("{phase}", text)))
