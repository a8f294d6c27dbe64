"""Controllers of a telescope or system over frequency: margins, rejection, what is left, what noise does."""

from collections.abc import Iterable, Iterator, Mapping, Sequence

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from wavequake.report.histories import has_all_instants
from wavequake.report.loops.frequency import NYQUIST, Curve, bode, nyquist, sensitivities
from wavequake.report.loops.spectra import Array, Spectrum, of_density, of_histories, spectra
from wavequake.report.page import Picture, picture
from wavequake.words import counted

# What a store has of each of some loops, by its label.
Rows = Iterable[tuple[str, xr.Dataset]]
_SENSITIVITIES = (("rejection", "sensitivity"), ("passed_noise", "complementary"))
# Fewer instants say nothing of a spectrum; cases of which spectra are taken.
_LEAST, _MOST = 32, 64
# Steps of time that differ by less are even; noise that moves less than this share of what is left is none.
_EVEN, _NOTHING = 1e-6, 1e-3
_GAINS = (
    "Each controller alone: the eigenvalues of its loop gain that have the gain and the phase margin. Curves "
    "end at half the rate of commands."
)
_BARS = "Bars end where a stable loop would become unstable: as a factor of the gain above, in degrees below."
SENSITIVITY = (
    "|S| is what is left of a motion, |T| what comes of the sensor's noise. Below 1 a loop helps, above 1 it "
    "amplifies."
)
_HEARD = (
    "Of each controller alone, exactly: noise of its sensors through regulator and actuator, as means over "
    "frames. It is a part of what is left."
)


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
    rows = by_controller(cases, names)
    yield from loops_over_frequency(f"{disturbance}-", curves_of(rows))
    left, count = _left(cases, models)
    if left:
        yield picture(
            f"{disturbance}-spectrum",
            "Spectrum of the line of sight, and how its rms adds up",
            spectra(left, "What is left of the line of sight", unit),
            f"Of the histories of {counted(count, 'case')}, both axes, each about its mean, with noise; the "
            "thick line is the motion without a loop. Below is the rms of all that is faster than a "
            "frequency: the residual comes from where a curve rises to the left.",
        )
    elif predicted := _predicted(cases, names):
        yield picture(
            f"{disturbance}-spectrum",
            "Spectrum of the line of sight, and how its rms adds up",
            spectra(predicted, "What |S|² leaves of the line of sight", unit),
            f"The motion of {counted(min(cases.sizes['case'], _MOST), 'case')} without a loop, both axes, at "
            "all instants that loops see, of which the store keeps too few; and times |S|² of each linear "
            "controller alone, up to half the rate of its commands. Noise is not in it. Below is the rms of "
            "all that is faster than a frequency.",
        )
    for key, what, of in (("los", "line of sight", unit), ("wfe", "wavefront", "nm")):
        heard = spectra_of(rows, f"noise_{key}")
        if heard and max(one.above[0] for one in heard) > _NOTHING * most[key]:
            yield noise_picture(f"{disturbance}-noise-{key}", what, of, heard)


def loops_over_frequency(
    key: str, curves: Sequence[Curve], gains: str = _GAINS, sensitivity: str = SENSITIVITY
) -> Iterator[Picture]:
    """Draw loop gains with their margins, and sensitivities, where there is a linear loop.

    Parameters
    ----------
    key : str
        What their names in a page begin with.
    curves : sequence of Curve
    gains, sensitivity : str
        What is drawn, for those who read it.
    """
    if not curves:
        return
    words = f"{gains} {_BARS}"
    yield picture(f"{key}bode", "Loop gain over frequency with its margins", bode(curves), words)
    yield picture(f"{key}nyquist", "Loop gain in the complex plane", nyquist(curves), NYQUIST)
    title = "Sensitivity and complementary sensitivity"
    yield picture(f"{key}rejection", title, sensitivities(curves), sensitivity)


def noise_picture(key: str, what: str, unit: str, heard: Sequence[Spectrum], words: str = _HEARD) -> Picture:
    """Draw what sensor noise does."""
    figure = spectra(heard, f"Sensor noise in the {what}", unit)
    return picture(key, f"What sensor noise does to the {what}", figure, words)


def curves_of(rows: Rows) -> list[Curve]:
    """Return those of some loops over frequency that are linear, whatever kind of store they are of.

    |S| and |T| are those of the worst eigenvalue, or largest singular values: stores have one of both.
    """
    found = []
    for label, one in rows:
        size, phase = (
            one[name].transpose("frequency", ...).to_numpy() for name in ("loop_gain", "loop_phase")
        )
        if np.isfinite(size).any():
            rejection, passed = (
                next(one[name].to_numpy() for name in names if name in one) for names in _SENSITIVITIES
            )
            margins = float(one["gain_up"]), float(one["phase_margin"])
            hertz = one["frequency"].to_numpy()
            found.append(Curve(label, hertz, locus(size, phase), rejection, passed, *margins))
    return found


def spectra_of(rows: Rows, key: str, *, flat: bool = True) -> list[Spectrum]:
    """Return the spectra of some loops that a store keeps under a name, where there is anything."""
    known = [(label, one["frequency"].to_numpy(), one[key].to_numpy()) for label, one in rows]
    return [
        of_density(label, hertz, density, flat=flat)
        for label, hertz, density in known
        if np.nan_to_num(density).max() > 0
    ]


def by_controller(cases: xr.Dataset, names: Iterable[str]) -> list[tuple[str, xr.Dataset]]:
    """Return what a store has of each of some controllers, with their names."""
    return [(name, cases.sel(controller=name)) for name in names]


def locus(size: Array, phase: Array) -> NDArray[np.complex128]:
    """Return different eigenvalues (f, m) of sizes and phases, deg, (f,) or (f, margin)."""
    gain = np.reshape(size * np.exp(1j * np.radians(phase)), (len(size), -1))
    kept = [k for k in range(gain.shape[1]) if k == 0 or not np.array_equal(gain[:, k], gain[:, 0], True)]
    return np.asarray(gain[:, kept])


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


def _predicted(cases: xr.Dataset, names: Sequence[str]) -> list[Spectrum]:
    """Return the spectra of a motion without a loop that a store keeps, and what |S|^2 leaves of them."""
    if "open_psd" not in cases:
        return []
    hertz, motion = cases["frequency"].to_numpy(), cases["open_psd"].isel(case=slice(0, _MOST))
    density = motion.mean("case").to_numpy()
    left = [
        of_density(name, hertz, density * size**2)
        for name, size in zip(names, cases["rejection"].sel(controller=list(names)).to_numpy(), strict=True)
        if np.isfinite(size).any()
    ]
    return [of_density("without a loop", hertz, density, calm=True), *left] if left else []
