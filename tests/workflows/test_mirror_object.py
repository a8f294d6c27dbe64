"""Objects that a shaken mirror images, in three kinds of light."""

import re

import numpy as np
import pytest
from small_mirrors import eleven

from wavequake.campaign.store.store import open_store
from wavequake.chain.images.coherent import source_of
from wavequake.errors import UserError
from wavequake.imaging.objects.formation import coherent_image, incoherent_image, partially_coherent_image
from wavequake.imaging.objects.shapes import double_slit
from wavequake.imaging.pupils.pupil_shape import PupilShape
from wavequake.report.campaign import report_store
from wavequake.workflows.exposures import mirror_exposure
from wavequake.workflows.exposures.mirror_exposure import KIND, aberrations_of, study_of
from wavequake.workflows.mirrors import model_store
from wavequake.workflows.mirrors.bench import bench_of
from wavequake.workflows.run import run_study
from wavequake.workflows.study import load_study

PIXELS, SAMPLING = 32, 0.25
SMALL = {
    "model.rings": 2,
    "reduction.variants": ["craigb18"],
    "imaging.pixels": PIXELS,
    "imaging.pupil_samples": 64,
    "imaging.instants": 11,
    "imaging.scale": 0.003,
    "optics.rays": 200,
    "optics.zernike_terms": 11,
    "time.duration_s": 0.005,
}
LIGHTS = {
    "incoherent": {},
    "coherent": {"object.light": "coherent"},
    "partial": {"object.light": "partial", "object.sigma": 0.4},
}
SLITS = {"object.double_slit": [0.75, 2.25]}


