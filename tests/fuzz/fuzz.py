"""Give damaged files to readers: ``python tests/fuzz/fuzz.py COUNT [READER ...]``.

A reader may succeed, or raise one UserError of one line within MOST characters: nothing else, in bounded
time and memory. Prints a line of JSON for each reader: how many files it read and refused, its slowest, and
what it did wrong. A process that dies has said before which reader it was at.
"""

import faulthandler
import json
import os
import resource
import signal
import sys
import tempfile
import time
import warnings
from pathlib import Path
from random import Random

sys.path.insert(0, str(Path(__file__).parent))
import mutations
import readers

from wavequake.errors import UserError
from wavequake.words import MOST, plain

TIME_S = 10.0  # of the processor; the usual file takes milliseconds
WAIT_S = 120.0  # of the clock, for what waits instead; the machine may be busy
MEMORY = 1_500_000_000  # bytes beyond what the libraries have taken
LIMIT_MB = 100  # WAVEQUAKE_MOST_MB
MOST_MORE_MB = 400


class TooLongError(BaseException):
    """No `except Exception` of a library catches it."""


def _peak_kb():
    """Return the most memory that this program has held; ru_maxrss begins with that of who started it."""
    status = Path("/proc/self/status").read_text()
    return int(status.split("VmHWM:")[1].split()[0])


def ring(number: int, frame: object) -> None:
    raise TooLongError


def trouble(read, path):
    """Return whether the file was read, and what went wrong, if anything did."""
    signal.setitimer(signal.ITIMER_PROF, TIME_S)
    signal.setitimer(signal.ITIMER_REAL, WAIT_S)
    try:
        read(path)
    except UserError as error:
        words = str(error)
        good = words and len(words) <= MOST and plain(words) == words
        return False, None if good else f"message {words!r}"
    except TooLongError:
        return False, f"takes more than {TIME_S} s of the processor, or {WAIT_S} s"
    except Exception as error:
        frames = []
        trace = error.__traceback__
        while trace:
            frames.append(f"{Path(trace.tb_frame.f_code.co_filename).name}:{trace.tb_lineno}")
            trace = trace.tb_next
        return False, f"{type(error).__name__}: {str(error)[:150]} at {' '.join(frames[-5:])}"
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        signal.setitimer(signal.ITIMER_REAL, 0.0)
    return True, None


def fuzz(name: str, count: int, folder: Path) -> dict[str, object]:
    reader = readers.READERS[name]
    path = folder / f"damaged{reader.suffix}"
    valid = [make() for make in reader.valid]
    for data in valid:  # which also loads its libraries
        path.write_bytes(data)
        reader.read(path)
    before = _peak_kb()
    found: dict[str, str] = {}
    worst, reads = 0.0, 0
    for index in range(count):
        random = Random(f"{name} {index}")
        data = mutations.damaged(random.choice(valid), random)
        path.write_bytes(data)
        start = time.process_time()
        was_read, wrong = trouble(reader.read, path)
        worst = max(worst, time.process_time() - start)
        reads += was_read
        if wrong:
            found.setdefault(wrong, f"mutation {index}")
            if keep := os.environ.get("FUZZ_KEEP"):
                (Path(keep) / f"{name}-{index}{reader.suffix}").write_bytes(data)
    more = (_peak_kb() - before) / 1024
    wrong = [f"{where}: {what}" for what, where in found.items()]
    if more > MOST_MORE_MB:
        wrong.append(f"takes {more:.0f} MB of memory")
    facts = {"reader": name, "files": count, "read": reads}
    return facts | {"worst_s": round(worst, 3), "more_mb": round(more), "wrong": wrong}


def main(count: int, names: list[str]) -> None:
    os.environ["WAVEQUAKE_MOST_MB"] = str(LIMIT_MB)
    faulthandler.enable()
    warnings.simplefilter("error")
    signal.signal(signal.SIGPROF, ring)
    signal.signal(signal.SIGALRM, ring)
    failures = []
    with tempfile.TemporaryDirectory() as folder:
        for name in names:
            print(json.dumps({"at": name}), flush=True)
            size = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
            _, hard = resource.getrlimit(resource.RLIMIT_AS)
            resource.setrlimit(resource.RLIMIT_AS, (size + MEMORY, hard))
            said = fuzz(name, count, Path(folder))
            print(json.dumps(said), flush=True)
            failures.append(said["wrong"])
    sys.exit(any(failures))


if __name__ == "__main__":
    main(int(sys.argv[1]), sys.argv[2:] or list(readers.READERS))
