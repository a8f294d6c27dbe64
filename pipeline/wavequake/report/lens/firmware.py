"""What the firmware did in a lens-experiment store, beside the same regulator in double precision."""

from dataclasses import dataclass

import numpy as np
import xarray as xr
from matplotlib import rc_context
from matplotlib.figure import Figure
from numpy.typing import NDArray

from wavequake.report.figures import COLORS, HEIGHT, STYLE, WIDTH, curve_style
from wavequake.report.mirrors.variants import few
from wavequake.report.statistics import distribution
from wavequake.report.table import number
from wavequake.workflows.kinds import study_of
from wavequake.workflows.lens.experiment import exact_of

Array = NDArray[np.float64]
_MOST_POINTS = 2000  # of a figure


@dataclass(frozen=True)
class Firmware:
    """The runs of c plants in the study's arithmetics a.

    Attributes
    ----------
    arithmetic : tuple of str
    hashes : ndarray of uint64, shape (c, a)
    largest, rms : ndarray, shape (c, a)
        Of the commands' difference from those in double precision, um.
    left, exact : ndarray, shapes (2, c, a), (2, c, 1)
        Range and late deviation that the firmware leaves, and the same regulator in double precision, in %
        of uncontrolled.
    """

    arithmetic: tuple[str, ...]
    hashes: NDArray[np.uint64]
    largest: Array
    rms: Array
    left: Array
    exact: Array

    @property
    def apart(self) -> Array:
        """How much more the firmware leaves than double precision, percentage points, (2, c, a)."""
        return np.asarray(self.left - self.exact)

    def cells(self, controller: str) -> tuple[tuple[str, str], tuple[str, str]]:
        """Return image and difference of commands of a controller for the table: value, small print."""
        name = controller.removeprefix("firmware-")
        if controller == name:
            return ("", ""), ("", "")
        place = self.arithmetic.index(name)
        known = np.unique(self.hashes[:, place])
        image = f"{int(known[0]):016x}" if len(known) == 1 else f"{len(known)} images"
        rms, largest = float(np.median(self.rms[:, place])), float(self.largest[:, place].max())
        return (image, ""), (number(rms, 2), f"at most {number(largest, 2)}")

    def answer(self) -> str:
        """Say how far the firmware is from double precision."""
        worst = np.abs(self.apart).max(axis=(0, 1))
        parts = ", ".join(
            f"{number(float(value), 2)} ({name})" for name, value in zip(self.arithmetic, worst, strict=True)
        )
        return (
            f"In {self.hashes.size} runs of the firmware, what is left differs from that in double precision "
            f"by at most {parts} percentage points."
        )


def firmware_of(dataset: xr.Dataset, rows: NDArray[np.int64]) -> Firmware | None:
    """Read what images did in some rows of a dataset; None if its study runs none."""
    if "firmware_hash" not in dataset:
        return None
    chosen = dataset.isel(case=rows)
    arithmetic = tuple(str(one) for one in dataset["firmware"].to_numpy())
    controllers = [str(one) for one in dataset["controller"].to_numpy()]
    places = [controllers.index(f"firmware-{one}") for one in arithmetic]
    left = np.stack([chosen[key].to_numpy() for key in ("peak_to_peak", "deviation")])
    exact = controllers.index(exact_of(study_of(dataset.attrs["study"])))
    largest, rms = (chosen[f"firmware_{key}"].to_numpy() for key in ("difference", "rms"))
    hashes = chosen["firmware_hash"].to_numpy()
    return Firmware(arithmetic, hashes, largest, rms, left[..., places], left[..., [exact]])


@rc_context(STYLE)
def off_exact(firmware: Firmware) -> Figure:
    """Show over plants how far commands are off those in double precision."""
    figure = Figure(figsize=(1.4 * WIDTH, HEIGHT))
    axes = figure.add_axes((0.09, 0.15, 0.89, 0.75))
    for place, name in enumerate(firmware.arithmetic):
        curve = distribution(firmware.rms[:, place], points=_MOST_POINTS)
        axes.step(
            curve.values,
            100 * curve.probability,
            where="post",
            label=name,
            **curve_style(place),
        )
    axes.set_xlim(left=0)
    axes.set_ylim(0, 103)
    axes.set_xlabel("rms difference of commands from double precision (µm); the converter's step is 3.9 µm")
    axes.set_ylabel("plants (%)")
    axes.legend(loc="lower right")
    return figure


@rc_context(STYLE)
def left_beside(firmware: Firmware) -> Figure:
    """Show over plants how much more the firmware leaves than double precision, range and deviation."""
    figure = Figure(figsize=(1.4 * WIDTH, HEIGHT))
    for half, title in enumerate(("range", "standard deviation, t > 1 s")):
        axes = figure.add_axes((0.11 + 0.48 * half, 0.15, 0.39, 0.75))
        for place, name in enumerate(firmware.arithmetic):
            apart = firmware.apart[half, :, place]
            drawn = np.sort(few(np.argsort(apart).tolist(), _MOST_POINTS))
            axes.plot(
                firmware.exact[half, drawn, 0], apart[drawn], "o",
                color=COLORS[place], markersize=3, fillstyle="none", markeredgewidth=0.6, label=name,
            )  # fmt: skip
        axes.axhline(0.0, color="#888888", linewidth=0.6)
        axes.set_xlabel("left in double precision (%)")
        axes.set_title(title)
        if half == 0:
            axes.set_ylabel("firmware's more (points)")
            axes.legend(loc="best")
    return figure
