"""Stop work of the main thread after some time, as Ctrl-C would."""

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

_AGAIN_S = 1.0  # what is raised while an object is deleted is lost
_PATIENCE_S = 0.7  # with compiled code, where there is a last word


class OutOfTimeError(BaseException):
    """The time is over. No `Exception`: what goes on after a case that failed must not go on after this."""


@contextmanager
def time_limit(seconds: float | None, last_word: Callable[[], None] | None = None) -> Iterator[None]:
    """Raise `OutOfTimeError` within, after so many seconds by the clock.

    A call into compiled code is waited for; not where there is a `last_word`, which another thread says then,
    and which ends the process. Without limit if `seconds` is None, in other threads than the main one, and on
    systems without such alarms (Windows).
    """
    main = threading.current_thread() is threading.main_thread()
    if seconds is None or not main or not hasattr(signal, "setitimer"):
        yield
        return

    def ring(number: int, frame: FrameType | None) -> None:
        raise OutOfTimeError

    before = signal.signal(signal.SIGALRM, ring)
    try:
        with _spoken(seconds + _PATIENCE_S, last_word):
            signal.setitimer(signal.ITIMER_REAL, seconds, _AGAIN_S)
            try:
                yield
            finally:
                signal.setitimer(signal.ITIMER_REAL, 0.0)
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


@contextmanager
def _spoken(seconds: float, last_word: Callable[[], None] | None) -> Iterator[None]:
    """Say a last word after so many seconds, in a thread, unless what is within has ended."""
    if last_word is None:
        yield
        return
    speaking, over = threading.Lock(), threading.Event()

    def speak() -> None:
        with speaking:
            if not over.is_set():
                last_word()

    timer = threading.Timer(seconds, speak)
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()
        with speaking:  # who speaks already ends the process
            over.set()
