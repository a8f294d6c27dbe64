"""Objects that an exposure shows, against sums over their pixels, and refused where they make no sense."""

import base64

import numpy as np
import pytest

from wavequake.campaign.store.store import open_store
from wavequake.chain.images.extended import ObjectSection, object_image
from wavequake.errors import UserError
from wavequake.imaging.engines.matrix_fourier import matrix_fourier, psf
from wavequake.imaging.exposures.detector import pixel_means
from wavequake.imaging.exposures.exposure import centroid
from wavequake.imaging.exposures.mtf import ideal_mtf
from wavequake.imaging.objects.shapes import resolution_chart
from wavequake.imaging.pupils.pupil_function import annular_pupil
from wavequake.report.campaign import report_store
from wavequake.workflows.run import run_study
from wavequake.workflows.study import load_study

SAMPLING, PIXELS, AREA = 0.25, 48, np.pi / 4
PUPIL = annular_pupil(64)
AIRY = psf(matrix_fourier(PUPIL, PIXELS, SAMPLING), np.zeros((1, len(PUPIL.cells))))[0]


def image(**keys):
    return object_image(ObjectSection(**keys), AIRY, PIXELS, SAMPLING, AREA, 1.0)


def test_a_chart_is_the_sum_over_its_pixels():
    found = image(chart=[1.0])
    picture = resolution_chart((PIXELS, PIXELS), SAMPLING, [1.0])
    square = pixel_means(AIRY, SAMPLING, SAMPLING)
    total, middle = np.zeros((3 * PIXELS, 3 * PIXELS)), PIXELS // 2
    for (row, column), bright in np.ndenumerate(picture):
        total[row + middle : row + middle + PIXELS, column + middle : column + middle + PIXELS] += (
            bright * square
        )
    expected = total[PIXELS : 2 * PIXELS, PIXELS : 2 * PIXELS] * SAMPLING**2 * AREA
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12)


def test_a_grating_keeps_the_contrast_of_its_first_order():
    row = image(grating=1.5)[PIXELS // 2, PIXELS // 2 - 6 : PIXELS // 2 + 6]
    # Only the first order, of amplitude 2/pi, passes; the frame cuts wings of the Airy pattern: steady light.
    assert np.ptp(row) == pytest.approx(4 / np.pi * ideal_mtf(np.array([1 / 1.5]))[0], abs=0.001)
    assert 0.4 < row.mean() < 0.5


def test_stars_lie_between_pixels_and_keep_their_flux():
    one = image(stars=[[1.1, -0.6, 2.0]])
    assert centroid(one, SAMPLING) == pytest.approx([1.1, -0.6], abs=0.02)
    assert one.sum() == pytest.approx(2.0 * image(stars=[[0.0, 0.0, 1.0]]).sum(), rel=0.01)


def test_a_wider_exposure_carries_light_from_rim_to_rim():
    """A point at the left rim lights the right one as the Airy pattern falls off over the whole frame."""
    wide = psf(matrix_fourier(PUPIL, 2 * PIXELS, SAMPLING), np.zeros((1, len(PUPIL.cells))))[0]
    picture = np.zeros((PIXELS, PIXELS), dtype="<f4")
    picture[PIXELS // 2, 0] = 1.0
    point = ObjectSection(picture_data=f"{PIXELS}x{PIXELS}:" + base64.b64encode(picture.tobytes()).decode())
    found, narrow = (
        object_image(point, spread, PIXELS, SAMPLING, AREA, 1.0)[PIXELS // 2] for spread in (wide, AIRY)
    )
    expected = pixel_means(wide, SAMPLING, SAMPLING)[PIXELS, PIXELS : 2 * PIXELS] * SAMPLING**2 * AREA
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-15)
    assert expected[-8:].max() > 1e-7
    assert np.abs(narrow[-8:]).max() < 1e-15


def test_slits_double_slits():
    assert image(slit=100.0)[PIXELS // 2, PIXELS // 2] == pytest.approx(1.0, abs=0.06)
    two = image(double_slit=[0.5, 4.0])[PIXELS // 2]
    assert two[PIXELS // 2 - 8] == pytest.approx(two[PIXELS // 2 + 8], rel=1e-12)
    assert two[PIXELS // 2] < 0.3 * two[PIXELS // 2 + 8]


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ({}, "exactly one of slit, double_slit, grating, chart, stars, picture; it has none"),
        ({"slit": 1.0, "grating": 2.0}, "it has slit, grating"),
        ({"stars": [[0.0, 1.0]]}, "three numbers"),
        ({"stars": [[0.0, 70.0, 1.0]]}, "beyond the frame of 12"),
        ({"stars": [[0.0, 0.0, -1.0]]}, "at least 0"),
        ({"chart": [9.0]}, "the chart is"),
        ({"double_slit": [2.0, 1.0]}, "overlap"),
    ],
)
def test_impossible_objects_are_refused(keys, words):
    with pytest.raises(UserError, match=words):
        image(**keys)


def test_a_study_shows_its_object(tmp_path):
    keys = {
        "optics.rays": 400,
        "wavefront.zernike_terms": 15,
        "imaging.pixels": 16,
        "disturbance.history.instants": 4,
        "campaign.cases": 1,
        "campaign.device": "numpy",
        "object.double_slit": [0.5, 2.0],
    }
    run_study(load_study("tmt-exposure", keys), tmp_path / "store", on="serial")
    found = open_store(tmp_path / "store").load()
    assert found["object_image"].dims == ("case", "controller", "y", "x")
    contrast = np.ptp(found["object_image"][0, :, 8].to_numpy(), axis=1)
    assert contrast[0] > 2 * contrast[1] > 0  # at rest, disturbed
    _, report = report_store(tmp_path / "store")
    assert "The object as case 0 exposes it, in incoherent light" in report.read_text()
    del keys["object.double_slit"]
    stars = load_study("tmt-exposure", keys | {"object.stars": [[9.0, 0.0, 1.0]]})
    with pytest.raises(UserError, match="beyond the frame of 4"):
        run_study(stars, tmp_path / "other", on="serial")
