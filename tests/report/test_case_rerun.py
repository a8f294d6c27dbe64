"""`wavequake rerun STORE --case ID`: the bits of the store, and what it does not keep."""

import dataclasses

import numpy as np
import pytest
import small_pistons
import xarray as xr

from wavequake import cli
from wavequake.campaign.store.store import open_store
from wavequake.errors import UserError
from wavequake.report.exports.rerun import rerun_stored
from wavequake.workflows import kinds
from wavequake.workflows.kinds import find_kind
from wavequake.workflows.run import run

STUDY = (
    small_pistons.STUDY
    + """
[[disturbance]]
name = "one"
model = "static-random"
piston_nm = 10.0
instants = 1
"""
)


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    folder = tmp_path_factory.mktemp("rerun")
    (folder / "tiny.toml").write_text(STUDY)
    run(folder / "tiny.toml", cases=6, store=folder / "store")
    return folder / "store"


@pytest.mark.parametrize("case", [0, 1, 5])
def test_a_case_again_has_the_bits_of_the_store_and_its_rays(store, case, tmp_path):
    found = rerun_stored(store, case, tmp_path / "case.nc")
    assert (found.differing, found.trouble, found.status) == ((), "", 1)
    assert "Every number has the bits of the store." in found.lines()
    stored = open_store(store).sel(case=case).load()
    with xr.open_dataset(tmp_path / "case.nc") as detail:
        np.testing.assert_array_equal(detail.zernike, stored.zernike)
        assert detail.case == case
        instants = int(np.isfinite(stored.time_s).sum())
        assert detail.sizes["instant"] == instants == (2, 1)[case % 2]
        # The rms over the rays, found from their paths, is what the store says.
        glass = detail.opd.where(detail.ray_segment >= 0).dropna("ray")
        np.testing.assert_allclose(glass.std("ray"), stored.wfe_rms_raw[:instants], rtol=1e-9)
        piston = detail.segment_motion.sel(dof="dz").std() * 1e9
        assert 3.0 < piston < 40.0


def test_other_numbers_than_stored_are_named(store, wavequake, monkeypatch, tmp_path):
    workflow = find_kind("segment-disturbance")

    def other(text, cases, device):
        result = workflow.compute(text, cases, device)
        result.arrays["strehl"][0, 0] = np.nextafter(result.arrays["strehl"][0, 0], 1)
        return result

    monkeypatch.setitem(kinds._registered, workflow.name, dataclasses.replace(workflow, compute=other))
    found = rerun_stored(store, 2, tmp_path / "case.nc")
    assert found.differing == ("strehl",)
    assert "Not the bits of the store: strehl." in found.lines()
    code, _, _ = wavequake("rerun", store, "--case", 2)
    assert code == cli.EXIT_DAMAGED


def test_a_case_that_fails_again_says_where(store, monkeypatch, tmp_path):
    def broken(text, cases, device):
        raise ZeroDivisionError("no light")

    workflow = dataclasses.replace(find_kind("segment-disturbance"), compute=broken)
    monkeypatch.setitem(kinds._registered, workflow.name, workflow)
    found = rerun_stored(store, 2, tmp_path / "case.nc")
    assert found.lines()[0] == "case 2: done in the store, raised now"
    assert "in broken" in found.trouble
    assert found.file is None
    assert not (tmp_path / "case.nc").exists()


def test_the_command_line_reruns(store, wavequake):
    code, said, _ = wavequake("rerun", store, "--case", 3)
    assert code == 0
    assert "Every number has the bits of the store." in said
    assert "disturbance" in said
    assert (store / "case-3.nc").exists()


def test_a_case_that_is_none_is_refused(store, tmp_path):
    with pytest.raises(UserError, match="has cases 0 to 5; there is no case 6"):
        rerun_stored(store, 6)
    with pytest.raises(UserError, match=r"must end in \.nc"):
        rerun_stored(store, 0, tmp_path / "case.csv")
