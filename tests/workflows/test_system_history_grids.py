"""Studies that read heights on grids over time."""

import numpy as np
import pytest
import xarray as xr
from test_system_history import HEAD, MOTION, RANDOM, TIME, written

from wavequake.campaign.contract import DONE
from wavequake.errors import UserError
from wavequake.kernels.device.devices import NUMPY
from wavequake.mechanics.disturbances.layout import NO_SEGMENTS
from wavequake.mechanics.disturbances.registry import draw_case, parts
from wavequake.optics.polynomials.zernike import annular_zernike
from wavequake.optics.shapes.shapes import GridDeformation
from wavequake.optics.systems.kinematics import rest_states
from wavequake.optics.wavefronts.wavefront import measure_system
from wavequake.report.exports.rerun import rerun_stored
from wavequake.workflows.budgets.budget import summed
from wavequake.workflows.budgets.elements import Factors, variants
from wavequake.workflows.budgets.systems import elements_of
from wavequake.workflows.run import run
from wavequake.workflows.sensitivity import sensitivity
from wavequake.workflows.study import load_study
from wavequake.workflows.systems import measure as system_measure
from wavequake.workflows.systems.bench import system_bench, system_states
from wavequake.workflows.systems.disturbance import KIND

SHAPE, SPACING = (15, 17), (1.6, 1.5)
X, Y = np.meshgrid(
    SPACING[0] * (np.arange(SHAPE[1]) - (SHAPE[1] - 1) / 2), SPACING[1] * (np.arange(SHAPE[0]) - 7.0)
)
ARRAYS = HEAD.replace("my history.csv", "history.npz")
MIRROR = """
entrance_diameter_mm = 3.4
wavelengths_nm = [500.0]
[[system.surface]]
name = "stop"
stop = true
[[system.surface]]
name = "M1"
radius_mm = -2000.0
conic = -1.0
glass = "mirror"
semi_diameter_mm = 1.5
[[system.surface]]
name = "image"
distance_mm = 1000.0
"""
ROUGH = np.random.default_rng(4).standard_normal((len(TIME), *SHAPE)) * 5.0


def study_of(folder, arrays, text=ARRAYS, *keys):
    np.savez(folder / "history.npz", **({"time_s": TIME} | arrays))
    (folder / "study.toml").write_text(text)
    return load_study(folder / "study.toml", keys)


def grid(heights, name="L1 front"):
    return {f"{name}.grid_nm": heights, f"{name}.grid_spacing_mm": SPACING}


def test_arrays_give_the_case_of_a_table(tmp_path):
    table = KIND.compute(written(tmp_path).identity_text(), np.array([0]), "numpy").arrays
    arrays = KIND.compute(study_of(tmp_path, MOTION).identity_text(), np.array([0]), "numpy").arrays
    for name, values in table.items():
        assert values.tobytes() == arrays[name].tobytes(), name


def test_heights_on_a_grid_give_what_they_give_in_python(tmp_path):
    bench = system_bench(study_of(tmp_path, grid(ROUGH)).identity_text())
    found = KIND.compute(bench.text, np.array([0]), "numpy").arrays
    form = bench.system.surfaces[0].deformation
    assert form.residual == GridDeformation(*SHAPE, *SPACING)
    states = rest_states(bench.system, len(TIME))
    states.deformations[0][:, form.terms :] = 1e-6 * ROUGH.reshape(len(TIME), -1)
    for field, (prepared, *_) in enumerate(bench.prepared):
        expected = measure_system(prepared, states, NUMPY)
        scale = 1e6 * prepared.wavelength * np.abs(expected.zernike).max()
        assert scale > 1.0
        values = found["zernike"][0, :, field, 0]
        np.testing.assert_allclose(
            values, 1e6 * prepared.wavelength * expected.zernike, rtol=0, atol=1e-12 * scale
        )


def test_a_cubic_figure_is_the_same_on_a_grid_and_by_its_polynomials(tmp_path):
    """A bicubic spline keeps polynomials of degree 3: tilt, defocus, astigmatism, coma, trefoil."""
    terms = np.random.default_rng(3).standard_normal((len(TIME), 10)) * 10.0
    columns = {f"L1 front.z{j}_nm": terms[:, j - 1] for j in range(1, 11)}
    bench = system_bench(study_of(tmp_path, columns).identity_text())
    form = bench.system.surfaces[0].deformation
    assert (form.terms, form.residual) == (10, None)
    by_terms = KIND.compute(bench.text, np.array([0]), "numpy").arrays
    basis = annular_zernike(X.ravel() / form.pupil_radius, Y.ravel() / form.pupil_radius, 10, 0.0)
    heights = (terms @ basis.T).reshape(len(TIME), *SHAPE)
    by_grid = KIND.compute(study_of(tmp_path, grid(heights)).identity_text(), np.array([0]), "numpy").arrays
    assert by_terms["wfe_change"].max() > 1.0
    for name in ("zernike", "wfe_change", "los_mm", "spot_rms"):
        scale = np.abs(by_terms[name]).max()
        np.testing.assert_allclose(by_grid[name], by_terms[name], rtol=0, atol=1e-9 * scale, err_msg=name)


