"""Supports of segments that are not known exactly: wind on them against supports that are built so."""

from dataclasses import replace

import numpy as np
import pytest

import wavequake as wq
from wavequake.errors import UserError
from wavequake.mechanics.disturbances.registry import draw_case
from wavequake.mechanics.disturbances.sources.segment_wind import (
    SegmentWind,
    compliance,
    segment_wind_rms_nm,
)
from wavequake.mechanics.disturbances.supports import Supports
from wavequake.workflows.segments.bench import bench_of
from wavequake.workflows.segments.disturbance import KIND, draw
from wavequake.workflows.study import load_study

# Softly held and lightly damped, in fast wind: the resonance counts.
SOFT = SegmentWind(
    name="wind",
    mean_speed_m_s=8.0,
    area_filter=False,
    stiffness_n_um=0.5,
    modes_hz=(2.0,),
    damping_ratios=(0.1,),
    instants=64,
)
KEYS = {
    "telescope.name": "tmt-18",
    "imaging.enabled": False,
    "campaign.device": "numpy",
    "disturbance.alignment.share": 0,
    "disturbance.edge-sensors.share": 0,
    "disturbance.wind-shake.share": 0,
    "disturbance.wind.instants": 16,
}


def windy(**keys):
    more = {f"structure.uncertain.{key}": value for key, value in keys.items()}
    return load_study("tmt-segments", {**KEYS, "campaign.cases": 40, **more})


@pytest.fixture(scope="module")
def layout():
    return bench_of(windy(frequency=0.1).identity_text()).layout


@pytest.mark.parametrize("apart", [False, True])
def test_a_segment_moves_as_one_whose_support_is_built_so(layout, apart):
    """Rms by the analytic spectrum of a source with the drawn frequency, damping and stiffness."""
    supports = Supports(0.15, 0.4, apart, (7, "~structure", 1))
    off = replace(layout, supports=supports)
    frequency, damping = supports.factors(18, 1)
    assert frequency.shape == (18 if apart else 1, 1)
    built = [
        segment_wind_rms_nm(
            SOFT.model_copy(
                update={
                    "modes_hz": (2.0 * f,),
                    "damping_ratios": (0.1 * d,),
                    "stiffness_n_um": 0.5 * f**2,  # the mass stays
                }
            ),
            layout,
        )
        for f, d in zip(frequency[:, 0].tolist(), damping[:, 0].tolist(), strict=True)
    ]
    expected = np.array(built)[np.arange(18) if apart else 0, np.arange(18)]
    time = np.sort(np.random.default_rng(0).uniform(0.0, 600.0, 64))
    squares = np.array(
        [
            (draw_case([SOFT], SOFT, off, 1, case, time=time).segment_motion[..., 2] ** 2).mean(axis=0)
            for case in range(200)
        ]
    )
    mean, error = squares.mean(axis=0), squares.std(axis=0) / np.sqrt(200)
    assert np.abs((mean * 1e18 - expected**2) / (error * 1e18)).max() < 4.0
    assert np.abs(expected / segment_wind_rms_nm(SOFT, layout) - 1.0).max() > 0.05


def test_stiffer_supports_give_way_less_and_keep_the_mass():
    wind = SegmentWind(name="wind")
    factors = np.array([1.1, 0.9, 1.2, 1.0]), np.full(4, 2.0)
    weights = np.array(wind.modes_hz) ** -2 / np.sum(np.array(wind.modes_hz) ** -2)
    still = compliance(wind, np.array([0.0]), *factors)[0].real
    assert still == pytest.approx(np.sum(weights / factors[0] ** 2) / 10e6, rel=1e-12)
    fast = compliance(wind, np.array([1e6]), *factors)[0] / compliance(wind, np.array([1e6]))[0]
    assert fast.real == pytest.approx(1.0, abs=1e-4)


def test_cases_share_models_and_nothing_unknown_changes_nothing():
    study = windy(frequency=0.05, repeats=3)
    text = study.identity_text()
    assert KIND.case_table(text, 0, 7)["replicate"].tolist() == [0, 0, 0, 1, 1, 1, 2]
    together = KIND.compute(text, np.arange(6), "numpy").arrays["wfe_rms_raw"]
    alone = KIND.compute(text, np.array([4]), "numpy").arrays["wfe_rms_raw"]
    np.testing.assert_array_equal(together[4], alone[0])
    plain = load_study("tmt-segments", KEYS)
    motions = [
        draw(bench_of(one.identity_text()), 1).motion.segment_motion
        for one in (plain, windy(frequency=0.0), windy(frequency=0.2))
    ]
    np.testing.assert_allclose(motions[1], motions[0], rtol=1e-12, atol=1e-22)
    assert not np.allclose(motions[2], motions[0], rtol=1e-3, atol=0.0)
    assert "structure" not in plain.identity_text()


def test_slow_wind_shows_the_log_normal_stiffness():
    """Far below a single mode a segment moves as 1 / frequency squared, all else alike."""
    one_mode = {"disturbance.wind.modes_hz": [500.0], "disturbance.wind.damping_ratios": [0.5]}
    sizes = []
    for keys in ({}, {"structure.uncertain.frequency": 0.05, "structure.uncertain.repeats": 1}):
        bench = bench_of(load_study("tmt-segments", {**KEYS, **one_mode, **keys}).identity_text())
        sizes.append([draw(bench, case).motion.segment_motion[..., 2].std() for case in range(300)])
    logs = np.log(np.array(sizes[1]) / np.array(sizes[0]))
    assert logs.std() == pytest.approx(0.1, rel=0.12)
    assert abs(logs.mean()) < 0.02


def test_reports_part_the_variance(tmp_path):
    for name, keys in (("images", {"imaging.enabled": True, "imaging.pixels": 16}), ("plain", {})):
        study = load_study(
            "tmt-segments",
            {**KEYS, **keys, "campaign.cases": 30, "structure.uncertain.frequency": 0.2},
        )
        wq.run(study, store=tmp_path / name, on="serial")
        page = wq.report(tmp_path / name).read_text()
        assert "What is not known of the structure makes up at most" in page
        assert "Variance between cases: excitation and model" in page


@pytest.mark.parametrize(
    ("keys", "said"),
    [
        ({"structure.uncertain.frequency": 0.1, "campaign.sampling": "sobol"}, "are no independent sets"),
        ({"structure.uncertain.frequency": 0.9}, "frequency"),
        ({"structure.uncertain.supports": "some"}, "supports"),
    ],
)
def test_wrong_keys_are_a_sentence(keys, said):
    with pytest.raises(UserError, match=said):
        load_study("tmt-segments", {**KEYS, **keys})


def test_without_wind_there_is_nothing_that_shakes_supports():
    with pytest.raises(UserError, match="on which segment-wind pushes; this study has no such disturbance"):
        load_study("jwst-segments", {"structure.uncertain.frequency": 0.1})
