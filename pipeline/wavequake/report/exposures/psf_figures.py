"""Figures of point spread functions: on a logarithmic scale, their MTF, through focus."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib import rc_context
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from numpy.typing import NDArray

from wavequake.imaging.exposures.mtf import ideal_mtf, modulation_transfer
from wavequake.report.figures import COLORS, HEIGHT, LINES, STYLE, WIDTH

Array = NDArray[np.float64]


@rc_context(STYLE)
def log_psf(image: Array, axis: Array, decades: int = 5) -> Figure:
    """Show an image (n, n) on a logarithmic scale; `axis` (n,) is in wavelengths / diameter."""
    figure = Figure(figsize=(WIDTH, HEIGHT), layout="constrained")
    axes = figure.add_subplot()
    top = float(image.max())
    floor = 10.0**-decades * top
    picture = axes.imshow(
        np.maximum(image, floor), norm=LogNorm(floor, top), origin="lower", extent=_extent(axis)
    )
    axes.set_xlabel("x (λ/D)")
    axes.set_ylabel("y (λ/D)")
    figure.colorbar(picture, ax=axes, label="irradiance; 1 = perfect peak")
    return figure


@rc_context(STYLE)
def mtf_curves(images: Mapping[str, Array], sampling: float) -> Figure:
    """Draw the MTF of images along x, and that of a perfect circular pupil."""
    figure = Figure(figsize=(WIDTH, HEIGHT), layout="constrained")
    axes = figure.add_subplot()
    for number, (name, image) in enumerate(images.items()):
        frequency, mtf = modulation_transfer(image, sampling)
        kept = (frequency >= 0.0) & (frequency <= 1.0)
        axes.plot(
            frequency[kept],
            mtf[len(mtf) // 2, kept],
            label=name,
            linewidth=1.3,
            color=COLORS[number % len(COLORS)],
            linestyle=LINES[number % len(LINES)],
        )
    at = np.linspace(0.0, 1.0, 101)
    axes.plot(at, ideal_mtf(at), color="#999999", linewidth=2.6, zorder=0, label="perfect circular pupil")
    axes.set_xlabel("spatial frequency along x (cycles per λ/D)")
    axes.set_ylabel("modulation transfer")
    axes.set_ylim(0.0, 1.05)
    axes.legend(fontsize=7.5)
    return figure


def focus_panels(images: Array, defocus: Sequence[float], axis: Array, unit: str = "waves") -> Figure:
    """Show images (k, n, n) through focus side by side, each with the same scale of square roots."""
    return image_row(images, [f"{value:+.3g} {unit}" for value in defocus], axis)


@rc_context(STYLE)
def image_row(images: Array, titles: Sequence[str], axis: Array) -> Figure:
    """Show images (k, n, n) side by side, each with the same scale of square roots."""
    figure = Figure(figsize=(WIDTH, WIDTH / max(len(images), 2) + 0.9), layout="constrained")
    places = figure.subplots(1, len(images), sharey=True, squeeze=False).ravel()
    top = float(np.sqrt(images.max()))
    for place, image, title in zip(places, images, titles, strict=True):
        place.imshow(
            np.sqrt(np.maximum(image, 0.0)), vmin=0.0, vmax=top, origin="lower", extent=_extent(axis)
        )
        place.set_title(title, fontsize=8)
        place.tick_params(labelsize=7)
    figure.supxlabel("x (λ/D)", fontsize=8)
    return figure


def _extent(axis: Array) -> tuple[float, float, float, float]:
    half = 0.5 * (axis[1] - axis[0])
    return (axis[0] - half, axis[-1] + half, axis[0] - half, axis[-1] + half)