def test_a_grid_is_added_to_what_else_deforms_a_surface(tmp_path):
    text = (ARRAYS + "share = 0\n" + RANDOM).replace("L1 front", "L3 front")
    arrays = grid(ROUGH, "L3 front") | {"L3 front.z6_nm": 30.0 * TIME, "lens 3.dx_um": TIME}
    bench = system_bench(study_of(tmp_path, arrays, text).identity_text())
    populations = bench.study.disturbance
    both = next(one for one in populations if one.name == "both")
    drawn = draw_case(populations, both, NO_SEGMENTS, 1, 0)
    index = [surface.name for surface in bench.system.surfaces].index("L3 front")
    form = bench.system.surfaces[index].deformation
    assert (form.terms, form.residual) == (8, GridDeformation(*SHAPE, *SPACING))
    found = system_states(bench, drawn).deformations[index]
    np.testing.assert_allclose(found[:, 8:], 1e-6 * ROUGH.reshape(len(TIME), -1), rtol=1e-14)
    np.testing.assert_allclose(found[:, 5], 30e-6 * TIME, rtol=1e-14)
    assert (found[:, 7] == found[0, 7]).all()
    assert found[0, 7] != 0.0


@pytest.mark.parametrize("device", ["numpy", "auto"])
def test_bits_of_grids_depend_on_no_other_case_or_piece(tmp_path, monkeypatch, device):
    time = np.arange(40.0)
    rough = np.random.default_rng(5).standard_normal((40, *SHAPE)) * 5.0
    text = study_of(tmp_path, grid(rough) | {"time_s": time}, ARRAYS + RANDOM).identity_text()
    together = KIND.compute(text, np.arange(4), device)
    assert (together.status == DONE).all(), together.messages
    monkeypatch.setattr(system_measure, "_RAYS", 40 * 16)
    pieces = KIND.compute(text, np.array([2, 3]), device).arrays
    for name, values in pieces.items():
        assert values.tobytes() == together.arrays[name][2:].tobytes(), name


def test_sensitivities_are_those_without_a_history(tmp_path):
    found, plain = (
        sensitivity(study_of(tmp_path, arrays, ARRAYS, "system.fields_mm=[[0.0, 5.0]]"), mirror_terms=1)
        for arrays in (grid(ROUGH), {"L2 back.dx_um": TIME})
    )
    for name in found.data_vars:
        np.testing.assert_allclose(found[name], plain[name], rtol=1e-6, atol=1e-6, err_msg=name)


def test_a_budget_takes_grids_away_with_their_surface(tmp_path):
    text = (ARRAYS + "share = 0\n" + RANDOM).replace("L1 front", "L3 front")
    study = study_of(tmp_path, grid(ROUGH, "L3 front"), text)
    sources = parts(study.disturbance, summed(study, None))
    assert elements_of(sources) == ("lens 3", "L3 front")
    whole, again, no_askew, no_shake, no_figure, no_body, no_surface, *_ = variants(
        summed(study, None), Factors(tuple(sources), surfaces=elements_of(sources)), NO_SEGMENTS, 1, 0
    )
    for one in (whole, again, no_askew, no_figure, no_body):
        np.testing.assert_allclose(one.grid["L3 front"], 1e-9 * ROUGH, rtol=1e-15)
    assert no_shake.grid == no_surface.grid == {}


def test_a_case_in_full_detail_has_its_grids(tmp_path):
    run(study_of(tmp_path, grid(ROUGH)), store=tmp_path / "s")
    assert rerun_stored(tmp_path / "s", 0, tmp_path / "case.nc").differing == ()
    with xr.open_dataset(tmp_path / "case.nc") as detail:
        np.testing.assert_allclose(detail["given_grid_0"], ROUGH, rtol=1e-15)
        assert detail["given_grid_0"].attrs["long_name"] == "heights on the grid of L1 front"


TWO = (
    ARRAYS
    + """
[[disturbance]]
name = "other"
model = "surface-history"
file = "other.npz"
"""
)


@pytest.mark.parametrize(
    ("arrays", "text", "sentence"),
    [
        (grid(ROUGH, "lens 3"), ARRAYS, "'shake' deforms the body 'lens 3'; only a surface deforms"),
        (grid(ROUGH, "L9"), ARRAYS, "acts on 'L9', but six-lens has no such surface"),
        (
            {"L1 front.grid_nm": ROUGH[:, :5, :5], "L1 front.grid_spacing_mm": (4.0, 1.0)},
            ARRAYS,
            "grid of heights of 'L1 front' reaches to x = 8 and y = 2 mm, the beams",
        ),
        (grid(ROUGH[..., :-1]), TWO, "'other' deforms 'L1 front' on another grid than one before"),
        (
            grid(ROUGH),
            ARRAYS.replace("history.npz", "none.npz"),
            "disturbance.shake.file: the file .*none.npz",
        ),
        (
            {"L1 front.grid_nm": ROUGH},
            ARRAYS,
            "study.toml: disturbance.shake: the history history.npz: .*spacing",
        ),
    ],
)
def test_grids_that_do_not_fit_are_refused(tmp_path, arrays, text, sentence):
    np.savez(tmp_path / "other.npz", time_s=TIME, **grid(ROUGH))
    with pytest.raises(UserError, match=sentence):
        KIND.check(study_of(tmp_path, arrays, text).identity_text())


def test_rays_that_an_opening_stops_need_no_heights(tmp_path):
    """A grid of 1.6 mm about a lens that lets pass what is within 1.5 mm."""
    small = {"L1 front.grid_nm": ROUGH[:, :5, :5], "L1 front.grid_spacing_mm": 0.8}
    with pytest.raises(UserError, match="it must cover them"):
        KIND.check(study_of(tmp_path, small).identity_text())
    mirror = (
        ARRAYS.replace('name = "six-lens"\n', MIRROR).replace("L3 front", "M1").replace(', "L3 back"', "")
    )
    study = study_of(tmp_path, {name.replace("L1 front", "M1"): one for name, one in small.items()}, mirror)
    KIND.check(study.identity_text())
