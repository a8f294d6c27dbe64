"""Cases of loops, mirrors and telescopes as lens files, traced anew, against what their stores hold."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from study_text import controller, part
from tests.recorded_studies import RECORDED

import wavequake as wq
from wavequake.campaign.schema import study_from_identity
from wavequake.campaign.store.store import read_manifest
from wavequake.errors import UserError
from wavequake.kernels.device.devices import NUMPY
from wavequake.kernels.device.tiles import TILE, from_tiles
from wavequake.kernels.trace.sequence import Rays
from wavequake.kernels.trace.sequential_numpy import trace_sequence_numpy
from wavequake.kernels.trace.status import OK
from wavequake.optics.rays.packing import moving, pack
from wavequake.optics.rays.pupils import segment_rays
from wavequake.optics.segments.alone import segment_systems
from wavequake.optics.segments.catalog import telescope as catalog_telescope
from wavequake.optics.segments.prepared import chief_rays, prepare, trace_states
from wavequake.optics.systems.kinematics import rest_states
from wavequake.optics.wavefronts.fits import fit_instants
from wavequake.optics.wavefronts.wavefront import prepare_system, trace_system
from wavequake.report.exports import case_states
from wavequake.report.exports.case_states import disturbed, segments_at
from wavequake.report.exports.lens_file import export_case
from wavequake.workflows.exposures.telescope_control import control_bench_of
from wavequake.workflows.loops import telescope_bench
from wavequake.workflows.loops.telescope_study import TelescopeLoopStudy
from wavequake.workflows.mirrors.bench import (
    aberrations_over_time,
    cases_of,
    study_of,
    variant_of,
)
from wavequake.workflows.mirrors.bench import bench_of as mirror_bench
from wavequake.workflows.mirrors.optics import optical_rows
from wavequake.workflows.segments import mor, mor_bench
from wavequake.workflows.segments.bench import MAS_PER_RAD, bench_of
from wavequake.workflows.segments.disturbance import draw
from wavequake.workflows.segments.launches import surface_states


def traced_alone(file, rays, number, wavelength, sphere):
    """Trace the rays of a telescope that hit a segment by its file; give which they are, and the light."""
    again, mine = wq.load_system(file), np.flatnonzero(rays.segment == number)
    slope = np.append(np.tan(again.fields[0]), 1.0)
    ahead = (slope / np.linalg.norm(slope))[:, None] * np.ones(len(mine))
    start = np.stack([rays.x[mine], rays.y[mine], np.zeros(len(mine))])
    light = Rays(start, ahead, (ahead * start).sum(axis=0))
    about = replace(moving(again, rest_states(again)), spheres=sphere)
    found = trace_sequence_numpy(pack(again, wavelength), light, about)
    assert (found.status == OK).all()
    return mine, found


def stored(name, folder, cases):
    """Return the small store of a bundled study."""
    keys = {key.replace(".", "__"): value for key, value in RECORDED[name].keys.items()}
    wq.run(RECORDED[name].study, store=folder / "store", cases=cases, **keys)
    return folder / "store"


def test_a_loops_case_is_that_under_the_controller(tmp_path, monkeypatch):
    small, store = RECORDED["image-stabilizer"], tmp_path / "store"
    text = wq.load_study(small.study, small.keys).identity_text()
    # Of a store, files are made by its study alone: no case is computed.
    manifest = SimpleNamespace(workflow="system-loop", study=text, cases=1)
    monkeypatch.setattr(case_states, "read_manifest", lambda store: manifest)
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
    pupil = mirror_bench(text, cases_of(study_of(text))[0][0]).optics.prepared.pupil
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
        mine, found = traced_alone(file, rays, number, bench.prepared.wavelength, sphere)
        np.testing.assert_allclose(found.x[0], x[mine], rtol=0, atol=1e-9)
        np.testing.assert_allclose(found.y[0], y[mine], rtol=0, atol=1e-9)
        paths[mine] = found.path[0]
    seen = np.isfinite(paths)
    assert opd[seen].std() > 1e-5
    away = (paths + opd)[seen] / bench.prepared.wavelength
    np.testing.assert_allclose(away - away.mean(), 0.0, rtol=0, atol=1e-5)


@pytest.mark.parametrize(("name", "terms", "some"), [("tmt-18", 21, (0, 7, 17)), ("elt", 15, (0, 400, 797))])
def test_segments_that_deform_are_lens_files(tmp_path, name, terms, some):
    """Polynomials about their centers, moved with them, beside the telescope's own trace of them."""
    telescope = catalog_telescope(name)
    prepared = prepare(telescope, segment_rays(telescope.segments, 3), 550e-6, 15, terms)
    states = rest_states(prepared.system, TILE)
    random = np.random.default_rng(5)
    states.segment_motion[0] = random.normal(size=(len(telescope.segments), 6)) * ([1e-3] * 3 + [1e-7] * 3)
    states.segment_figure[0] = random.normal(size=(len(telescope.segments), terms)) * 5e-5
    truth = trace_states(prepared, states, NUMPY)
    bare = trace_states(prepared, replace(states, segment_figure=0.0 * states.segment_figure), NUMPY)
    parts = dict(segment_systems(telescope, states, 0, [prepared.wavelength]))
    assert list(parts) == list(telescope.segments.names)
    x, y, opd, still = (from_tiles(one)[0] for one in (truth.x, truth.y, truth.opd, bare.opd))
    chief = from_tiles(chief_rays(prepared, states))[0]
    sphere = np.array([[*chief[:2], 0.0, prepared.train.sphere_radius]])
    for number in some:
        file = wq.write_zmx(parts[telescope.segments.names[number]], tmp_path / "one.zmx")
        again, mine = wq.load_system(file), np.flatnonzero(prepared.rays.segment == number)
        start = np.stack([prepared.rays.x[mine], prepared.rays.y[mine], np.zeros(len(mine))])
        ahead = np.array([[0.0], [0.0], [1.0]]) * np.ones(len(mine))
        about = replace(moving(again, rest_states(again)), spheres=sphere)
        found = trace_sequence_numpy(
            pack(again, prepared.wavelength), Rays(start, ahead, 0 * start[2]), about
        )
        assert (found.status == OK).all()
        np.testing.assert_allclose(found.x[0], x[mine], rtol=0, atol=1e-9)
        np.testing.assert_allclose(found.y[0], y[mine], rtol=0, atol=1e-9)
        away = (found.path[0] + opd[mine]) / prepared.wavelength
        np.testing.assert_allclose(away - away.mean(), 0.0, rtol=0, atol=1e-5)
        assert (opd - still)[mine].std() > 1e-4 * prepared.wavelength
    states.segment_figure[0] *= 1e3
    states = replace(states, segment_figure=np.pad(states.segment_figure, ((0, 0), (0, 0), (0, 45 - terms))))
    states.segment_figure[0, -1, -1] = 1.0
    with pytest.raises(UserError, match="about the vertex of M1, as lens files have them, they drown in"):
        list(segment_systems(telescope, states, 0, [550e-6]))


