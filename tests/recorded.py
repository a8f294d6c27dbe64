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
from dataclasses import dataclass, field
from hashlib import sha256
from importlib.metadata import version
from pathlib import Path
from tempfile import TemporaryDirectory
from unittest.mock import patch

import numpy as np
from tests.workflows.small_disc import DISC

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

EXPOSED = {
    "model.rings": 2,
    "reduction.reference": "craigb36",
    "reduction.variants": ["krylov36(150)"],
    "imaging.pixels": 24,
    "imaging.pupil_samples": 48,
    "imaging.instants": 5,
    "optics.rays": 200,
    "optics.zernike_terms": 21,
    "time.duration_s": 0.005,
}
SEGMENTS = {
    "disturbance.alignment.instants": 2,
    "disturbance.edge-sensors.instants": 4,
    "disturbance.wind.instants": 4,
    "disturbance.wind-shake.instants": 4,
    "imaging.pixels": 16,
}
FEW_SEGMENTS = SEGMENTS | {"telescope.name": "tmt-18", "imaging.enabled": False}
MIRRORS = {
    "model.rings": 2,
    "reduction.frequencies": 24,
    "imaging.pixels": 12,
    "imaging.pupil_samples": 24,
    "imaging.instants": 3,
    "optics.rays": 200,
    "optics.zernike_terms": 21,
    "time.duration_s": 0.004,
}
SHAKEN = {
    "model.divisions": 3,
    "reduction.frequencies": 20,
    "reduction.spot_checks": 1,
    "time.duration_s": 0.05,
    "time.traced": 16,
    "optics.rays_per_segment": 18,
    "optics.zernike_terms": 11,
    "imaging.pixels": 12,
}
CONTROLLED = {
    "model.divisions": 3,
    "model.modes": 60,
    "controller.effort": [0.1],
    "reduction.variants": ["modal10", "craigb18", "rubin15", "krylov27(50)"],
    "reduction.frequencies": 40,
}
TRACED = {"model.rings": 2, "optics.rays": 120, "optics.zernike_terms": 21, "time.duration_s": 0.002}
SHORT = {"time.duration_s": 2.0, "time.step_ms": 20.0}
STRUCTURE = {
    "body.primary.mirror.rings": 2,
    "body.secondary.mirror.rings": 2,
    "body.tube.beams.pieces": 1,
    "reduction.variants": ["guyan", "craigb24"],
    "disturbance.floor.instants": 8,
    "disturbance.floor.share": 1,
    "disturbance.wheel.instants": 8,
    "disturbance.wheel.share": 1,
    "disturbance.gravity.instants": 4,
    "disturbance.all.instants": 8,
    "disturbance.all.share": 1,
    "imaging.pixels": 16,
    "optics.rays": 120,
}
JITTER = {"disturbance.jitter.instants": 4, "disturbance.phasing-and-jitter.instants": 4}
HISTORY = {"disturbance.history.instants": 4, "optics.rays": 400}
LOOPS = HISTORY | {
    "disturbance.history.instants": 20,
    "imaging.pixels": 16,
    "look.traced": 2,
    "wavefront.zernike_terms": 15,
    "actuator.figure.terms": 15,
    **DISC,
    "controller.body-perfect.modes": 12,
    "controller.body.modes": 12,
    "controller.rigid.vary": {"latency_frames": [0.5, 2.0]},
    "controller.elastic.vary": {"latency_frames": [0.5, 2.0], "gain": [0.2]},
    "controller.body.vary": {"latency_frames": [0.5, 2.0], "bandwidth_hz": [20.0]},
    "controller.elastic-faint.vary": {"rate_hz": [500.0]},
    "controller.elastic-lqg.vary": {"latency_frames": [1.5]},
}
STEADIED = {
    **{
        f"disturbance.{name}.{key}": value
        for name in ("tremor", "drive", "both")
        for key, value in (("instants", 4), ("duration_s", 0.25))
    },
    "optics.rays": 60,
    "imaging.pixels": 16,
    "controller.integrator.vary": {"bandwidth_hz": [20.0]},
}
RINGING = {
    "disturbance.shaken.instants": 40,
    "disturbance.shaken.duration_s": 0.2,
    "disturbance.shaken.low_hz": 10.0,
    "disturbance.shaken.high_hz": 40.0,
    "optics.rays": 300,
    "imaging.pixels": 16,
    "look.traced": 2,
    "wavefront.zernike_terms": 15,
    "actuator.figure.terms": 15,
    "controller.tilt.vary": {"bandwidth_hz": [15.0]},
    "controller.tilt-lqg.vary": {"latency_frames": [1.0]},
    "controller.tilt-both.vary": {"latency_frames": [0.5]},
    "controller.figure.vary": {"bandwidth_hz": [15.0]},
    "controller.figure-lqg.vary": {"latency_frames": [0.5]},
}


@dataclass(frozen=True)
class Small:
    """A bundled study made small: changed keys, and the number of cases where it is not given by them."""

    study: str
    keys: dict = field(default_factory=dict)
    cases: int | None = None


