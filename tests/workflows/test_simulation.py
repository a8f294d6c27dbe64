"""Two thousand campaigns that one seed each interleaves; `make soak` plays a hundred thousand."""

import os
from collections import Counter

import pytest
import simulation
from simulation import simulate

from wavequake.campaign.engine import commit
from wavequake.campaign.store import fence, journal


def test_nothing_is_lost_or_wrong_in_any_interleaving():
    seeds = int(os.environ.get("SOAK_SEEDS", "2000"))
    counts = sum((simulate(seed) for seed in range(seeds)), Counter())
    print(f"{seeds} campaigns: {dict(counts)}; nothing lost, nothing wrong")
    assert min(counts.values()) > seeds / 10


def unordered(disk):
    disk.admit()
    yield
    disk.append()
    yield from disk.write()


def careless(disk):
    disk.admit()
    yield
    if disk.is_begun():
        disk.reopen()
    yield from disk.write()
    disk.append()


def unopened(disk):
    disk.is_begun = bool
    return commit.commit(disk)


BROKEN = {
    "anybody may write": (simulation, "admits", lambda shut, token: True),
    "records before data": (simulation, "commit", unordered),
    "a chunk twice in a run": (simulation, "commit", careless),
    "data that change under their record": (simulation, "commit", unopened),
    "clocks decide": (journal, "_order", lambda record: (0, record.time)),
    "runs shut nobody out": (
        simulation,
        "shut",
        lambda known, name, others, token: fence.Fence(known.epoch + 1, {**known.runs, token: token}),
    ),
}


@pytest.mark.parametrize("fault", BROKEN)
def test_the_simulation_finds_an_engine_that_is_broken(monkeypatch, fault):
    module, name, broken = BROKEN[fault]
    monkeypatch.setattr(module, name, broken)
    with pytest.raises(AssertionError):
        Counter(map(str, map(simulate, range(2000))))


def test_a_seed_is_played_the_same_way_twice():
    assert [simulate(seed) for seed in range(20)] == [simulate(seed) for seed in range(20)]
    assert commit.commit is simulation.commit
