"""Where cases of segments are cut, on which device and by how many threads they are computed: bits stay."""
# ruff: noqa: F811  fixtures are arguments

from types import SimpleNamespace

import numpy as np
import pytest
from small_telescope import DEVICE, OPENCL, chunk, only_pistons, study, text  # noqa: F401
from threadpoolctl import threadpool_limits

from wavequake.kernels.device.devices import choose_device
from wavequake.workflows.segments import disturbance as workflow
from wavequake.workflows.segments import exposures, launches
from wavequake.workflows.segments.bench import bench_of
from wavequake.workflows.study import load_study, study_with


def test_a_case_alone_has_the_bits_that_it_has_in_a_chunk(text, chunk):
    for case in (0, 2, 11):
        alone = workflow.KIND.compute(text, np.array([case]), DEVICE)
        for name, values in alone.arrays.items():
            np.testing.assert_array_equal(values[0], chunk.arrays[name][case], err_msg=name)


def test_cases_that_stand_still_are_traced_once_and_do_not_depend_on_each_other(study):
    """They share tiles, at the place of their realization; the rest of the chunk moves."""
    bench = bench_of(study.identity_text())
    draws = [workflow.draw(bench, case) for case in range(60)]
    instants = [launches.traced_instants(drawn) for drawn in draws]
    still = [row for row, count in enumerate(instants) if count == 1]
    assert len(still) > 20
    assert {draws[row].population.name for row in still} == {"pistons", "figure", "both"}
    pieces = [piece for launch in launches.launches(draws, instants) for piece in launch]
    assert sum(piece.last - piece.first for piece in pieces) == sum(instants)
    tiles = {piece.place // 16 for piece in pieces if piece.row in still}
    assert len(tiles) < len(still) / 6
    text, cases = only_pistons(study).identity_text(), np.arange(5, 25)
    together = workflow.KIND.compute(text, cases, DEVICE).arrays
    for row in (0, 13, 19):
        alone = workflow.KIND.compute(text, cases[row : row + 1], DEVICE).arrays
        for name, values in alone.items():
            np.testing.assert_array_equal(values[0], together[name][row], err_msg=name)
            if values.ndim > 1 and name not in ("time_s", "exposure"):  # the same at every instant
                np.testing.assert_array_equal(values[0, :3], np.repeat(values[0, :1], 3, axis=0))


@pytest.mark.skipif(choose_device(DEVICE).kind != "cpu", reason="no OpenCL of a processor here")
def test_images_of_cases_that_stand_still_are_made_together(study, monkeypatch):
    made, images = [], exposures.still_images
    monkeypatch.setattr(exposures, "still_images", lambda *given: made.append(images(*given)) or made[-1])
    text, cases = only_pistons(study).identity_text(), np.arange(5, 25)
    found, twin = (workflow.KIND.compute(text, cases, device).arrays for device in (DEVICE, "numpy"))
    assert sum(map(len, made)) > len(cases) - 3  # some may be too steep for a few moments
    for name in ("exposure", "peak", "ee50"):
        np.testing.assert_allclose(found[name], twin[name], rtol=0, atol=1e-5, err_msg=name)


def test_where_a_long_case_is_cut_depends_on_it_alone(monkeypatch):
    """Exposures are sums over pieces, whose last bits are those of their order."""
    monkeypatch.setattr(launches, "_LAUNCH_TILES", 4)
    instants = [40, 1, 150, 17, 33, 1, 64, 65]
    draws = [SimpleNamespace(realization=row) for row in range(len(instants))]
    cut = list(launches.launches(draws, instants))
    assert all(piece.here.stop <= 64 for launch in cut for piece in launch)
    for row, count in enumerate(instants):
        alone = launches.launches(draws[row : row + 1], [count])
        bounds = [(piece.first, piece.last) for launch in alone for piece in launch]
        assert (bounds[0][0], bounds[-1][1]) == (0, count)
        assert [(one.first, one.last) for launch in cut for one in launch if one.row == row] == bounds
    last = [max(-(-piece.here.stop // 16) for piece in launch) for launch in cut]
    assert last == [3, 4, 4, 4, 3, 4, 4, 2]  # the two that stand still share a tile


@pytest.mark.skipif(not OPENCL, reason="no OpenCL device here")
def test_opencl_and_numpy_agree(text, chunk):
    """OPDs agree to about 1e-7 waves (rounding over 100 m), so Strehl ratios to a few times that."""
    twin = workflow.KIND.compute(text, np.arange(3), "numpy")
    for name, atol in {
        "zernike": 1e-4,
        "los": 1e-6,
        "wfe_rms_raw": 1e-4,
        "strehl": 1e-6,
        "exposure": 1e-5,
    }.items():
        np.testing.assert_allclose(chunk.arrays[name][:3], twin.arrays[name], rtol=0, atol=atol, err_msg=name)


def test_preparation_has_the_same_bits_on_any_number_of_threads():
    """The driver prepares on all its threads, workers on one; what is stored must not tell."""
    text = load_study("tmt-segments").identity_text()  # large enough for BLAS to split its work
    benches = []
    for threads in (1, 2):
        with threadpool_limits(threads):
            benches.append(bench_of.__wrapped__(text))
    for name in ("zernike", "los", "centroid", "strehl", "segment_phase"):
        np.testing.assert_array_equal(*(getattr(bench.static, name) for bench in benches))
    np.testing.assert_array_equal(*(bench.m2_tilt for bench in benches))
    np.testing.assert_array_equal(*(bench.prepared.fit.matrix for bench in benches))


def test_long_cases_are_cut_into_launches_without_changing_bits(study, monkeypatch):
    text = study_with(study, {"disturbance.mount.instants": 70}).identity_text()
    whole = workflow.KIND.compute(text, np.array([2, 3]), DEVICE)
    monkeypatch.setattr(launches, "_LAUNCH_TILES", 2)
    cut = workflow.KIND.compute(text, np.array([2, 3]), DEVICE)
    for name in ("zernike", "los", "strehl"):
        np.testing.assert_array_equal(cut.arrays[name], whole.arrays[name])
    np.testing.assert_allclose(cut.arrays["exposure"], whole.arrays["exposure"], rtol=1e-12)
