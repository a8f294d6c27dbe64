"""Exposures of a shaken mirror against sums over its pupil, and the reports of both exposure workflows."""

import shutil
import tracemalloc

import numpy as np
import pytest
from PIL import Image
from small_mirrors import eleven
from typer.testing import CliRunner

from wavequake.campaign.contract import DONE, RAISED
from wavequake.campaign.store.store import open_store
from wavequake.cli import app
from wavequake.errors import UserError
from wavequake.imaging.engines.matrix_fourier import matrix_fourier, psf
from wavequake.imaging.exposures.mtf import ideal_mtf
from wavequake.imaging.exposures.through_focus import through_focus
from wavequake.imaging.pupils.pupil_function import annular_pupil
from wavequake.report.campaign import report_store, summary_table
from wavequake.report.exposures import psf_figures
from wavequake.report.mirrors import exposures as mirror_exposures
from wavequake.report.page import render_page
from wavequake.viewer import animate as animation
from wavequake.viewer.animate import animate
from wavequake.workflows.exposures import mirror_exposure
from wavequake.workflows.exposures.mirror_exposure import KIND, aberrations_of, exposed_instants
from wavequake.workflows.mirrors import model_store
from wavequake.workflows.run import run_study
from wavequake.workflows.study import load_study

SMALL = {
    "model.rings": 2,
    "reduction.variants": ["craigb18"],
    "imaging.pixels": 32,
    "imaging.pupil_samples": 32,
    "imaging.instants": 21,
    "imaging.scale": 0.003,
    "optics.rays": 200,
    "optics.zernike_terms": 11,
    "time.duration_s": 0.005,
}
SINE, ONE = range(2)


