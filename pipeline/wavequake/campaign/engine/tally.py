"""What of a run is done, told to who asked for it and to the log."""

from collections.abc import Callable, Mapping
from logging import Logger
from typing import TYPE_CHECKING

from wavequake.campaign.store.journal import Chunk, Record

if TYPE_CHECKING:
    from wavequake.campaign.engine.chunks import Outcome

Progress = Callable[[int, int, int], None]


class Tally:
    """Counts of a run, told to the caller's progress and to the log after each chunk."""

    def __init__(
        self, wanted: list[Chunk], before: Mapping[Chunk, Record], progress: Progress | None
    ) -> None:
        self.total = sum(last - first for first, last in wanted)
        self.done = sum(last - first for first, last in before)
        self.quarantined = sum(record.quarantined for record in before.values())
        self.chunk_seconds = [record.timings.get("compute_s", 0.0) for record in before.values()]
        self.compute_s = self.write_s = 0.0
        self.log = Logger("nothing yet")
        self._progress = progress or (lambda done, total, quarantined: None)
        self._progress(self.done, self.total, self.quarantined)

    def add(self, outcome: "Outcome") -> None:
        """Count a chunk that has just been computed."""
        first, last = outcome.chunk
        self.done += last - first
        self.quarantined += outcome.quarantined
        self.compute_s += outcome.compute_s
        self.write_s += outcome.write_s
        self.chunk_seconds.append(outcome.compute_s)
        self.log.info(
            "cases %d to %d: computed in %.3f s, written in %.3f s, %d quarantined",
            *(first, last - 1, outcome.compute_s, outcome.write_s, outcome.quarantined),
        )
        self._progress(self.done, self.total, self.quarantined)
