"""A workflow without physics, to try the engine: random numbers, and cases that go wrong on request."""

import json
import os
import signal
import subprocess
import sys
import threading
import time
import warnings

import numpy as np
from threadpoolctl import threadpool_info

from wavequake.campaign.contract import DONE, RAISED, ChunkResult, StudyKind, Template, Variable

INSTANTS, TERMS = 4, 3


def study(**options):
    """Canonical study text.

    Options: seed, sleep_s (per case), folder, and ids of cases in poison, reasons, crash, once, wait,
    hang, hoard, blow and say; liar is the folder of a flag, count a file of what is begun.
    """
    return json.dumps({"study": {"name": "toy", "seed": 7}, **options}, sort_keys=True, separators=(",", ":"))


def template(text):
    noll = np.arange(1, TERMS + 1)
    return Template(
        {
            "time_s": Variable(("time",), (INSTANTS,), {"units": "s", "long_name": "time"}, coordinate=True),
            "zernike": Variable(
                ("time", "noll"), (INSTANTS, TERMS), {"units": "nm", "long_name": "Zernike coefficients"}
            ),
            "strehl": Variable((), (), {"units": "1", "long_name": "Strehl ratio"}),
            "count": Variable((), (), {"units": "1", "long_name": "a number of things"}, dtype="int32"),
        },
        {
            "noll": (("noll",), noll, {"long_name": "Noll index"}),
            "names": (("noll",), np.array(["piston", "tip", "tilt"]), {"long_name": "name of the term"}),
            "zernike_static": (("noll",), noll * 1.5, {"units": "nm", "long_name": "at rest"}),
        },
    )


def case_table(text, first, last):
    ids = np.arange(first, last)
    return {
        "disturbance": np.array(["wind" if i % 2 else "random" for i in ids], dtype=object),
        "realization": ids // 2,
    }


def numbers(case, seed=7):
    generator = np.random.Generator(np.random.Philox(np.random.SeedSequence(seed, spawn_key=(0, case))))
    return generator.standard_normal((INSTANTS, TERMS))


def compute(text, cases, device):
    options = json.loads(text)
    if set(options.get("poison", ())) & {int(case) for case in cases}:
        raise ValueError("the segment broke")
    _misbehave(options, cases)
    zernike = np.stack([numbers(int(case)) for case in cases])
    if "liar" in options and _is_liar(options["liar"]):
        zernike = np.nextafter(zernike, 9.0)
    status = np.full(len(cases), DONE, dtype=np.int8)
    messages = [""] * len(cases)
    for row, case in enumerate(cases):
        if case in options.get("reasons", ()):
            status[row], messages[row], zernike[row] = RAISED, f"case {case} loses a segment", np.nan
        if case in options.get("blow", ()):
            zernike[row, 2:, 1] = [np.inf, np.nan]
    arrays = {
        "time_s": np.tile(np.arange(INSTANTS) * 0.1, (len(cases), 1)),
        "zernike": zernike,
        "strehl": np.exp(-(zernike**2).sum(axis=(1, 2))),
        "count": cases.astype(np.int32) * 3,
    }
    return ChunkResult(arrays, status, tuple(messages), {"trace_s": 0.25})


def _is_liar(folder):
    """The first process that asks is a machine that computes wrong, and so it stays."""
    flag = os.path.join(folder, "liar")
    try:
        with open(flag, "x") as file:
            file.write(str(os.getpid()))
    except FileExistsError:
        time.sleep(0.02)  # until it is written
    with open(flag) as file:
        return file.read() == str(os.getpid())


def _talk():
    """Print in all ways that a library has."""
    print("a sentence of Python")
    warnings.warn("a warning of Python", stacklevel=1)
    os.write(2, b"\x1b[2Jlast words of C\n")
    thread = threading.Thread(target=lambda: 1 / 0)
    thread.start()
    thread.join()


def _misbehave(options, cases):
    if "count" in options:
        with open(options["count"], "a") as file:
            file.write("".join(f"{case}\n" for case in cases))
    for case in cases:
        time.sleep(options.get("sleep_s", 0.0))
        if case in options.get("say", ()):
            _talk()
        if case in options.get("crash", ()):
            os.kill(os.getpid(), signal.SIGSEGV)
        if case in options.get("wait", ()):
            time.sleep(10**6)
        if case in options.get("hang", ()):
            sum(range(10**15))  # holds the interpreter's lock: no thread of this process runs any more
        if case in options.get("hoard", ()):
            hoard = []
            while len(hoard) < 150:
                hoard.append(np.ones(2**22))  # 32 MB
                time.sleep(0.03)
        if case in options.get("once", ()):  # dies the first time only
            flag = os.path.join(options["folder"], f"died-{case}")
            if not os.path.exists(flag):
                open(flag, "x").close()
                os.kill(os.getpid(), signal.SIGKILL)


TOY = StudyKind("toy", template, case_table, compute)


def run(path, options=None, *, cases=40, chunk=10, on="serial", workers=None, **keywords):
    """Run a toy campaign with these study options."""
    from wavequake.campaign.engine.driver import run_campaign
    from wavequake.campaign.engine.driver_lock import shard_of

    if "shard" in keywords:
        keywords["shard"] = shard_of(keywords["shard"])
    # The sources may be edited while tests run.
    keywords.setdefault("allow_mixed", True)
    return run_campaign(
        TOY,
        study(**(options or {})),
        path,
        cases=cases,
        chunk=chunk,
        device="numpy",
        on=on,
        workers=workers,
        **keywords,
    )


def job(path, workflow=TOY, **fields):
    """Begin a run of a store and return its job, as workers get it."""
    from wavequake.campaign.engine.chunks import Job
    from wavequake.campaign.store.fence import begin

    latest = begin(path, "", (), 0)
    return Job(workflow, str(path), "numpy", latest.runs[""], epoch=latest.epoch, **fields)


def digests(path):
    """Digests of every chunk of a store; equal digests mean equal bits."""
    from wavequake.campaign.store.journal import read_journal

    return {chunk: dict(record.digests) for chunk, record in read_journal(path / "done").records.items()}


def driver(path, options=None, **keywords):
    """Start a campaign in a process of its own; it prints the number of cases computed, or "interrupted"."""
    script = (
        "import toy\n"
        "if __name__ == '__main__':\n"
        "    try:\n"
        f"        print(toy.run({str(path)!r}, {options!r}, **{keywords!r}).computed)\n"
        "    except KeyboardInterrupt:\n"
        "        print('interrupted')\n"
    )
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    return subprocess.Popen(
        [sys.executable, "-c", script],
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )


def records(path):
    """Number of records of finished chunks in the journal, duplicates counted."""
    lines = [line for file in (path / "done").glob("*.jsonl") for line in file.read_text().splitlines()]
    return sum('"counts":[0,' in line or bool(line and '"counts":' not in line) for line in lines)


def wait_for_records(path, count, timeout_s=120.0):
    """Return once the journal has at least `count` records, however busy the machine is."""
    end = time.monotonic() + timeout_s
    while records(path) < count:
        assert time.monotonic() < end, f"only {records(path)} records after {timeout_s} s"
        time.sleep(0.02)


def blas_threads():
    """Return the numbers of threads of all libraries of NumPy's and SciPy's kind; MKL is used with one."""
    return {pool["num_threads"] for pool in threadpool_info() if pool["internal_api"] == "openblas"}
