"""The report of a telescope-loop or system-loop store: what controllers leave of wavefront and image."""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from matplotlib import rc_context
from matplotlib.figure import Figure
from numpy.typing import NDArray
from rich.table import Table

from wavequake.campaign.contract import DONE
from wavequake.report.exposures import figures as draw
from wavequake.report.exposures import tables as common
from wavequake.report.figures import HEIGHT, STYLE, curve_style, stacked
from wavequake.report.histories import has_histories, over_time, what_is_kept
from wavequake.report.loops.over_frequency import over_frequency
from wavequake.report.page import Page, Picture, Section, picture
from wavequake.report.populations import frame_of, left_out
from wavequake.report.table import number, radius, table_of_rows
from wavequake.workflows.loops.controller_names import explain_names

Array = NDArray[np.float64]

_FIGURES = ("m2-figure", "m2-influence", "m2-body")
_IDEAL = ("off", "perfect")
# A wavefront that falls by less is not what the controller is for.
_HELPS = 0.99
# Of the largest in a table, what is written as none if it is below its error.
_NOTHING = 1e-3
_GREYS = {"off": "#999999", "perfect": "#444444"}
_MEDIANS = (
    "Medians over cases of each case's rms over time. WFE: of the fitted Zernike terms j ≥ 4. LOS: distance "
    "of the line of sight from rest. Largest: position of any channel of the actuator. Limited: commands "
    "that stroke or slew cut."
)
_TRACED = {
    "peak": "Peak: of the exposure, 1 = perfect image. EE80: radius that holds 80 % of its energy.",
    "light_error_los": "Light error: of the loop's linear light, of the WFE, from rays traced in full.",
}
_SMALL_PRINT = (
    "Medians over cases of each case's rms over time; all controllers of a case share its draw. In small "
    "print the share of what is left without a controller (off). Peak: of the exposure, 1 = perfect image."
)
_DEFINITIONS = (
    (
        "controller",
        "Its name, and behind slashes the values of its keys of `vary`, in their order: with bandwidth_hz "
        "and latency_frames, rigid/60/2 is the loop of 60 Hz that acts two frames late.",
    ),
    ("WFE", "Rms of the fitted Zernike terms j ≥ 4, with that at rest."),
    ("LOS", "Distance of the line of sight from rest."),
    ("perfect", "Acts at once on the same instant's reading, without delay, noise, dynamics or limits."),
    (
        "largest",
        "Largest position of any of the actuator's channels: nm of shifts and figures, nrad of turns.",
    ),
    ("limited", "Share of the commands of all channels that stroke or slew cut."),
    (
        "light error",
        "Largest difference of the loop's linear light from rays that are traced in full, at the traced "
        "instants: of the WFE, and in small print of the LOS. Where it is below a thousandth of the largest "
        "in the table, what is left and smaller than it is written as 0.",
    ),
)


@dataclass(frozen=True)
class Result:
    """What a controller leaves: medians over cases; traced numbers are NaN where nothing was traced."""

    name: str
    wfe: float
    los: float
    peak: float
    ee80: float
    largest: float
    limited: float
    wfe_error: float
    los_error: float


def controllers_of(dataset: xr.Dataset) -> dict[str, dict[str, Any]]:
    """Return the keys of every controller of a store, by name."""
    return {one["name"]: one for one in json.loads(dataset.attrs["study"])["controller"]}


def results(cases: xr.Dataset) -> list[Result]:
    """Return what each controller leaves of some cases."""
    wfe, los = (_case_rms(cases[name]).compute() for name in ("wfe_rms", "los"))
    known = ("peak", "ee80", "largest", "limited", "light_error_wfe_rms", "light_error_los")
    others = cases[[one for one in known if one in cases]].compute()
    found = []
    for index, name in enumerate(map(str, cases["controller"].to_numpy())):
        middle = [float(np.median(one.isel(controller=index))) for one in (wfe, los)]
        for key in known:
            values = others[key].isel(controller=index).to_numpy() if key in others else np.zeros(0)
            values = values[~np.isnan(values)]  # of a share of cases, where not all are traced
            whole = np.max if key.startswith("light") else np.median
            middle.append(float(whole(values)) if len(values) else np.nan)
        found.append(Result(name, *middle))
    most = [max(getattr(one, key) for one in found) for key in ("wfe", "los")] if found else []
    return [
        replace(one, wfe=_known(one.wfe, one.wfe_error, most[0]), los=_known(one.los, one.los_error, most[1]))
        for one in found
    ]


