"""Figures of point spread functions: on a logarithmic scale, their MTF, through focus."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib import rc_context
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.path import Path
from numpy.typing import NDArray

from wavequake.drawing.color_scales import colorbar
from wavequake.drawing.ticks import in_inches
from wavequake.imaging.exposures.mtf import modulation_transfer
from wavequake.report.figures import HEIGHT, STYLE, WIDTH, curve_style, one_panel
from wavequake.report.table import number

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_CELLS = 512  # across a pupil


@rc_context(STYLE)
def log_psf(image: Array, axis: Array, decades: int = 5) -> Figure:
    """Show an image (n, n) on a logarithmic scale; `axis` (n,) is in wavelengths / diameter."""
    figure = Figure(figsize=(WIDTH, HEIGHT))
    axes = in_inches(figure, 0.65, 0.5, HEIGHT - 0.95, HEIGHT - 0.95)
    top = float(image.max())
    floor = 10.0**-decades * top
    picture = axes.imshow(
        np.maximum(image, floor), norm=LogNorm(floor, top), origin="lower", extent=_extent(axis)
    )
    axes.set_xlabel("x (λ/D)")
    axes.set_ylabel("y (λ/D)")
    colorbar(figure, axes, picture, "irradiance; 1 = perfect peak")
    return figure


def annulus(obscuration: float) -> Mask:
    """Return which cells (n, n) over the diameter of a pupil are lit, of an annulus."""
    axis = (2.0 * np.arange(_CELLS) + 1.0 - _CELLS) / _CELLS
    radius = np.hypot(*np.meshgrid(axis, axis))
    return (radius <= 1.0) & (radius >= obscuration)


def polygons(corners: Array, outer: float) -> Mask:
    """Return the same of polygons (S, V, 2) within the radius `outer`, in their unit."""
    axis = outer * (2.0 * np.arange(_CELLS) + 1.0 - _CELLS) / _CELLS
    lit = np.zeros((_CELLS, _CELLS), dtype=bool)
    for one in corners:
        (left, low), (right, high) = one.min(axis=0), one.max(axis=0)
        x, y = (slice(*np.searchsorted(axis, ends)) for ends in ((left, right), (low, high)))
        places = np.stack(np.meshgrid(axis[x], axis[y]), axis=-1)
        inside = Path(one).contains_points(places.reshape(-1, 2))
        lit[y, x] |= inside.reshape(places.shape[:2])
    return lit


def perfect_mtf(pupil: Mask) -> tuple[Array, Array]:
    """Return frequencies along x, cycles per lambda/D, and the MTF of a pupil without aberration.

    It is the autocorrelation of the pupil: the share of it that lies on its copy, shifted by the frequency.
    """
    count = len(pupil)
    rows = np.fft.rfft(pupil.astype(np.float64), 2 * count, axis=1)
    shared = np.fft.irfft(np.sum(np.abs(rows) ** 2, axis=0))[: count + 1]
    return np.arange(count + 1) / count, shared / shared[0]


def frame_mtf(image: Array, sampling: float, pupil: Mask) -> tuple[Array, Array]:
    """Return frequencies and MTF along x of an image, over the energy of the whole one.

    An image holds the part of the light that its frame shows; over its own sum the curve would rise by what
    is missing, above that of the perfect image. A peak of 1 stands for the square of the diameter over the
    area of the pupil.

    Parameters
    ----------
    image : ndarray, shape (n, n)
        Relative to the peak of the perfect one.
    sampling : float
        Wavelengths / diameter per pixel.
    pupil : ndarray of bool, shape (m, m)
        Cells over the diameter that are lit.
    """
    frequency, mtf = modulation_transfer(image, sampling)
    row = mtf[len(mtf) // 2] * (float(image.sum()) * sampling**2 * float(pupil.mean()))
    kept = (frequency > 0.0) & (frequency <= 1.0)
    return np.append(0.0, frequency[kept]), np.append(1.0, row[kept])


@rc_context(STYLE)
def mtf_curves(images: Mapping[str, Array], sampling: float, pupil: Mask) -> Figure:
    """Draw the MTF of images along x, and that of their pupil without aberration (`frame_mtf`)."""
    figure, axes = one_panel()
    for index, (name, image) in enumerate(images.items()):
        axes.plot(
            *frame_mtf(image, sampling, pupil),
            label=name,
            **curve_style(index),
        )
    axes.plot(*perfect_mtf(pupil), color="#999999", linewidth=2.6, zorder=0, label="perfect pupil")
    axes.set_xlabel("spatial frequency along x (cycles per λ/D)")
    axes.set_ylabel("modulation transfer")
    axes.set_ylim(0.0, 1.05)
    axes.legend(fontsize=7.5)
    return figure


def focus_panels(images: Array, defocus: Sequence[float], axis: Array, unit: str = "waves") -> Figure:
    """Show images (k, n, n) through focus side by side, each with the same scale of square roots."""
    return image_row(images, [f"{value:+.3g} {unit}" if value else "in focus" for value in defocus], axis)


@rc_context(STYLE)
def image_row(
    images: Array, titles: Sequence[str], axis: Array, unit: str = "λ/D", scale: str = ""
) -> Figure:
    """Show images (k, n, n) side by side, each with the same scale of square roots, and what it measures."""
    wide = 2.0 * WIDTH if len(images) > 3 else WIDTH
    figure = Figure(figsize=(wide, wide / max(len(images), 2) + 0.7), layout="constrained")
    places = figure.subplots(1, len(images), sharey=True, squeeze=False).ravel()
    top = float(np.sqrt(images.max()))
    for place, image, title in zip(places, images, titles, strict=True):
        shown = place.imshow(
            np.sqrt(np.maximum(image, 0.0)), vmin=0.0, vmax=top, origin="lower", extent=_extent(axis)
        )
        place.set_title(title, fontsize=8)
        place.tick_params(labelsize=7)
    figure.supxlabel(f"x ({unit})", fontsize=8)
    places[0].set_ylabel(f"y ({unit})", fontsize=8)
    if scale and top > 0.0:
        ticks = top * np.array([0.0, 0.5, 0.75, 1.0])
        bar = figure.colorbar(shown, ax=list(places), ticks=ticks, shrink=0.8)
        bar.ax.set_yticklabels([number(float(tick) ** 2) for tick in ticks], fontsize=7)
        bar.set_label(scale, fontsize=8)
    return figure


def _extent(axis: Array) -> tuple[float, float, float, float]:
    half = 0.5 * (axis[1] - axis[0])
    return (axis[0] - half, axis[-1] + half, axis[0] - half, axis[-1] + half)
