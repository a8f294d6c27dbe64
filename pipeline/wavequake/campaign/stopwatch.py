"""Seconds by the kind of work, for the journal."""

import time
from collections.abc import Iterator
from contextlib import contextmanager

CPU = "cpu "


class Stopwatch:
    """Adds up the seconds spent on each kind of work: by the clock, and by all threads of the process."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    @contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        """Count what is done within this context as `name`, its processor time as ``cpu name``."""
        start, busy = time.perf_counter(), time.process_time()
        try:
            yield
        finally:
            self._add(name, time.perf_counter() - start)
            self._add(CPU + name, time.process_time() - busy)

    def _add(self, name: str, seconds: float) -> None:
        self.seconds[name] = self.seconds.get(name, 0.0) + seconds