RECORDED = {
    "controller-mor": Small("controller-mor", CONTROLLED),
    "double-gauss": Small("double-gauss", {"optics.rays": 100}, 8),
    "double-gauss-slopes": Small(
        "double-gauss", {"optics.rays": 120, "wavefront.method": "slopes", "wavefront.zernike_terms": 15}, 8
    ),
    "double-gauss-sphere": Small(
        "double-gauss",
        {
            "optics.rays": 100,
            "wavefront.reference": "fitted",
            "campaign.sampling": "latin-hypercube",
            "campaign.replicates": 2,
        },
        8,
    ),
    "euv": Small("euv", {"optics.rays": 120}, 6),
    "euv-allowances": Small("euv-allowances", {"optics.rays": 120}, 6),
    "euv-every": Small(
        "euv",
        {
            "optics.rays": 120,
            "disturbance.drift.instants": 8,
            "disturbance.heating.share": 0,
            "store.every": 8,
        },
        3,
    ),
    "jwst-segments": Small(
        "jwst-segments",
        {
            "disturbance.jitter.instants": 4,
            "disturbance.phasing-and-jitter.instants": 4,
            "imaging.pixels": 16,
        },
        3,
    ),
    "jwst-segments-field": Small(
        "jwst-segments",
        JITTER
        | {
            "imaging.enabled": False,
            "optics.field_arcmin": [1.0, 0.5],
            "wavefront.method": "slopes",
            "wavefront.basis": "circular",
        },
        6,
    ),
    "lens-experiment": Small("lens-experiment", SHORT, 2),
    "lens-firmware": Small("lens-firmware", SHORT, 2),
    "lens-passive": Small("lens-passive", {"passive.iterations": 3}, 2),
    "mirror-exposure": Small("mirror-exposure", EXPOSED),
    "mirror-exposure-coherent": Small(
        "mirror-exposure", EXPOSED | {"object.grating": 2.0, "object.light": "coherent"}, 1
    ),
    "mirror-exposure-incoherent": Small("mirror-exposure", EXPOSED | {"object.chart": [0.5, 0.25]}, 1),
    "mirror-exposure-partial": Small(
        "mirror-exposure",
        EXPOSED | {"object.double_slit": [0.75, 2.25], "object.light": "partial", "object.sigma": 0.4},
        1,
    ),
    "mirror-mor": Small("mirror-mor", MIRRORS),
    "mirror-trace": Small("mirror-trace", TRACED),
    "mirror-trace-residual": Small(
        "mirror-trace", TRACED | {"model.shapes": ["circular"], "optics.residual_limit": 0.0}
    ),
    "image-stabilizer": Small("image-stabilizer", STEADIED, 3),
    "structure-loop": Small("structure-loop", RINGING, 2),
    "telescope-structure": Small("telescope-structure", STRUCTURE, 12),
    "tip-tilt-vibration": Small(
        "tip-tilt-vibration", {"simulated.duration_s": 4.0, "simulated.settling_s": 1.0}, 6
    ),
    "tmt-ao": Small("tmt-ao", LOOPS, 3),
    "tmt-exposure": Small("tmt-exposure", HISTORY | {"imaging.pixels": 16, "wavefront.zernike_terms": 28}, 2),
    "tmt-exposure-slit": Small(
        "tmt-exposure",
        HISTORY
        | {
            "imaging.pixels": 16,
            "wavefront.zernike_terms": 28,
            "object.slit": 1.0,
            "object.light": "partial",
            "object.sigma": 0.4,
        },
        1,
    ),
    "tmt-m1-control": Small("tmt-m1-control", {"mirror.telescope": "tmt-18"}, 2),
    "tmt-million": Small("tmt-million", {}, 40),
    "tmt-million-series": Small(
        "tmt-million", {"store.reduce": "none", "optics.modal_tolerance_nm": 1e-4}, 3
    ),
    "tmt-rare": Small("tmt-rare", {"telescope.name": "tmt-18", "rare.limit": 100.0}, 6),
    "tmt-segment-mor": Small("tmt-segment-mor", SHAKEN),
    "tmt-segments": Small("tmt-segments", SEGMENTS, 8),
    "tmt-segments-figures": Small(
        "tmt-segments",
        SEGMENTS
        | {
            "disturbance.alignment.figure_nm": {"4": 20.0, "7": 10.0},
            "disturbance.alignment.piston_distribution": "uniform",
            "optics.rays_per_segment": 36,
        },
        1,
    ),
    "tmt-segments-sobol": Small(
        "tmt-segments",
        FEW_SEGMENTS
        | {
            "disturbance.edge-sensors.share": 0,
            "disturbance.wind.share": 0,
            "campaign.sampling": "sobol",
            "store.reduce": "summary",
        },
        16,
    ),
    "tmt-segments-sphere": Small(
        "tmt-segments", FEW_SEGMENTS | {"wavefront.reference": "fitted", "store.every": 2}, 4
    ),
    "tmt18-history": Small("tmt18-history", HISTORY | {"imaging.pixels": 16}, 3),
}


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
    # What the command line asks before it computes, and what may prepare something in this process.
    kind.check(text)
    per_case = kind.template(text).per_case
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
    return digest(numbers), "; ".join(f"{key} {words}" for key, words in changed.items())


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
