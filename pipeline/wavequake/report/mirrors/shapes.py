"""Pictures of mirror-mor: modes and wavefronts over the pupil, and a node over time.

After Figs. 4.16, 4.21b to 4.24, 4.28 and 4.35 of Störkle 2018.
"""

from collections.abc import Iterable, Sequence
from functools import lru_cache

import numpy as np
import xarray as xr
from matplotlib import rc_context
from matplotlib.figure import Figure
from numpy.typing import NDArray

from wavequake.optics.polynomials.zernike import annular_zernike
from wavequake.report.figures import STYLE, WIDTH, one_panel
from wavequake.report.histories import has_all_instants
from wavequake.report.mirrors.deformed_body import bodies
from wavequake.report.mirrors.figures import beside_reference
from wavequake.report.mirrors.variants import ModelResult, VariantResult, representatives
from wavequake.report.page import Picture, picture
from wavequake.report.table import number as shortened
from wavequake.workflows.mirrors.shapes import PAIR

Array = NDArray[np.float64]

_PIXELS, _COLUMNS, _ROWS = 72, 6, 4


def pictures(dataset: xr.Dataset, model: ModelResult) -> Iterable[Picture]:
    """Yield the pictures of one model; none for a store that was made before there were such shapes."""
    if model.reference is None or not model.variants or "mode_figure" not in dataset:
        return
    reference, shown = model.reference, representatives(model, _ROWS - 1)
    yield picture(
        f"{model.name}-modes",
        "Elastic modes, and what they do to the light",
        modes(dataset, reference),
        "Above the displacement of the surface, below the wavefront: red forward, blue back.",
    )
    yield picture(
        f"{model.name}-variant-modes",
        "Modes of variants on the mirror",
        modes_of_variants(dataset, shown, reference),
        "A column is one mode: a variant that shows another picture has lost it.",
    )
    if not has_all_instants(dataset):  # the worst one may be missing
        return
    yield picture(
        f"{model.name}-peaks",
        "Wavefronts when that of the reference is worst",
        peak_wavefronts(dataset, shown, reference),
        "All at the same instant and on one color scale.",
    )
    if "peak_figure" in dataset:
        yield picture(
            f"{model.name}-body",
            "The mirror at these instants",
            bodies(dataset, reference),
            "Exaggerated; the gray grid is the mirror at rest.",
        )
    for excitation in map(str, dataset["excitation"].to_numpy()):
        yield picture(
            f"{model.name}-{excitation}-node",
            f"Motion of a node on the rim, {excitation}",
            node_history(dataset, excitation, representatives(model), reference),
            "The node that moves most: phases that drift apart are wrong frequencies.",
        )


@rc_context(STYLE)
def modes(dataset: xr.Dataset, reference: VariantResult) -> Figure:
    """Draw elastic modes of the reference on the mirror, and their wavefronts without their plane."""
    one = dataset.sel(case=reference.case)
    chosen = distinct(elastic_frequencies(one))
    rows = [
        (_surfaces(one, "mode_figure", 1), [f"{elastic_frequencies(one)[k]:.1f} Hz" for k in chosen]),
        (_surfaces(one, "mode_wavefront", 4), [""] * len(chosen)),
    ]
    return _mosaic(
        [([pictures[k] for k in chosen], words) for pictures, words in rows], ["mirror", "wavefront"]
    )


@rc_context(STYLE)
def modes_of_variants(
    dataset: xr.Dataset, shown: Sequence[VariantResult], reference: VariantResult
) -> Figure:
    """Draw the same modes of the reference and of some variants on the mirror; one of each pair."""
    chosen = distinct(elastic_frequencies(dataset.sel(case=reference.case)))
    rows = []
    for one in (reference, *shown):
        part = dataset.sel(case=one.case)
        frequencies, surfaces = elastic_frequencies(part), _surfaces(part, "mode_figure", 1)
        known = [k for k in chosen if k < len(frequencies)]
        rows.append(([surfaces[k] for k in known], [f"{frequencies[k]:.1f} Hz" for k in known]))
    return _mosaic(rows, [one.variant for one in (reference, *shown)])


@rc_context(STYLE)
def peak_wavefronts(dataset: xr.Dataset, shown: Sequence[VariantResult], reference: VariantResult) -> Figure:
    """Draw the wavefronts of the reference and of variants when that of the reference is worst."""
    worst = dataset["wfe_rms"].sel(case=reference.case).to_numpy().argmax(axis=1)
    every = (reference, *shown)
    cases = [dataset.sel(case=one.case) for one in every]
    surfaces = [_surfaces(case, "peak_wavefront", 4) for case in cases]
    rms = [case["wfe_rms"].to_numpy() for case in cases]
    rows, labels = [], []
    for row, excitation in enumerate(map(str, dataset["excitation"].to_numpy())):
        words = [f"{shortened(values[row, worst[row]])} nm" for values in rms]
        if row == 0:
            words = [f"{one.variant}: {word}" for one, word in zip(every, words, strict=True)]
        rows.append(([tiles[row] for tiles in surfaces], words))
        labels.append(f"{excitation}, {1e3 * float(dataset['time'][worst[row]]):.4g} ms")
    return _mosaic(rows, labels, alike=True)


