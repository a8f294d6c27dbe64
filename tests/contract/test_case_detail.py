"""`wavequake rerun` of any workflow: whole histories, and what was drawn and traced."""

from dataclasses import replace

import numpy as np
import pytest
import xarray as xr
from small_kinds import SMALL, SYSTEM

from wavequake.campaign.contract import RAISED
from wavequake.campaign.store.store import open_store
from wavequake.control.bench import bench_modes
from wavequake.report.exports.rerun import rerun_stored
from wavequake.report.segments import case_detail
from wavequake.workflows.lens.bench import bench_of
from wavequake.workflows.run import run

pytestmark = pytest.mark.usefixtures("mirror_models")


@pytest.fixture
def again(kept_stores, tmp_path):
    """Return the full store of a workflow, and one case of a store that keeps less, computed again."""
    _, store_of = kept_stores

    def again_of(name, case=0, **keys):
        found = rerun_stored(store_of(name, **keys), case, tmp_path / "case.nc")
        assert (found.differing, found.trouble, found.status) == ((), "", 1)
        with xr.open_dataset(tmp_path / "case.nc") as detail:
            return open_store(store_of(name)).load(), detail.load()

    return again_of


# What a store keeps is no matter of the workflow: summaries of each, the others of three.
KEPT = [(name, {"reduce": "summary"}) for name in SMALL]
for name in ("telescope-exposure", "mirror-exposure", "mirror-mor"):
    KEPT += [(name, {"every": 2}), (name, {})]


@pytest.mark.parametrize(("name", "keys"), KEPT, ids=str)
def test_all_histories_of_a_case_have_the_bits_of_a_store_that_keeps_them(again, name, keys):
    whole, detail = again(name, case=0, **keys)
    assert int(detail["case"]) == 0
    for key in [*whole.data_vars, *(key for key in ("time", "time_s") if key in whole)]:
        if key in ("message", "seconds", "reduce_seconds", "segment_motion"):
            continue
        expected = whole[key].isel(case=0) if "case" in whole[key].dims else whole[key]
        assert detail[key].dims == expected.dims
        np.testing.assert_array_equal(detail[key].to_numpy(), expected.to_numpy(), err_msg=key)
    for key in ("seed", "realization"):
        if key in whole.coords:
            assert int(detail[key]) == int(whole[key][0])


@pytest.mark.parametrize(("case", "instants"), [(0, 7), (1, 3)])
def test_rays_of_a_system_have_the_errors_that_are_stored(again, case, instants):
    whole, detail = again("system-disturbance", case, reduce="summary")
    stored = whole.isel(case=case, time=slice(instants))
    assert detail.sizes["instant"] == detail.sizes["traced_instant"] == instants
    # All rays arrive and weigh alike.
    np.testing.assert_allclose(detail["opd"].std("ray"), stored["wfe_rms_raw"], rtol=1e-6, atol=1e-9)
    center = detail["spot"].mean("ray")
    moved = center - center.isel(traced_instant=0)
    centroid = 1e3 * (stored["centroid_mm"] - stored["centroid_mm"].isel(time=0))
    np.testing.assert_allclose(moved, centroid.to_numpy(), rtol=0, atol=1e-6)
    spread = np.sqrt(((detail["spot"] - center) ** 2).sum("axis").mean("ray"))
    np.testing.assert_allclose(spread, stored["spot_rms"], rtol=1e-6, atol=1e-8)


def test_motions_of_a_system_are_those_that_were_asked_for(again):
    """The image plane hums at 10 Hz by up to 7 um and 5 urad, and the light stands still."""
    _, detail = again("system-disturbance", 0, every=2)
    assert detail["element"].to_numpy().tolist() == ["image"]
    image = detail["surface_motion"].sel(surface="image")
    np.testing.assert_array_equal(image, detail["drawn_motion"].sel(element="image"))
    time = detail["time_s"].to_numpy()
    waves = np.stack([np.cos(20 * np.pi * time), np.sin(20 * np.pi * time)], axis=1)
    for dof, size in (("dy", 7e-6), ("rx", 5e-6)):
        history = image.sel(dof=dof).to_numpy()
        parts = np.linalg.lstsq(waves, history, rcond=None)[0]
        np.testing.assert_allclose(waves @ parts, history, rtol=0, atol=1e-12)
        assert np.hypot(*parts) == pytest.approx(size, rel=1e-9)
    assert not detail["surface_motion"].sel(surface="mirror").any()
    assert not detail["sight"].any()
    _, other = again("system-disturbance", 1)
    assert "drawn_motion" not in other
    # A distant star moves its image by the focal length times the angle.
    center = other["spot"].mean("ray").isel(field=0)
    moved = other["sight"] - other["sight"].isel(instant=0)
    expected = np.repeat(1e6 * moved.to_numpy()[:, None], 2, axis=1)
    np.testing.assert_allclose(
        abs(center - center.isel(traced_instant=0)), abs(expected), rtol=1e-3, atol=1e-4
    )


