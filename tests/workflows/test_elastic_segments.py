"""Segments that deform as well as move, against the dense model, rigid segments and segment-mor."""

from types import SimpleNamespace

import numpy as np
import pytest
from small_pistons import HEAD
from small_segments import text_of

import wavequake as wq
from wavequake.errors import UserError
from wavequake.kernels.device.devices import choose_device
from wavequake.mechanics.disturbances.sources.base_motion import below
from wavequake.reduction.metrics import receptance
from wavequake.report.answers.accuracy import plan_accuracy
from wavequake.report.answers.errors import spread_ids, store_errors
from wavequake.report.answers.errors_shown import errors_notes
from wavequake.workflows.allow import allowances
from wavequake.workflows.kinds import study_of
from wavequake.workflows.mirrors.segment_body import build_segment, hexagon_of, motion_rows
from wavequake.workflows.segments.bench import bench_of
from wavequake.workflows.segments.disturbance import KIND, draw
from wavequake.workflows.segments.mor import traced
from wavequake.workflows.segments.mor_bench import model_of
from wavequake.workflows.study import load_study

pytestmark = pytest.mark.usefixtures("mirror_models")

STUDY = (
    HEAD
    + """[optics]
rays_per_segment = 18
[wavefront]
zernike_terms = 11
[imaging]
enabled = false
[campaign]
cases = 4
device = "numpy"
"""
)
# As in small_segments.py.
ELASTIC = """
[segment]
thickness_m = 0.5
spring_n_m = [5e8, 5e8, 5e8]
divisions = 3
figure_terms = 11
last_hz = 400.0
"""


def shaking(keys):
    return f'[[disturbance]]\nname = "cell"\nmodel = "segment-shaking"\ninstants = 16\n{keys}\n'


def loaded(folder, *parts, **keys):
    path = folder / "study.toml"
    path.write_text("\n".join((STUDY, *parts)))
    return load_study(path, {key.replace("__", "."): value for key, value in keys.items()})


def drawn(study, case=0):
    bench = bench_of(study.identity_text())
    return bench, draw(bench, case)


def swings(time, values, frequency):
    """Return the complex amplitudes of what is a sinusoid of a frequency at all instants."""
    phase = 2.0 * np.pi * frequency * time
    basis = np.column_stack([np.cos(phase), -np.sin(phase)])
    found = np.linalg.lstsq(basis, values.reshape(len(time), -1))[0]
    np.testing.assert_allclose(basis @ found, values.reshape(len(time), -1), atol=1e-9 * np.abs(values).max())
    return (found[0] + 1j * found[1]).reshape(values.shape[1:])