def small(monkeypatch, workflow, name):
    """Put the small form of a bundled study in the place of a store: files are made by its study alone."""
    text = wq.load_study(RECORDED[name].study, RECORDED[name].keys).identity_text()
    manifest = SimpleNamespace(workflow=workflow, study=text, cases=2)
    monkeypatch.setattr(case_states, "read_manifest", lambda store: manifest)
    return text


def test_a_shaken_segments_model_is_one_file_for_each_segment(tmp_path, monkeypatch):
    """Rays of the files, beside those of the telescope at rest, are what the study sees less one plane."""
    text = small(monkeypatch, "segment-mor", "tmt-segment-mor")
    study, prepared = study_of(text), mor_bench.model_of(text).bench.prepared
    telescope, instant = prepared.system, 5
    case, (disturbed, _) = next(one for one in enumerate(mor.cases_of(study)) if one[1][0] == "all")
    monkeypatch.setattr(case_states, "_manifest", lambda store, case: case_states.read_manifest(store))
    _, seen = mor.traced_reference(text, disturbed, "numpy")
    parts = segments_at(tmp_path, case, instant, study.excitation[0].name)
    assert list(parts) == list(telescope.segments.names)
    still = rest_states(telescope, TILE)
    before, chief = trace_states(prepared, still, NUMPY), chief_rays(prepared, still)
    sphere = np.array([[*from_tiles(chief)[0, :2], 0.0, prepared.train.sphere_radius]])
    rows, away = [], []
    for number in (5, 11, 17):
        again = wq.load_system(wq.write_zmx(parts[telescope.segments.names[number]], tmp_path / "one.zmx"))
        mine = np.flatnonzero(prepared.rays.segment == number)
        x, y = prepared.rays.x[mine], prepared.rays.y[mine]
        ahead = np.append(np.tan(again.fields[0]), 1.0)[:, None] * np.ones(len(mine))
        ahead /= np.linalg.norm(ahead, axis=0)
        start = np.stack([x, y, 0.0 * x])
        about = replace(moving(again, rest_states(again)), spheres=sphere)
        light = Rays(start, ahead, (ahead * start).sum(axis=0))
        paths = trace_sequence_numpy(pack(again, prepared.wavelength), light, about).path[0]
        rows.append(np.column_stack([np.ones_like(x), x, y]))
        away.append(paths + from_tiles(before.opd)[0, mine])
        away[-1] += from_tiles(seen["opd"][0])[instant, mine] * 1e-6
    rows, away = np.vstack(rows), np.concatenate(away) / prepared.wavelength
    left = away - rows @ np.linalg.lstsq(rows, away)[0]
    assert len(left) > 20
    np.testing.assert_allclose(left, 0.0, atol=1e-5)
    assert seen["opd"][0].std() * 1e-6 / prepared.wavelength > 1e-3