def _known(value: float, error: float, most: float) -> float:
    """Return a value, 0 where the linear light that it comes from is off by more, and by nothing of the most.

    What is off by much is no reason to call a controller the best.
    """
    return 0.0 if value < error < _NOTHING * most else value


def _case_rms(values: xr.DataArray) -> xr.DataArray:
    if "statistic" in values.dims:
        return over_time(values, "rms")
    squares = values**2
    if "axis" in values.dims:
        squares = squares.sum("axis", skipna=False)
    found: xr.DataArray = squares.mean("time") ** 0.5
    return found


def seen_by_loops(dataset: xr.Dataset) -> xr.Dataset:
    """Return a store as its loops see it: of a ``system-loop`` the first field point, image motion in um."""
    if "los_mm" not in dataset:
        return dataset
    away = dataset["wavelength"].to_numpy() - float(dataset["loop_wavelength_nm"])
    wavelength = int(np.abs(away).argmin())
    one = dataset.isel(field=0, wavelength=wavelength)
    far = {"los": one["los_mm"], "light_error_los": one["light_error_los"]}
    return one.assign({name: (1e3 * values).assign_attrs(units="um") for name, values in far.items()})


def sight_unit(dataset: xr.Dataset) -> str:
    """Return the unit of a store's line of sight, as reports write it."""
    return str(dataset["los"].attrs["units"]).replace("um", "µm")


def answer(dataset: xr.Dataset) -> str:
    """Say how near the best controller of each actuator comes to the perfect one."""
    known, words = controllers_of(dataset), []
    for disturbance, cases in common.finished(dataset, "disturbance"):
        found = {one.name: one for one in results(cases)}
        off = next((found[name] for name, one in known.items() if one["model"] == "off"), None)
        for actuator in _actuators(known):
            names = [name for name, one in known.items() if one["actuator"] == actuator]
            acting = [found[one] for one in names if known[one]["model"] not in _IDEAL]
            ideal = next((found[one] for one in names if known[one]["model"] == "perfect"), None)
            if not acting:
                continue
            best, calm = _best(acting)
            beside = {key: one for key, one in (("off", off), ("perfect", ideal)) if one is not None}
            others = {key: one.los for key, one in beside.items()}
            parts = [_least("motion of the line of sight", sight_unit(dataset), calm, calm.los, others)]
            if off is None or best.wfe < _HELPS * off.wfe:
                others = {key: one.wfe for key, one in beside.items()}
                parts.insert(0, _least("wavefront error", "nm", best, best.wfe, others))
            words.append(f"{disturbance}, {actuator}: {'; '.join(parts)}.")
    return " ".join(words) or "No case is done yet."


def _best(acting: Sequence[Result]) -> tuple[Result, Result]:
    """Return the controllers that leave the least wavefront error and the least line of sight."""
    return min(acting, key=lambda one: (one.wfe, one.los)), min(acting, key=lambda one: one.los)


def _least(what: str, unit: str, one: Result, value: float, others: Mapping[str, float]) -> str:
    beside = ", ".join(f"{number(other)} {how}" for how, other in others.items())
    return f"{one.name} leaves the least {what}, {number(value)} {unit}" + (f" ({beside})" if beside else "")


def _actuators(known: dict[str, dict[str, Any]]) -> list[str]:
    return list(dict.fromkeys(one["actuator"] for one in known.values() if one["actuator"]))


def table_of(store: Path, dataset: xr.Dataset) -> Table:
    """Return the table of a store for the terminal."""
    dataset = seen_by_loops(dataset)
    rows = common.without_what_is_alike(_rows(dataset))
    labels = list(rows[0]).index("controller") + 1 if rows else 0
    legend = [_MEDIANS, *(words for key, words in _TRACED.items() if key in dataset)]
    legend += [_traced(dataset), explain_names(controllers_of(dataset).values())]
    legend += [answer(dataset) + what_is_kept(dataset)]
    caption = " ".join(filter(None, legend))
    return table_of_rows(rows, caption, labels)


