"""The deformed mirror as a body, exaggerated (Störkle 2018, Fig. 4.24)."""

import numpy as np
import xarray as xr
from matplotlib import colormaps, rc_context
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from numpy.typing import NDArray

from wavequake.optics.polynomials.zernike import annular_zernike
from wavequake.report.figures import STYLE, WIDTH
from wavequake.report.mirrors.variants import VariantResult
from wavequake.report.table import number

Array = NDArray[np.float64]

_RINGS, _SECTORS = 16, 96
# Of the radius: the largest height as drawn, and the rim, which is no more than a hint of the thickness.
_HEIGHT, _RIM = 0.15, 0.08
_ELEVATION = np.radians(35.0)


@rc_context(STYLE)
def bodies(dataset: xr.Dataset, reference: VariantResult) -> Figure:
    """Draw the mirror under each excitation when the wavefront of the reference is worst."""
    one = dataset.sel(case=reference.case)
    names = [str(name) for name in dataset["excitation"].to_numpy()]
    worst = one["wfe_rms"].to_numpy().argmax(axis=1)
    columns = min(len(names), 4)
    rows = -(-len(names) // columns)
    width = 2 * WIDTH / max(columns, 2)
    figure = Figure(figsize=(columns * width, 0.9 * width * rows), layout="constrained")
    for place, name in enumerate(names):
        axes = figure.add_subplot(rows, columns, place + 1)
        heights, node = _heights(one, place)
        largest = float(np.abs(heights).max())
        axes.add_collection(_drawn(heights, float(one["obscuration"])))
        axes.plot(*node, "o", markersize=4, markerfacecolor="none", color="#222222")
        instant = 1e3 * float(dataset["time"][worst[place]])
        axes.set_title(f"{name}, {instant:.4g} ms, up to {number(largest)} µm", fontsize=8)
        axes.set_aspect("equal")
        axes.set_xlim(-1.05, 1.05)
        axes.set_ylim(-0.85, 0.8)
        axes.set_axis_off()
    return figure


def _heights(one: xr.Dataset, excitation: int) -> tuple[Array, Array]:
    """Return heights toward the light at corners of polar cells, um, and where to draw the node."""
    numbers = one["peak_figure"].to_numpy()[excitation]
    numbers = numbers[np.isfinite(numbers)]
    obscuration = float(one["obscuration"])
    x, y = _corners(obscuration)
    basis = annular_zernike(x.ravel(), y.ravel(), len(numbers), obscuration)
    heights = -(basis @ numbers).reshape(x.shape)
    angle = np.radians(float(one["node_angle"]))
    rim = np.array([np.cos(angle)]), np.array([np.sin(angle)])
    height = -(annular_zernike(*rim, len(numbers), obscuration) @ numbers)
    scale = _HEIGHT / (np.abs(heights).max() or 1.0)
    return heights, _projected(np.array([rim[0][0], rim[1][0], scale * height[0]]))


def _corners(obscuration: float) -> tuple[Array, Array]:
    radius = np.linspace(obscuration, 1.0, _RINGS + 1)[:, None]
    angle = np.linspace(0.0, 2.0 * np.pi, _SECTORS + 1)
    return radius * np.cos(angle), radius * np.sin(angle)


def _projected(points: Array) -> Array:
    """Return x and y of points (..., 3) as seen from the front, above."""
    x, y, z = np.moveaxis(points, -1, 0)
    return np.stack([x, np.sin(_ELEVATION) * y + np.cos(_ELEVATION) * z], axis=-1)


def _drawn(heights: Array, obscuration: float) -> PolyCollection:
    """Return the cells of the face and of the outer rim, those in front last, colored by height."""
    x, y = _corners(obscuration)
    top = np.stack([x, y, heights * (_HEIGHT / (np.abs(heights).max() or 1.0))], axis=-1)
    rim = np.stack([top[-1], top[-1] - np.array([0.0, 0.0, _RIM])])
    cells, values = [], []
    for sheet, height in ((top, heights), (rim, np.stack([heights[-1], heights[-1]]))):
        corners = (sheet[:-1, :-1], sheet[1:, :-1], sheet[1:, 1:], sheet[:-1, 1:])
        cells.append(np.stack(corners, axis=2).reshape(-1, 4, 3))
        values.append((height[:-1, :-1] + height[1:, 1:]).ravel() / 2.0)
    quads, colors = np.concatenate(cells), np.concatenate(values)
    largest = float(np.abs(heights).max()) or 1.0
    shown = colormaps["RdBu_r"](0.5 + 0.5 * colors / largest)
    shown[len(values[0]) :, :3] *= 0.6  # the rim is in the shade
    order = np.argsort(-quads[:, :, 1].mean(axis=1), kind="stable")
    return PolyCollection(
        list(_projected(quads)[order]), facecolors=shown[order], edgecolors="face", linewidths=0.3
    )
