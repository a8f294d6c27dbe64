"""What a study of mirror-exposure is told of a pupil that is too coarse for its phases."""

import pytest

from wavequake.workflows.exposures.mirror_exposure import KIND
from wavequake.workflows.mirrors import model_store
from wavequake.workflows.study import load_study

SMALL = {
    "model.rings": 2,
    "reduction.variants": ["craigb18"],
    "imaging.pixels": 16,
    "imaging.pupil_samples": 32,
    "imaging.instants": 5,
    "imaging.scale": 0.003,
    "optics.rays": 200,
    "optics.zernike_terms": 11,
    "time.duration_s": 0.002,
}


@pytest.fixture(autouse=True)
def models(tmp_path, monkeypatch):
    monkeypatch.setattr(model_store, "model_folder", lambda: tmp_path / "models")


def told(**keys):
    study = load_study("mirror-exposure", SMALL | {f"imaging.{key}": value for key, value in keys.items()})
    return list(KIND.notices(study.identity_text()))


def test_a_pupil_too_coarse_is_told_of_once_a_model():
    assert not told()
    study = load_study("mirror-exposure", SMALL)
    found = told(scale=1.0)
    assert [line.partition(":")[0] for line in found] == list(study.models)
    assert "has 32 samples across, but its phase" in found[0]
    needed = int(found[0].partition("need ")[2].partition(":")[0])
    if needed <= 1024:
        assert not told(scale=1.0, pupil_samples=needed)