def _traced(dataset: xr.Dataset) -> str:
    """Say of how many cases the traced numbers are, where not all are traced."""
    if "peak" not in dataset:
        return ""
    done = dataset["peak"].isel(case=dataset["status"].to_numpy() == DONE, controller=0)
    count, whole = int(np.isfinite(done).sum()), done.sizes["case"]
    return "" if count == whole else f"Images and light errors are those of {count} of {whole} cases."


def _rows(dataset: xr.Dataset) -> list[dict[str, tuple[str, str]]]:
    rows, known, units = [], controllers_of(dataset), _units_of(dataset)
    for disturbance, cases in common.finished(dataset, "disturbance"):
        found = results(cases)
        off = next((one for one in found if known[one.name]["model"] == "off"), None)
        for one in found:
            row = {
                "disturbance": (disturbance, ""),
                "controller": (one.name, ""),
                "WFE (nm)": (number(one.wfe), _share(one.wfe, off.wfe if off else None)),
                f"LOS ({sight_unit(dataset)})": (number(one.los), _share(one.los, off.los if off else None)),
            }
            if "peak" in cases:
                row["peak"] = number(one.peak), ""
                row["EE80 (λ/D)"] = radius(one.ee80, frame_of(cases)), ""
            unit = units.get(known[one.name]["actuator"], "")
            row["largest"] = f"{number(one.largest)} {unit}".rstrip(), ""
            row["limited"] = f"{100 * one.limited:.3g} %", ""
            if "light_error_los" in cases:
                row["light error"] = f"{one.wfe_error:.0e} nm", f"{one.los_error:.0e} {sight_unit(dataset)}"
            rows.append(row)
    return rows


def _units_of(dataset: xr.Dataset) -> dict[str, str]:
    """Return the unit of each actuator's positions: of shifts and figures nm, of turns nrad, of both both."""
    found = {}
    for one in json.loads(dataset.attrs["study"])["actuator"]:
        if one.get("dofs"):
            units = ("nrad" if dof.startswith("r") else "nm" for dof in one["dofs"])
            found[one["name"]] = " or ".join(dict.fromkeys(units))
        elif one["model"] in _FIGURES:
            found[one["name"]] = "nm"
    return found


def _share(value: float, of: float | None) -> str:
    return f"{number(100 * value / of)} %" if of else ""


def page_of(store: Path, dataset: xr.Dataset, device: str) -> Page:
    """Return the HTML report."""
    dataset = seen_by_loops(dataset)
    known = controllers_of(dataset)
    sections, overview = [], []
    for disturbance, cases in common.finished(dataset, "disturbance"):
        found = results(cases)
        overview += [*_scans(disturbance, found, known, sight_unit(dataset))]
        sections.append(Section(disturbance, [*_shown(disturbance, cases, found, known)]))
    return Page(
        answer=answer(dataset),
        table=common.without_what_is_alike(_rows(dataset)),
        small_print=" ".join(filter(None, (_SMALL_PRINT, _traced(dataset), explain_names(known.values()))))
        + what_is_kept(dataset),
        overview=overview,
        sections=[one for one in sections if one.figures],
        definitions=list(_DEFINITIONS),
        kind="controller",
        left_out=left_out(dataset),
    )


def _scans(
    disturbance: str, found: Sequence[Result], known: dict[str, dict[str, Any]], unit: str
) -> Iterator[Picture]:
    for actuator in _actuators(known):
        mine = [one for one in found if known[one.name]["actuator"] == actuator]
        acting = [known[one.name] for one in mine if known[one.name]["model"] not in _IDEAL]
        if len({one["latency_frames"] for one in acting}) > 1:
            off = [one for one in found if known[one.name]["model"] == "off"]
            yield picture(
                f"scan-{disturbance}-{actuator}",
                f"What controllers of {actuator} leave over their latency, {disturbance}",
                _scan([*off, *mine], known, unit),
                "Each line is a controller with its gain or bandwidth; flat lines are nothing done (off) and "
                "the perfect correction. Where a line lies above off, the loop does harm.",
            )


