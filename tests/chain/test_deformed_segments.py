"""Segments and mirrors of segmented telescopes that deform, by name, over time and in files."""

import numpy as np
import pytest

from wavequake.errors import UserError
from wavequake.optics.polynomials.zernike import noll_to_nm
from wavequake.workflows.exposures.telescope_control import CONTROLLERS
from wavequake.workflows.kinds import find_kind
from wavequake.workflows.segments.bench import bench_of
from wavequake.workflows.study import load_study

KIND = find_kind("segment-disturbance")
STUDY = """
[study]
name = "bent"
workflow = "segment-disturbance"
[telescope]
name = "tmt-18"
[optics]
rays_per_segment = 72
wavelength_nm = 1000.0
[wavefront]
zernike_terms = 15
[imaging]
pixels = 16
"""
HISTORY = STUDY + '[[disturbance]]\nname = "given"\nmodel = "surface-history"\nfile = "history.csv"\n'
DRAWN = (
    STUDY
    + """
[[disturbance]]
name = "drawn"
model = "surface-deformation"
of = ["7", "M2"]
rms_nm = { 5 = 20.0, 7 = 10.0 }
"""
)


@pytest.fixture
def loaded(tmp_path):
    def load(text, table="", **keys):
        (tmp_path / "history.csv").write_text(table)
        (tmp_path / "study.toml").write_text(text)
        return load_study(
            tmp_path / "study.toml", {name.replace("__", "."): one for name, one in keys.items()}
        )

    return load


def compute(study, cases=(0,)):
    found = KIND.compute(study.identity_text(), np.array(cases), "numpy")
    assert found.messages == ("",) * len(cases)
    return found.arrays


def figure_of(bench, name, noll):
    """A Noll polynomial over the circle about a segment's outline, at the rays (zero beside the segment)."""
    index, rays = bench.system.segments.names.index(name), bench.prepared.rays
    center, corners = bench.system.segments.centers[index, :2], bench.system.segments.corners[index]
    radius = np.hypot(*(corners - center).T).max()
    local = bench.layout.axes[index, :2, 0] * [1.0, 1.0]
    angle = np.arctan2(local[1], local[0])
    x, y = (np.stack([rays.x, rays.y]) - center[:, None]) / radius
    rho, theta = np.hypot(x, y), np.arctan2(y, x) - angle
    n, m = noll_to_nm(noll)
    assert (n, abs(m)) in ((2, 0), (2, 2))
    radial = np.sqrt(3.0) * (2.0 * rho**2 - 1.0) if m == 0 else np.sqrt(6.0) * rho**2
    turn = 1.0 if m == 0 else (np.cos(2 * theta) if noll % 2 == 0 else np.sin(2 * theta))
    return np.where(rays.segment == index, radial * turn, 0.0)


@pytest.mark.parametrize("noll", [4, 5, 6])
def test_a_figure_of_one_segment_over_time_is_twice_itself_in_the_wavefront(loaded, noll):
    table = f"time_s,8.z{noll}_nm\n0.1,30\n0.2,-10\n0.3,0\n"
    study = loaded(HISTORY, table)
    arrays, bench = compute(study), bench_of(study.identity_text())
    weight, shape = bench.prepared.weight, figure_of(bench, "8", noll)
    mean = weight @ shape / weight.sum()
    rms = np.sqrt(weight @ (shape - mean) ** 2 / weight.sum())
    rest = bench.static.rms_raw[0] * 1000.0
    expected = np.hypot(2.0 * rms * np.array([30.0, 10.0, 0.0]), rest)
    np.testing.assert_allclose(arrays["wfe_rms_raw"][0], expected, rtol=0.02)
    # Fits of the shape itself, which the trace does not know: sign and place.
    basis = bench.prepared.fit.basis
    fit = np.linalg.lstsq(basis * np.sqrt(weight)[:, None], shape * np.sqrt(weight), rcond=None)[0]
    change = arrays["zernike"][0, 0] - arrays["zernike"][0, 1]
    assert np.corrcoef(change[3:], fit[3:])[0, 1] > 0.999
    strong = np.abs(fit) > 0.3 * np.abs(fit[3:]).max()
    strong[:3] = False
    np.testing.assert_allclose(np.abs(change[strong] / fit[strong]), 80.0, rtol=0.05)  # 2 (30 + 10)


def test_a_figure_of_m2_is_twice_itself_in_the_wavefront(loaded):
    arrays = compute(loaded(HISTORY, "time_s,M2.z5_nm,M2.z8_nm\n0.1,40,0\n0.2,0,25\n0.3,0,0\n"))
    change = np.abs(arrays["zernike"][0, :2] - arrays["zernike"][0, 2])
    for row, (noll, figure) in enumerate(((5, 40.0), (8, 25.0))):
        # The pupil is annular and M2's polynomials are circular; the obscuration of 0.12 hardly matters.
        assert change[row, noll - 1] == pytest.approx(2.0 * figure, rel=0.05)
        assert np.delete(change[row], [0, 1, 2, noll - 1]).max() < 0.05 * 2.0 * figure


def test_drawn_figures_are_those_of_the_elements_names(loaded):
    study = loaded(DRAWN)
    both = compute(study, (0, 1))
    assert np.ptp(both["wfe_rms_raw"], axis=1).max() == 0.0
    alone = compute(loaded(DRAWN.replace('"7", "M2"', '"M2"')))
    segment = compute(loaded(DRAWN.replace('"7", "M2"', '"7"')))
    rest = bench_of(study.identity_text()).static.zernike[0] * 1000.0
    change = (alone["zernike"][0, 0] - rest) + (segment["zernike"][0, 0] - rest)
    np.testing.assert_allclose(both["zernike"][0, 0] - rest, change, atol=1e-3)
    assert np.abs(change).max() > 5.0
    assert not np.array_equal(both["exposure"][0], both["exposure"][1])


def test_m2_corrects_one_deformed_segment_as_far_as_its_terms_go(loaded):
    """As in Störkle 2018, Fig. 4.46: the fitted terms are taken away, steps at the segment's rim stay."""
    text = HISTORY.replace("segment-disturbance", "telescope-exposure").replace(
        "zernike_terms = 15", "zernike_terms = 28"
    )
    study = loaded(text + "[exposure]\nscale = 1.0\n", "time_s,8.z4_nm\n0.1,100\n0.2,80\n")
    kind = find_kind("telescope-exposure")
    kind.check(study.identity_text())
    arrays = kind.compute(study.identity_text(), np.array([0]), "numpy").arrays
    wfe = dict(zip(CONTROLLERS, arrays["wfe_rms"][0].max(axis=-1), strict=True))
    peak = dict(zip(CONTROLLERS, arrays["peak"][0], strict=True))
    assert wfe["disturbed"] > wfe["static"] + 3.0
    assert wfe["elastic"] == pytest.approx(wfe["static"], abs=0.05)
    assert peak["disturbed"] < peak["elastic"] < peak["static"]


@pytest.mark.parametrize(
    ("column", "words"),
    [
        ("image.z4_nm", "deforms 'image' of the telescope tmt-18, where the image is"),
        ("99.z4_nm", "acts on '99', but the telescope tmt-18 has no such segment or surface"),
    ],
)
def test_what_cannot_deform_is_refused(loaded, column, words):
    with pytest.raises(UserError, match=words):
        KIND.check(loaded(HISTORY, f"time_s,{column}\n0.1,1\n").identity_text())