def test_a_case_that_loses_its_light_shows_what_was_drawn(tmp_path):
    wild = (
        SYSTEM[: SYSTEM.index("[[disturbance]]")]
        + """
[[disturbance]]
name = "wild"
model = "surface-random"
of = ["mirror"]
rms = { dz_um = 2e8 }
"""
    )
    (tmp_path / "wild.toml").write_text(wild)
    run(tmp_path / "wild.toml", cases=2, store=tmp_path / "s", store__reduce="summary")
    found = rerun_stored(tmp_path / "s", 0, tmp_path / "case.nc")
    assert (found.status, found.differing) == (RAISED, ())
    assert "rays of field" in found.trouble
    with xr.open_dataset(tmp_path / "case.nc") as detail:
        assert abs(float(detail["drawn_motion"].sel(element="mirror", dof="dz").isel(instant=0))) > 10.0
        assert not np.isfinite(detail["opd"]).all()
        assert np.isnan(detail["wfe_rms"]).all()
        assert "miss" in str(detail["message"].item())


def test_many_rays_are_those_of_the_worst_instant(again, monkeypatch):
    monkeypatch.setattr(case_detail, "_RAYS_BYTES", 10_000)
    whole, detail = again("system-disturbance", 0)
    change = whole["wfe_change"].isel(case=0, wavelength=0).max("field")
    assert detail["traced_instant"].to_numpy().tolist() == [int(change.argmax("time"))]
    stored = whole["wfe_rms_raw"].isel(case=0, time=int(change.argmax("time")))
    np.testing.assert_allclose(detail["opd"].isel(traced_instant=0).std("ray"), stored, rtol=1e-6, atol=1e-9)
    assert detail.sizes["instant"] == 7


def test_rays_and_motions_of_an_exposure(again):
    whole, detail = again("telescope-exposure", 2, reduce="summary")
    stored = whole.isel(case=2)
    instants = int(np.isfinite(stored["time_s"]).sum())
    assert (str(detail["disturbance"].item()), detail.sizes["instant"]) == ("mount", instants)
    assert not detail["segment_motion"].any()
    assert detail["mount"].std() > 0
    glass = (detail["ray_segment"] >= 0).to_numpy()
    plane = np.stack([np.ones(glass.sum()), detail["ray_x"][glass], detail["ray_y"][glass]], axis=1)
    opd = detail["opd"].to_numpy()[..., glass].reshape(-1, glass.sum())
    flat = opd - (plane @ np.linalg.lstsq(plane, opd.T, rcond=None)[0]).T
    expected = stored["wfe_rms_flat"].to_numpy()[:, :instants].ravel()
    np.testing.assert_allclose(flat.std(axis=1), expected, rtol=0.02)  # rays weigh nearly alike


def test_the_plant_of_a_lens_experiment(again, kept_stores):
    whole, detail = again("lens-experiment", 2, reduce="summary")
    nominal = bench_of(kept_stores[0]("lens-experiment"), "initial")
    drawn = {name: detail[name].to_numpy() for name in ("lens_springs", "ring_springs", "couplings")}
    errors = np.concatenate([np.log(drawn[name] / getattr(nominal, name)) for name in drawn])
    assert 0.005 < errors.std() < 0.04  # 2 % of each spring
    plant = replace(nominal, **drawn, housing_spring=float(detail["housing_spring"]))
    found = np.abs(bench_modes(plant).poles)
    np.testing.assert_allclose(found, whole["true_frequency"].isel(case=2), rtol=1e-12)
    assert 0 <= float(detail["trigger_late"]) <= 2e-3
    assert 0.9 < float(detail["blow_strength"].sel(blow="controlled")) < 1.1
    assert abs(float(detail["converter_noise"].std()) - 1.0) < 0.05


def test_inputs_and_coefficients_of_a_mirror(again):
    whole, detail = again("mirror-trace", 0, reduce="summary")
    stored, time = whole.isel(case=0), whole["time"].to_numpy()
    for name in ("standard", "modal"):
        rms = np.sqrt((detail[f"zernike_{name}"].sel(noll=slice(4, None)) ** 2).sum("noll"))
        np.testing.assert_allclose(rms, stored[f"wfe_rms_{name}"], rtol=1e-12, atol=1e-12)
    driven = detail["input"].sel(excitation="sine100").to_numpy()
    sine = np.sin(2 * np.pi * 100.0 * time)
    moved = driven[:, np.abs(driven).max(axis=0) > 0]
    assert moved.shape[1] > 0
    np.testing.assert_allclose(
        moved, sine[:, None] * (sine @ moved) / (sine @ sine), rtol=0, atol=1e-12 * abs(moved).max()
    )
    # A mirror that moves by a small height lengthens the path by twice as much.
    slow = detail.sel(excitation="sine100", noll=slice(4, None))
    ratio = np.sqrt((slow["zernike_standard"] ** 2).sum() / (slow["figure"] ** 2).sum())
    assert float(ratio) == pytest.approx(2.0, rel=0.1)
