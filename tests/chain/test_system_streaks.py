"""Exposures of systems that vibrate are streaks: closed forms of a swing and of jitter, and many instants."""

import numpy as np
import pytest
from scipy.special import j0, j1

from wavequake.workflows.kinds import find_kind
from wavequake.workflows.study import load_study
from wavequake.workflows.systems.bench import system_bench

KIND = find_kind("system-disturbance")
# f/50: lambda/D is 25 um in the image.
STUDY = """
[study]
name = "streak"
workflow = "system-disturbance"
[system]
name = "parabola"
wavelengths_nm = [500.0]
entrance_diameter_mm = 20.0
surface = [
  { name = "M1", radius_mm = -2000.0, conic = -1.0, glass = "mirror", stop = true },
  { name = "image", distance_mm = 1000.0 },
]
[optics]
rays = 200
[wavefront]
zernike_terms = 11
[imaging]
pixels = 48
instants = 1024
"""
SWING = """
[[disturbance]]
name = "swing"
model = "surface-vibration"
of = ["NAME"]
duration_s = 0.01
instants = 4
lines = [{ frequency_hz = 100.0, amplitude = { AMPLITUDE } }]
"""


def exposures(folder, text, cases=1, **keys):
    path = folder / "study.toml"
    path.write_text(STUDY + text)
    study = load_study(path, {key.replace("__", "."): value for key, value in keys.items()})
    found = KIND.compute(study.identity_text(), np.arange(cases), "numpy")
    assert found.messages == ("",) * cases
    return study, found.arrays["exposure"][:, 0]


def airy(x, y):
    radius = np.pi * np.hypot(x, y)
    radius = np.where(radius < 1e-9, 1e-9, radius)
    return (2.0 * j1(radius) / radius) ** 2


@pytest.mark.parametrize("axis", ["x", "y"])
def test_a_detector_that_swings_sees_the_mean_of_airys_pattern_along_its_way(tmp_path, axis):
    """Over one period, 2 lambda/D to either side, from four traced instants."""
    text = SWING.replace("NAME", "image").replace("AMPLITUDE", f"d{axis}_um = 50.0")
    _, (found,) = exposures(tmp_path, text)
    along = (np.arange(48) - 24) * 0.25
    y, x = np.meshgrid(along, along, indexing="ij")
    ways = 2.0 * np.cos(2.0 * np.pi * (np.arange(2048) + 0.5) / 2048)
    expected = np.mean([airy(x - way, y) if axis == "x" else airy(x, y - way) for way in ways], axis=0)
    assert expected.max() < 0.3
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-3)


def test_jitter_leaves_the_factor_of_a_gaussian(tmp_path):
    """exp(-2 pi² sigma² f²) on the transform, the mean of many streaks of 16 instants each."""
    (tmp_path / "white.csv").write_text("frequency_hz,psd\n20,1\n400,1\n")
    mas = 0.5 * 0.025 / 1000.0 * 180.0 / np.pi * 3600e3  # 0.5 lambda/D
    text = f"""
[[disturbance]]
name = "jitter"
model = "line-of-sight"
spectrum = "file"
file = "white.csv"
rms_mas = {mas}
direction_deg = 90.0
duration_s = 4.0
instants = 16
"""
    study, found = exposures(tmp_path, text, 12)
    still = np.asarray(KIND.template(study.identity_text()).fixed["exposure_static"][1])[0]
    one, two = (np.abs(np.fft.fft2(image)) for image in (found.mean(axis=0), still))
    for column in (2, 4, 6):  # cycles per frame of 12 lambda/D
        expected = np.exp(-2.0 * np.pi**2 * 0.25 * (column / 12.0) ** 2)
        assert one[column, 0] / two[column, 0] == pytest.approx(expected, abs=0.02)
        assert one[0, column] / two[0, column] == pytest.approx(1.0, abs=0.02)


def test_few_instants_of_all_that_moves_leave_the_streak_of_many(tmp_path):
    """A mirror that shifts, turns and bends, and a star that moves: its places are linear in all."""
    text = SWING.replace("NAME", "M1").replace("AMPLITUDE", "dx_um = 20.0, ry_urad = 8.0, rx_urad = 6.0")
    text += """
[[disturbance]]
name = "sight"
model = "vibration-lines"
lines = [{ frequency_hz = 150.0, fwhm_hz = 2.0, rms_mas = 900.0 }]
share = 0
[[disturbance]]
name = "all"
model = "combine"
of = ["swing", "sight"]
duration_s = 0.02
instants = 16
share = 1
"""
    given = text.replace("instants = 4", "instants = 4\nshare = 0")
    _, few = exposures(tmp_path, given, imaging__pixels=32)
    _, many = exposures(tmp_path, given.replace("= 16", "= 256"), imaging__pixels=32)
    assert many.max() < 0.5
    np.testing.assert_allclose(few, many, rtol=0, atol=2e-3 * many.max())


