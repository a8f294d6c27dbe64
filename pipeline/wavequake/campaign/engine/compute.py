"""Have what a store lacks computed, here or by workers, and a share of all again."""

from collections.abc import Callable

from wavequake.campaign.engine.chunks import Job
from wavequake.campaign.engine.isolation import NoProcessError, compute_isolated, renewed
from wavequake.campaign.engine.recheck import Check
from wavequake.campaign.engine.series import in_series, left_open, unmark
from wavequake.campaign.engine.stream import limit_of, stream
from wavequake.campaign.engine.tally import Tally
from wavequake.campaign.store.journal import Chunk
from wavequake.campaign.store.objects import location
from wavequake.cluster.places import Opener


def compute(
    job: Job,
    todo: list[Chunk],
    place: Opener | None,
    workers: int | None,
    tally: Tally,
    timeout_s: float | None,
    dashboard: Callable[[str], None] | None,
    check: Check,
) -> tuple[str, ...]:
    """Compute chunks, and then a share of all again; return what came of that, in words."""

    def limit() -> float:
        return limit_of(timeout_s, tally.chunk_seconds)

    if place is None:
        path = location(job.path)
        died = left_open(path, todo)
        for piece in died:
            tally.log.warning(
                "the run before died in cases %d to %d: each is tried alone", piece[0], piece[1] - 1
            )
        rest = [piece for piece in todo if piece not in died]
        suspects = in_series(job, rest, tally.add, limit, tally.log)
        for piece in died:
            try:
                tally.add(compute_isolated(job, *piece, limit()))
            except NoProcessError:  # most likely it was killed, and no case is guilty
                suspects += in_series(job, [piece], tally.add, limit, tally.log)
            unmark(path, piece)
    else:
        with place(
            workers and min(workers, max(2 if check.share else 1, len(todo))), dashboard is not None
        ) as client:
            if dashboard is not None:
                dashboard(client.dashboard_link)
            suspects = stream(client, job, todo, tally.add, limit, tally.log) if todo else []
            told, job = check(job, client, limit, tally.log)
    if suspects:  # a worker that was given up may go on: what it writes now would not be what is recorded
        job = renewed(job)
    for piece in suspects:
        tally.add(compute_isolated(job, *piece, limit()))
    if place is None:
        told, job = check(job, None, limit, tally.log)
    return told
