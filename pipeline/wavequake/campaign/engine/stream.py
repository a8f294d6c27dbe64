"""Feed chunks to Dask workers, a window at a time, and end those that kill their workers or never end."""

import time
from collections.abc import Callable, Sequence
from collections.abc import Set as AbstractSet
from contextlib import suppress
from logging import Logger
from queue import Empty, SimpleQueue
from statistics import median
from typing import TYPE_CHECKING, Any

from wavequake.campaign.engine.chunks import Job, Outcome, compute_chunk
from wavequake.campaign.engine.plan import Feed
from wavequake.campaign.store.journal import Chunk
from wavequake.errors import UserError

if TYPE_CHECKING:
    from distributed import Client, Future

# A chunk hangs if it takes that many times the usual; machines are slow now and then, and chunks differ.
_PATIENCE, _LEAST_S, _FIRST_S = 20.0, 1800.0, 10800.0
_LOOK_S = 5.0  # between two looks at what the workers are at


def limit_of(timeout_s: float | None, seconds: Sequence[float]) -> float:
    """Return how long a chunk may take, in s: `timeout_s`, or by default what follows from finished ones."""
    if timeout_s is not None:
        return timeout_s
    return max(_LEAST_S, _PATIENCE * median(seconds)) if seconds else _FIRST_S


class _Watchdog:
    """Knows since when each chunk runs; a worker has one at a time, the others wait at the scheduler."""

    def __init__(self, client: "Client", limit: Callable[[], float]) -> None:
        self._client, self._limit = client, limit
        self._since: dict[tuple[str, Any], float] = {}
        self._next = time.monotonic()

    def overdue(self, ours: AbstractSet[Any]) -> dict[str, Any]:
        """Return the workers that have one of our chunks for too long, and its key; looks only now and then.

        Where a worker has more than one, which the scheduler avoids for many chunks, the first is running.
        """
        now, limit = time.monotonic(), self._limit()
        if now < self._next:
            return {}
        self._next = now + min(_LOOK_S, limit / 4)
        try:
            at_work = self._client.processing()
        except (OSError, TimeoutError):
            return {}  # the scheduler went away, which the futures will say
        running = [(worker, key) for worker, keys in at_work.items() for key in sorted(ours & set(keys))]
        self._since = {pair: self._since.get(pair, now) for pair in running}
        late = [pair for pair in running if now - self._since[pair] > limit]
        return dict(reversed(late))

    def end(self, worker: str) -> None:
        """Kill a worker, in whose place its nanny starts a new one."""
        with suppress(KeyError, TimeoutError):  # it has gone already, or will
            self._end(worker)

    def _end(self, worker: str) -> None:
        try:
            self._client.restart_workers([worker], timeout=60, raise_for_error=False)
        except ValueError:
            raise UserError(
                f"A chunk hangs on {worker}, which has no nanny to end it: start workers with "
                "`dask worker --nanny`, which is its default."
            ) from None


def stream(
    client: "Client",
    job: Job,
    todo: Sequence[Chunk],
    done: Callable[[Outcome], None],
    limit: Callable[[], float],
    log: Logger,
) -> list[Chunk]:
    """Compute chunks on the workers of `client` and return those that killed them or ran beyond `limit`.

    Raises
    ------
    UserError
        If the scheduler goes away, a chunk ends the run, or a worker that hangs cannot be ended.
    """
    from distributed import CancelledError
    from distributed.scheduler import KilledWorker

    feed = Feed(todo, max(32, 4 * sum(client.nthreads().values())))
    futures: dict[Any, Future] = {}
    arrived: SimpleQueue[Future] = SimpleQueue()
    watchdog = _Watchdog(client, limit)

    def submit() -> None:
        for piece in feed.fill():
            # Tuple keys with a common first part: the scheduler keeps the tasks in its queue, and does not
            # assign them to workers that may die with them.
            key = (f"chunk-{job.run}", piece[0])
            futures[key] = client.submit(compute_chunk, job, *piece, key=key, pure=False)
            futures[key].add_done_callback(arrived.put)

    submit()
    while feed.at_work:
        for worker, key in watchdog.overdue(futures.keys()).items():
            piece = feed.suspected(key[1])
            log.warning("cases %d to %d ran for too long on %s, which is restarted", *piece or key, worker)
            futures.pop(key).cancel()
            watchdog.end(worker)
            submit()
        try:
            future = arrived.get(timeout=min(1.0, limit() / 4))
        except Empty:
            continue
        if futures.pop(future.key, None) is None:
            continue
        try:
            outcome = future.result()
        except KilledWorker as death:
            piece = feed.suspected(future.key[1])
            log.warning("cases %d to %d killed their worker twice: %s", *piece or future.key, death)
        except CancelledError:
            raise UserError(
                "The Dask scheduler went away; what is done is kept, so run the same command again."
            ) from None
        else:
            if feed.answered(outcome.chunk[0]):
                done(outcome)
        future.release()
        submit()
    return feed.suspects
