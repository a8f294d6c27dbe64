"""Figures of mirror-mor and mirror-trace, after Figs. 4.14 to 4.21 and 4.27 to 4.36 of Störkle 2018."""

from collections.abc import Mapping, Sequence

import numpy as np
import xarray as xr
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from wavequake.drawing.ticks import label_powers
from wavequake.report.figures import COLORS, HEIGHT, LINES, STYLE, WIDTH, curve_style, one_panel, stacked
from wavequake.report.mirrors.variants import MEASURES, Criterion, ModelResult, VariantResult, largest

Array = NDArray[np.float64]

_FLOOR = 1e-9  # of errors in a figure
EXPOSED = 3  # variants whose exposures stand beside that of the reference
# Noll indices whose responses Fig. 4.29 shows: one of each pair that three-fold symmetry makes alike.
_SHOWN = (2, 4, 5, 7, 9, 11)


@rc_context(STYLE)
def errors_over_order(models: Sequence[ModelResult], criterion: Criterion) -> Figure:
    """Draw the deciding error of all variants over their order, one marker per method."""
    figure, axes = one_panel()
    methods = list(dict.fromkeys(one.method for model in models for one in model.variants))
    markers = "osD^v<>PX*hd8p"
    for model_number, model in enumerate(models):
        for number, method in enumerate(methods):
            mine = [
                one for one in model.variants if one.method == method and np.isfinite(largest(one, criterion))
            ]
            axes.plot(
                [one.order for one in mine],
                [max(largest(one, criterion), 1e-12) for one in mine],
                markers[number % len(markers)],
                color=COLORS[number % len(COLORS)],
                markersize=5,
                fillstyle="full" if model_number == 0 else "none",
                label=method if model_number == 0 else None,
            )
    axes.axhline(criterion.bound, color="#444444", linewidth=0.8, linestyle=(0, (5, 2)))
    axes.set_yscale("log")
    label_powers(axes.yaxis)
    axes.set_xlabel("order (coordinates of the variant)")
    axes.set_ylabel(f"largest {MEASURES[criterion.measure]}, relative")
    names = [f"{'full' if number == 0 else 'open'}: {model.name}" for number, model in enumerate(models)]
    axes.set_title(", ".join(names) if len(models) > 1 else "")
    if methods:
        axes.legend(fontsize=7.5, ncols=2)
    return figure


@rc_context(STYLE)
def spectra(
    dataset: xr.Dataset, name: str, shown: Sequence[VariantResult], reference: VariantResult | None
) -> Figure:
    """Draw a stored spectrum of some variants over frequency, and that of the reference beneath them."""
    figure, axes = one_panel()
    frequency = dataset["frequency"].to_numpy()
    rows = {int(case): row for row, case in enumerate(dataset["case"].to_numpy())}
    if reference is not None:
        values = dataset[name].isel(case=rows[reference.case]).to_numpy()
        axes.semilogy(frequency, values, color="#999999", linewidth=2.6, label=reference.variant)
    for number, one in enumerate(shown):
        values = dataset[name].isel(case=rows[one.case]).to_numpy()
        axes.semilogy(frequency, np.maximum(values, 1e-16), label=one.variant, **curve_style(number))
    label_powers(axes.yaxis)
    axes.set_xlabel("frequency (Hz)")
    units = dataset[name].attrs.get("units", "1")
    axes.set_ylabel(_SPECTRA[name] + (f" ({units})" if units != "1" else ""))
    axes.legend(fontsize=7.5)
    return figure


_SPECTRA = {
    "frf_mech": "interface receptance, Frobenius norm",
    "eps_mech": "relative error of the receptance",
    "frf_opt": "mechanical-optical response, Frobenius norm",
    "eps_opt": "relative error of the optical response",
}


@rc_context(STYLE)
def coefficient_spectra(dataset: xr.Dataset, reference: VariantResult) -> Figure:
    """Draw which aberrations respond at which frequency, for the reference (Fig. 4.29a)."""
    figure, axes = one_panel()
    values = dataset["frf_zernike"].sel(case=reference.case)
    for number, j in enumerate(j for j in _SHOWN if j in values["noll"].to_numpy()):
        axes.semilogy(
            dataset["frequency"].to_numpy(),
            values.sel(noll=j).to_numpy(),
            label=f"c{j}",
            **curve_style(number),
        )
    label_powers(axes.yaxis)
    axes.set_xlabel("frequency (Hz)")
    axes.set_ylabel("response of the coefficient (nm/N)")
    axes.legend(fontsize=7.5, ncols=2)
    return figure


