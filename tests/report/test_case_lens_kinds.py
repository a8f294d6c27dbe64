"""Cases of loops, mirrors and telescopes as lens files, traced anew, against what their stores hold."""

from dataclasses import replace

import numpy as np
import pytest
from tests.recorded_studies import RECORDED

import wavequake as wq
from wavequake.campaign.store.store import read_manifest
from wavequake.errors import UserError
from wavequake.kernels.device.devices import NUMPY
from wavequake.kernels.device.tiles import TILE, from_tiles
from wavequake.kernels.trace.sequence import Rays
from wavequake.kernels.trace.sequential_numpy import trace_sequence_numpy
from wavequake.kernels.trace.status import OK
from wavequake.optics.rays.packing import moving, pack
from wavequake.optics.segments.alone import segment_systems
from wavequake.optics.segments.catalog import telescope as catalog_telescope
from wavequake.optics.segments.prepared import chief_rays, trace_states
from wavequake.optics.segments.states import rest
from wavequake.optics.systems.kinematics import rest_states
from wavequake.optics.wavefronts.fits import fit_instants
from wavequake.optics.wavefronts.wavefront import prepare_system, trace_system
from wavequake.report.exports.case_states import disturbed
from wavequake.report.exports.lens_file import export_case
from wavequake.workflows.mirrors.bench import bench_of as mirror_bench
from wavequake.workflows.mirrors.bench import cases_of, trace_study_of
from wavequake.workflows.segments.bench import bench_of
from wavequake.workflows.segments.disturbance import draw
from wavequake.workflows.segments.launches import surface_states


def stored(name, folder, cases):
    """Return the small store of a bundled study."""
    keys = {key.replace(".", "__"): value for key, value in RECORDED[name].keys.items()}
    wq.run(RECORDED[name].study, store=folder / "store", cases=cases, **keys)
    return folder / "store"


def test_a_loops_case_is_that_under_the_controller(tmp_path):
    store = stored("image-stabilizer", tmp_path, 1)
    with pytest.raises(UserError, match="--under which controller of the case is meant: off, perfect"):
        export_case(store, tmp_path / "case.zmx", 0)
    ends = {}
    for name in ("off", "perfect"):
        (file,) = export_case(store, tmp_path / f"{name}.zmx", 0, 2, under=name)
        again = wq.load_system(file)
        system, states = disturbed(store, 0, name)
        still = rest_states(system)
        moved = states.surface_motion[2:3]
        assert states.line_of_sight[2].any() or moved.any()
        x, y = np.random.default_rng(3).uniform(-0.6, 0.6, (2, 40)) * system.pupil.value / 2.0
        start = np.stack([x, y, np.full(40, system.surfaces[0].position[2] - 30.0)])
        ahead = np.array([[0.0], [0.0], [1.0]]) * np.ones(40)
        if states.line_of_sight[2].any():
            ahead = np.concatenate([np.tan(again.fields[0])[:, None] * np.ones(40), np.ones((1, 40))])
            ahead = ahead / np.linalg.norm(ahead, axis=0)
        here = Rays(start, ahead, np.zeros(40))
        there = Rays(
            start - [[0.0], [0.0], [system.surfaces[0].position[2] + moved[0, 0, 2]]], ahead, here.path
        )
        still.surface_motion[:] = moved
        ours, theirs = (
            trace_sequence_numpy(pack(one, 550e-6), rays, moving(one, state), True)
            for one, rays, state in ((system, here, still), (again, there, rest_states(again)))
        )
        assert (ours.status == OK).all()
        assert (theirs.status == OK).all()
        for key in ("x", "y", "path"):
            np.testing.assert_allclose(getattr(theirs, key), getattr(ours, key), rtol=0, atol=1e-9)
        ends[name] = theirs.x
    assert np.abs(ends["off"] - ends["perfect"]).max() > 1e-6


