"""Recordings of what bundled studies compute, small: ``python -m tests.recorded NAME...`` makes them anew.

A recording is kept in ``tests/data/recorded/NAME.npz``. Large arrays are condensed to some of their numbers
and to a few weighted sums of all. What agrees with the recording there is stays as it is; the command prints
what has moved, come or gone, which belongs in the change log. ``--compare NAME...`` changes nothing and ends
with code 1 if something differs; with ``--workers`` two worker processes compute, chunks half as large.

Rounding is magnified where numbers are errors of something (`modal_error_los`), or depend on a basis that
rounding chooses (a pair of equal modes): another BLAS kernel changes them by more than their size. So all is
computed with the kernels of AVX2 processors (`SAME`), which every newer one can run. With these the numbers
are the same to the bit whichever processor OpenCL's compiler is told (AVX2, AVX-512, Zen 3), which cache
size OpenBLAS is told, and with one or two threads of BLAS.
"""

import os
import subprocess
import sys
from contextlib import contextmanager, nullcontext
from hashlib import sha256
from importlib.metadata import version
from pathlib import Path
from tempfile import TemporaryDirectory
from unittest.mock import patch

import numpy as np
from tests.recorded_studies import RECORDED

FOLDER = Path(__file__).parent / "data" / "recorded"
WHOLE, SAMPLES, SUMS = 96, 24, 8
# The largest difference, as a share of the largest number of a variable, of two computations that agree.
AGREED = 1e-12
# Differences of two positions of some 100 mm, which are known to the rounding of those, in their unit.
ROUNDED = {"centroid_mm": 1e-13}
# Kernels of BLAS and NumPy (two generations of names) that every processor with AVX2 has.
SAME = {
    "OPENBLAS_CORETYPE": "Haswell",
    "NPY_DISABLE_CPU_FEATURES": "X86_V4 AVX512_ICL AVX512_SPR "
    "AVX512F AVX512CD AVX512_SKX AVX512_CLX AVX512_CNL",
    "POCL_MAX_PTHREAD_COUNT": "1",
}
# Other versions of both have other kernels of BLAS, and other last bits.
MADE_WITH = {"numpy": "2.4", "scipy": "1.17"}
MARK = "WAVEQUAKE_RECORDS"  # set where the environment is that of `SAME`


