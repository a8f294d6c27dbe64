"""Settings that every test shares."""

import os

from hypothesis import settings

# One thread per process, as in a worker, and examples that are the same in every run.
for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(name, "1")
os.environ.setdefault("POCL_MAX_PTHREAD_COUNT", "1")

settings.register_profile("ci", max_examples=25, deadline=None, derandomize=True, database=None)
settings.load_profile("ci")