def test_a_mirrors_figure_is_that_of_the_excitation_with_what_polynomials_leave(tmp_path):
    """The file's light has the wavefront error that the store holds of every ray."""
    store = stored("mirror-trace-residual", tmp_path, 1)
    held, text = wq.open_store(store), read_manifest(store).study
    pupil = mirror_bench(text, cases_of(trace_study_of(text))[0][0]).optics.prepared.pupil
    for name in ("sine100", "sine300"):
        (file,) = export_case(store, tmp_path / f"{name}.zmx", 0, 12, under=name)
        again = wq.load_system(file)
        prepared = prepare_system(again, *pupil.T, np.ones(len(pupil)), 21)
        opd, _, _ = trace_system(prepared, rest_states(again), NUMPY)
        flat = opd - fit_instants(prepared.fit, opd, NUMPY)[:, :3] @ prepared.fit.basis[:, :3].T
        raw = np.sqrt(np.mean(flat**2)) * prepared.wavelength * 1e6
        expected = float(held["wfe_rms_raw"].sel(case=0, excitation=name)[12])
        assert expected > 1.0
        assert raw == pytest.approx(expected, rel=1e-9)


def test_each_segment_of_a_telescope_is_a_lens_file(tmp_path):
    """All segments' files together have the light of the telescope's own trace, moved as it was."""
    store = stored("tmt18-history", tmp_path, 1)
    bench = bench_of(read_manifest(store).study)
    drawn = draw(bench, 0)
    states = surface_states(bench, drawn, 0, len(drawn.time))
    assert np.abs(states.segment_motion).max() > 1e-7
    instant, rays = len(drawn.time) - 1, bench.prepared.rays
    truth = trace_states(bench.prepared, states, NUMPY)
    files = export_case(store, tmp_path / "case.zmx", 0, instant)
    segments = bench.system.segments
    assert [file.name for file in files] == [f"case-{one}.zmx" for one in segments.names]
    x, y, opd = (from_tiles(values)[instant] for values in (truth.x, truth.y, truth.opd))
    paths, chief = np.full(len(x), np.nan), from_tiles(chief_rays(bench.prepared, states))[instant]
    sphere = np.array([[*chief[:2], 0.0, bench.prepared.train.sphere_radius]])
    for number, file in enumerate(files[:4]):
        again, mine = wq.load_system(file), np.flatnonzero(rays.segment == number)
        slope = np.append(np.tan(again.fields[0]), 1.0)
        ahead = (slope / np.linalg.norm(slope))[:, None] * np.ones(len(mine))
        start = np.stack([rays.x[mine], rays.y[mine], np.zeros(len(mine))])
        light = Rays(start, ahead, (ahead * start).sum(axis=0))
        about = replace(moving(again, rest_states(again)), spheres=sphere)
        found = trace_sequence_numpy(pack(again, bench.prepared.wavelength), light, about)
        assert (found.status == OK).all()
        np.testing.assert_allclose(found.x[0], x[mine], rtol=0, atol=1e-9)
        np.testing.assert_allclose(found.y[0], y[mine], rtol=0, atol=1e-9)
        paths[mine] = found.path[0]
    seen = np.isfinite(paths)
    assert opd[seen].std() > 1e-5
    away = (paths + opd)[seen] / bench.prepared.wavelength
    np.testing.assert_allclose(away - away.mean(), 0.0, rtol=0, atol=1e-5)


def test_segments_that_deform_and_kinds_without_surfaces_are_refused(tmp_path):
    telescope = catalog_telescope("tmt-18")
    states = rest(TILE, 18, len(telescope.surfaces), 6)
    states.segment_figure[0, 3, 4] = 1e-6
    with pytest.raises(UserError, match="deform, each about its own center"):
        list(segment_systems(telescope, states, 0, [550e-6]))
    store = stored("lens-passive", tmp_path, 1)
    with pytest.raises(UserError, match="lens-passive, whose cases are no states of one optical system"):
        export_case(store, tmp_path / "case.zmx", 0)
