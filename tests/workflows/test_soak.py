"""Ten random deaths of a campaign; `make soak` inflicts two hundred."""

import os

import pytest
from soak import soak


@pytest.mark.slow
def test_a_campaign_that_is_killed_again_and_again_loses_nothing(tmp_path):
    kills = int(os.environ.get("SOAK_KILLS", "10"))
    counts = soak(tmp_path, kills)
    print(f"{counts.total()} deaths: {dict(counts)}; nothing lost, nothing changed")
    assert counts.total() >= kills
