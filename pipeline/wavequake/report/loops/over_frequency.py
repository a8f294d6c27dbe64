"""Controllers of a telescope or system over frequency: margins, rejection, what is left, what noise does."""

from collections.abc import Iterator, Mapping, Sequence

import numpy as np
import xarray as xr

from wavequake.report.histories import has_all_instants
from wavequake.report.loops.frequency import NYQUIST, Curve, bode, nyquist, sensitivities
from wavequake.report.loops.spectra import Spectrum, of_density, of_histories, spectra
from wavequake.report.page import Picture, picture
from wavequake.words import counted

# Fewer instants say nothing of a spectrum; cases of which spectra are taken.
_LEAST, _MOST = 32, 64
# Steps of time that differ by less are even; noise that moves less than this share of what is left is none.
_EVEN, _NOTHING = 1e-6, 1e-3


def over_frequency(
    disturbance: str, cases: xr.Dataset, models: Mapping[str, str], unit: str, most: Mapping[str, float]
) -> Iterator[Picture]:
    """Draw the linear ones of some controllers, and what all of them leave of the line of sight.

    Parameters
    ----------
    disturbance : str
    cases : Dataset
        Its finished cases.
    models : mapping of str to str
        Of the controllers that are shown, by name.
    unit : str
        Of the line of sight.
    most : mapping of str to float
        The largest rms of line of sight and wavefront ("los", "wfe") of any controller.
    """
    names = list(models)
    if "gain_up" not in cases:  # of a release that kept no margins
        return
    if curves := curves_of(cases, names):
        yield picture(
            f"{disturbance}-bode",
            "Loop gain over frequency with its margins",
            bode(curves),
            "Each controller alone: the eigenvalue of the loop gain that is nearest to -1. Bars end where a "
            "loop would be unstable. Curves end at half the rate of commands.",
        )
        yield picture(f"{disturbance}-nyquist", "Loop gain in the complex plane", nyquist(curves), NYQUIST)
        yield picture(
            f"{disturbance}-rejection",
            "Sensitivity and complementary sensitivity",
            sensitivities(curves),
            "|S| is what is left of a motion, |T| what comes of the sensor's noise. Below 1 a loop helps, "
            "above 1 it amplifies.",
        )
    left, count = _left(cases, models)
    if left:
        yield picture(
            f"{disturbance}-spectrum",
            "Spectrum of the line of sight, and how its rms adds up",
            spectra(left, "What is left of the line of sight", unit),
            f"Of the histories of {counted(count, 'case')}, both axes, each about its mean, with noise; the "
            "thick line is the motion without a loop. Below is the rms of all that is faster than a "
            "frequency: where a curve rises to the left, the residual comes from.",
        )
    for key, what, of in (("los", "line of sight", unit), ("wfe", "wavefront", "nm")):
        heard = _heard(cases, names, f"noise_{key}")
        if heard and max(one.above[0] for one in heard) > _NOTHING * most[key]:
            yield picture(
                f"{disturbance}-noise-{key}",
                f"What sensor noise does to the {what}",
                spectra(heard, f"Sensor noise in the {what}", of),
                "Of each controller alone, exactly: noise of its sensors through regulator and actuator, as "
                "means over frames. It is a part of what is left.",
            )


def curves_of(cases: xr.Dataset, names: Sequence[str]) -> list[Curve]:
    """Return the linear ones of some controllers over frequency."""
    found, hertz = [], cases["frequency"].to_numpy()
    for name in names:
        size, phase, rejection, passed, gain_up, margin = (
            cases[key].sel(controller=name).to_numpy()
            for key in ("loop_gain", "loop_phase", "rejection", "passed_noise", "gain_up", "phase_margin")
        )
        if np.isfinite(size).any():
            gain = (size * np.exp(1j * np.radians(phase)))[:, None]
            found.append(Curve(name, hertz, gain, rejection, passed, float(gain_up), float(margin)))
    return found


def _left(cases: xr.Dataset, models: Mapping[str, str]) -> tuple[list[Spectrum], int]:
    """Return the spectra of the line of sight under controllers, where instants are as fast as loops."""
    if not has_all_instants(cases) or "time_s" not in cases:
        return [], 0
    some = cases[["time_s", "los"]].isel(case=slice(0, _MOST)).load()
    time = some["time_s"].isel(case=0).to_numpy()
    time = time[np.isfinite(time)]
    steps = np.diff(time)
    if len(time) < _LEAST or np.ptp(steps) > _EVEN * steps.mean():
        return [], 0
    # Frequencies end at half the rate of the fastest sensor.
    if steps.mean() > 0.5 / cases["frequency"].to_numpy()[-1] * (1 + _EVEN):
        return [], 0
    los = some["los"].isel(time=slice(0, len(time))).transpose("controller", "case", "time", "axis")
    found = []
    for name, model in models.items():
        values = los.sel(controller=name).to_numpy()
        if np.isfinite(values).all():
            calm = model == "off"
            label = "without a loop" if calm else name
            found.append(of_histories(label, float(steps.mean()), values, calm))
    most = max((one.above[0] for one in found), default=0.0)
    # What is perfect leaves rounding, of which a spectrum tells nothing.
    return [one for one in found if one.above[0] > _EVEN * most], some.sizes["case"]


def _heard(cases: xr.Dataset, names: Sequence[str], key: str) -> list[Spectrum]:
    densities = cases[key].sel(controller=list(names)).to_numpy()
    hertz = cases["frequency"].to_numpy()
    return [
        of_density(name, hertz, one, flat=True)
        for name, one in zip(names, densities, strict=True)
        if np.nan_to_num(one).max() > 0
    ]