def curve_label(one: dict[str, Any]) -> str:
    """Return the name of a controller without its latency, as curves over latency have it."""
    family = str(one["name"]).split("/")[0]
    if one.get("bandwidth_hz") is not None:
        return f"{family}, {one['bandwidth_hz']:g} Hz"
    return f"{family}, gain {one['gain']:g}" if one.get("gain") is not None else family


@rc_context(STYLE)
def _scan(mine: Sequence[Result], known: dict[str, dict[str, Any]], unit: str) -> Figure:
    shown = {"wfe": "wavefront error (nm)", "los": f"line of sight ({unit})"}
    if min(one.wfe for one in mine) > _HELPS * max(one.wfe for one in mine):
        del shown["wfe"]  # a mirror that only tilts leaves it as it is
    figure, panels = stacked(len(shown), height=(0.3 + 0.6 * len(shown)) * HEIGHT)
    for axes, (key, label) in zip(panels, shown.items(), strict=True):
        curves: dict[str, list[tuple[float, float]]] = {}
        for one in mine:
            record = known[one.name]
            if record["model"] in _IDEAL:
                color = _GREYS[record["model"]]
                axes.axhline(getattr(one, key), color=color, linewidth=1.8, linestyle=":", label=one.name)
                continue
            point = float(record["latency_frames"]), float(getattr(one, key))
            curves.setdefault(curve_label(record), []).append(point)
        for place, (name, points) in enumerate(curves.items()):
            axes.plot(*np.array(sorted(points)).T, label=name, marker="o", markersize=3, **curve_style(place))
        axes.set_ylim(bottom=0)
        axes.set_ylabel(label)
    panels[-1].set_xlabel("latency (periods of the controller)")
    handles, labels_ = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels_, loc="outside upper center", fontsize=7, ncols=3)
    return figure


def _shown(
    disturbance: str, cases: xr.Dataset, found: Sequence[Result], known: dict[str, dict[str, Any]]
) -> Iterator[Picture]:
    """Draw a case in the middle, under nothing, the best controller of each actuator and the perfect ones."""
    order = np.argsort(_case_rms(cases["los"]).isel(controller=0).to_numpy(), kind="stable")
    if "peak" in cases:  # of those that are traced, where any is
        traced = np.isfinite(cases["peak"].isel(controller=0).to_numpy())
        order = order[traced[order]] if traced.any() else order
    shown = cases.isel(case=int(order[(len(order) - 1) // 2])).load()
    names = telling(found, known)
    case = int(shown["case"])
    if "exposure" in shown:
        panels = [
            draw.Panel(name, shown["exposure"].sel(controller=name).to_numpy(), np.zeros((0, 2)))
            for name in names
        ]
        yield picture(
            f"{disturbance}-exposure",
            f"Exposures of case {case}",
            draw.exposure_panels(panels, shown["x"].to_numpy()),
            "The mean image of the traced instants, four decades.",
        )
    if "object_image" in shown:
        seen = shown["object_image"]
        images = {name: seen.sel(controller=name).to_numpy() for name in names}
        words = f"case {case} exposes it"
        yield common.object_picture(disturbance, words, images, seen, shown["x"].to_numpy())
    if has_histories(shown):
        time = shown["time_s"].to_numpy()
        kept = np.isfinite(time)
        tracks = {name: shown["los"].sel(controller=name).to_numpy()[kept] for name in names}
        wfe = {name: shown["wfe_rms"].sel(controller=name).to_numpy()[kept] for name in names}
        yield from common.history_pictures(disturbance, time[kept] * 1e3, tracks, sight_unit(shown), wfe)
    most = {key: max(getattr(one, key) for one in found) for key in ("los", "wfe")}
    models = {name: known[name]["model"] for name in names}
    yield from over_frequency(disturbance, cases, models, sight_unit(cases), most)


def telling(found: Sequence[Result], known: dict[str, dict[str, Any]]) -> list[str]:
    """Return nothing done, the perfect controllers, and the best one of each actuator."""
    names = [one.name for one in found if known[one.name]["model"] in _IDEAL]
    for actuator in _actuators(known):
        mine = [one for one in found if known[one.name]["actuator"] == actuator]
        acting = [one for one in mine if known[one.name]["model"] not in _IDEAL]
        if acting:
            best, calm = _best(acting)
            helps = best.wfe < _HELPS * max(one.wfe for one in mine)
            names.append((best if helps else calm).name)
    return names
