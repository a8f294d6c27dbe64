"""Settings that every test shares."""

import os
import signal
from contextlib import suppress

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