@pytest.fixture(autouse=True, scope="module")
def models(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        folder = tmp_path_factory.getbasetemp() / "mirror-exposure-models"
        patch.setattr(model_store, "model_folder", lambda: folder)
        yield


def computed(keys):
    text = load_study("mirror-exposure", SMALL | keys).identity_text()
    found = KIND.compute(text, np.array([1]), "numpy")
    assert found.status[0] == 1, found.messages
    return text, {name: values[0] for name, values in found.arrays.items()}


def imaged(study, wavefront):
    """The same slits on a finer grid with a wide border, filtered by the pupil's transfer function."""
    fine, border = 3, 112
    picture = np.kron(
        np.pad(double_slit((PIXELS, PIXELS), SAMPLING, 0.75, 2.25), border), np.ones((fine, fine))
    )
    pupil, lit = PupilShape(0.0, wavefront), study.object
    if lit.light == "incoherent":
        image = incoherent_image(picture, SAMPLING / fine, pupil)
    elif lit.light == "coherent":
        image = coherent_image(picture, SAMPLING / fine, pupil)
    else:
        image = partially_coherent_image(picture, SAMPLING / fine, pupil, source_of(lit))
    first, last = border * fine + fine // 2, (border + PIXELS) * fine
    return image[first:last:fine, first:last:fine]


@pytest.mark.parametrize("light", LIGHTS)
def test_one_instant_images_as_a_transfer_function_does(light):
    """Three mounts in phase: the line of sight stays, the rest is Noll's polynomials written out."""
    text, found = computed(SLITS | LIGHTS[light] | {"imaging.instants": 2, "imaging.scale": 0.01})
    study = study_of(text)
    last = aberrations_of(text, "circular", "craigb18")[0, -1]
    los = study.imaging.scale * last[:2] / found["resolution_mm"]
    opd = study.imaging.scale * last[5:] / study.optics.wavelength_nm

    def wavefront(x, y):
        # Images have the axes of the image plane, to whose +x an OPD moves light that falls along +x.
        return 0.5 * (los[0] * x + los[1] * y) - eleven(x, y)[:, 3:] @ opd

    still = imaged(study, None)
    np.testing.assert_allclose(found["object_static"], still, rtol=0, atol=0.04 * still.max())
    expected = 0.5 * (still + imaged(study, wavefront))  # the first of the two instants is at rest
    np.testing.assert_allclose(found["object_image"][0], expected, rtol=0, atol=0.04 * still.max())
    assert np.abs(expected - still).max() > 0.1 * still.max()


@pytest.mark.parametrize("light", LIGHTS)
def test_a_pinhole_shows_the_exposure(tmp_path, light):
    np.save(tmp_path / "pinhole.npy", np.ones((1, 1)))
    _, found = computed({"object.picture": str(tmp_path / "pinhole.npy")} | LIGHTS[light])
    seen, exposure, rest = (found[name] for name in ("object_image", "exposure", "object_static"))
    # A pixel's square spectrum falls by some percent to the rim of the pupil.
    np.testing.assert_allclose(seen / rest.max(), exposure, rtol=0, atol=0.02)
    np.testing.assert_allclose(rest / rest.max(), found["exposure_static"], rtol=0, atol=0.02)


def test_a_study_with_an_object_stores_and_reports_it(tmp_path):
    study = load_study("mirror-exposure", SMALL | SLITS | LIGHTS["coherent"])
    run_study(study, tmp_path / "store", on="serial")
    stored = open_store(tmp_path / "store").load()
    assert stored["object_image"].dims == ("case", "excitation", "y", "x")
    assert stored["object_static"].dims == ("case", "y", "x")
    assert (
        stored["object_image"].attrs["long_name"].startswith("exposed image of the object in coherent light")
    )
    _, report = report_store(tmp_path / "store")
    assert "The object as one300 exposes it, scale 0.003, in coherent light" in report.read_text()


@pytest.mark.parametrize("keys", [{}, SLITS, SLITS | LIGHTS["partial"]])
def test_template_describes_what_is_computed(keys):
    text, found = computed(keys)
    assert {name: np.shape(values) for name, values in found.items()} == {
        name: variable.shape for name, variable in KIND.template(text).per_case.items()
    }


def test_an_object_in_the_dark_stays_dark(tmp_path):
    np.savetxt(tmp_path / "dark.csv", np.zeros((3, 3)), delimiter=",")
    for light in LIGHTS.values():
        _, found = computed({"object.picture": str(tmp_path / "dark.csv")} | light)
        assert np.abs(found["object_image"]).max() < 1e-15


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ({"object.slit": 1.0, "object.grating": 2.0}, "it has slit, grating"),
        ({"object.light": "coherent"}, "it has none"),
        ({"object.picture": "nowhere.png"}, "cannot be read"),
    ],
)
def test_objects_that_are_none_are_refused_when_the_study_is_loaded(keys, words):
    with pytest.raises(UserError, match=words):
        load_study("mirror-exposure", SMALL | keys)


@pytest.mark.parametrize("light", LIGHTS.values())
def test_an_object_that_does_not_fit_is_refused_before_a_case_runs(light):
    study = load_study("mirror-exposure", SMALL | {"object.chart": [9.0]} | light)
    with pytest.raises(UserError, match="the chart is"):
        KIND.check(study.identity_text())


def test_a_pupil_too_coarse_for_a_coherent_object_is_warned_of(monkeypatch):
    """From rim to rim of object and image are two frames of 16, on top of a line of sight of 10 lambda/D."""
    tilted = np.zeros((2, 51, 13))
    needed = {}
    for light in ("incoherent", "coherent"):
        keys = {"imaging.pupil_samples": 16, "imaging.pixels": 64, "imaging.scale": 1.0}
        text = load_study("mirror-exposure", SMALL | SLITS | LIGHTS[light] | keys).identity_text()
        tilted[..., 0] = 10.0 * bench_of(text, "circular").optics.resolution
        monkeypatch.setattr(mirror_exposure, "aberrations_of", lambda *_: tilted)
        (notice,) = KIND.notices(text)
        needed[light] = int(re.search(r"need (\d+)", notice).group(1))
    # Where the light is incoherent, one frame and 0.5 waves of defocus (4 sqrt(3) per radius) count.
    assert needed["incoherent"] == int(np.ceil(2.0 * (10.0 + 8.0 + 2.0 * 0.5 * 4.0 * np.sqrt(3.0))))
    assert needed["coherent"] == 2 * (10 + 16)
