"""Reports, comparisons and exports of stores that are larger than what they may take of the memory."""

import os
import subprocess
import sys
import tracemalloc

import dask
import numpy as np
import pytest

from wavequake.campaign import provenance
from wavequake.campaign.contract import ChunkResult
from wavequake.campaign.statistics import blocks
from wavequake.campaign.statistics.judged import judged_in
from wavequake.campaign.statistics.until import Goal, quantiles_of
from wavequake.campaign.store.arrays import array_of, open_group, write_chunk
from wavequake.campaign.store.journal import Record, append
from wavequake.campaign.store.store import create_store, open_store
from wavequake.campaign.store.verify import verify_store
from wavequake.kernels.device.devices import choose_device
from wavequake.report.answers.comparison import compare
from wavequake.report.answers.tail import per_case
from wavequake.report.exports.store import export
from wavequake.workflows.run import run_study
from wavequake.workflows.segments import disturbance as segment_disturbance
from wavequake.workflows.study import load_study

CASES, CHUNK = 5_000, 500
MEASURED = """
import os, sys
from wavequake import cli

def peak(words):  # of this process alone, in MB: ru_maxrss may be that of the process that started it
    sys.argv = ["wavequake", *words]
    try:
        cli.main()
    except SystemExit as end:
        assert not end.code, end.code
    (line,) = (line for line in open("/proc/self/status") if line.startswith("VmHWM"))
    return int(line.split()[1]) / 1024

os.chdir(sys.argv[1])
words = sys.argv[2:]
# Small stores first: what is loaded and drawn anyway.
before = peak([word.replace("large", "small") for word in words])
print("GREW", peak(words) - before)
"""


def random_store(path, seed, cases, chunk=CHUNK):
    """Write a store of random numbers, 32 kB per case of them images, as a campaign would."""
    keys = {"telescope.name": "tmt-18", "optics.rays_per_segment": 6, "campaign.cases": cases}
    keys |= {"imaging.pixels": 64, "optics.wavelength_nm": 550.0 + seed}
    text = load_study("tmt-segments", keys).identity_text()
    workflow, words = segment_disturbance.KIND, provenance.collect(choose_device("numpy"))
    manifest = create_store(path, workflow, text, cases, chunk, "numpy", words)
    variables, group = workflow.template(text).per_case, open_group(path / "data.zarr")
    arrays = {name: array_of(group, name) for name in manifest.variables}
    random = np.random.default_rng(seed)
    numbers = {
        name: (random.random((chunk, *one.shape)) + 0.5).astype(one.dtype) for name, one in variables.items()
    }
    numbers["time_s"][:] = np.arange(1, 17) * 0.01
    for first in range(0, cases, chunk):
        result = ChunkResult(numbers, np.ones(chunk, dtype=np.int8), ("",) * chunk)
        digests = write_chunk(arrays, (first, first + chunk), result)
        append(path / "done", Record(first, first + chunk, digests, (0, chunk, 0, 0, 0, 0), {}, {}))


@pytest.fixture(scope="module")
def stores(tmp_path_factory):
    folder = tmp_path_factory.mktemp("large")
    for seed in (1, 2):
        random_store(folder / f"large{seed}", seed, CASES)
        random_store(folder / f"small{seed}", seed, CHUNK)
    return folder


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "most"),
    [(["compare", "large1", "large2"], 150.0), (["report", "large1"], 100.0)],
    ids=["compare", "report"],
)
def test_commands_take_a_part_of_the_store_into_memory_at_a_time(stores, words, most):
    """The images of one store are 160 MB, those that are compared 320 MB; on a machine of 16 processors."""
    command = [sys.executable, "-c", MEASURED, stores, *words]
    # One arena of the C library: with one per thread, what it keeps of freed memory varies by 30 MB.
    alone = {**os.environ, "MALLOC_ARENA_MAX": "1", "DASK_NUM_WORKERS": "16"}
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=alone)
    assert "GREW" in done.stdout, done.stderr[-2000:]
    assert float(done.stdout.split("GREW")[1]) < most, done.stdout[-80:]


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    """A store of 80 MB in 10 chunks."""
    path = tmp_path_factory.mktemp("store") / "s"
    random_store(path, 1, 2000, 200)
    return path


COMMANDS = {
    "verify": verify_store,
    "tail": lambda path: per_case(open_store(path), judged_in("wfe_rms_raw", open_store(path)), "rms"),
    "until": lambda path: quantiles_of(Goal("zernike[noll=4]", 0.9, 0.1), open_store(path)),
    "compare": lambda path: compare(open_store(path), open_store(path), "one", "two"),
    "csv": lambda path: export(open_store(path), path / "a.csv"),
    "nc": lambda path: export(open_store(path), path / "a.nc"),
    "fits": lambda path: export(open_store(path), path / "a.fits"),
}


@pytest.mark.parametrize("command", COMMANDS.values(), ids=list(COMMANDS))
def test_what_reads_a_whole_store_holds_a_part_of_it(store, tmp_path, command, monkeypatch):
    monkeypatch.setattr(blocks, "BLOCK_BYTES", 2**22)
    random_store(tmp_path / "small", 1, 20, 10)
    # In one thread, so that as many chunks are in memory everywhere.
    with dask.config.set(scheduler="synchronous"):
        command(tmp_path / "small")  # imports what it needs, which takes up to 30 MB at the first time
        tracemalloc.start()
        found = command(store)
        _, peak = tracemalloc.get_traced_memory()
        tracemalloc.stop()
    assert getattr(found, "ok", True)
    assert open_store(store).nbytes > 80e6
    assert peak < 35e6


def test_a_csv_is_the_same_whatever_the_size_of_its_blocks(tmp_path, monkeypatch):
    keys = {"telescope.name": "tmt-18", "optics.rays_per_segment": 6, "campaign.cases": 23}
    run_study(load_study("tmt-segments", {**keys, "imaging.enabled": False}), tmp_path / "s", on="serial")
    export(open_store(tmp_path / "s"), tmp_path / "one.csv")
    monkeypatch.setattr("wavequake.campaign.statistics.blocks.BLOCK_BYTES", 2000)
    export(open_store(tmp_path / "s"), tmp_path / "many.csv")
    assert (tmp_path / "one.csv").read_bytes() == (tmp_path / "many.csv").read_bytes()
    assert len((tmp_path / "one.csv").read_text().splitlines()) == 24
