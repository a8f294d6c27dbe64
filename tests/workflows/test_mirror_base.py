"""Fixed-interface modes ride on the rigid motion of their mounts, and nothing but that."""

import sys

import numpy as np
import pytest
from small_mirrors import MOR, TRACE

from wavequake import cli
from wavequake.campaign.store.store import open_store
from wavequake.errors import UserError
from wavequake.mechanics.vibration.drive import Drive, Harmonic
from wavequake.workflows.mirrors import trace as mirror_trace
from wavequake.workflows.mirrors.base import driven
from wavequake.workflows.mirrors.bench import bench_of, check_variants_of, variant_of
from wavequake.workflows.planning.plan import plan
from wavequake.workflows.run import run_study
from wavequake.workflows.study import load_study

pytestmark = pytest.mark.usefixtures("mirror_models")


def _traced(variants, keys=None):
    study = load_study("mirror-trace", TRACE | {"reduction.variants": variants} | (keys or {}))
    result = mirror_trace.KIND.compute(study.identity_text(), np.arange(len(variants)), "auto")
    assert list(result.status) == [1] * len(variants), result.messages
    return result.arrays


@pytest.mark.parametrize("interfaces", [[0, 1, 2], [1]])
def test_under_rigid_motion_they_are_craig_bampton_with_as_many_modes(interfaces):
    """Constraint modes of a rigid motion of the mounts are that motion: nine of them then are six too many.

    Three mounts in one plane that move across it, alike or not, tilt and lift the mirror as a rigid body.
    """
    keys = {f"excitation.{name}.interfaces": interfaces for name in ("sine100", "sine300")}
    found = _traced(["modalfix18", "craigb27"], keys)
    assert list(found["order"]) == [24, 27]
    for name in ("wfe_rms_standard", "wfe_rms_modal", "los_standard", "wfe_rms_raw"):
        size = np.abs(found[name]).max()
        assert size > 0.0
        np.testing.assert_allclose(found[name][0], found[name][1], rtol=0, atol=1e-7 * size, err_msg=name)


def test_more_modes_come_near_the_full_model(tmp_path):
    keys = {"reduction.variants": ["modalfix6", "modalfix36", "modalfix90"], "model.rings": 2}
    study = load_study("mirror-mor", MOR | keys | {"excitation.sine300.interfaces": [0, 1, 2]})
    run_study(study, tmp_path / "s", on="serial")
    store = open_store(tmp_path / "s").load()
    assert list(store["status"].values) == [1] * 4
    shares = store["wfe_error"].max("time") / store["wfe_rms"].isel(case=0).max("time")
    worst = shares.sel(excitation=["sine100", "sine300"]).max("excitation").values
    assert worst[1] > 5 * worst[2] > 25 * worst[3]
    assert worst[3] < 2e-3
    # Forces only push it about: its mounts do not bend it.
    assert store["eps_mech"].isel(case=1).max() > 0.5


def test_a_motion_that_strains_the_mounts_is_refused_before_the_run(tmp_path, monkeypatch, capsys):
    keys = TRACE | {
        "reduction.variants": ["craigb18", "modalfix12"],
        "excitation.sine300.direction": "x",
        "excitation.sine300.interfaces": [1],
    }
    words = [f"{key}={value}".replace("'", '"') for key, value in keys.items()]
    for name in ("run", "plan"):
        command = [name, "mirror-trace", *words, "--store", str(tmp_path / "s")]
        monkeypatch.setattr(sys, "argv", ["wavequake", *command])
        with pytest.raises(SystemExit) as end:
            cli.main()
        assert end.value.code == 2
        message = " ".join(capsys.readouterr().err.split())
        assert "modalfix12 holds the mounts together, and the excitation 'sine300' moves them" in message
    assert not (tmp_path / "s").exists()
    # All mounts along x, alike, are a rigid motion.
    assert plan(load_study("mirror-trace", keys | {"excitation.sine300.interfaces": [0, 1, 2]}))


@pytest.mark.parametrize(
    ("variant", "words"),
    [
        ("craigb900", "craigb900 is above the 855 degrees of freedom"),
        ("modalfix850", "only 846 with 9 coordinates clamped"),
        ("rubin14", "below the 15 rigid motions and attachment modes"),
    ],
)
def test_orders_above_the_model_are_refused_before_the_run(variant, words):
    study = load_study("mirror-trace", TRACE | {"reduction.variants": ["craigb18", variant]})
    with pytest.raises(UserError, match=words):
        mirror_trace.KIND.check(study.identity_text())


def test_other_variants_and_forces_are_left_alone():
    study = load_study("mirror-trace", TRACE | {"reduction.variants": ["craigb18", "modalfix12"]})
    bench = bench_of(study.identity_text(), "circular")
    check_variants_of(study, bench, study.reduction.variants)
    wave = Harmonic(1.0, 0.0, np.zeros(9), np.eye(9)[0])
    for variant, prescribed in (("craigb18", True), ("modalfix12", False)):
        model = variant_of(bench, variant)
        drive = Drive(np.full(9, prescribed), (wave,))
        assert driven(model, drive, "wave") == (model, drive)