def test_a_segment_answers_as_its_dense_finite_element_model_does(tmp_path):
    """(K - w² M + i w D) x = sum of k u at the supports: shift across, lift and turn of the cell."""
    line = "{ frequency_hz = 70.0, amplitude = { dx_um = 0.3, dz_um = 0.2, ry_urad = 0.1 } }"
    study = loaded(tmp_path, ELASTIC, shaking(f'segments = ["8"]\nlines = [{line}]'))
    bench, case = drawn(study)
    moved, omega = case.motion.segment_motion, 2.0 * np.pi * 70.0
    assert not np.delete(moved, 7, axis=1).any()
    found = np.concatenate(
        [swings(case.time, one[:, 7], 70.0) for one in (moved, case.motion.segment_figure)]
    )
    side, turn = hexagon_of(bench.system)
    full = build_segment(study.segment, side, bench.system.primary.shape.radius)
    stiff = (full.stiffness - omega**2 * full.mass + 1j * omega * full.damping_matrix).toarray()
    fit = model_of(text_of()).fit
    rows = (
        motion_rows(fit, turn, SimpleNamespace(order=len(stiff), surface=np.asarray(full.surface.todense())))
        * np.repeat([1e-3, 1.0, 1e-3], [3, 3, 11])[:, None]
    )
    cosine, sine = np.cos(turn), np.sin(turn)
    to_model = np.array([[cosine, sine, 0.0], [-sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    answers = []
    for shift, spin in (([0.3e-6, 0, 0], [0, 0, 0]), ([0, 0, 0.2e-6], [0, 0, 0]), ([0, 0, 0], [0, 1e-7, 0])):
        ends = [
            to_model @ np.array(shift, float) + np.cross(to_model @ np.array(spin, float), place)
            for place in full.nodes[full.interfaces]
        ]
        answers.append(rows @ np.linalg.solve(stiff, full.inputs @ (5e8 * np.concatenate(ends))))
    # Phases of the three are random: what is drawn is a sum of the three answers, each turned.
    mix = np.linalg.lstsq(np.array(answers).T, found)[0]
    np.testing.assert_allclose(np.abs(mix), 1.0, rtol=1e-8)
    np.testing.assert_allclose(np.array(answers).T @ mix, found, rtol=0, atol=1e-8 * np.abs(found[6:]).max())
    assert np.abs(found[6:]).max() > 1e-3 * np.abs(found[:3]).max()


def test_one_shaken_segment_is_that_of_segment_mor(tmp_path):
    """The same receptance, and the same wavefront of the telescope for the same motion."""
    line = "{ frequency_hz = 20.0, amplitude = { dz_um = 0.005 } }"
    study = loaded(tmp_path, ELASTIC, shaking(f'segments = ["8"]\nlines = [{line}]'))
    text, model = text_of(), model_of(text_of())
    bench, case = drawn(study)
    rows = motion_rows(model.fit, model.turn, model.reference)
    there = receptance(model.reference, np.array([20.0]), rows)[0]
    expected = there @ (5e8 * 5e-9 * np.tile([0.0, 0.0, 1.0], 3))
    motion = np.concatenate([case.motion.segment_motion, case.motion.segment_figure], axis=2)[:, 7]
    motion = motion * np.repeat([1e3, 1.0, 1e3], [3, 3, 11])  # mm and rad
    found = swings(case.time, motion, 20.0)
    phase = found[2] / expected[2]
    assert abs(phase) == pytest.approx(1.0, rel=1e-9)
    np.testing.assert_allclose(found, phase * expected, rtol=0, atol=1e-9 * np.abs(expected[6:]).max())
    seen = traced(study_of(text), model.bench, "one", motion[None, :, None], choose_device("numpy"))
    result = KIND.compute(study.identity_text(), np.array([0]), "numpy")
    change = result.arrays["zernike"][0] - bench.static.zernike[0] * 550.0
    expected = seen["wfe_zernike"][0]
    np.testing.assert_allclose(np.linalg.norm(change[:, 3:], axis=1), expected, rtol=1e-9, atol=1e-9)


def test_stiff_segments_have_the_numbers_of_rigid_ones(tmp_path):
    """Every segment's cell shakes by itself; the same rigid motions from a file, without a figure."""
    line = "{ frequency_hz = 15.0, amplitude = { dz_um = 0.05, rx_urad = 0.01, ry_urad = 0.01 } }"
    stiff = loaded(
        tmp_path,
        ELASTIC,
        shaking(f"lines = [{line}]"),
        segment__youngs_modulus_pa=9e15,
        segment__last_hz=300.0,
    )
    bench, case = drawn(stiff)
    moved = case.motion.segment_motion
    assert np.abs(case.motion.segment_figure).max() < 1e-4 * np.abs(moved[..., 2]).max()
    kinds = ("dx_um", "dy_um", "dz_um", "rx_urad", "ry_urad", "rz_urad")
    header = ",".join(f"{name}.{kind}" for name in bench.layout.names for kind in kinds)
    table = np.column_stack([case.time, moved.reshape(16, -1) * 1e6])
    np.savetxt(tmp_path / "moved.csv", table, delimiter=",", header="time_s," + header, comments="")
    rigid = loaded(tmp_path, '[[disturbance]]\nname = "given"\nmodel = "surface-history"\nfile = "moved.csv"')
    one, two = (
        KIND.compute(study.identity_text(), np.array([0]), "numpy").arrays for study in (stiff, rigid)
    )
    for name in ("wfe_rms", "wfe_rms_raw", "los", "strehl", "segment_piston_rms"):
        np.testing.assert_allclose(one[name], two[name], rtol=0, atol=1e-5 * np.abs(two[name]).max())


def test_a_cell_that_moves_slowly_as_one_carries_all_segments_along(tmp_path):
    """A turn of the cell about the origin turns M1: no figure, and the sight by twice the angle."""
    line = "{ frequency_hz = 1e-2, amplitude = { rx_urad = 0.05 } }"
    study = loaded(tmp_path, ELASTIC, shaking(f'cell = "as one"\nlines = [{line}]'))
    bench, case = drawn(study)
    turn = case.motion.segment_motion[:, 0, 3:] @ bench.layout.axes[0].T
    expected = below(bench.layout, np.pad(turn, ((0, 0), (3, 0))).astype(complex)).real
    np.testing.assert_allclose(
        case.motion.segment_motion, expected, rtol=0, atol=1e-6 * np.abs(expected).max()
    )
    assert np.abs(case.motion.segment_figure).max() < 1e-6 * np.abs(expected).max()
    los = KIND.compute(study.identity_text(), np.array([0]), "numpy").arrays["los"][0]
    angle = np.abs(turn[:, 0]).max() * 180.0 / np.pi * 3600e3
    # Its coma, of an f/1 mirror, takes 1.4 % of the fitted tilt.
    assert np.linalg.norm(los, axis=1).max() == pytest.approx(2.0 * angle, rel=2e-2)


def test_random_shaking_has_the_variance_of_the_spectrum_times_the_response(tmp_path):
    """Displacement from 2 to 6 Hz, far below resonance: segments follow, each by itself."""
    keys = 'quantity = "displacement"\naxes = ["z"]\nspectrum = { rms = 1e-8, low_hz = 2.0, high_hz = 6.0 }'
    study = loaded(tmp_path, ELASTIC, shaking(keys + "\nduration_s = 3.0"), campaign__cases=30)
    bench = bench_of(study.identity_text())
    lifts = np.array([draw(bench, case).motion.segment_motion[..., 2] for case in range(30)])
    of_each = np.mean(lifts**2, axis=1).ravel()  # 540 independent ones
    assert abs(of_each.mean() / 1e-16 - 1.0) < 3.0 * of_each.std() / np.sqrt(540) / 1e-16 + 0.01
    together = np.corrcoef(lifts.transpose(2, 0, 1).reshape(18, -1))
    assert np.abs(together - np.eye(18)).max() < 0.3


def test_reduced_models_are_shaken_alike(tmp_path):
    """A reduced model as good as the full one has its motion; a poor one another figure."""
    cell = shaking("spectrum = { rms = 1e-4, low_hz = 10.0, high_hz = 150.0 }")
    full, good, poor = (
        drawn(loaded(tmp_path, ELASTIC, cell, segment__reduced=name))[1].motion
        for name in ("full", "craigb99", "guyan9")
    )
    scale = np.abs(full.segment_figure).max()
    assert np.abs(good.segment_figure - full.segment_figure).max() < 1e-3 * scale
    assert np.abs(poor.segment_figure - full.segment_figure).max() > 1e-2 * scale


@pytest.mark.parametrize(
    ("parts", "words"),
    [
        ((shaking("spectrum = { rms = 1.0 }"),), "add the section \\[segment\\]"),
        (
            (ELASTIC, '[[disturbance]]\nname = "a"\nmodel = "static-random"\npiston_nm = 1.0'),
            "segment-shaking",
        ),
        ((ELASTIC, shaking("")), "shakes nothing"),
        ((ELASTIC + 'reduced = "craigb1000"', shaking("spectrum = { rms = 1.0 }")), "1000"),
    ],
)
def test_what_is_wrong_with_elastic_segments_is_said(tmp_path, parts, words):
    with pytest.raises(UserError, match=words):
        drawn(loaded(tmp_path, *parts))


LINE = "lines = [{ frequency_hz = 120.0, amplitude = { dz_um = 0.1 } }]"


def test_a_study_of_one_reduced_model_errs_by_what_the_full_one_says(tmp_path):
    parts = ELASTIC + 'reduced = "craigb10"', shaking(LINE)
    study = loaded(tmp_path, *parts, campaign__cases=6)
    reduced = wq.run(study, store=tmp_path / "s", on="serial")
    found = store_errors(tmp_path / "s", 3)
    full = wq.run(
        loaded(tmp_path, *parts, campaign__cases=6, segment__reduced="full"),
        store=tmp_path / "f",
        on="serial",
    )
    ids = spread_ids(np.ones(6, dtype=bool), 3)
    both = [np.sqrt((one.wfe_rms_raw.isel(case=ids) ** 2).mean("time")) for one in (reduced, full)]
    exact = float(np.sqrt(((both[0] - both[1]) ** 2).mean()))
    names = found["name"].to_numpy().tolist()
    error = found["error"].sel(origin="reduction").isel(measure=names.index("wfe_rms_raw"))
    np.testing.assert_allclose(float(error[0]), exact, rtol=1e-6)
    assert exact > 0.0
    words = list(errors_notes(found))
    steps = "segment.reduced=craigb10; segment.reduced=craigb20; segment.reduced=full"
    assert any(steps in one for one in words)
    assert not any("all stored cases" in one for one in words)
    planned = plan_accuracy(study, 0.9, "wfe_rms_raw")
    assert planned["order"].startswith("segment.reduced=craigb10 ")


def test_allowances_count_what_an_elastic_segment_does_once(tmp_path):
    """Piston and tilts of its figure are its motion; what only rounds is none. Figures swing in the check."""
    study = loaded(tmp_path, ELASTIC + 'reduced = "craigb18"', shaking(LINE))
    shares = allowances(study, "wfe_rms_raw", 0.05, 60.0, cases=100)
    assert shares.axes[0] == "dz"
    assert not {"dx", "rx", "figure 1", "figure 2", "figure 3"} & set(shares.axes)
    np.testing.assert_allclose(np.nansum(shares.shares), 1.0, rtol=1e-9)
    grown = allowances(study, "wfe_rms_raw", 0.05, 60.0, "factor", cases=100)
    line = LINE.replace("0.1", f"{0.1 * grown.factor:.12g}")
    forward = loaded(tmp_path, ELASTIC + 'reduced = "craigb18"', shaking(line), campaign__cases=100)
    found = wq.run(forward, store=tmp_path / "s", on="serial")
    p95 = float(np.quantile(np.sqrt((found.wfe_rms_raw**2).mean("time")), 0.95))
    assert p95 == pytest.approx(60.0, rel=0.01)
    assert grown.check.value == pytest.approx(p95, rel=0.01)
