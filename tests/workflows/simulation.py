"""Campaigns without machines: drivers, workers, network and disk as actors that one seed interleaves.

What decides is the engine's own code: who may write (`shut`, `admits`), in which order a chunk enters a store
(`commit`), which records hold (`judged`), what is computed next (`pieces_of`, `todo_of`, `Feed`). What is
played here is what that code has to live with: processes die between any two steps, or are stopped and wake
long after; scheduler and workers lose each other, and a chunk is handed out twice; messages are late, come
twice or in another order; records are torn; clocks are random.
"""

import random
from collections import Counter
from dataclasses import replace

from wavequake.campaign.engine.commit import commit
from wavequake.campaign.engine.driver_lock import Shard
from wavequake.campaign.engine.plan import Feed, pieces_of, todo_of
from wavequake.campaign.store.fence import Fence, ShutOutError, admits, shut
from wavequake.campaign.store.journal import Record, judged

K = 3
ARRAYS = ("zernike", "strehl", "status")
BUSY = object()  # what a step yields that could not go on


class Disk:
    """A store on a disk that keeps what was written, whoever wrote it."""

    def __init__(self, dice):
        self.dice, self.cases, self.fence = dice, 0, Fence()
        self.files, self.journal, self.locks = {}, [], {}
        self.drivers = {}  # by shard, "" for all: what flock holds

    def plan(self):
        return [(first, min(first + K, self.cases)) for first in range(0, self.cases, K)]

    def holding(self):
        journal = judged(self.journal)
        assert not journal.contested, journal.contested
        return {piece: journal.records[piece] for piece in self.plan() if piece in journal.records}

    def check(self):
        """Every record that holds tells the truth, unless its chunk is being written right now."""
        for piece, record in self.holding().items():
            if piece[0] not in self.locks:
                found = {name: self.files.get((name, piece[0])) for name in ARRAYS}
                assert found == record.digests, (piece, found, record)


class Writing:
    """What `commit` asks of the disk, for one chunk that fared in one way."""

    def __init__(self, disk, token, epoch, piece, fared, faults):
        self.disk, self.token, self.epoch, self.piece = disk, token, epoch, piece
        self.faults = faults
        content = {name: f"{name} {piece} {fared}" for name in ARRAYS}
        counts = (0, piece[1] - piece[0] - (fared != "well"), 0, int(fared != "well"), 0, 0)
        self.record = Record(*piece, content, counts, {}, time=disk.dice.uniform(0, 9), epoch=epoch)

    def admit(self):
        if not admits(self.disk.fence, self.token):
            raise ShutOutError("shut out")

    def is_recorded(self):
        return any((r.chunk, r.epoch) == (self.piece, self.epoch) for r in self.disk.journal)

    def write(self):
        for name in ARRAYS:
            self.disk.files[name, self.piece[0]] = self.record.digests[name]
            yield

    def is_begun(self):
        return any((name, self.piece[0]) in self.disk.files for name in ARRAYS)

    def reopen(self):
        counts = (self.piece[1] - self.piece[0], 0, 0, 0, 0, 0)
        self._add(replace(self.record, digests={}, counts=counts))

    def append(self):
        self._add(self.record)

    def _add(self, record):
        if self.faults and self.disk.dice.random() < 0.03:
            raise TornError
        self.disk.journal.append(record)


class TornError(Exception):
    """A process has died in the middle of a record."""


def locked(disk, name, me, steps):
    """Do steps under the lock of a chunk, which the end of the process gives back."""
    while disk.locks.get(name, me) is not me:
        yield BUSY
    disk.locks[name] = me
    try:
        yield from steps
    finally:
        disk.locks.pop(name, None)


def worker(disk, job, piece, inbox, dice, faults):
    """Compute one chunk, write it, and answer."""
    token, epoch = job
    me = object()
    for _ in range(dice.randrange(4)):
        yield
    fared = "badly" if faults and dice.random() < 0.1 else "well"
    writing = Writing(disk, token, epoch, piece, fared, faults)
    try:
        yield from locked(disk, piece[0], me, commit(writing))
        for _ in range(1 + (faults and dice.random() < 0.2)):
            inbox.append(("done", piece[0]))
    except ShutOutError:
        return
    except TornError:
        inbox.append(("lost", piece[0]))


