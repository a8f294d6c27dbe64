"""Objects in coherent and partially coherent light, against Fourier optics on a fine grid."""

import itertools

import numpy as np
import pytest
from scipy.special import j1

from wavequake.campaign.store.store import open_store
from wavequake.chain.images.coherent import lit_by_cells, lit_object, mean_image, source_of
from wavequake.chain.images.extended import ObjectSection, object_image
from wavequake.errors import UserError
from wavequake.imaging.engines.matrix_fourier import matrix_fourier
from wavequake.imaging.engines.segment_basis import ray_basis
from wavequake.imaging.engines.segment_psf import psf
from wavequake.imaging.objects.formation import coherent_image, partially_coherent_image
from wavequake.imaging.objects.shapes import double_slit
from wavequake.imaging.pupils.pupil_function import annular_pupil
from wavequake.imaging.pupils.pupil_shape import PupilShape
from wavequake.workflows.run import run_study
from wavequake.workflows.study import load_study

SAMPLING, PIXELS, FINE, BORDER = 0.25, 32, 3, 112
GRID = annular_pupil(96)
SMALL = {
    "optics.rays": 400,
    "wavefront.zernike_terms": 15,
    "imaging.pixels": 16,
    "disturbance.history.instants": 2,
    "campaign.cases": 1,
    "campaign.device": "numpy",
}


def waves(x, y):
    """Tilt, defocus and coma."""
    return 0.3 * x + 0.1 * (x**2 + y**2) + 0.15 * (3.0 * (x**2 + y**2) - 2.0) * y


def image(section, phase, of="rays"):
    if of == "cells":
        return mean_image(lit_by_cells(section, matrix_fourier(GRID, PIXELS, SAMPLING)), [phase])
    rays = GRID.x, GRID.y, GRID.light
    lit = lit_object(section, rays, PIXELS, SAMPLING, np.pi, 2.0)
    return mean_image(lit, [phase])


@pytest.mark.parametrize("of", ["rays", "cells"])
@pytest.mark.parametrize("light", [{"light": "coherent"}, {"light": "partial", "sigma": 0.4}])
def test_rays_and_cells_image_as_transfer_functions_do(light, of):
    section = ObjectSection(double_slit=[0.75, 2.25], **light)
    found = image(section, waves(GRID.x, GRID.y)[None], of)
    picture = double_slit((PIXELS, PIXELS), SAMPLING, 0.75, 2.25)
    fine = np.kron(np.pad(picture, BORDER), np.ones((FINE, FINE)))
    pupil = PupilShape(0.0, lambda x, y: waves(-x, -y))  # an OPD there falls where the phase here grows
    if section.sigma is None:
        expected = coherent_image(fine, SAMPLING / FINE, pupil)
    else:
        expected = partially_coherent_image(fine, SAMPLING / FINE, pupil, source_of(section))
    first, last = BORDER * FINE + FINE // 2, (BORDER + PIXELS) * FINE
    # The pupil's rim is a staircase there, whose steps shrink as the border grows.
    np.testing.assert_allclose(
        found, expected[first:last:FINE, first:last:FINE], rtol=0, atol=0.03 * expected.max()
    )


@pytest.mark.parametrize("of", ["rays", "cells"])
@pytest.mark.parametrize("sigma", [None, 0.4])
def test_at_rest_airys_amplitudes_add(sigma, of):
    """The closed form of a disc's transform, times the wave of each point of the source, over each pixel."""
    light = {"light": "coherent"} if sigma is None else {"light": "partial", "sigma": sigma}
    section = ObjectSection(double_slit=[0.75, 2.25], **light)
    found = image(section, np.zeros((1, len(GRID.x))), of)
    picture = double_slit((PIXELS, PIXELS), SAMPLING, 0.75, 2.25)
    axis = (np.arange(PIXELS) - PIXELS // 2) * SAMPLING
    y, x = (axis[index] for index in np.nonzero(picture))
    source = source_of(section)
    fields = np.zeros((len(source.points), PIXELS * PIXELS), dtype=complex)
    step = 0.5 * SAMPLING / np.sqrt(3)  # Gauss points of a pixel
    for at_x, at_y in itertools.product((x - step, x + step), (y - step, y + step)):
        radius = np.pi * np.hypot(axis[None, :, None] - at_x, axis[:, None, None] - at_y)
        disc = np.pi / 4 * 2 * j1(radius) / radius * 0.25 * SAMPLING**2 * picture[picture > 0.0]
        waves_of_source = np.exp(1j * np.pi * source.points @ np.stack([at_x, at_y]))
        fields += waves_of_source @ disc.reshape(-1, len(x)).T
    expected = (source.weights @ np.abs(fields) ** 2).reshape(PIXELS, PIXELS)
    np.testing.assert_allclose(found, expected, rtol=0, atol=5e-4 * expected.max())


def test_a_source_larger_than_the_pupil_lights_incoherently():
    grid, pixels = annular_pupil(16), 12
    phase = waves(grid.x, grid.y)[None]
    rays = grid.x, grid.y, grid.light
    slits = {"double_slit": [0.75, 2.0]}  # whole pixels: their amplitudes are their intensities
    found = mean_image(
        lit_object(ObjectSection(light="partial", sigma=2.0, **slits), rays, pixels, SAMPLING, np.pi, 2.0),
        [phase],
    )
    spread = psf(ray_basis(*rays, pixels, SAMPLING, 2.0), phase).reshape(pixels, pixels)
    expected = object_image(ObjectSection(**slits), spread, pixels, SAMPLING, np.pi, 2.0)
    # The pupil takes in a quarter of the source; what the slits diffract beyond the source's rim is missing.
    np.testing.assert_allclose(4.0 * found, expected, rtol=0, atol=0.13 * expected.max())


def test_the_mean_is_that_of_the_instants():
    section = ObjectSection(slit=1.0, light="coherent")
    phases = np.stack([waves(GRID.x, GRID.y), 0.2 * GRID.x, np.zeros_like(GRID.x)])
    each = [image(section, phase[None]) for phase in phases]
    np.testing.assert_allclose(image(section, phases), np.mean(each, axis=0), rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ({"slit": 1.0, "light": "partial"}, "which needs it"),
        ({"slit": 1.0, "sigma": 0.5}, 'the light is "incoherent", sigma 0.5'),
        ({"stars": [[0.0, 0.0, 1.0]], "light": "coherent"}, "stars shine incoherently"),
    ],
)
def test_light_that_does_not_fit_is_refused(keys, words):
    with pytest.raises(UserError, match=words):
        ObjectSection(**keys).chosen()


@pytest.mark.parametrize("light", [{}, {"object.sigma": 0.3}])
def test_a_pinhole_of_a_study_shows_the_exposure(tmp_path, light):
    np.save(tmp_path / "pinhole.npy", np.ones((1, 1)))
    keys = SMALL | {"object.picture": str(tmp_path / "pinhole.npy")} | light
    study = load_study("tmt-exposure", keys | {"object.light": "partial" if light else "coherent"})
    run_study(study, tmp_path / "store", on="serial")
    found = open_store(tmp_path / "store").load()
    seen, exposure = (found[name][0].to_numpy() for name in ("object_image", "exposure"))
    # The spectrum of a square pixel falls by some percent to the rim of the pupil.
    np.testing.assert_allclose(seen / seen[0].max(), exposure / exposure[0].max(), rtol=0, atol=0.02)
    words = "in partially coherent light" if light else "in coherent light"
    assert words in found["object_image"].attrs["long_name"]