@pytest.fixture(autouse=True, scope="module")
def models(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        folder = tmp_path_factory.getbasetemp() / "mirror-exposure-models"
        patch.setattr(model_store, "model_folder", lambda: folder)
        yield


@pytest.fixture(scope="module")
def study():
    return load_study("mirror-exposure", SMALL)


@pytest.fixture(scope="module")
def store(study, tmp_path_factory):
    path = tmp_path_factory.mktemp("exposure") / "store"
    run_study(study, path, on="serial")
    return path


@pytest.fixture(scope="module")
def dataset(store):
    found = open_store(store).load()
    assert (found["status"] == DONE).all(), found["message"].values
    return found


@pytest.mark.parametrize("excitation", [SINE, ONE])
def test_the_exposure_is_the_mean_of_sums_over_the_pupil(study, dataset, excitation):
    """Noll's polynomials written out, the motion of the image as a tilt of the pupil, every cell summed."""
    text = study.identity_text()
    history = aberrations_of(text, "circular", "craigb18")[excitation][exposed_instants(study)]
    pupil = annular_pupil(32)
    scale = study.imaging.scale
    waves = scale * history[:, 5:] @ eleven(pupil.x, pupil.y)[:, 3:].T / study.optics.wavelength_nm
    los = scale * history[:, :2] / float(dataset["resolution_mm"][1])
    middles = pupil.axis[np.array(np.unravel_index(pupil.cells, pupil.amplitude.shape)[::-1])]
    phase = np.pi * los @ middles - 2 * np.pi * waves
    axis = (np.arange(32) - 16) * study.imaging.sampling
    along_x, along_y = (np.exp(-1j * np.pi * np.outer(axis, where)) for where in middles)
    light = pupil.amplitude.ravel()[pupil.cells]
    field = np.einsum("yc,xc,tc->tyx", along_y, along_x, light * np.exp(1j * phase), optimize=True)
    wanted = (np.abs(field) ** 2).mean(axis=0) / light.sum() ** 2
    np.testing.assert_allclose(dataset["exposure"][1, excitation], wanted, rtol=0, atol=2e-4)
    assert wanted.max() < 0.9


@pytest.mark.parametrize("excitation", [SINE, ONE])
def test_exposures_through_focus_are_sums_over_the_defocused_pupil(study, dataset, excitation):
    """In focus the tilted pupil's sum is the exposure that Fourier phases place."""
    scan = dataset["exposure_focus"][1, excitation]
    np.testing.assert_allclose(scan.sel(focus=0.0), dataset["exposure"][1, excitation], rtol=0, atol=2e-4)
    text, scale, pupil = study.identity_text(), study.imaging.scale, annular_pupil(32)
    history = aberrations_of(text, "circular", "craigb18")[excitation][exposed_instants(study)]
    opd = scale * history[:, 5:] @ eleven(pupil.x, pupil.y)[:, 3:].T / study.optics.wavelength_nm
    opd += 0.25 * np.sqrt(3) * (2 * (pupil.x**2 + pupil.y**2) - 1)
    los = scale * history[:, :2] / float(dataset["resolution_mm"][1])
    phase = np.pi * los @ np.stack([pupil.x, pupil.y]) - 2 * np.pi * opd
    wanted = psf(matrix_fourier(pupil, 32, study.imaging.sampling), phase).mean(axis=0)
    np.testing.assert_allclose(scan.sel(focus=0.25), wanted, rtol=0, atol=1e-12)


def test_the_mirror_at_rest_shows_its_own_peak(dataset):
    assert dataset["exposure_static"].max() == pytest.approx(1.0, abs=1e-12)
    assert (dataset["peak"] < 0.95).all()


def test_one_mount_tilts_the_mirror_three_do_not(dataset):
    los = np.abs(dataset["los_mm"]).max(dim=("time", "axis")).to_numpy()
    assert (los[:, SINE] < 1e-2 * los[:, ONE]).all()


def test_the_reference_is_off_by_nothing(dataset):
    error = dataset["wfe_error"].max("time").to_numpy()
    assert (error[0] == 0.0).all()
    assert (error[1] > 0.0).all()


def test_shortcuts_become_right_in_proportion_to_a_small_vibration():
    """Odd aberrations, as the trefoil of three mounts, act in first order, even ones in second."""
    errors = []
    for scale in (1e-5, 3e-5):
        calm = load_study("mirror-exposure", {**SMALL, "imaging.scale": scale}).identity_text()
        errors.append(KIND.compute(calm, np.array([0]), "numpy").arrays["image_error"][0])
    np.testing.assert_allclose(errors[1] / errors[0], 3.0, rtol=2e-2)


def test_a_case_does_not_depend_on_its_chunk(study):
    text = study.identity_text()
    together, alone = (KIND.compute(text, np.array(cases), "numpy").arrays for cases in ([0, 1], [1]))
    for name, values in alone.items():
        np.testing.assert_array_equal(values[0], together[name][1], err_msg=name)
    assert {name: values.shape[1:] for name, values in alone.items()} == {
        name: variable.shape for name, variable in KIND.template(text).per_case.items()
    }


@pytest.mark.parametrize("light", ["incoherent", "coherent"])
def test_the_memory_of_an_exposure_does_not_hold_its_images(light):
    """500 more instants take less than a tenth of their local images, of 32 KB each."""
    peaks = []
    for instants in (3, 100, 600):  # the first prepares what all share
        keys = {"imaging.instants": instants, "time.duration_s": 0.06}
        keys |= {"object.slit": 1.0, "object.light": light}
        text = load_study("mirror-exposure", SMALL | keys).identity_text()
        aberrations_of(text, "circular", "krylov108(200,450,700)")
        tracemalloc.start()
        assert KIND.compute(text, np.array([0]), "numpy").status[0] == DONE
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[2] - peaks[1] < 0.1 * 500 * 64**2 * 8


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ({"imaging.scale": 1e6}, "the line of sight moves by up to"),
        ({"imaging.scale": 1e300}, "too far for an"),
    ],
)
def test_motion_that_no_image_holds_is_quarantined(keys, words):
    found = KIND.compute(load_study("mirror-exposure", SMALL | keys).identity_text(), np.array([1]), "numpy")
    assert found.status[0] == RAISED
    assert words in found.messages[0]
    assert np.isnan(found.arrays["exposure"][0]).all()


def test_a_wavefront_that_is_no_number_is_quarantined_alone(study, monkeypatch):
    text = study.identity_text()
    spoiled = aberrations_of(text, "circular", "craigb18").copy()
    spoiled[ONE, 20, 7] = np.nan  # instants are every second or third

    def of(text, model, variant):
        return spoiled if variant == "craigb18" else aberrations_of(text, model, variant)

    monkeypatch.setattr(mirror_exposure, "aberrations_of", of)
    found = KIND.compute(text, np.array([0, 1]), "numpy")
    assert found.status.tolist() == [DONE, RAISED]
    assert "is not finite, so there is no exposure" in found.messages[1]


