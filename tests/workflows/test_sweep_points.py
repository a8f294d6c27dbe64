"""Points of sweeps: which there can be, what they need, and kinds of plug-ins."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from test_sweep import MIRROR, SMALL, WAVES

import wavequake as wq
from wavequake.campaign import plugins
from wavequake.campaign.store.grid import unstack
from wavequake.errors import UserError
from wavequake.workflows import kinds
from wavequake.workflows import sweep as swept
from wavequake.workflows.run import kind_of
from wavequake.workflows.study import load_study


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ({"sweep.optics.wavelength_mn": [1.0]}, "nearest valid key is 'wavelength_nm'"),
        ({"sweep.optics.wavelength_nm": 5.0}, "give a list of values"),
        ({"sweep.optics.wavelength_nm": []}, "give a list of values"),
        ({"sweep.optics.wavelength_nm": [5.0, 5.0]}, "listed twice"),
        ({"sweep.disturbance.alignment.piston_nm": [0.0, 0.0]}, "0.0 is listed twice"),
        (WAVES | {"campaign.until": "wfe_rms.p95 ci<=2%"}, "campaign.until judges cases of one point"),
        ({"sweep.optics.wavelength_nm": [5.0, -6.0]}, r"optics\.wavelength_nm = -6.0: .*greater than 0"),
        ({"sweep.optics.wavelength_nm": ["a", 5.0]}, "partly numbers and partly texts"),
        ({"sweep.optics.wavelength_nm": [[1.0], [2.0]]}, "input should be a valid number"),
        ({"sweep.campaign.cases": [5, 6]}, "says nothing of a case's numbers"),
        ({"sweep.telescope.polygons": ["a", "b"]}, "files are read when a study is loaded"),
        ({"sweep.study.seed": list(range(100_001))}, "points of 4 cases each are more than"),
        ({"sweep.disturbance.gale.share": [1, 2]}, "no disturbance called 'gale'"),
    ],
)
def test_impossible_sweeps_are_told_in_a_sentence(keys, words):
    with pytest.raises(UserError, match=words):
        load_study("tmt-segments", SMALL | keys)


def test_points_that_need_other_stores_are_named():
    study = load_study("tmt-segments", SMALL | {"sweep.wavefront.zernike_terms": [21, 28]})
    with pytest.raises(UserError, match=r"'zernike' have another shape at wavefront.zernike_terms = 28"):
        kind_of(study).check(study.identity_text())
    with pytest.raises(UserError, match=r"sweep\.reduction\.variants: \['craigb18'\] is neither"):
        load_study("mirror-mor", MIRROR | {"sweep.reduction.variants": [["craigb18"], ["craigb36"]]})


def test_points_between_the_first_and_the_last_one_are_compared_too():
    """The longest series of both disturbances has 2, 2, 1 and 2 instants."""
    keys = {
        **{f"disturbance.{name}.instants": 1 for name in ("alignment", "edge-sensors")},
        "sweep.disturbance.wind.instants": [2, 1],
        "sweep.disturbance.wind-shake.instants": [1, 2],
    }
    study = load_study("tmt-segments", SMALL | keys)
    with pytest.raises(UserError, match=r"another shape at .*wind\.instants = 1, .*shake\.instants = 1 than"):
        kind_of(study).check(study.identity_text())


def test_what_is_of_no_case_must_not_change_between_points_that_agree(monkeypatch):
    """The store would keep the first point's; where first and last differ, it keeps none."""
    study = load_study("tmt-segments", SMALL | {"sweep.study.seed": [1, 5, 3]})
    text, real = study.identity_text(), kinds.find_kind("segment-disturbance")

    def parted(text):
        template = real.template(text)
        seed = np.array(float(json.loads(text)["study"]["seed"]))
        fixed = {"far": ((), (seed - 2.0) ** 2, {}), "seed": ((), seed, {})}
        return dataclasses.replace(template, fixed={**template.fixed, **fixed})

    kind = dataclasses.replace(real, template=parted)
    monkeypatch.setattr("wavequake.workflows.sweep.find_kind", lambda name: kind)
    swept._texts.cache_clear()
    try:
        with pytest.raises(UserError, match=r"'far' is the same at .* = 1 and at .* = 3, but not at .* = 5"):
            swept.check(text)
        assert "far" in swept.template(text).fixed
        assert "seed" not in swept.template(text).fixed
    finally:
        swept._texts.cache_clear()


def test_no_study_names_the_workflow_itself(tmp_path):
    file = tmp_path / "study.toml"
    file.write_text('[study]\nname = "a"\nworkflow = "sweep"\n')
    with pytest.raises(UserError, match=r"a sweep is a table \[sweep\] in a study of any workflow"):
        load_study(file)


def test_kinds_of_plugins_are_swept(monkeypatch, tmp_path):
    monkeypatch.setattr(kinds, "_registered", {})
    monkeypatch.setattr(plugins, "_loaded", {})
    plugins.load_plugin(Path(__file__).parent / "pendulum.py")
    file = tmp_path / "swing.toml"
    file.write_text(
        '[study]\nname = "swing"\nworkflow = "pendulum"\n[campaign]\ncases = 4\n'
        "[sweep]\nstudy.seed = [1, 2, 3]\n"
    )
    dataset = wq.run(file, store=tmp_path / "store")
    assert dataset.sizes["case"] == 12
    first = dataset["angle"].to_numpy()[:, -1].reshape(3, 4)
    assert len(np.unique(first)) == 12
    grid = unstack(dataset, "study_seed", "length_m", "realization")
    assert dict(grid["frequency"].sizes) == {"study_seed": 3, "length_m": 2, "realization": 2}
    with pytest.raises(UserError, match="Several cases have the same length_m"):
        unstack(dataset, "length_m")
    with pytest.raises(UserError, match="'wind' is no label"):
        unstack(dataset, "wind")