def test_what_stands_still_or_moves_a_hundredth_of_a_pixel_is_a_dot(tmp_path):
    text = SWING.replace("NAME", "image").replace("AMPLITUDE", "dx_um = 0.04")
    study, (found,) = exposures(tmp_path, text)
    bench = system_bench(study.identity_text())
    still = np.asarray(KIND.template(study.identity_text()).fixed["exposure_static"][1])[0]
    assert bench.imager is not None
    np.testing.assert_allclose(found, still, rtol=0, atol=1e-4)


def test_an_object_in_coherent_light_swings_as_a_whole(tmp_path):
    """Its image keeps its shape on the way: the transform of the places' arcsine density is J0(2 pi a f)."""
    text = SWING.replace("NAME", "image").replace("AMPLITUDE", "dx_um = 50.0")
    text += '[object]\nslit = 1.0\nlight = "coherent"\n'
    path = tmp_path / "study.toml"
    path.write_text(STUDY + text)
    identity = load_study(path).identity_text()
    found = KIND.compute(identity, np.arange(1), "numpy").arrays["object_image"][0, 0]
    rest = KIND.template(identity).fixed["object_static"][1][0]
    factor = j0(2.0 * np.pi * 2.0 * np.fft.rfftfreq(144, 0.25))
    padded = np.pad(rest, ((0, 0), (48, 48)))
    expected = np.fft.irfft(np.fft.rfft(padded, axis=1) * factor, axis=1)[:, 48:-48]
    assert found.max() < 0.5 * rest.max()
    np.testing.assert_allclose(found, expected, rtol=0, atol=0.01 * rest.max())


HISTORY = '[[disturbance]]\nname = "given"\nmodel = "surface-history"\nfile = "history.csv"\n'


def mean_along(time, places, exposed):
    """Airy's pattern, for each exposed row over half the way to those before and after, by straight lines."""
    along = (np.arange(48) - 24) * 0.25
    at = time[exposed]
    ends = np.concatenate([at[:1], 0.5 * (at[1:] + at[:-1]), at[-1:]])
    share = (np.arange(400) + 0.5) / 400
    ways = (ends[:-1, None] + share * np.diff(ends)[:, None]).ravel()
    x, y = (np.interp(ways, time, one) for one in places.T)
    return np.mean([airy(along - a, along[:, None] - b) for a, b in zip(x, y, strict=True)], axis=0)


def test_a_history_leaves_the_light_of_straight_lines_between_its_rows(tmp_path):
    """The detector goes 2 lambda/D to the right, 4 up and back; the image goes the other way."""
    rows = "time_s,image.dx_um,image.dy_um\n0,0,0\n0.001,50,0\n0.002,50,100\n0.006,0,0\n"
    (tmp_path / "history.csv").write_text(rows)
    _, (found,) = exposures(tmp_path, HISTORY)
    time = np.array([0.0, 0.001, 0.002, 0.006])
    places = np.array([[0.0, 0.0], [-2.0, 0.0], [-2.0, -4.0], [0.0, 0.0]])
    expected = mean_along(time, places, np.arange(4))
    np.testing.assert_allclose(found, expected, rtol=0, atol=2e-3)
    assert np.abs(found[:, ::-1] - expected).max() > 0.1


def test_rows_of_a_history_that_are_not_exposed_are_on_its_way(tmp_path):
    """Of 64 rows of a swing nine are exposed: what is between them is that of the rows, not of a chord."""
    time = np.arange(64) / 6400.0
    swing = 2.0 * np.sin(2.0 * np.pi * 100.0 * time)
    lines = [f"{one:.9g},{-25.0 * place:.9g}" for one, place in zip(time, swing, strict=True)]
    (tmp_path / "history.csv").write_text("\n".join(["time_s,image.dx_um", *lines]))
    _, (found,) = exposures(tmp_path, HISTORY, imaging__instants=9)
    exposed = np.linspace(0, 63, 9).round().astype(int)
    places = np.stack([swing, np.zeros(64)], axis=1)
    np.testing.assert_allclose(found, mean_along(time, places, exposed), rtol=0, atol=2e-3)
    chords = np.stack([np.interp(time, time[exposed], swing[exposed]), np.zeros(64)], axis=1)
    assert np.abs(found - mean_along(time, chords, exposed)).max() > 0.01
