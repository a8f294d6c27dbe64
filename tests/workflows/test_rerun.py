import dataclasses

import numpy as np
import pytest
import toy
from typer.testing import CliRunner

from wavequake.campaign.engine.rerun import retry_store, statuses
from wavequake.campaign.store.status import store_status
from wavequake.campaign.store.store import extend_store, open_store
from wavequake.campaign.store.verify import verify_store
from wavequake.cli import app
from wavequake.errors import StoreDamageError, UserError
from wavequake.workflows import kinds


def workflow(flag, drift=0.0):
    """Return the toy, whose case 13 raises until `flag` exists; then `drift` is added to case 12."""

    def compute(text, cases, device):
        if 13 in cases and not flag.exists():
            raise ValueError("no file yet")
        result = toy.compute(text, cases, device)
        if flag.exists():
            result.arrays["strehl"][cases == 12] += drift
        return result

    return dataclasses.replace(toy.TOY, compute=compute)


def failed_store(tmp_path, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(toy, "TOY", workflow(tmp_path / "flag"))
        assert toy.run(tmp_path / "s", cases=23).quarantined == 1
    return tmp_path / "s"


def test_a_retried_case_succeeds_and_the_others_keep_their_bits(tmp_path, monkeypatch):
    path = failed_store(tmp_path, monkeypatch)
    (tmp_path / "flag").touch()
    raised = statuses("raised")
    summary = retry_store(workflow(tmp_path / "flag"), path, raised, on="serial")
    assert (summary.chunks, summary.computed, summary.quarantined) == (1, 10, 0)
    toy.run(tmp_path / "whole", cases=23)
    assert toy.digests(path) == toy.digests(tmp_path / "whole")
    np.testing.assert_array_equal(open_store(path).zernike.sel(case=13), toy.numbers(13))
    assert verify_store(path).ok
    assert retry_store(workflow(tmp_path / "flag"), path, raised, on="serial").chunks == 0


def test_other_statuses_are_left_alone(tmp_path, monkeypatch):
    path = failed_store(tmp_path, monkeypatch)
    (tmp_path / "flag").touch()
    summary = retry_store(workflow(tmp_path / "flag"), path, statuses("crashed, 4"), on="serial")
    assert (summary.chunks, summary.quarantined) == (0, 1)


def test_a_done_case_with_other_numbers_alarms(tmp_path, monkeypatch):
    path = failed_store(tmp_path, monkeypatch)
    (tmp_path / "flag").touch()
    before, digests = open_store(path).load(), toy.digests(path)
    with pytest.raises(StoreDamageError, match=r"cases 10 to 19 .* strehl of cases .*Nothing was changed"):
        retry_store(workflow(tmp_path / "flag", 1e-9), path, statuses("2"), on="serial")
    assert open_store(path).load().identical(before)
    assert toy.digests(path) == digests


def test_a_retry_computes_nothing_that_was_not_computed_before(tmp_path, monkeypatch):
    path = failed_store(tmp_path, monkeypatch)
    extend_store(path, toy.TOY, 60)
    (tmp_path / "flag").touch()
    summary = retry_store(workflow(tmp_path / "flag"), path, statuses("raised"), on="serial")
    assert (summary.chunks, summary.computed, summary.quarantined) == (1, 10, 0)
    assert store_status(path).counts[:2] == (40, 20)  # 23 cases were done: the short last chunk has grown
    assert verify_store(path).damaged == ()


def test_unknown_statuses_are_named():
    with pytest.raises(UserError, match="'done' is no status"):
        statuses("raised,done")


def test_the_command_line_retries(tmp_path, monkeypatch):
    path = failed_store(tmp_path, monkeypatch)
    monkeypatch.setitem(kinds._registered, "toy", workflow(tmp_path / "flag"))
    words = ["retry", str(path), "--status", "raised", "--on", "serial"]
    assert CliRunner().invoke(app, words).exit_code == 3
    (tmp_path / "flag").touch()
    (tmp_path / "cluster.yaml").write_text("hosts: []")
    elsewhere = [*words[:-1], "ssh", "--cluster", str(tmp_path / "cluster.yaml")]
    assert "hosts: " in str(CliRunner().invoke(app, elsewhere).exception)
    result = CliRunner().invoke(app, words)
    assert result.exit_code == 0
    assert "1 chunk computed again; 0 cases are quarantined now." in result.output
