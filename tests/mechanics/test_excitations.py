from types import SimpleNamespace

import numpy as np
import pytest
from pydantic import TypeAdapter, ValidationError
from truss import truss

from wavequake.errors import UserError
from wavequake.mechanics.disturbances.spectra import variance
from wavequake.mechanics.model import rotations
from wavequake.mechanics.vibration.drive import values
from wavequake.mechanics.vibration.excitations import (
    AnyExcitation,
    ForceImpulse,
    RandomVibration,
    Recorded,
    Sinusoid,
    drive_of,
    read_record,
    vibration_spectrum,
)
from wavequake.mechanics.vibration.modal import modal_model
from wavequake.mechanics.vibration.response import displacements, respond

TIME = 1e-4 * np.arange(2001)


def test_the_default_is_the_excitation_of_the_reference_text():
    """Three interfaces, 10 um at 100 Hz in z, x and y held: nine prescribed directions."""
    drive = drive_of(Sinusoid(name="thesis"), 3, TIME)
    assert drive.prescribed.all()
    expected = np.zeros((len(TIME), 9))
    expected[:, 2::3] = 1e-5 * np.sin(2 * np.pi * 100 * TIME)[:, None]
    np.testing.assert_allclose(values(drive, TIME), expected, rtol=0, atol=1e-19)


def test_kind_selects_the_excitation():
    adapter = TypeAdapter(AnyExcitation)
    found = adapter.validate_python({"kind": "psd", "name": "a", "rms": 1e-6, "interfaces": [0, 2]})
    assert isinstance(found, RandomVibration)
    assert found.interfaces == (0, 2)
    assert isinstance(adapter.validate_python({"kind": "impulse", "name": "b"}), ForceImpulse)
    assert adapter.validate_python(found.model_dump()) == found


def test_a_force_prescribes_nothing_and_a_displacement_may_leave_others_free():
    force = drive_of(Sinusoid(name="a", acts="force", direction="x", interfaces=(1,)), 3, TIME)
    assert not force.prescribed.any()
    assert (force.harmonics[0].sine != 0).nonzero()[0].tolist() == [3]
    turned = drive_of(Sinusoid(name="a", direction="ry", interfaces=(1,)), 6, TIME, turns=(3, 4, 5))
    assert (turned.harmonics[0].sine != 0).nonzero()[0].tolist() == [13]
    assert turned.prescribed.all()
    with pytest.raises(UserError, match="pads with pad_dofs = 6 do"):
        drive_of(Sinusoid(name="a", direction="ry"), 3, TIME)
    # Rotations stand where the model has them: of the first node beside it, of the second nowhere.
    mixed = SimpleNamespace(interfaces=np.array([7, 7, 9]), turns=np.array([1]))
    assert rotations(mixed).tolist() == [1, -1]
    for direction, node, place in (("ry", 0, 4), ("z", 1, 8), ("x", 0, 0)):
        found = drive_of(
            Sinusoid(name="a", acts="force", direction=direction, interfaces=(node,)), 3, TIME, turns=(1, -1)
        )
        assert (found.harmonics[0].sine != 0).nonzero()[0].tolist() == [place]
    with pytest.raises(UserError, match="pads with pad_dofs = 6 do"):
        drive_of(Sinusoid(name="a", direction="ry", interfaces=(1,)), 3, TIME, turns=(1, -1))
    free = drive_of(Sinusoid(name="a", others="free", interfaces=(0, 1)), 3, TIME)
    assert free.prescribed.nonzero()[0].tolist() == [2, 5]
    with pytest.raises(UserError, match="without stiffness"):
        modal_model(truss(), free.prescribed)


def test_an_impulse_gives_its_momentum_to_a_free_body():
    body = truss()
    drive = drive_of(ForceImpulse(name="blow", momentum_n_s=2.0, at_s=0.05), 3, TIME)
    found = displacements(respond(modal_model(body), [drive], TIME), body.surface)[0]
    weight = np.diag(body.mass)[2::3]
    np.testing.assert_allclose(found[:, 2::3] @ weight, 6.0 * np.maximum(TIME - 0.05, 0), rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    "excitation",
    [
        RandomVibration(name="a", rms=3e-6, alike=False),
        RandomVibration(name="b", rms=2.0, acts="force", spectrum="resonance", alike=False),
        RandomVibration(name="c", spectrum="file", file_csv="10,1e-12\n100,3e-12\n200,0", alike=False),
    ],
    ids=lambda e: e.spectrum,
)
def test_vibration_has_the_variance_of_its_spectrum(excitation):
    """Over 300 realizations of three nodes; the spread of the mean square of 900 Gaussians is 5 %."""
    time = 1e-4 * np.arange(52)
    last = [drive_of(excitation, 3, time, 7, realization).samples[-1, 2::3] for realization in range(300)]
    assert np.mean(np.square(last)) == pytest.approx(variance(vibration_spectrum(excitation)), rel=0.1)


