"""Load what a command needs at its end while workers compute."""

import itertools
import threading
from collections.abc import Callable

Progress = Callable[[int, int, int], None]


def while_it_runs(progress: Progress, workflow: str) -> Progress:
    """Return a progress that loads what the report needs once a chunk is done: a second less to wait."""
    calls = itertools.count()

    def told(done: int, total: int, quarantined: int) -> None:
        progress(done, total, quarantined)
        if next(calls) == 1 and done < total:
            from wavequake.report.campaign import load

            threading.Thread(target=load, args=(workflow,)).start()

    return told
