"""The modal model against full traces, an independent trace, and its own scaling laws."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from wavefront_cases import two_of_492

from wavequake.errors import UserError
from wavequake.kernels.device.devices import NUMPY
from wavequake.optics.rays.pupils import PupilRays, on_glass, segment_rays, sunflower
from wavequake.optics.segments import modal
from wavequake.optics.segments.catalog import telescope
from wavequake.optics.segments.modal_derivatives import modal_model
from wavequake.optics.segments.prepared import at_field, prepare, trace_states
from wavequake.optics.segments.slopes import slope_fit
from wavequake.optics.segments.wavefront import measure
from wavequake.optics.systems.kinematics import rest_states

WAVELENGTH = 550e-6
SEGMENTS, INSTANTS, TERMS = 18, 16, 6
DOFS = (0, 1, 2, 3, 4, 5, 9, 11)  # all rigid motions, and figures of Noll terms 4 and 6
FIELD = np.array([2e-5, -1e-5])
# Rounding of paths of 1e5 mm, per ray: an ulp is 2.6e-8 waves.
ROUNDING = 3e-8


@pytest.fixture(scope="module")
def tmt18():
    system = telescope("tmt-18", gap=20.0)
    return prepare(system, segment_rays(system.segments, 6), WAVELENGTH, 21, figure_terms=TERMS)


@pytest.fixture(scope="module")
def model(tmt18):
    return modal_model(at_field(tmt18, FIELD), NUMPY, DOFS)


def motions(sizes, common=0.0, seed=5):
    """Random motions (16, D * 18 + 4) of rms `sizes` by degree of freedom, of M2 and the field."""
    random = np.random.default_rng(seed)
    local = random.standard_normal((INSTANTS, len(DOFS), SEGMENTS)) * np.reshape(sizes, (-1, 1))
    return np.concatenate(
        [local.reshape(INSTANTS, -1), common * random.standard_normal((INSTANTS, 4))], axis=1
    )


def states_of(prepared, motion):
    states = rest_states(prepared.system, INSTANTS)
    local = motion[:, :-4].reshape(INSTANTS, len(DOFS), SEGMENTS)
    for column, dof in enumerate(DOFS):
        target = states.segment_motion[:, :, dof] if dof < 6 else states.segment_figure[:, :, dof - 6]
        target[:] = local[:, column]
    states.surface_motion[:, 2, 3:5] = motion[:, -4:-2]
    states.line_of_sight[:] = FIELD + motion[:, -2:]
    return states


def errors(prepared, model, motion):
    """Differences between the model and full traces, in waves, and mm in the image."""
    traced = measure(prepared, states_of(prepared, motion), NUMPY)
    still = measure(prepared, states_of(prepared, 0.0 * motion), NUMPY)
    found = modal.wavefronts(model, modal.forms(model, motion, INSTANTS))
    return {
        "zernike": found.zernike - traced.zernike,
        "rms": found.rms - traced.rms,
        "rms_raw": found.rms_raw - traced.rms_raw,
        "rms_flat": found.rms_flat - traced.rms_flat,
        "los": found.los - (traced.los - still.los),
        "centroid": found.centroid - (traced.centroid - still.centroid),
    }


PISTONS = [0, 0, 70e-6, 0, 0, 0, 0, 0]
TILTS = [0, 0, 0, 1e-6, 1e-6, 0, 0, 0]
ALL = [1e-3, 1e-3, 70e-6, 1e-7, 1e-7, 1e-6, 20e-6, 20e-6]


def test_pistons_agree_with_full_traces_to_rounding(tmt18, model):
    """Rms wavefront errors of 0.2 waves agree to 1e-8 waves: 5e-6 nm."""
    for name, error in errors(tmt18, model, motions(PISTONS)).items():
        assert np.abs(error).max() < ROUNDING, name


@pytest.mark.parametrize(
    ("sizes", "common", "names"),
    [
        (TILTS, 0.0, ("zernike", "rms_raw", "los", "centroid")),
        (10 * np.array(ALL), 3e-7, ("zernike", "rms_raw", "los", "centroid")),
        ([0] * 8, 1e-6, ("zernike", "los")),
    ],
)
def test_errors_fall_as_the_square_of_the_motion(tmt18, model, sizes, common, names):
    motion = motions(sizes, common)
    whole, half = (errors(tmt18, model, scale * motion) for scale in (4.0, 2.0))
    for name in names:
        assert 1.9 < np.log2(np.abs(whole[name]).max() / np.abs(half[name]).max()) < 2.1, name


@pytest.mark.parametrize(
    ("sizes", "common"), [(PISTONS, 0.0), (TILTS, 0.0), (ALL, 0.0), ([0] * 8, 1e-6), (ALL, 1e-6)]
)
def test_the_bound_is_above_the_error_of_every_ray_sum_and_not_far(tmt18, model, sizes, common):
    motion = motions(sizes, common)
    there, back, still = (
        trace_states(tmt18, states_of(tmt18, sign * motion), NUMPY).opd[0] / WAVELENGTH for sign in (1, -1, 0)
    )
    error = np.sqrt(tmt18.weight @ ((there + back) / 2.0 - still) ** 2)  # even orders
    bound = modal.error_bound(model, modal.amplitudes(model, motion))
    noise = 5 * ROUNDING  # the chief ray's own is common to all rays
    assert (error < bound + noise).all()
    if sizes != PISTONS:
        assert (bound > 3 * noise).all()
        assert (bound < 60 * error).all()
    found = errors(tmt18, model, motion)
    for name in ("rms_raw", "rms_flat"):
        assert (np.abs(found[name]) < bound + ROUNDING).all(), name


def test_figures_and_common_motions_are_in_the_rms(tmt18, model):
    """Quadratic forms with all cross terms: each kind of motion alone and with the others."""
    alone = [motions(np.array(ALL) * (np.arange(8) == i)) for i in range(8)]
    together = modal.wavefronts(model, modal.forms(model, motions(ALL, 1e-7), INSTANTS))
    assert np.abs(errors(tmt18, model, motions(ALL, 1e-7))["rms_flat"]).max() < 2e-5 * together.rms_flat.min()
    for motion in alone:
        for name in ("rms_raw", "rms_flat"):
            assert np.abs(errors(tmt18, model, motion)[name]).max() < 2e-5, name


def test_a_scaled_motion_is_the_scaled_forms(model):
    motion, history = motions(ALL, 1e-7), np.array([0.0, 0.5, -2.0])
    found = modal.wavefronts(model, modal.scaled(modal.forms(model, motion, INSTANTS), history))
    for k, factor in enumerate(history):
        direct = modal.wavefronts(model, modal.forms(model, factor * motion, INSTANTS))
        for name in ("zernike", "rms", "rms_raw", "rms_flat", "los", "centroid"):
            np.testing.assert_allclose(
                getattr(found, name)[:, k], getattr(direct, name), rtol=1e-9, atol=1e-12, err_msg=name
            )


def test_a_row_has_the_same_bits_whatever_its_neighbors(model):
    motion = motions(ALL, 1e-7)
    whole = modal.forms(model, np.concatenate([motions(ALL, seed=8), motion]), INSTANTS)
    for row in range(INSTANTS):
        alone = np.zeros_like(motion)
        alone[row] = motion[row]
        found = modal.forms(model, alone, INSTANTS)
        np.testing.assert_array_equal(found.linear[row], whole.linear[INSTANTS + row])
        assert found.quadratic[row] == whole.quadratic[INSTANTS + row]


def test_mean_squares_of_two_of_492_segments_against_an_independent_trace():
    """Of pistons along and turns about the telescope's axes: mean OPD and rms on the segment."""
    names = ["A1", "B10"]
    prepared = two_of_492(names)
    model = modal_model(prepared, NUMPY, (0, 1, 2, 3, 4, 5))
    share = np.bincount(prepared.rays.segment) / len(prepared.rays.segment)
    path = Path(__file__).parents[1] / "data" / "tmt492_segments.json"
    for k, name in enumerate(names):
        expected = json.loads(path.read_text())["segments"][name]
        to_optics = np.diag([1.0, 1.0, -1.0]) @ prepared.system.segments.axes[k]
        local = np.zeros((3, 6, 2))
        local[0, :3, k] = to_optics[2]
        local[1, 3:, k], local[2, 3:, k] = -to_optics[0] * 1e-3, -to_optics[1] * 1e-3  # m per rad
        motion = np.concatenate([local.reshape(3, -1), np.zeros((3, 4))], axis=1)
        found = modal.forms(model, motion, 3)
        mean = found.linear[:, modal.layout_of(3).mean] * WAVELENGTH / share[k]
        rms = np.sqrt(found.quadratic * WAVELENGTH**2 / share[k] - mean**2)
        for i, dof in enumerate(("piston_z", "rot_x", "rot_y")):
            assert mean[i] == pytest.approx(expected[dof]["mean_opd_m_per_unit"], rel=1e-6, abs=1e-6)
            assert rms[i] == pytest.approx(expected[dof]["rms_opd_on_segment"], rel=1e-6, abs=1e-6)