def test_file_spectrum_integrates_to_the_area_below_its_lines():
    spectrum = vibration_spectrum(
        RandomVibration(name="c", spectrum="file", file_csv="10,1e-12\n100,3e-12\n200,0")
    )
    assert variance(spectrum) == pytest.approx(90 * 2e-12 + 100 * 1.5e-12, rel=1e-9)


def test_vibration_starts_from_rest_and_is_one_draw_per_realization():
    excitation = RandomVibration(name="a", rms=1e-6)
    first = drive_of(excitation, 3, TIME, 1, 0).samples
    assert (first[0] == 0).all()
    assert (first[:, 2] == first[:, 5]).all()
    assert (first == drive_of(excitation, 3, TIME, 1, 0).samples).all()
    assert (first != drive_of(excitation, 3, TIME, 1, 1).samples)[1:, 2].all()
    assert (first != drive_of(excitation, 3, TIME, 2, 0).samples)[1:, 2].all()
    apart = drive_of(excitation.model_copy(update={"alike": False}), 3, TIME, 1, 0).samples
    assert (apart[1:, 2] != apart[1:, 5]).all()


def test_record_is_joined_by_straight_lines():
    text = "time_s,a,b\n# comment\n0,0,1\n0.1,1,3\n0.2,0,5\n"
    drive = drive_of(Recorded(name="r", file_csv=text, interfaces=(0, 2), factor=1e-6), 3, TIME)
    np.testing.assert_allclose(drive.samples[500, [2, 8]], [0.5e-6, 2e-6], rtol=1e-12)
    np.testing.assert_allclose(drive.samples[1500, [2, 8]], [0.5e-6, 4e-6], rtol=1e-12)
    assert (drive.samples[:, [0, 1, 3, 4, 5, 6, 7]] == 0).all()


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("time_s,a\n0,0\n1,nan\n", "line 3.*not finite"),
        ("0,0\n1,inf\n", "line 2.*not finite"),
        ("0,0\n1\n", "line 2 has 1 number"),
        ("0,0\n1,1,1\n", "line 2 has 3 numbers"),
        ("0,0\n0,1\n", "line 2: time_s 0 does not increase"),
        ("0,0\n1,x\n", "line 2: '1,x' is not a row"),
        ("x,0\n1,2\n2,3", "line 1: 'x,0' is not a row"),
        ("0,0\n", "has 1 rows"),
        ("", "has 0 rows"),
    ],
)
def test_bad_records_are_refused(text, match):
    with pytest.raises(UserError, match=match):
        read_record(text, "motion.csv")
    with pytest.raises(ValidationError, match="file_csv"):
        Recorded(name="r", file_csv=text)


@pytest.mark.parametrize(
    ("excitation", "match"),
    [
        (Sinusoid(name="a", interfaces=(3,)), "interface node 3, but the body has 3"),
        (RandomVibration(name="a", rms=1.0, high_hz=6000.0), "resolve 5000 Hz"),
        (RandomVibration(name="a", rms=1.0, spectrum="resonance", center_hz=3000.0), "time step of at most"),
        (Recorded(name="a", file_csv="0,0\n0.1,1"), "covers 0 to 0.1 s"),
        (Recorded(name="a", file_csv="0.1,0\n1,1"), "covers 0.1 to 1 s"),
        (Recorded(name="a", file_csv="0,0,0\n1,1,1"), "has 2 columns"),
    ],
)
def test_excitations_that_do_not_fit_are_refused(excitation, match):
    with pytest.raises(UserError, match=match):
        drive_of(excitation, 3, TIME)


@pytest.mark.parametrize(
    ("fields", "match"),
    [
        ({"kind": "psd"}, "state its rms"),
        ({"kind": "psd", "spectrum": "file"}, "needs a file"),
        ({"kind": "psd", "rms": 1.0, "file_csv": "1,1\n2,1"}, "takes no file"),
        ({"kind": "psd", "spectrum": "file", "file_csv": "1,1\n2,nan"}, "line 2"),
        ({"kind": "psd", "rms": 1.0, "low_hz": 500.0}, "below high_hz"),
        ({"kind": "psd", "rms": 1.0, "spectrum": "resonance", "fwhm_hz": 200.0}, "cannot be 200 Hz wide"),
        ({"kind": "psd", "rms": 1.0, "ramp_s": 0.0}, "needs a ramp_s"),
        ({"kind": "impulse", "momentum_n_s": 0.0}, "excites nothing"),
        ({"kind": "impulse", "acts": "displacement"}, "force"),
        ({"kind": "sinusoid", "amplitude": -1.0}, "greater than 0"),
        ({"kind": "sinusoid", "frequency_hz": float("nan")}, "finite"),
        ({"kind": "sinusoid", "interfaces": [0, 0]}, "different nodes"),
        ({"kind": "sinusoid", "interfaces": []}, "at least one"),
        ({"kind": "sinusoid", "freq": 1.0}, "extra"),
    ],
)
def test_bad_sections_are_refused(fields, match):
    with pytest.raises(ValidationError, match=match):
        TypeAdapter(AnyExcitation).validate_python({"name": "a"} | fields)