def test_images_wider_than_the_pupils_period_are_refused_before_a_case_runs():
    study = load_study("mirror-exposure", SMALL | {"imaging.pixels": 128})
    with pytest.raises(UserError, match=r"computed 64 lambda/D wide.*set it to at least 64"):
        KIND.check(study.identity_text())


def test_the_table_of_a_mirror(store, dataset):
    table = summary_table(store)
    columns = {str(column.header).replace("\n", " "): list(column.cells) for column in table.columns}
    assert columns["variant"] == ["krylov108(200,450,700)", "craigb18"] * 2
    assert columns["image off"][0] == columns["image off"][2] == "reference"
    peaks = dataset["peak"].to_numpy().T.ravel()
    np.testing.assert_allclose([float(value) for value in columns["peak"]], peaks, rtol=6e-3)
    assert "craigb18 is off by" in table.caption


@pytest.mark.usefixtures("lettered")
def test_the_report_of_a_mirror(store, dataset):
    shown = dataset.isel(excitation=[ONE])
    text = render_page(shown, mirror_exposures.page_of(store, shown, "numpy"))
    assert text.count("<svg") == 8
    off = f"LOS only, {float(dataset['image_error'][0, ONE, 0]):.1e} off"
    for words in ("Störkle 2018, Eq. 3.79", "krylov108(200,450,700)", "circular, one300", off):
        assert words in text


@pytest.fixture(scope="module")
def telescope_store(tmp_path_factory):
    path = tmp_path_factory.mktemp("telescope") / "store"
    keys = {
        "optics.rays": 400,
        "wavefront.zernike_terms": 15,
        "imaging.pixels": 16,
        "disturbance.history.instants": 3,
        "campaign.cases": 2,
        "campaign.device": "numpy",
    }
    run_study(load_study("tmt-exposure", keys), path, on="serial")
    return path


@pytest.mark.usefixtures("lettered")
def test_the_report_of_a_telescope(telescope_store):
    table, path = report_store(telescope_store)
    text = path.read_text()
    assert table.row_count == 4
    assert "of the peak at rest the exposure keeps" in table.caption
    assert text.count("<svg") == 9
    for controller in ("static", "disturbed", "rigid", "elastic"):
        assert controller in text
    off = open_store(telescope_store)["image_error"].sel(controller="disturbed").isel(shortcut=1).to_numpy()
    assert any(f"Gaussian, {value:.1e} off" in text for value in off)


def test_the_table_of_a_telescope_says_what_its_store_holds(telescope_store):
    columns = {
        str(column.header).replace("\n", " "): list(column.cells)
        for column in summary_table(telescope_store).columns
    }
    stored = open_store(telescope_store).load()
    peaks = stored["peak"].median("case").to_numpy()
    np.testing.assert_allclose([float(value) for value in columns["peak"]], peaks, rtol=6e-3)
    assert columns["controller"] == ["static", "disturbed", "rigid", "elastic"]
    wfe = stored["wfe_rms"].mean("time").median("case").to_numpy()
    np.testing.assert_allclose([float(value) for value in columns["WFE (nm)"]], wfe, rtol=6e-3)


def test_a_case_is_animated(telescope_store):
    path = animate(telescope_store, 0, "elastic")
    assert path.name == "case-0-elastic.gif"
    with Image.open(path) as film:
        assert film.n_frames == 3
        film.seek(2)
        assert len(set(film.convert("L").tobytes())) > 20


@pytest.mark.parametrize(
    ("case", "controller", "words"),
    [
        (0, "robust", "choose one of disturbed, rigid, elastic"),
        (-1, "rigid", "has cases 0 to 1; there is no case -1"),
    ],
)
def test_what_cannot_be_animated(telescope_store, case, controller, words):
    with pytest.raises(UserError, match=words):
        animate(telescope_store, case, controller)
    with pytest.raises(UserError, match="there is no format 'avi'; choose one of gif, mp4"):
        animate(telescope_store, 0, kind="avi")


def test_the_command_line_animates_and_leaves_the_report(telescope_store):
    report_store(telescope_store)
    before = (telescope_store / "report.html").stat().st_mtime_ns
    result = CliRunner().invoke(app, ["report", str(telescope_store), "--animate", "1"])
    assert result.exit_code == 0, result.output
    assert "frame 3 of 3" in result.output
    assert (telescope_store / "case-1-disturbed.gif").stat().st_size > 1000
    assert (telescope_store / "report.html").stat().st_mtime_ns == before


