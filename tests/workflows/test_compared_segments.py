"""Reduced models of elastic segments as cases of one study, against sweeps, full draws and closed forms."""

import numpy as np
import pytest

import wavequake as wq
from wavequake.errors import UserError
from wavequake.workflows.kinds import find_kind
from wavequake.workflows.segments.bench import bench_of
from wavequake.workflows.segments.disturbance import draw
from wavequake.workflows.study import load_study

pytestmark = pytest.mark.usefixtures("mirror_models")

KIND = find_kind("segment-disturbance")
STUDY = """
[study]
name = "compared"
workflow = "segment-disturbance"
[telescope]
name = "tmt-18"
[optics]
rays_per_segment = 72
wavelength_nm = 1000.0
[wavefront]
zernike_terms = 11
[imaging]
pixels = 16
[segment]
thickness_m = 0.5
spring_n_m = [5e8, 5e8, 5e8]
divisions = 3
figure_terms = 11
last_hz = 400.0
[[disturbance]]
name = "cell"
model = "segment-shaking"
instants = 8
lines = [{ frequency_hz = 70.0, amplitude = { dx_um = 0.3, dz_um = 0.2, ry_urad = 0.1 } }]
[[disturbance]]
name = "floor"
model = "segment-shaking"
cell = "as one"
instants = 4
lines = [{ frequency_hz = 30.0, amplitude = { dz_um = 0.2 } }]
[campaign]
device = "numpy"
"""
MODELS = ["guyan9", "craigb18"]


@pytest.fixture
def study_of(tmp_path):
    def load(**keys):
        path = tmp_path / "study.toml"
        path.write_text(STUDY)
        return load_study(path, {name.replace("__", "."): value for name, value in keys.items()})

    return load


def test_each_model_is_a_case_of_the_same_draw(study_of):
    """Cases have the numbers of studies that take the model; errors are those of their Noll coefficients."""
    text = study_of(reduction__variants=MODELS).identity_text()
    table = KIND.case_table(text, 0, 12)
    assert table["reduction"].tolist() == ["full", "full", *MODELS[:1] * 2, *MODELS[1:] * 2] * 2
    assert table["realization"].tolist() == [0] * 6 + [1] * 6
    found = KIND.compute(text, np.arange(6), "numpy").arrays
    for place, model in enumerate(["full", *MODELS]):
        alone = study_of(segment__reduced=model).identity_text()
        own = KIND.compute(alone, np.arange(2), "numpy").arrays
        for name in ("zernike", "los", "exposure", "strehl"):
            rows = slice(2 * place, 2 * place + 2)
            np.testing.assert_array_equal(found[name][rows], own[name], err_msg=f"{name} {model}")
    full, other = found["zernike"][0, :, 3:], found["zernike"][2, :, 3:]
    error = np.sqrt(((other - full) ** 2).sum(axis=1).mean())
    assert found["model_error_wfe"][2] == pytest.approx(error, rel=1e-12)
    still = bench_of(text).static.zernike[0, 3:] * 1000.0
    swing = np.sqrt(((found["los"][0]) ** 2).sum(axis=1).mean())
    shares = [
        error / np.sqrt(((full - still) ** 2).sum(axis=1).mean()),
        np.sqrt(((found["los"][2] - found["los"][0]) ** 2).sum(axis=1).mean()) / swing,
    ]
    assert found["model_error"][2] == pytest.approx(max(shares), rel=1e-9)
    apart = np.linalg.norm(found["exposure"][2] - found["exposure"][0]) / np.linalg.norm(found["exposure"][0])
    assert found["model_error_image"][2] == pytest.approx(apart, rel=1e-12)
    assert not found["model_error"][:2].any()
    assert (found["model_error"][2:4] > 3.0 * found["model_error"][4:6]).all()
    assert (found["model_error"][4:6] > 0.0).all()


def test_a_case_has_the_same_bits_alone_and_beside_its_full_model(study_of):
    text = study_of(reduction__variants=MODELS).identity_text()
    together, alone = (KIND.compute(text, np.array(cases), "numpy").arrays for cases in ((1, 0, 5), (5,)))
    for name, values in alone.items():
        np.testing.assert_array_equal(together[name][2], values[0], err_msg=name)
    bench = bench_of(text)
    one, other = draw(bench, 1), draw(bench, 5)
    assert (one.realization, one.model, other.model) == (0, "full", "craigb18")


def test_a_lift_of_the_whole_cell_is_seen_by_every_model_alike(study_of):
    """Far below all resonances segments follow the cell as rigid bodies, whatever their model."""
    line = [{"frequency_hz": 0.01, "amplitude": {"dz_um": 0.2}}]
    study = study_of(
        reduction__variants=MODELS, disturbance__cell__lines=line, disturbance__cell__cell="as one"
    )
    found = KIND.compute(study.identity_text(), np.arange(0, 6, 2), "numpy").arrays
    assert np.ptp(found["los"], axis=0).max() < 1e-6
    assert np.ptp(found["zernike"], axis=0).max() < 1e-3


def test_a_store_unstacks_to_models_and_its_report_judges_them(study_of, tmp_path):
    study = study_of(
        reduction__variants=MODELS,
        campaign__cases=12,
        optics__wavelengths_nm=[1000.0, 800.0],
        wavefront__zernike_terms=6,
        imaging__enabled=False,
    )
    data = wq.run(study, store=tmp_path / "store").load()
    assert data.model_error.dims == ("case", "wavelength")
    assert "model_error_image" not in data
    grid = wq.unstack(data)
    assert sorted(grid["reduction"].to_numpy().tolist()) == sorted(["full", *MODELS])
    assert grid.model_error.sel(reduction="full").max() == 0.0
    words = wq.report(tmp_path / "store").read_text()
    assert "Errors of reduced models" in words
    assert "craigb18 (" in words
    names = wq.compare(tmp_path / "store", tmp_path / "store")
    assert names is not None


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ({"reduction__variants": ["full"]}, "leave 'full' out"),
        ({"reduction__variants": ["guyan9", "guyan9"]}, "listed twice"),
        ({"reduction__variants": ["guyan9"], "segment__reduced": "craigb18"}, "without segment.reduced"),
        ({"reduction__variants": ["guyan9"], "campaign__sampling": "sobol"}, "at random"),
        (
            {"reduction__variants": ["guyan9"], "optics__light": "modal", "imaging__enabled": False},
            "optics.light = 'traced'",
        ),
    ],
)
def test_what_cannot_be_compared_is_refused(study_of, keys, words):
    with pytest.raises(UserError, match=words):
        study_of(**keys)
