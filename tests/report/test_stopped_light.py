"""What is said of light that mirrors of a segmented telescope stop."""

import re

import numpy as np
import pytest
import xarray as xr
from typer.testing import CliRunner

from wavequake.campaign.contract import DONE
from wavequake.cli import app
from wavequake.errors import UserError
from wavequake.kernels.trace.status import GAP, VIGNETTED, lost_at
from wavequake.optics.rays.pupils import segment_rays
from wavequake.optics.segments.catalog import telescope
from wavequake.optics.segments.prepared import prepare
from wavequake.report.segments.vignetting import stopped_light
from wavequake.workflows.budgets.budget import budget
from wavequake.workflows.run import kind_of
from wavequake.workflows.segments import disturbance as workflow
from wavequake.workflows.segments.bench import bench_of
from wavequake.workflows.segments.vignetting import stopped_at_rest
from wavequake.workflows.study import load_study

STUDY = """
[study]
name = "two-halves"
workflow = "segment-disturbance"
[telescope]
name = "custom"
polygons = "polygons.csv"
primary_radius_mm = -10000.0
surfaces = [
    {{ name = "M2", distance_mm = 4000.0, radius_mm = -2500.0, conic = -2.25, {edge} }},
    {{ name = "image", distance_mm = 5000.0 }},
]
[optics]
rays_per_segment = 36
[wavefront]
zernike_terms = 6
[imaging]
pixels = 16
[[disturbance]]
name = "pistons"
model = "static-random"
piston_nm = 5.0
{figure}
[campaign]
cases = 2
device = "numpy"
"""
HALVES = """id,x1_m,y1_m,x2_m,y2_m,x3_m,y3_m,x4_m,y4_m
a,-1,-1,-0.01,-1,-0.01,1,-1,1
b,0.01,-1,1,-1,1,1,0.01,1
"""
RUNNER = CliRunner()


def study_file(folder, edge="semi_diameter_mm = 120.0", figure=""):
    (folder / "polygons.csv").write_text(HALVES)
    path = folder / "halves.toml"
    path.write_text(STUDY.format(edge=edge, figure=figure))
    return path


def said(*words):
    result = RUNNER.invoke(app, [str(word) for word in words])
    assert result.exit_code == 0, result.output
    return " ".join(result.output.split())


def heights_on_m2(path):
    """By a hyperbola in polar coordinates about the focus of the parabola, which both have."""
    rays = bench_of(load_study(path).identity_text()).prepared.rays
    radius = np.hypot(rays.x, rays.y)
    angle = np.arctan2(radius, 5000.0 - radius**2 / 20000.0)
    return 2500.0 / (1.0 + 1.5 * np.cos(angle)) * np.sin(angle)


def expected(path):
    height = heights_on_m2(path)
    assert np.abs(height - 120.0).min() > 0.01  # none is in doubt
    return int(np.count_nonzero(height > 120.0)), len(height)


@pytest.fixture(scope="module")
def stopping(tmp_path_factory):
    """A study whose M2 is too small, what it prints as it runs, and the line that is due."""
    folder = tmp_path_factory.mktemp("stopping")
    path = study_file(folder)
    stopped, rays = expected(path)
    ran = said("run", path, "--store", folder / "store", "--on", "serial")
    return path, ran, f"M2 stops {stopped} of {rays} rays ({100 * stopped / rays:.0f} %) at rest"


def test_a_run_says_what_is_stopped_as_it_starts_in_its_table_and_in_its_report(stopping):
    path, ran, words = stopping
    assert ran.count(words) == 2  # as it starts, and in the answer
    assert words in (path.parent / "store" / "report.html").read_text()


def test_cases_whose_motion_stops_more_are_counted(stopping):
    """Of four cases one is not done, and one stops two rays more than are stopped at rest."""
    path, _, words = stopping
    counts = np.array([34.0, 36.0, np.nan, 33.0])
    said_of_it = stopped_light(path.parent / "store", xr.Dataset({"vignetted": ("case", counts)}))
    assert said_of_it == (
        f"{words}; up to 36 of 48 are stopped at an instant of 1 of 3 cases. "
        "All numbers are those of the light that arrives."
    )


@pytest.mark.parametrize("command", ["plan", "info"])
def test_a_plan_and_the_system_say_it(stopping, command):
    path, _, words = stopping
    assert words in said(command, path)


def test_sensitivities_say_it(stopping, tmp_path):
    path, _, words = stopping
    assert f"{words}; the numbers are those of the others." in said("sensitivity", path, "--store", tmp_path)


def test_a_budget_says_it(stopping, tmp_path):
    path, _, _ = stopping
    stopped, rays = expected(path)
    printed = said("budget", path, "--cases", 16, "--store", tmp_path)
    light = "All numbers are those of the light that arrives."
    assert f"{stopped} of {rays} rays do not arrive at rest. {light}" in printed


