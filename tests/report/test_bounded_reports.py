"""Tables of stores that are larger than what they may take of the memory, without any file."""

import tracemalloc
from pathlib import Path

import dask
import numpy as np
import pytest
import xarray as xr
from dask.array import full

from wavequake.campaign.contract import DONE
from wavequake.report.exposures import report as exposures
from wavequake.report.mirrors import exposures as mirror_exposures
from wavequake.report.mirrors import report as mirrors
from wavequake.report.mirrors import traces as mirror_traces
from wavequake.report.mirrors.variants import few
from wavequake.workflows.kinds import find_kind
from wavequake.workflows.mirrors import model_store
from wavequake.workflows.study import load_study

MIRROR = {
    "model.shapes": ["circular"],
    "model.rings": 2,
    "reduction.variants": [f"modal{order}" for order in range(7, 17)],
    "optics.zernike_terms": 11,
    "time.duration_s": 8.0,
}
IMAGES = {"imaging.pixels": 128, "imaging.pupil_samples": 32, "imaging.instants": 21}
# Study, its report, keys, how often its cases are repeated, and what the table is made of.
STORES = [
    ("mirror-mor", mirrors, MIRROR, 1, ("wfe_error", "los_error")),
    ("mirror-trace", mirror_traces, MIRROR, 1, ("wfe_rms_standard", "wfe_difference", "los_difference")),
    ("mirror-exposure", mirror_exposures, MIRROR | IMAGES, 1, ("wfe_rms", "los_mm", "exposure")),
    ("tmt-exposure", exposures, {"disturbance.history.instants": 4000}, 20, ("wfe_rms", "los")),
]


def lazy_store(name, keys, copies):
    """Return a store of made-up numbers, each case of the study so many times, in chunks as if from files."""
    study = load_study(name, keys)
    text = study.identity_text()
    workflow = find_kind(study.study.workflow)
    template = workflow.template(text)
    first = study.cases
    cases = first * copies
    chunk = max(1, cases // 10)
    numbers = {
        key: (("case", *one.dims), full((cases, *one.shape), 0.5, chunks=(chunk, *one.shape)), one.attrs)
        for key, one in template.per_case.items()
    }
    labels = {
        key: ("case", np.tile(values, copies)) for key, values in workflow.case_table(text, 0, first).items()
    }
    fixed = {key: (dims, values, attrs) for key, (dims, values, attrs) in template.fixed.items()}
    ends = {"status": ("case", np.full(cases, DONE)), "message": ("case", np.full(cases, ""))}
    return xr.Dataset(
        numbers | ends | {key: one for key, one in fixed.items() if one[0] != (key,)},
        labels | {key: one for key, one in fixed.items() if one[0] == (key,)} | {"case": np.arange(cases)},
        {"study": text},
    )


@pytest.fixture(autouse=True, scope="module")
def models(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        folder = tmp_path_factory.mktemp("models")
        patch.setattr(model_store, "model_folder", lambda: folder)
        yield


@pytest.mark.parametrize(("name", "report", "keys", "copies", "read"), STORES, ids=[one[0] for one in STORES])
def test_tables_are_made_chunk_by_chunk(name, report, keys, copies, read):
    dataset = lazy_store(name, keys, copies)
    size = sum(dataset[key].nbytes for key in read)
    assert size > 15e6
    report.table_of(Path(), dataset.isel(case=slice(2)))  # loads what is loaded once
    tracemalloc.start()
    with dask.config.set(scheduler="synchronous"):  # the peak shall not depend on the number of threads
        table = report.table_of(Path(), dataset)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert table.row_count > 2
    assert peak < 0.35 * size


@pytest.mark.parametrize("count", [0, 1, 5, 12, 13, 1000])
def test_few_keeps_both_ends_and_the_order(count):
    kept = few(range(count))
    assert len(kept) == min(count, 12)
    assert kept == sorted(set(kept))
    assert {*kept[:1], *kept[-1:]} == {*range(count)[:1], *range(count)[-1:]}
