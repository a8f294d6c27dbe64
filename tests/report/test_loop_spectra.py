"""Spectra of loops in reports: sums of squares are kept, and known motions are where they belong."""

import numpy as np
import pytest
import xarray as xr

from wavequake.report.loops.over_frequency import locus, over_frequency
from wavequake.report.loops.spectra import of_density, of_histories
from wavequake.workflows.loops.curves import spectrum

STEP = 1e-3


@pytest.mark.parametrize("count", [400, 401])
def test_the_rms_of_all_is_that_of_the_histories(count):
    values = np.random.default_rng(1).standard_normal((3, count, 2)) + 5.0
    found = of_histories("a", STEP, values)
    about = values - values.mean(axis=1, keepdims=True)
    assert found.above[0] == pytest.approx(np.sqrt((about**2).sum(axis=2).mean()), rel=1e-12)
    assert (np.diff(found.above) <= 0).all()


def test_a_line_adds_its_rms_where_it_is():
    """Of two amplitudes 3 and 4 at 50 and 200 Hz: 5 / sqrt(2) in all, 4 / sqrt(2) above the first."""
    time = STEP * np.arange(1000)
    motion = 3 * np.sin(2 * np.pi * 50 * time) + 4 * np.cos(2 * np.pi * 200 * time)
    found = of_histories("a", STEP, motion[None, :, None])
    above = np.interp([10.0, 100.0, 300.0], found.hertz, found.above) * np.sqrt(2)
    np.testing.assert_allclose(above, [5.0, 4.0, 0.0], atol=1e-6)
    # A Hann window keeps the sum of squares of a line, too.
    near = np.abs(found.hertz - 50) < 5
    assert found.density[near].sum() * found.hertz[0] == pytest.approx(4.5, rel=1e-9)


def test_a_density_adds_up_to_its_integral():
    """An integrator without latency passes g / (2 - g) of white noise: 2 T g^2 / |z - 1 + g|^2."""
    gain, hertz = 0.3, np.geomspace(0.5, 499.0, 200)
    size = np.exp(2j * np.pi * hertz * STEP)
    density = np.append(2 * STEP * np.abs(gain / (size - 1 + gain)) ** 2, np.nan)
    found = of_density("a", np.append(hertz, 500.0), density, flat=True)
    assert found.above[0] == pytest.approx(np.sqrt(gain / (2 - gain)), rel=1e-3)
    lacking = of_density("a", np.append(hertz, 500.0), density)
    assert found.above[0] ** 2 - lacking.above[0] ** 2 == pytest.approx(0.5 * density[0], rel=1e-9)
    assert len(found.hertz) == 200  # what is not known is not drawn


def test_the_spectrum_of_a_motion_is_where_it_moves_and_adds_up():
    """Lines of amplitude 3 and 4 along two axes at 50 and 200 Hz, white noise beside, and a mean."""
    time, hertz = STEP * np.arange(2001), np.geomspace(0.5, 500.0, 150)
    motion = np.stack([3 * np.sin(2 * np.pi * 50 * time), 5 + 4 * np.cos(2 * np.pi * 200 * time)], axis=1)
    between = np.sqrt(hertz[1:] * hertz[:-1])
    wide = np.diff(np.concatenate([[hertz[0] ** 2 / between[0]], between, hertz[-1:]]))
    found = spectrum(time, motion, hertz)
    powers = np.cumsum(found * wide)
    np.testing.assert_allclose(np.interp([30.0, 100.0, 400.0], hertz, powers), [0, 4.5, 12.5], atol=0.02)
    noise = np.random.default_rng(2).standard_normal((200_001, 1))
    flat = spectrum(STEP * np.arange(len(noise)), noise, hertz)
    assert np.median(flat) == pytest.approx(2 * STEP, rel=0.05)
    kept = np.delete(np.arange(len(time)), np.arange(3, 2000, 100))  # a little uneven
    np.testing.assert_allclose(spectrum(time[kept], motion[kept], hertz).max(), found.max(), rtol=0.05)


def test_eigenvalues_that_are_one_are_drawn_once():
    size, phase = np.array([[2.0, 2.0], [1.0, 1.0], [np.nan, np.nan]]), np.zeros((3, 2))
    assert locus(size, phase).shape == locus(size[:, 0], phase[:, 0]).shape == (3, 1)
    size[1, 1] = 0.5
    np.testing.assert_allclose(locus(size, phase)[1], [1.0, 0.5])


def store(steps, noise=1e-6):
    """Return cases of an integrator and of nothing done, at so many instants per second."""
    hertz, names = np.geomspace(0.5, 500.0, 50), ["off", "a"]
    size = np.exp(2j * np.pi * hertz * STEP)
    gain = 0.3 / (size - 1)
    known = np.array([np.full(50, np.nan), np.abs(gain)])
    time = np.arange(1, 101) / steps
    los = np.random.default_rng(0).standard_normal((2, 2, 100, 2))
    over = ("controller", "frequency")
    return xr.Dataset(
        {
            "loop_gain": (over, known),
            "loop_phase": (over, np.degrees(np.angle([np.nan * gain, gain]))),
            "rejection": (over, np.abs([np.nan * gain, 1 / (1 + gain)])),
            "passed_noise": (over, np.abs([np.nan * gain, gain / (1 + gain)])),
            "gain_up": ("controller", [np.nan, 2 / 0.3]),
            "phase_margin": ("controller", [np.nan, 80.0]),
            "noise_los": (over, np.array([np.full(50, np.nan), np.full(50, noise)])),
            "noise_wfe": (over, np.array([np.full(50, np.nan), np.zeros(50)])),
            "los": (("case", "controller", "time", "axis"), los),
        },
        {"controller": names, "frequency": hertz, "time_s": (("case", "time"), [time, time])},
    )


def shown(dataset):
    models = {name: {"off": "off", "a": "integrator"}[name] for name in dataset["controller"].to_numpy()}
    return [one.id for one in over_frequency("d", dataset, models, "mas", {"los": 1.0, "wfe": 10.0})]


def test_figures_are_drawn_where_they_tell_something():
    linear = ["d-bode", "d-nyquist", "d-rejection"]
    assert shown(store(1000.0)) == [*linear, "d-spectrum", "d-noise-los"]
    assert shown(store(500.0)) == [*linear, "d-noise-los"]  # slower than the loop
    assert shown(store(1000.0, noise=1e-12)) == [*linear, "d-spectrum"]  # of 2e-5 mas
    assert shown(store(1000.0).isel(controller=[0])) == ["d-spectrum"]
    assert shown(store(1000.0).isel(time=slice(20))) == [*linear, "d-noise-los"]
    known = store(500.0)
    known["open_psd"] = ("case", "frequency"), np.ones((2, 50))
    assert shown(known) == [*linear, "d-spectrum", "d-noise-los"]  # what |S|^2 leaves
    assert shown(known.isel(controller=[0])) == []
    assert shown(store(1000.0).assign_attrs(study='{"store": {"every": 2}}')) == [*linear, "d-noise-los"]
