"""Run the command line as ``wavequake`` or ``python -m wavequake``."""

import gc
import os
import signal
import sys
import time
from collections.abc import Sequence
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder
from importlib.util import LazyLoader
from types import FrameType, ModuleType

# Modules live on: going through all their objects after every 700 new ones takes an eighth of a command, and
# again after every tenth of such looks a twentieth of a report.
_GARBAGE = 100_000, 50
# A power of two, processor cycles: BLAS keeps its threads busy waiting for a hundredth of a second after each
# product, a twentieth of a command that does little else than load.
_WAITING = ("OPENBLAS_THREAD_TIMEOUT", "16")
# Pydantic reads what every installed distribution declares, to see who wants to watch it.
_UNWATCHED = ("PYDANTIC_DISABLE_PLUGINS", "1")
# What SciPy has NumPy load and nothing uses: a compiler of Fortran, which needs a library that guesses the
# encoding of files, and tests. They take as long as NumPy itself; now they load when something asks for them.
_LATER = frozenset({"numpy.f2py", "numpy.testing"})
_IMPATIENCE_S = 2.0  # who presses Ctrl-C again while we clean up does not disturb that


class _Later(MetaPathFinder):
    """Finds modules that load when they are first asked for something."""

    def find_spec(
        self, name: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Return where such a module is; of others, nothing."""
        found = PathFinder.find_spec(name, path) if name in _LATER else None
        if found is not None and found.loader is not None:
            found.loader = LazyLoader(found.loader)
        return found


def main() -> None:
    """Run the command line, which takes a moment to load; SIGTERM and SIGHUP end it as Ctrl-C does."""
    gc.set_threshold(*_GARBAGE)
    os.environ.setdefault(*_WAITING)
    os.environ.setdefault(*_UNWATCHED)
    sys.meta_path.insert(0, _Later())
    came: list[float] = []

    def interrupt(number: int, frame: FrameType | None) -> None:
        now = time.monotonic()
        if not came or now - came[-1] > _IMPATIENCE_S:
            came.append(now)
            raise KeyboardInterrupt

    def end(number: int, frame: FrameType | None) -> None:
        if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # a shell without job control started us by `&`
            signal.signal(signal.SIGINT, interrupt)
        signal.raise_signal(signal.SIGINT)

    ends = [one for one in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, one)]  # Windows has no SIGHUP
    # What ends a job on a cluster, and a closed terminal, is to it what Ctrl-C is; `nohup` is obeyed.
    for name in ends:
        number, handler = getattr(signal, name), interrupt if name == "SIGINT" else end
        if number == signal.SIGTERM or signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, handler)
    try:
        from wavequake.cli import main as command_line
    except BaseException:
        if not came:  # libraries that are interrupted as they load may say something else
            raise
        print("Interrupted before anything was begun; to start: the same command again.", file=sys.stderr)
        sys.exit(130)
    try:
        command_line(came)
    except KeyboardInterrupt:  # while the command was ending
        from wavequake.terminal import interrupted

        interrupted()
    finally:  # nothing is left to be kept: Ctrl-C ends what libraries still do, and needs no words
        for name in ends:
            signal.signal(getattr(signal, name), signal.SIG_DFL)
        gc.freeze()  # else Python looks for garbage in all that ends with it: up to half a second


if __name__ == "__main__":
    main()