@rc_context(STYLE)
def models_side_by_side(dataset: xr.Dataset, models: Sequence[ModelResult]) -> Figure:
    """Draw the receptance and the eigenfrequencies of the models' references (Figs. 4.14 and 4.15)."""
    figure = Figure(figsize=(2 * WIDTH, HEIGHT), layout="constrained")
    response, modes = figure.subplots(1, 2)
    for number, model in enumerate(models):
        if model.reference is None:
            continue
        one = dataset.sel(case=model.reference.case)
        style = curve_style(number) | {"label": f"{model.name} ({model.reference.variant})"}
        response.semilogy(dataset["frequency"].to_numpy(), one["frf_mech"].to_numpy(), **style)
        found = one["mode_frequency"].to_numpy()
        modes.plot(np.arange(1, len(found) + 1), found, ".-", color=style["color"], linewidth=0.6)
    label_powers(response.yaxis)
    response.set_xlabel("frequency (Hz)")
    response.set_ylabel("interface receptance (m/N)")
    modes.set_xlabel("mode, rigid motions first")
    modes.set_ylabel("eigenfrequency (Hz)")
    if response.lines:
        response.legend(fontsize=7.5)
    return figure


@rc_context(STYLE)
def mechanical_and_optical(dataset: xr.Dataset, reference: VariantResult) -> Figure:
    """Draw both responses of the reference, scaled alike at the mechanical one's highest peak (Fig. 4.27)."""
    figure, axes = one_panel()
    frequency, other = dataset["frequency"].to_numpy(), axes.twinx()
    one = dataset.sel(case=reference.case)
    # Of the elastic part only: below the first resonance the free mirror just flies.
    mechanical, optical = (one[name].to_numpy() for name in ("frf_mech", "frf_opt"))
    elastic = frequency >= frequency[0] + 0.05 * (frequency[-1] - frequency[0])
    peak = int(np.argmax(np.where(elastic, optical, 0.0)[: len(frequency) // 3 + 1]))
    axes.plot(frequency, mechanical, color=COLORS[0], linewidth=1.2)
    other.plot(frequency, optical, color=COLORS[1], linewidth=1.2, linestyle=LINES[1])
    share = 1.1 * max(
        mechanical[elastic].max() / max(mechanical[peak], 1e-300),
        optical[elastic].max() / max(optical[peak], 1e-300),
    )
    axes.set_ylim(0.0, share * mechanical[peak] if mechanical[peak] > 0 else None)
    other.set_ylim(0.0, share * optical[peak] if optical[peak] > 0 else None)
    axes.set_xlabel("frequency (Hz)")
    axes.set_ylabel("receptance (m/N)", color=COLORS[0])
    other.set_ylabel("optical response (nm/N), dashed", color=COLORS[1])
    return figure


def wavefront_history(
    dataset: xr.Dataset, excitation: str, shown: Sequence[VariantResult], reference: VariantResult
) -> Figure:
    """Draw the wavefront error over time, and beneath it how far the variants are off the reference."""
    part, cases = dataset.sel(excitation=excitation), {one.variant: one.case for one in shown}
    curves = {
        name: tuple(part[key].sel(case=case).to_numpy() for key in ("wfe_rms", "wfe_error"))
        for name, case in cases.items()
    }
    truth, title = part["wfe_rms"].sel(case=reference.case), f"{excitation}; gray: {reference.variant}"
    return beside_reference(
        dataset, truth.to_numpy(), curves, title, ("WFE rms (nm)", "off the reference (nm)")
    )


@rc_context(STYLE)
def beside_reference(
    dataset: xr.Dataset,
    truth: Array,
    curves: Mapping[str, tuple[Array, ...]],
    title: str,
    labels: tuple[str, str],
    line: float | None = None,
) -> Figure:
    """Draw histories (n,) by variant over a gray one of the reference, and beneath how far they are off it.

    `labels` are those of both axes; a dashed `line` marks an error.
    """
    figure, (above, below) = stacked()
    time = dataset["time"].to_numpy() * 1e3
    above.plot(time, truth, color="#999999", linewidth=2.6)
    for number, (name, (values, off)) in enumerate(curves.items()):
        above.plot(time, values, **curve_style(number))
        below.semilogy(time, np.maximum(off, _FLOOR), label=name, **curve_style(number))
    if line is not None:
        below.axhline(line, color="#444444", linewidth=0.8, linestyle=(0, (5, 2)))
    _label_histories(above, below, title, *labels)
    return figure


def _label_histories(above: Axes, below: Axes, title: str, values: str, difference: str) -> None:
    above.set_ylabel(values)
    above.set_title(title)
    label_powers(below.yaxis)
    below.set_ylabel(difference)
    below.set_xlabel("time (ms)")
    below.legend(fontsize=7, ncols=2)


@rc_context(STYLE)
def pseudo_frequencies(shown: Sequence[VariantResult]) -> Figure:
    """Draw the largest pseudo-eigenfrequency of some variants (Fig. 4.21a)."""
    figure, axes = one_panel()
    place = np.arange(len(shown))
    axes.barh(place, [one.pseudo_frequency_max / 1e3 for one in shown], color=COLORS[0])
    axes.set_yticks(place, [one.variant for one in shown])
    axes.invert_yaxis()
    axes.set_xlabel("largest pseudo-eigenfrequency (kHz)")
    return figure


@rc_context(STYLE)
def mac_map(dataset: xr.Dataset, one: VariantResult, reference: VariantResult) -> Figure:
    """Map the modal assurance criterion of a variant's modes with the reference's (Fig. 4.19)."""
    figure, axes = one_panel()
    table: NDArray[np.float64] = dataset["mac"].sel(case=one.case).to_numpy()
    count = int(np.isfinite(table).any(axis=1).sum())
    image = axes.imshow(table[:count], cmap="Greys", vmin=0.0, vmax=1.0, origin="lower", extent=None)
    axes.set_xlabel(f"mode of {reference.variant}")
    axes.set_ylabel(f"mode of {one.variant}")
    figure.colorbar(image, ax=axes, label="MAC", shrink=0.8)
    return figure


@rc_context(STYLE)
def mode_fits(dataset: xr.Dataset, shown: Sequence[VariantResult]) -> Figure:
    """Draw how badly the Zernike polynomials fit each mode of some variants (Fig. 4.36)."""
    figure, axes = one_panel()
    for number, one in enumerate(shown):
        values = dataset["fit_residual"].sel(case=one.case).to_numpy()[: one.order]
        axes.semilogy(
            np.arange(1, len(values) + 1), np.maximum(values, 1e-16), label=one.variant, **curve_style(number)
        )
    label_powers(axes.yaxis)
    axes.set_ylim(bottom=1e-6)
    axes.set_xlabel("mode of the variant, rigid motions first")
    axes.set_ylabel("share of the mode that the fit misses")
    axes.legend(fontsize=7.5)
    return figure


@rc_context(STYLE)
def both_methods(dataset: xr.Dataset, excitation: str, shown: Sequence[tuple[int, str]]) -> Figure:
    """Draw the wavefront error over time by both methods, and beneath it their difference (Fig. 4.33)."""
    figure, (above, below) = stacked()
    time = dataset["time"].to_numpy() * 1e3
    part = dataset.sel(excitation=excitation)
    for number, (case, variant) in enumerate(shown):
        one, color = part.sel(case=case), COLORS[number % len(COLORS)]
        above.plot(time, one["wfe_rms_standard"], color=color, linewidth=2.4, alpha=0.35)
        above.plot(time, one["wfe_rms_modal"], color=color, linewidth=0.9)
        off = np.maximum(one["wfe_difference"].to_numpy(), _FLOOR)
        below.semilogy(time, off, label=variant, **curve_style(number))
    title = f"{excitation}; wide: every instant traced, thin: sensitivities of modes"
    _label_histories(above, below, title, "WFE rms (nm)", "difference (nm)")
    return figure


@rc_context(STYLE)
def costs(seconds: Mapping[str, Mapping[str, float]]) -> Figure:
    """Draw the time of each stage as a bar per variant (Table 4.1)."""
    figure, axes = one_panel(2 * WIDTH, 1.0 + 0.3 * len(seconds))
    start = np.zeros(len(seconds))
    for number, stage in enumerate(next(iter(seconds.values()))):
        width = 1e3 * np.array([stages[stage] for stages in seconds.values()])
        if stage in ("sensitivities", "residual of modes"):  # once, and longer than all others together
            continue
        color, hatch = COLORS[number % len(COLORS)], "///" if number >= len(COLORS) else ""
        rows = np.arange(len(seconds))
        axes.barh(rows, width, left=start, label=stage, color=color, hatch=hatch, edgecolor="white")
        start += width
    axes.set_yticks(np.arange(len(seconds)), list(seconds))
    axes.invert_yaxis()
    axes.set_xlabel("time (ms), without the sensitivities of mirror and model")
    axes.legend(fontsize=7, ncols=5, loc="lower center", bbox_to_anchor=(0.5, 1.0))
    return figure
