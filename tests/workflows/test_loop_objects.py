"""Objects in the exposures of loops: by shifted exposures, and as telescope-exposure has them."""

import numpy as np
import pytest
from small_loops import small, table

import wavequake as wq
from wavequake.campaign.stopwatch import Stopwatch
from wavequake.errors import UserError
from wavequake.workflows.loops import telescope_loop
from wavequake.workflows.loops.telescope_bench import bench_of

FEW = {"disturbance.history.instants": 8, "look.traced": 8, "imaging.pixels": 24}


def first_case_of(**keys):
    bench = bench_of(small(**FEW, **keys))
    (block,) = telescope_loop.compute(bench, table(bench, 1), "numpy", Stopwatch())
    assert not block.messages
    return bench, {name: values[0] for name, values in block.result.items()}


def test_stars_are_shifted_exposures():
    step = 4
    sampling = small().imaging.sampling
    stars = [[0.0, 0.0, 1.0], [step * sampling, 0.0, 3.0]]
    bench, found = first_case_of(**{"object.stars": stars})
    control = bench.optics.control
    scale = sampling**2 * control.area / control.diameter**2
    exposure = found["exposure"]
    wanted = exposure.copy()
    wanted[:, :, step:] += 3.0 * exposure[:, :, :-step]
    # Light of the second star from beyond the frame of the exposure is in the first columns alone.
    np.testing.assert_allclose(
        found["object_image"][:, :, step:], scale * wanted[:, :, step:], atol=2e-9 * scale * wanted.max()
    )


@pytest.mark.parametrize(
    "light", [{}, {"object.light": "coherent"}, {"object.light": "partial", "object.sigma": 0.5}]
)
def test_what_is_not_corrected_is_that_of_telescope_exposure(light, tmp_path):
    keys = {"object.grating": 4.0, **light}
    bench, found = first_case_of(**keys)
    (tmp_path / "study.toml").write_text(
        """
[study]
name = "exposed"
workflow = "telescope-exposure"
seed = 20180701
[telescope]
name = "tmt-18"
[[disturbance]]
name = "history"
model = "segment-history"
duration_s = 0.1
instants = 8
peak_nm = 70.0
[optics]
wavelength_nm = 550.0
sampling = "sunflower"
rays = 300
[wavefront]
zernike_terms = 15
[imaging]
pixels = 24
[exposure]
scale = 1.0
figure_terms = 15
[campaign]
cases = 1
"""
    )
    wq.run(wq.load_study(tmp_path / "study.toml", keys), store=tmp_path / "store", on="serial")
    stored = wq.open_store(tmp_path / "store").load().isel(case=0)
    names = [one.name for one in bench.controllers]
    for name, other in (("off", "disturbed"), ("elastic-perfect", "elastic")):
        wanted = stored["object_image"].sel(controller=other).to_numpy()
        off = np.abs(found["object_image"][names.index(name)] - wanted).max() / wanted.max()
        assert off < 1e-6


def test_an_object_that_is_never_imaged_is_refused():
    with pytest.raises(UserError, match=r"look\.traced must be 1 or more"):
        small(**{"object.slit": 2.0, "look.traced": 0})
