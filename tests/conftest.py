"""Settings that every test shares."""

import os
import signal
import sys
from contextlib import suppress

import pytest
from hypothesis import settings

# One thread per process, as in a worker, and examples that are the same in every run.
for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(name, "1")
os.environ.setdefault("POCL_MAX_PTHREAD_COUNT", "1")

# A shell ignores Ctrl-C for what it runs in the background, and children would inherit that.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    with suppress(ValueError):  # outside the main thread
        signal.signal(signal.SIGINT, signal.default_int_handler)

settings.register_profile("ci", max_examples=25, deadline=None, derandomize=True, database=None)
settings.load_profile("ci")


@pytest.fixture
def wavequake(monkeypatch, capsys):
    """Run the command line in this process; give (exit code, standard output, standard error)."""
    from wavequake import cli  # after the threads of NumPy are set

    def run(*words):
        monkeypatch.setattr(sys, "argv", ["wavequake", *map(str, words)])
        try:
            cli.main()
            code = 0
        except SystemExit as end:
            code = end.code or 0
        captured = capsys.readouterr()
        return code, captured.out, captured.err

    return run