def compute(name, workers=False):
    """Return every number of a recording's study by its name, without what a stopwatch measured.

    With `workers`, two processes of Dask compute a half each.
    """
    import wavequake as wq
    from wavequake.workflows.run import kind_of

    small = RECORDED[name]
    cases = {} if small.cases is None else {"campaign.cases": small.cases}
    keys = small.keys | cases | {"campaign.device": "cpu"}
    study, where = wq.load_study(small.study, keys), {"on": "serial"}
    if workers:
        study = wq.load_study(small.study, keys | {"store.chunk_cases": -(-study.cases // 2)})
        where = {"on": "local", "workers": 2}
    kind, text = kind_of(study), study.identity_text()
    per_case = kind.template(text).per_case
    if not workers:  # what the command line asks before it computes may prepare something in this process
        _ = [*kind.notices(text)], kind.describe(text), kind.case_table(text, 0, 1)
    with TemporaryDirectory() as folder:
        dataset = wq.run(study, store=Path(folder) / "store", **where).load()
    return {
        str(key): values.to_numpy()
        for key, values in dataset.variables.items()
        if not (key in per_case and per_case[key].measured)
    }


@contextmanager
def shared_workers():
    """Start two workers that all studies share: starting them anew takes longer than most studies."""
    from wavequake.campaign.engine import driver
    from wavequake.cluster.local import local_cluster

    with local_cluster(2) as client, patch.object(driver, "place_of") as place_of:
        place_of.return_value = lambda workers, dashboard: nullcontext(client)
        yield


def condense(values):
    """Return an array, or of a large one some of its numbers and weighted sums, as {suffix: array}."""
    if values.dtype.kind not in "fiub":
        return {"": np.array(values.tolist(), dtype=str)}
    if values.size <= WHOLE or values.dtype.kind != "f":
        return {"": values}
    table = values.reshape(len(values), -1) if values.ndim > 1 else values[None]
    known = np.where(np.isfinite(table), table, 0.0)
    entries = np.arange(table.shape[1])
    weights = np.cos(np.outer(entries + 1.0, np.arange(1, SUMS + 1) * 2.399963)) / np.sqrt(len(entries))
    sample = table[:, entries[:: max(1, len(entries) // SAMPLES)]]
    return {
        "|largest": np.abs(known).max(keepdims=True),
        "|unknown": np.count_nonzero(~np.isfinite(table), axis=1),
        "|sample": sample,
        "|sums": np.einsum("ij,jk->ik", known, weights),
    }


def digest(numbers):
    """Return the SHA-256 of the bits of named arrays."""
    found = sha256()
    for key, values in sorted(numbers.items()):
        found.update(f"{key} {values.shape}".encode())
        found.update(values.tobytes() if values.dtype.kind in "fiub" else repr(values.tolist()).encode())
    return found.hexdigest()


def difference(kept, key, values):
    """Return how far an array is from the recorded one, as a share of the variable's largest number.

    Everything but floating-point numbers is equal (0) or is not (inf).
    """
    recorded = kept[key]
    if recorded.shape != values.shape or recorded.dtype.kind != values.dtype.kind:
        return np.inf
    if recorded.dtype.kind != "f":
        return 0.0 if np.array_equal(recorded, values) else np.inf
    if not np.array_equal(np.isfinite(recorded), np.isfinite(values)):
        return np.inf
    known = np.isfinite(recorded)
    name = key.partition("|")[0]
    apart = np.abs(recorded[known] - values[known]).max(initial=0.0)
    if apart <= ROUNDED.get(name, 0.0):
        return 0.0
    largest = kept.get(name + "|largest", recorded[known])
    return float(apart / np.abs(largest).max(initial=0.0)) if apart else 0.0


def changes(kept, now):
    """Return what has changed of a recording, in words, by the name of the array."""
    found = {key: "is gone" for key in kept if key not in now}
    for key, values in now.items():
        if key not in kept:
            found[key] = "is new"
        elif not (apart := difference(kept, key, values)) <= AGREED:
            found[key] = f"moves by {apart:.1e} of its scale"
    return found


def compare(name, *, record, workers=False):
    """Return the bits of a study as a digest, and what has changed since it was recorded, in words."""
    numbers, path = compute(name, workers), FOLDER / f"{name}.npz"
    now = {key + suffix: part for key, values in numbers.items() for suffix, part in condense(values).items()}
    kept = dict(np.load(path)) if path.exists() else {}
    changed = changes(kept, now)
    if record and changed:
        path.parent.mkdir(exist_ok=True)
        np.savez_compressed(path, **{key: now[key] if key in changed else kept[key] for key in now})
    return digest(numbers), "; ".join(f"{key} {words}" for key, words in sorted(changed.items()))


def made_with():
    """Return the versions here of the libraries in `MADE_WITH`."""
    return {name: ".".join(version(name).split(".")[:2]) for name in MADE_WITH}


def run_alike(*words, threads=1):
    """Run this module on its own with the kernels of every AVX2 processor and no models of earlier runs.

    With other libraries than the recordings' the kernels are those of this processor: no recording has their
    bits, and those of AVX2 crash in OpenBLAS 0.3.34 where there is AVX-512, too (its issues 6013 and 6026).
    """
    home = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    with TemporaryDirectory() as folder:
        kept = {"XDG_CACHE_HOME": folder, "POCL_CACHE_DIR": str(home / "pocl" / "kcache")}
        command = [sys.executable, "-m", "tests.recorded", *words]
        same = SAME if made_with() == MADE_WITH else {"POCL_MAX_PTHREAD_COUNT": "1"}
        environment = {**os.environ, **kept, **same, "OPENBLAS_NUM_THREADS": str(threads), MARK: "1"}
        return subprocess.run(command, env=environment, capture_output=True, text=True)


def main(*words):
    """Make the recordings that are named, or all; with --compare, compare them with those there are."""
    names = [word for word in words if not word.startswith("--")] or list(RECORDED)
    if unknown := set(names) - set(RECORDED):
        sys.exit(f"There is no recording {', '.join(sorted(unknown))}; there are {', '.join(RECORDED)}.")
    same, workers = True, "--workers" in words
    with shared_workers() if workers else nullcontext():
        for name in names:
            bits, changed = compare(name, record="--compare" not in words, workers=workers)
            same = same and not changed
            print(f"{name}: {changed or 'agrees'} {bits[:16]}", flush=True)
    return int("--compare" in words and not same)


if __name__ == "__main__":
    if os.environ.get(MARK):
        sys.exit(main(*sys.argv[1:]))
    done = run_alike(*sys.argv[1:])
    print(done.stdout, done.stderr, sep="", end="")
    sys.exit(done.returncode)