def test_mirrors_of_reduced_models_have_the_wavefront_of_their_stores(tmp_path, monkeypatch):
    """But for what is quadratic, which linear maps leave out: 4e-5 of 29 µm, 9e-6 of 11 µm."""
    for workflow, name in (("mirror-exposure", "mirror-exposure"), ("mirror-mor", "mirror-mor")):
        text = small(monkeypatch, workflow, name)
        model, variant = cases_of(study_of(text))[1]
        bench, excitation = mirror_bench(text, model), study_of(text).excitation[0].name
        rows = optical_rows(bench.optics, variant_of(bench, variant))
        expected = aberrations_over_time(study_of(text), variant_of(bench, variant), rows)[0]
        instant = int(np.argmax(np.abs(expected[:, 5:]).max(axis=1)))
        (file,) = export_case(tmp_path, tmp_path / f"{name}.zmx", 1, instant, under=excitation)
        again, pupil = wq.load_system(file), bench.optics.prepared.pupil
        prepared = prepare_system(again, *pupil.T, np.ones(len(pupil)), bench.optics.terms)
        opd, _, _ = trace_system(prepared, rest_states(again), NUMPY)
        found = fit_instants(prepared.fit, opd, NUMPY)[0] * prepared.wavelength * 1e6
        assert np.abs(expected[instant, 5:]).max() > 1.0
        np.testing.assert_allclose(
            found[3:], expected[instant, 5:], atol=1e-4 * np.abs(expected[instant]).max()
        )


def test_kinds_without_surfaces_are_refused(tmp_path):
    store = stored("lens-passive", tmp_path, 1)
    with pytest.raises(UserError, match="lens-passive, of whose cases no lens files are made"):
        export_case(store, tmp_path / "case.zmx", 0)


SHORT = {"duration_s": 0.1, "instants": 20}
TELESCOPE = "".join(
    [
        '[study]\nname = "small"\nworkflow = "telescope-{kind}"\n[telescope]\nname = "tmt-18"\n',
        "[imaging]\npixels = 16\n[wavefront]\nzernike_terms = 15\n[optics]\nrays_per_segment = 6\n",
        part("disturbance", name="all", model="combine", of=["mount", "segments", "tips"], instants=20),
        part("disturbance", name="tips", model="static-random", tip_nrad=20.0, tilt_nrad=20.0, instants=20),
        part("disturbance", name="segments", model="segment-history", peak_nm=100.0, **SHORT),
        part("disturbance", name="mount", model="line-of-sight", act="mount", rms_mas=10.0, **SHORT),
    ]
)
EXPOSED = TELESCOPE.replace("{kind}", "exposure")
LOOP = "".join(
    [
        TELESCOPE.replace("{kind}", "loop"),
        "[look]\ntraced = 2\n",
        part("sensor", name="sight", model="line-of-sight", rate_hz=1000.0),
        part("sensor", name="wavefront", model="wavefront", rate_hz=1000.0),
        part("actuator", name="tilt", model="m2-rigid"),
        part("actuator", name="figure", model="m2-figure", terms=11),
        controller("off", "off"),
        controller("rigid", "integrator", "sight", "tilt", bandwidth_hz=60.0),
        controller("elastic", "perfect", "wavefront", "figure", modes=10),
    ]
)