def test_a_budget_counts_the_cases_whose_motion_stops_light(tmp_path):
    """Segments that turn by 1 urad rms move their light on M2 by 8 um rms, past an edge 6 um beyond it."""
    path = study_file(tmp_path, "semi_diameter_mm = 251.535")
    assert heights_on_m2(path).max() == pytest.approx(251.5293, abs=1e-4)
    path.write_text(path.read_text().replace("piston_nm = 5.0", "tip_nrad = 1000.0\ntilt_nrad = 1000.0"))
    study = load_study(path, {"imaging.enabled": False})
    counts = workflow.KIND.compute(study.identity_text(), np.arange(16), "numpy").arrays["vignetted"]
    said_of_it = budget(study, 16).attrs["vignetted"]
    found = re.fullmatch(
        r"up to (\d+) of 48 do not arrive at an instant of (\d+) of 16 cases\. All numbers .*", said_of_it
    )
    # What is drawn again stops light in further cases.
    most, cases = int(found[1]), int(found[2])
    assert 0 < counts.max() <= most <= 4
    assert 0 < np.count_nonzero(counts) <= cases <= 16


def test_reports_of_summaries_say_it(stopping, tmp_path):
    path, _, words = stopping
    summary = said("run", path, "store.reduce=summary", "--store", tmp_path, "--on", "serial")
    assert summary.count(words) == 2
    assert words in (tmp_path / "report.html").read_text()


def test_nothing_is_said_where_all_light_arrives(stopping, tmp_path):
    path = study_file(tmp_path, "semi_diameter_mm = 400.0")
    ran = said("run", path, "--store", tmp_path / "store", "--on", "serial")
    assert "stop" not in ran
    assert "stops" not in (tmp_path / "store" / "report.html").read_text()
    assert bench_of(load_study(path).identity_text()).stopped.light == 1.0


def test_figured_segments_of_such_a_telescope_have_images(tmp_path):
    """A figure of nothing changes nothing."""
    plain = load_study(study_file(tmp_path)).identity_text()
    figured = load_study(study_file(tmp_path, figure="figure_nm = { 4 = 0.0 }")).identity_text()
    cases = np.arange(2)
    one, other = (workflow.KIND.compute(text, cases, "numpy") for text in (plain, figured))
    assert (other.status == DONE).all()
    for name in ("exposure", "peak", "ee50", "ee80", "vignetted"):
        np.testing.assert_allclose(one.arrays[name], other.arrays[name], rtol=0, atol=1e-6)
    alone = workflow.KIND.compute(figured, cases[1:], "numpy")
    np.testing.assert_array_equal(alone.arrays["exposure"][0], other.arrays["exposure"][1])


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"wavefront.zernike_terms": 15}, "; the others do not determine 15 Zernike terms"),
        # Fits to this third of the pupil's radius would be noise, a hundred times as large as the wavefront.
        (
            {"wavefront.zernike_terms": 11, "optics.rays_per_segment": 72},
            "; the others do not determine 11 Zernike terms",
        ),
        (
            {"optics.light": "modal", "imaging.enabled": False},
            ", so that the modal model has no derivatives",
        ),
    ],
)
def test_what_cannot_be_is_refused_with_the_mirror_and_the_rays(tmp_path, keys, message):
    path = study_file(tmp_path)
    with pytest.raises(UserError, match=r"M2 stops \d+ of \d+ rays \(\d+ %\) at rest" + message):
        check(load_study(path, keys))


def check(study):
    """Raise what a study's workflow says against it."""
    kind_of(study).check(study.identity_text())


@pytest.mark.parametrize("keys", [{}, {"wavefront.reference": "fitted"}, {"wavefront.method": "slopes"}])
def test_a_mirror_that_stops_all_light_is_named_with_its_opening(tmp_path, keys):
    study = load_study(study_file(tmp_path, "semi_diameter_mm = 1.0"), keys)
    with pytest.raises(
        UserError,
        match=r"No ray of segment a .* image: M2, whose semi-diameter is 1 mm, stops 24 of 24; .*"
        r"M2 stops 48 of 48 rays \(100 %\) at rest",
    ):
        workflow.KIND.check(study.identity_text())


def test_a_field_point_too_far_out_for_images_is_refused_where_light_is_stopped_too():
    keys = {"telescope.name": "tmt-18", "optics.field_arcmin": [8.0, 0.0], "imaging.pixels": 8}
    study = load_study("tmt-segments", keys)
    assert bench_of(study.identity_text()).stopped.vignetted
    with pytest.raises(UserError, match="too far from focus"):
        workflow.KIND.check(study.identity_text())


def test_words_for_several_mirrors_and_other_losses():
    """Of 36 rays on each of 18 segments: 1 misses the glass, 2 M2, 300 the next mirror."""
    system = telescope("tmt-18")
    prepared = prepare(system, segment_rays(system.segments, 6), 550e-6, 11)
    status = np.zeros(18 * 36, dtype=np.int8)
    status[0], status[5:7], status[300:600] = GAP, lost_at(VIGNETTED, 0), lost_at(VIGNETTED, 1)
    found = stopped_at_rest(prepared, status)
    first, second = (surface.name for surface in system.after_primary[:2])
    assert found.words() == (
        f"{first} stops 2 of 648 rays (< 1 %), {second} stops 300 of 648 rays (46 %), "
        "1 of 648 rays (< 1 %) pass beside the glass at rest"
    )
    assert found.light == pytest.approx(1.0 - 302 / 648, abs=0.02)
    assert stopped_at_rest(prepared, np.zeros_like(status)).words() == ""