def test_motions_that_carry_a_ray_over_an_edge_are_out_of_range(tmt18, model):
    rays, edges = tmt18.rays, tmt18.train.edges[tmt18.rays.segment]
    inside = edges[..., 2] - edges[..., 0] * rays.x[:, None] - edges[..., 1] * rays.y[:, None]
    assert model.clearance == pytest.approx(
        inside.min(), abs=0.1
    )  # the field shifts the footprint by 0.04 mm
    for size, far in ((0.9, False), (1.1, True)):
        shift = np.zeros((INSTANTS, len(model.columns)))
        shift[:, 0] = size * model.clearance
        assert np.isinf(modal.error_bound(model, modal.amplitudes(model, shift))).all() == far


def test_a_ray_on_an_edge_has_no_derivatives():
    system = telescope("tmt-18", gap=20.0)
    rays = segment_rays(system.segments, 6)
    edge = system.segments.corners[0, :2].mean(axis=0) * (1 - 1e-10)
    center = system.segments.centers[0, :2]
    at = center + (edge - center) * (1 - 1e-7)
    more = PupilRays(
        np.append(rays.x, at[0]),
        np.append(rays.y, at[1]),
        np.append(rays.weight, rays.weight[0]),
        np.append(rays.segment, 0),
    )
    prepared = prepare(system, more, WAVELENGTH, 6)
    with pytest.raises(UserError, match=r"rays are lost at rest or within 0.02 mm .* optics.rays"):
        modal_model(prepared, NUMPY, (0, 1))


def test_wavefronts_from_slopes_are_refused(tmt18):
    with pytest.raises(UserError, match="path lengths about the chief ray"):
        modal_model(replace(tmt18, slopes=slope_fit(tmt18)), NUMPY, (2,))


def test_a_mirror_without_edges_has_a_model_too():
    system = telescope("tmt-thesis")
    prepared = prepare(
        system, on_glass(system, sunflower(system.annulus.inner, system.annulus.outer, 400)), WAVELENGTH, 11
    )
    model = modal_model(prepared, NUMPY, (3,))
    assert np.isinf(model.clearance)
    motion = np.zeros((16, 5))
    motion[0, 0] = 1e-7
    states = rest_states(system, 16)
    states.segment_motion[0, 0, 3] = 1e-7
    found = modal.wavefronts(model, modal.forms(model, motion, 16))
    traced = measure(prepared, states, NUMPY)
    np.testing.assert_allclose(found.los[0], (traced.los - traced.los[1])[0], rtol=0, atol=1e-7)
    assert np.abs(found.los[0]).max() > 0.05