def wavefront_of(files, prepared):
    """Trace the files of all segments: rms beside the plane and of Noll 4 and up, nm; line of sight, mm."""
    waves, rays = np.full(len(prepared.weight), np.nan), prepared.rays
    chief = chief_rays(prepared, rest_states(prepared.system, TILE))[0, :2, 0]
    sphere = np.array([[*chief, 0.0, prepared.train.sphere_radius]])
    for number, file in enumerate(files):
        mine, found = traced_alone(file, rays, number, prepared.wavelength, sphere)
        waves[mine] = -found.path[0] / prepared.wavelength
    waves -= waves.mean()
    share = np.sqrt(prepared.weight)
    plane, zernike = (
        np.linalg.lstsq(share[:, None] * fit.basis, share * waves, rcond=None)[0]
        for fit in (prepared.plane, prepared.fit)
    )
    flat = np.sqrt(np.sum((share * (waves - prepared.plane.basis @ plane)) ** 2))
    steep = np.hypot(1.0, prepared.system.pupil.obscuration) * prepared.numerical_aperture
    los = chief - 2.0 * prepared.wavelength / steep * zernike[1:3]
    nm = 1e6 * prepared.wavelength
    return nm * flat, nm * np.linalg.norm(zernike[3:]), los


@pytest.mark.parametrize(
    ("text", "names"),
    [(EXPOSED, ("static", "disturbed", "rigid", "elastic")), (LOOP, ("off", "rigid", "elastic"))],
)
def test_a_telescopes_case_has_the_wavefront_that_its_store_holds(text, names, tmp_path):
    """Under each controller: line of sight, wavefront error; M2 tilts or deforms in the file."""
    path = tmp_path / "study.toml"
    path.write_text(text)
    wq.run(path, store=tmp_path / "store", cases=1, on="serial")
    study, held = read_manifest(tmp_path / "store").study, wq.open_store(tmp_path / "store").isel(case=0)
    if text is LOOP:
        bench = telescope_bench.bench_of(study_from_identity(TelescopeLoopStudy, study))
        control, instant, place, kept = bench.optics.control, 9, 0, "traced_"
    else:
        control, instant, place, kept = control_bench_of(study), 13, 13, ""
    nm, found = 1e6 * control.prepared.wavelength, {}
    with pytest.raises(UserError, match=f"controller of the case is meant: {', '.join(names)}"):
        export_case(tmp_path / "store", tmp_path / "case.zmx", 0, instant)
    with pytest.raises(UserError, match="there is no instant 20"):
        export_case(tmp_path / "store", tmp_path / "case.zmx", 0, 20, under=names[0])
    for name in names:
        files = export_case(tmp_path / "store", tmp_path / f"{name}.zmx", 0, instant, under=name)
        flat, rms, los = wavefront_of(files, control.prepared)
        mas = (los - control.static.los[0]) * MAS_PER_RAD / control.bench.first_order.focal_length
        one = held.sel(controller=name).isel({"traced" if kept else "time": place})
        assert rms == pytest.approx(float(one[f"{kept}wfe_rms"]), rel=0, abs=1e-5 * nm)
        assert kept or flat == pytest.approx(float(one["wfe_rms_flat"]), rel=0, abs=1e-5 * nm)
        np.testing.assert_allclose(mas, one[f"{kept}los"], rtol=0, atol=1e-3)
        found[name] = rms, np.linalg.norm(mas)
    first = "disturbed" if "disturbed" in names else "off"
    assert found["rigid"][1] < 0.7 * found[first][1]
    assert found["elastic"][0] < 0.7 * found[first][0]
