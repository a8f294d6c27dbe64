"""The telescope at rest from disk: the same bits, and others for another telescope, light or field."""

import numpy as np
import pytest

from wavequake import tables
from wavequake.optics.segments import at_rest
from wavequake.workflows.segments import bench
from wavequake.workflows.study import load_study

SMALL = {"telescope.name": "tmt-18", "optics.rays_per_segment": 6, "wavefront.zernike_terms": 11}


@pytest.fixture
def traced(tmp_path, monkeypatch):
    """Give a function that prepares a study as a new process does, and says whether it was traced."""
    calls = []
    trace = at_rest._traced
    monkeypatch.setattr(tables, "table_folder", lambda: tmp_path)
    monkeypatch.setattr(at_rest, "_traced", lambda *given: calls.append(0) or trace(*given))

    def prepare(**keys):
        calls.clear()
        text = load_study("tmt-segments", SMALL | keys).identity_text()
        return bench._prepared(text), len(calls)

    return prepare


def test_a_second_process_traces_nothing_and_has_the_same_bits(traced):
    (first, once), (second, never) = traced(), traced()
    assert (once, never) == (1, 0)
    for name in ("zernike", "los", "segment_phase", "lost", "lost_segments"):
        one, other = getattr(first.static, name), getattr(second.static, name)
        assert one.dtype == other.dtype
        np.testing.assert_array_equal(one, other)
    np.testing.assert_array_equal(first.m2_tilt, second.m2_tilt)
    assert first.stopped == second.stopped


@pytest.mark.parametrize(
    "keys",
    [
        {"telescope.side_mm": 700.0},
        {"optics.wavelength_nm": 1000.0},
        {"optics.field_arcmin": [0.0, 1.0]},
        {"optics.rays_per_segment": 18},
        {"wavefront.zernike_terms": 10},
        {"wavefront.method": "slopes"},
        {"disturbance.alignment.figure_nm": {"4": 10.0}},
    ],
    ids=lambda keys: next(iter(keys)),
)
def test_what_changes_the_reference_is_traced_anew(traced, keys):
    traced()
    assert traced(**keys)[1] == 1


def test_what_does_not_change_it_is_not(traced):
    traced()
    assert traced(**{"study.seed": 5, "imaging.pixels": 16})[1] == 0