class Run:
    """A driver with its scheduler; `tasks` are its workers at work, which may outlive it."""

    def __init__(self, disk, cases, shard, dice, faults):
        self.disk, self.cases, self.shard, self.dice, self.faults = disk, cases, shard, dice, faults
        self.tasks, self.inbox, self.deaths, self.ended = [], [], Counter(), False
        self.steps = self._steps()

    def begin(self, others):
        """Begin with a token of its own, once nobody writes."""
        for _ in range(10**9 if not self.faults else 60):
            if not self.disk.locks:
                break
            yield BUSY
        else:
            raise ShutOutError("a writer does not go on")
        token = f"token {self.dice.random()}"
        self.disk.fence = shut(self.disk.fence, str(self.shard or ""), others, token)
        self.job = token, self.disk.fence.epoch

    def hand_out(self, piece):
        task = worker(self.disk, self.job, piece, self.inbox, self.dice, self.faults)
        self.tasks.append((piece, task))

    def _steps(self):
        disk, name = self.disk, str(self.shard or "")
        others = [other for other in disk.drivers if other != name] if self.shard else []
        if (others and disk.cases < self.cases) or name in disk.drivers:
            return
        if any((other == "") != (name == "") for other in disk.drivers):
            return
        disk.drivers[name] = self
        try:
            yield from self.begin(others)
            yield
            disk.cases = max(disk.cases, self.cases)
            yield
            ours = pieces_of(disk.plan(), self.cases, K, self.shard)
            feed = Feed(todo_of(ours, disk.holding(), frozenset()), window=3)
            for piece in feed.fill():
                self.hand_out(piece)
            while feed.at_work:
                yield
                self.dice.shuffle(self.inbox)  # messages come in any order
                kind, first = self.inbox.pop() if self.inbox else ("", 0)
                if kind == "done":
                    feed.answered(first)
                elif kind == "lost":  # its worker died, or seems to have: once more, and then it is suspect
                    self.deaths[first] += 1
                    if self.deaths[first] > 1:
                        feed.suspected(first)
                    elif first in feed.at_work:
                        self.hand_out(feed.at_work[first])
                elif self.faults and self.dice.random() < 0.01:  # it takes too long, by a clock that is wrong
                    feed.suspected(self.dice.choice(sorted(feed.at_work)))
                for piece in feed.fill():
                    self.hand_out(piece)
            if feed.suspects:
                yield from self.begin(None)
            for piece in feed.suspects:
                fared = "badly" if self.faults and self.dice.random() < 0.5 else "well"
                writing = Writing(disk, *self.job, piece, fared, self.faults)
                yield from locked(disk, piece[0], self, commit(writing))
        except (ShutOutError, TornError):
            pass
        finally:
            disk.drivers.pop(name, None)
            self.ended = True


def simulate(seed):
    """Play one campaign, and count what happened; raises AssertionError if anything is lost or wrong."""
    dice = random.Random(seed)
    disk, stale, runs, counts = Disk(dice), [], [], Counter()
    cases = dice.randint(2, 8)
    for _ in range(dice.randint(20, 150)):
        if len(runs) < 2 and dice.random() < 0.3:
            cases += dice.choice([0, 0, 1, 2, 4]) * (not disk.drivers)
            shard = dice.choice([None, None, Shard(0, 2), Shard(1, 2)])
            runs.append(Run(disk, cases, shard, dice, faults=True))
            counts["runs"] += 1
        act(disk, runs, stale, dice, counts)
        disk.check()
    for run in runs:  # everybody dies but those that nobody can reach
        kill(run, stale, dice, counts)
    last = Run(disk, max(cases, disk.cases), None, dice, faults=False)
    # Who was stopped within a write keeps the last run waiting, and goes on at last.
    for _ in range(20000):
        act(disk, [last], stale, dice, counts, faults=False)
        disk.check()
        if last.ended:
            break
    assert last.ended, "the last run hangs"
    while stale:
        act(disk, [], stale, dice, counts, faults=False)
        disk.check()
    assert list(disk.holding()) == disk.plan(), "chunks are lost"
    disk.check()
    counts["chunks"] += len(disk.plan())
    return counts


def kill(run, stale, dice, counts):
    """End a driver; its workers end with it, but for those that are stopped or cut off."""
    run.steps.close()
    run.ended = True
    counts["deaths of drivers"] += 1
    for piece, task in run.tasks:
        if dice.random() < 0.5:
            stale.append((piece, task))
            counts["workers that outlive their run"] += 1
        else:
            task.close()
    run.tasks.clear()


def act(disk, runs, stale, dice, counts, faults=True):
    """Let one actor, drawn by lot, take a step, or have something happen to it."""
    actors = [*runs, *(run for run in runs for _ in run.tasks), *stale[: 1 if faults else None]]
    if not actors:
        return
    actor = dice.choice(actors)
    if isinstance(actor, tuple):
        advance(stale, dice.randrange(len(stale)))
        return
    fate = dice.random() if faults else 1.0
    if fate < 0.01:
        kill(actor, stale, dice, counts)
        runs.remove(actor)
    elif actor.tasks and fate < 0.06:
        piece, task = actor.tasks.pop(dice.randrange(len(actor.tasks)))
        actor.inbox.append(("lost", piece[0]))
        if fate < 0.035:
            task.close()
            counts["deaths of workers"] += 1
        else:
            stale.append((piece, task))
            counts["workers that are cut off"] += 1
    elif actor.tasks and dice.random() < 0.7:
        index = dice.randrange(len(actor.tasks))
        advance(actor.tasks, index)
    else:
        try:
            next(actor.steps)
        except StopIteration:
            stale += actor.tasks
            actor.tasks = []
            if actor in runs and faults:
                runs.remove(actor)


def advance(tasks, index):
    try:
        next(tasks[index][1])
    except StopIteration:
        tasks.pop(index)