def test_the_command_line_writes_an_mp4(telescope_store):
    if shutil.which("ffmpeg") is None:
        pytest.skip("ffmpeg, which writes MP4, is not installed (apt install ffmpeg)")
    result = CliRunner().invoke(app, ["report", str(telescope_store), "--animate", "1", "--format", "mp4"])
    assert result.exit_code == 0, result.output
    film = (telescope_store / "case-1-disturbed.mp4").read_bytes()
    assert film[4:8] == b"ftyp"  # the first box of an MP4 (ISO/IEC 14496-12)
    assert b"avc1" in film
    assert len(film) > 5000


def program(folder, script):
    """Put a program called ffmpeg alone on the PATH, but for /bin."""
    path = folder / "ffmpeg"
    path.write_text("#!/bin/sh\n" + script)
    path.chmod(0o755)
    return f"{folder}:/bin:/usr/bin"


def test_an_mp4_has_the_frames_of_the_gif(telescope_store, tmp_path, monkeypatch):
    """What ffmpeg is sent: raw pixels, one frame after the other."""
    monkeypatch.setenv("PATH", program(tmp_path, 'for last; do :; done\ncat > "$last"\n'))
    sent = animate(telescope_store, 0, "elastic", "mp4").read_bytes()
    path = animate(telescope_store, 0, "elastic")
    with Image.open(path) as film:
        frames = np.frombuffer(sent, np.uint8).reshape(film.n_frames, film.height, film.width, 4)
        for number, frame in enumerate(frames):
            film.seek(number)
            off = np.abs(np.asarray(film.convert("RGB"), dtype=int) - frame[..., :3])
            assert off.mean() < 3.0  # the GIF has 256 colors
    assert np.abs(frames[2].astype(int) - frames[0]).max() > 100


def test_an_mp4_without_ffmpeg_names_the_package(telescope_store, tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    before = set(telescope_store.iterdir())
    with pytest.raises(UserError, match="not on the PATH: install the package ffmpeg"):
        animate(telescope_store, 0, "elastic", "mp4")
    assert set(telescope_store.iterdir()) == before


def test_an_ffmpeg_that_fails_leaves_nothing(telescope_store, tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", program(tmp_path, 'echo "Unknown encoder h264" >&2\nexit 1\n'))
    before = set(telescope_store.iterdir())
    with pytest.raises(UserError, match=r"could not write the MP4 \(Unknown encoder h264\)"):
        animate(telescope_store, 0, "rigid", "mp4")
    assert set(telescope_store.iterdir()) == before


@pytest.mark.parametrize(("option", "value"), [("--controller", "elastic"), ("--format", "mp4")])
def test_options_of_an_animation_need_one(telescope_store, option, value):
    result = CliRunner().invoke(app, ["report", str(telescope_store), option, value])
    assert "belong to an animation" in str(result.exception)


def test_a_mirror_is_animated(store, monkeypatch):
    monkeypatch.setattr(animation, "_MOST_FRAMES", 4)
    assert animate(store, 1, "mode 2").name == "case-1-mode-2.gif"
    path = animate(store, 1, "one300")
    assert path.name == "case-1-one300.gif"
    with Image.open(path) as film:
        assert 2 <= film.n_frames <= 4
    with pytest.raises(UserError, match=r"there is no take 'disturbed'; choose one of mode 1, .*one300"):
        animate(store, 0, "disturbed")


def test_figures_of_images():
    """An image that ends at its frame's border still has curves; a perfect one follows the gray line."""
    axis = (np.arange(64) - 32) * 0.25
    pupil = annular_pupil(64)
    transform = matrix_fourier(pupil, 64, 0.25)
    images = through_focus(transform, np.zeros(len(pupil.cells)), [-0.2, 0.0, 0.2])
    assert len(psf_figures.log_psf(images[1], axis).axes) == 2
    (axes,) = psf_figures.mtf_curves({"perfect": images[1]}, 0.25, psf_figures.annulus(0.0)).axes
    curve = axes.lines[0]
    np.testing.assert_allclose(curve.get_ydata(), ideal_mtf(curve.get_xdata()), rtol=0, atol=0.05)
    panels = psf_figures.focus_panels(images, [-0.2, 0.0, 0.2], axis).axes
    assert [place.get_title(loc="left") for place in panels] == ["-0.2 waves", "in focus", "+0.2 waves"]