def node_history(
    dataset: xr.Dataset, excitation: str, shown: Sequence[VariantResult], reference: VariantResult
) -> Figure:
    """Draw the motion of a node, and its error as a share of the largest motion (Figs. 4.21b to 4.23)."""
    motion = dataset["node_motion"].sel(excitation=excitation) * 1e6
    truth = motion.sel(case=reference.case).to_numpy()
    moved = {one.variant: motion.sel(case=one.case).to_numpy() for one in shown}
    largest = max(float(np.abs(truth).max()), 1e-300)
    curves = {name: (values, np.abs(values - truth) / largest) for name, values in moved.items()}
    title = f"{excitation}; gray: {reference.variant}; dashed: 1 %"
    return beside_reference(dataset, truth, curves, title, ("z (µm)", "error / largest z"), 0.01)


def elastic_frequencies(one: xr.Dataset) -> Array:
    """Return the frequencies of the elastic modes of a case whose shapes are stored, Hz."""
    found = one["mode_frequency"].to_numpy()
    elastic = found[np.isfinite(found) & (found > 0.0)]
    return np.asarray(elastic[: one.sizes["elastic_mode"]])


def distinct(frequencies: Array) -> list[int]:
    """Return the first modes, of each pair the first one."""
    near = np.diff(frequencies, prepend=-np.inf) <= PAIR * frequencies
    return [int(k) for k in np.flatnonzero(~near)][:_COLUMNS]


def _surfaces(one: xr.Dataset, name: str, first: int) -> Array:
    """Return what Noll coefficients j >= first look like over the pupil, (m, pixels, pixels); NaN off it."""
    numbers = one[name].to_numpy()
    terms = int(np.isfinite(numbers[0]).sum()) if numbers.ndim == 2 else int(np.isfinite(numbers).sum())
    inside, basis = _basis(terms, float(one["obscuration"]))
    numbers = np.atleast_2d(numbers)[:, first - 1 : terms]
    found = np.full((len(numbers), *inside.shape), np.nan)
    found[:, inside] = numbers @ basis[:, first - 1 :].T
    return found


@lru_cache(maxsize=8)
def _basis(terms: int, obscuration: float) -> tuple[NDArray[np.bool_], Array]:
    """Return which pixels are in the pupil, y upwards, and the polynomials there, (pixels inside, J)."""
    along = (np.arange(_PIXELS) + 0.5) / _PIXELS * 2.0 - 1.0
    x, y = np.meshgrid(along, along)
    radius = np.hypot(x, y)
    inside = (radius <= 1.0) & (radius >= obscuration)
    return inside, annular_zernike(x[inside], y[inside], terms, obscuration)


def _mosaic(
    rows: Sequence[tuple[Sequence[Array], Sequence[str]]], labels: Sequence[str], alike: bool = False
) -> Figure:
    """Draw rows of tiles with words above each, every tile scaled to its largest value, or a row alike.

    One picture of all tiles: a set of axes for each takes twenty times as long.
    """
    columns = max((len(tiles) for tiles, _ in rows), default=0) or 1
    gap = _PIXELS // 4
    cell = _PIXELS + gap
    canvas = np.full((len(rows) * cell, columns * cell), np.nan)
    figure, axes = one_panel(2 * WIDTH, 2 * WIDTH * len(rows) / columns + 0.3)
    for row, (tiles, words) in enumerate(rows):
        bottom = (len(rows) - 1 - row) * cell
        sizes = [float(np.nanmax(np.abs(tile))) for tile in tiles]
        for column, (tile, word) in enumerate(zip(tiles, words, strict=True)):
            scale = max(sizes) if alike else sizes[column]
            place = slice(column * cell + gap // 2, column * cell + gap // 2 + _PIXELS)
            canvas[bottom : bottom + _PIXELS, place] = tile / (scale or 1.0)
            axes.text((column + 0.5) * cell, bottom + _PIXELS + gap * 0.2, word, ha="center", fontsize=8)
        axes.text(
            -0.3 * gap, bottom + _PIXELS / 2, labels[row], ha="right", va="center", fontsize=8, rotation=90
        )
    extent = (0, canvas.shape[1], 0, canvas.shape[0])
    axes.imshow(canvas, cmap="RdBu_r", vmin=-1.0, vmax=1.0, origin="lower", extent=extent)
    axes.set_axis_off()
    return figure
