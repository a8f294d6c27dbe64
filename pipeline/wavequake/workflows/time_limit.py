"""Stop work of the main thread after some time, as Ctrl-C would."""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

_AGAIN_S = 1.0  # what is raised while an object is deleted is lost


class OutOfTimeError(BaseException):
    """The time is over. No `Exception`: what goes on after a case that failed must not go on after this."""


@contextmanager
def time_limit(seconds: float | None) -> Iterator[None]:
    """Raise `OutOfTimeError` within, after so many seconds by the clock.

    A call into compiled code is waited for. Without limit if `seconds` is None, in other threads than the
    main one, and on systems without such alarms (Windows).
    """
    main = threading.current_thread() is threading.main_thread()
    if seconds is None or not main or not hasattr(signal, "setitimer"):
        yield
        return

    def ring(number: int, frame: FrameType | None) -> None:
        raise OutOfTimeError

    before = signal.signal(signal.SIGALRM, ring)
    try:
        signal.setitimer(signal.ITIMER_REAL, seconds, _AGAIN_S)
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)
