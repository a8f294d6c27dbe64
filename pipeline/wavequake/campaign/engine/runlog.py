"""The log of a run: a text file in its store that says when what was done, and what went wrong."""

import logging
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path

from wavequake.campaign.store.objects import ObjectPath, upload
from wavequake.cluster.output import OUTPUT
from wavequake.errors import UserError
from wavequake.words import printable, shortened

_MOST_LINES = 1000  # of what workers print, in a log


class _QuietHandler(logging.FileHandler):
    """Writes lines to a file, and never disturbs the run: its disk may be full."""

    def handleError(self, record: logging.LogRecord) -> None:  # noqa: N802 (the name is logging's)
        """Say nothing."""

    def close(self) -> None:
        """Close the file, whatever of it did not fit on the disk."""
        with suppress(OSError):
            super().close()


class _Formatter(logging.Formatter):
    """Writes one line for each message, whatever names and files hold."""

    def formatMessage(self, record: logging.LogRecord) -> str:  # noqa: N802 (the name is logging's)
        """Return the line of a message."""
        record.message = shortened(record.message.replace("\n", "\\n"))
        return super().formatMessage(record)

    def format(self, record: logging.LogRecord) -> str:
        """Return the line, and the traceback if there is one."""
        return printable(super().format(record))


@contextmanager
def run_log(folder: Path) -> Iterator[logging.Logger]:
    """Make a new file in `folder`; write to it what is logged, what workers print, and how the run ended."""
    logger = logging.Logger("wavequake.run")  # of this run alone: no global state
    start = datetime.now(UTC)
    handler: logging.Handler = logging.NullHandler()
    target = folder
    scratch = ExitStack()
    if isinstance(target, ObjectPath):
        folder = Path(scratch.enter_context(tempfile.TemporaryDirectory(prefix="wavequake-")))
    file = folder / f"{start:%Y%m%dT%H%M%SZ}-{os.getpid()}.log"
    try:
        folder.mkdir(exist_ok=True)
        handler = _QuietHandler(file, encoding="utf-8")
    except OSError:
        pass  # what cannot be written, the data will say
    handler.setFormatter(_Formatter("%(asctime)s %(levelname)-7s %(message)s"))
    logger.addHandler(handler)
    try:
        with _workers_heard(file.with_suffix(".workers"), logger):
            yield logger
        logger.info("the run is complete")
    except KeyboardInterrupt:
        logger.warning("interrupted; what is done is kept, and the next run continues")
        raise
    except BaseException as error:
        logger.exception("the run ended early: %s", error)
        raise
    finally:
        logger.removeHandler(handler)
        handler.close()
        with scratch, suppress(OSError, UserError):  # what cannot be written, the data have said
            if isinstance(target, ObjectPath):
                upload(folder, target)


@contextmanager
def _workers_heard(folder: Path, logger: logging.Logger) -> Iterator[None]:
    """Log in the end what worker processes have printed, each into a file of its own in this folder."""
    with suppress(OSError):  # nor is there a log
        folder.mkdir()
    before = os.environ.get(OUTPUT, os.devnull)
    os.environ[OUTPUT] = str(folder)
    try:
        yield
    finally:
        os.environ[OUTPUT] = before
        with suppress(OSError):
            for number, line in enumerate(_lines_within(folder)):
                if number == _MOST_LINES:
                    logger.warning("workers said more, which is lost")
                    break
                logger.warning("a worker said: %s", line.decode(errors="replace").rstrip())
        shutil.rmtree(folder, ignore_errors=True)


def _lines_within(folder: Path) -> Iterator[bytes]:
    """Return what is in the files, one after the other, as they were written last."""
    for file in sorted(folder.iterdir(), key=lambda file: file.stat().st_mtime_ns):
        with file.open("rb") as said:
            yield from (line for line in said if line.strip())
