"""Allowances as a table, a figure and a CSV file."""

import csv
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray
from rich.table import Table

from wavequake.campaign.schema import Study
from wavequake.drawing.style import COLORS, HEIGHT, STYLE, WIDTH, svg_text
from wavequake.drawing.ticks import number_powers
from wavequake.errors import UserError
from wavequake.report.table import empty_table, number
from wavequake.workflows.allow import Allowances
from wavequake.workflows.asked_sections import RMS, STATIC, AllowSection
from wavequake.workflows.limits import in_unit, unit_of
from wavequake.workflows.systems.study import SystemStudy

Array = NDArray[np.float64]

_FORM = re.compile(r"\s*(\w+(?:\[.*\])?)\.p(\d+(?:\.\d+)?)\s*")
_TURNS = ("rx", "ry", "rz")
_MARKS = "os^Dv<>Xp*"
_FEW = 12  # elements of which each has a row of the table
_NAMES = 40  # elements that are named along an axis
_PICTURES = (".svg", ".png", ".pdf")


@dataclass(frozen=True)
class Asked:
    """What is limited: ``measure`` is ``name`` with its quantile, ``limit`` in its unit."""

    measure: str
    name: str
    probability: float
    limit: float
    by: str


def asked_of(study: Study, measure: str | None, limit: str | float | None, by: str | None) -> Asked:
    """Return what allowances are asked for: by a user, or else by the section ``[allow]`` of the study.

    Raises
    ------
    UserError
        If no limit is given, or as :func:`goal_of`.
    """
    own: AllowSection | None = getattr(study, "allow", None)
    usual = "wfe_change.p95" if own and isinstance(study, SystemStudy) else "wfe_rms.p95"
    measure = measure or (own and own.measure) or usual
    limit = limit or (own.limit if own else None)
    if limit is None:
        raise UserError(f"Below what shall {measure} stay? Give a limit, as --limit '60 nm'.")
    name, probability, value = goal_of(measure, limit)
    return Asked(measure, name, probability, value, by or (own.by if own else "shares"))


def goal_of(measure: str, limit: str | float) -> tuple[str, float, float]:
    """Read ``wfe_rms.p95`` and ``60 nm``: the measure, how often the limit may be exceeded, the limit.

    Raises
    ------
    UserError
        If they have another form, or the quantile is no upper one.
    """
    match = _FORM.fullmatch(measure)
    if not match or not 50.0 < float(match[2]) < 100.0:
        raise UserError(f"{measure!r} is no upper quantile of a measure; write it as wfe_rms.p95.")
    return match[1], 1.0 - float(match[2]) / 100.0, in_unit(limit, unit_of(match[1]))


def allow_table(found: Allowances) -> Table:
    """Return the allowances as a table for the terminal: of few elements each, of many those of each axis."""
    units = _units(found)
    if len(found.elements) <= _FEW:
        table = empty_table(("axis", *found.elements, "unit"), ("axis", "unit"), pad_edge=False)
        for row, (axis, values) in enumerate(zip(found.axes, found.rms, strict=True)):
            scale, unit = units[row]
            table.add_row(axis, *(_allowed(scale * value) for value in values), f"{unit} rms")
        share = [number(100.0 * one) for one in np.nansum(found.shares, axis=0)]
        table.add_row("share", *share, "%")
        return table
    headers = ("axis", f"least of {len(found.elements)}", "median", "most", "unit", "share")
    table = empty_table(headers, ("axis", "unit"), pad_edge=False)
    for (scale, unit), axis, values, shares in zip(units, found.axes, found.rms, found.shares, strict=True):
        known = values[~np.isnan(values)]
        numbers = (known.min(), float(np.median(known)), known.max())
        table.add_row(
            axis, *(_allowed(scale * one) for one in numbers), f"{unit} rms", f"{np.nansum(shares):.1%}"
        )
    return table


def _allowed(value: float) -> str:
    return "any" if np.isinf(value) else number(value)


def _units(found: Allowances) -> list[tuple[float, str]]:
    """Return the factor and the unit in which the allowances of each axis read best: one for each kind."""
    kinds = [_kind(axis) for axis in found.axes]
    units = {kind: _unit(found.rms[[one == kind for one in kinds]], kind == "turn") for kind in set(kinds)}
    return [units[kind] for kind in kinds]


def _kind(axis: str) -> str:
    return "turn" if axis in _TURNS else "figure" if axis.startswith("figure") else "shift"


def _unit(values: Array, turns: bool) -> tuple[float, str]:
    known = values[np.isfinite(values)]
    power = int(np.floor(np.log10(np.median(known)) / 3.0)) if known.size else -3
    power = min(max(power, -4), -1)
    return 10.0 ** (-3 * power), {-1: "m", -2: "u", -3: "n", -4: "p"}[power] + ("rad" if turns else "m")


def allow_notes(found: Allowances, measure: str, limit: float) -> Iterator[str]:
    """Yield what the allowances mean, and whether full traces confirm them, in lines."""
    if np.isfinite(found.factor):
        yield f"What the study has, times {found.factor:.4g}."
    check, unit = found.check, found.unit
    low = number(check.low, 4)
    between = f"{low}–{number(check.high, 4)}" if np.isfinite(check.high) else f"≥ {low}: too few cases"
    how = "by the linear model, exactly" if found.exact else "in 4000 draws of the linear model"
    yield (
        f"{measure} is {number(limit, 4)} {unit} {how}; of {found.cases - found.failed} cases that were "
        f"drawn with these allowances and traced in full {number(check.value, 4)} {unit} ({between})."
    )
    for axis, values in zip(found.axes, found.rms, strict=True):
        idle = np.flatnonzero(np.isinf(values))
        if idle.size:
            names = _named(found.elements, idle)
            yield f"Any {axis} is allowed, since it does nothing to {measure}: {names}."
    yield from _kinds(found)
    if found.failed:
        yield f"WARNING {found.failed} of {found.cases} cases cannot be traced, and are left out."
    if not check.low <= limit <= check.high:
        yield "WARNING Full traces do not confirm the limit: the motions are too large for the linear model."


def _kinds(found: Allowances) -> Iterator[str]:
    """Yield what does not keep still during a case, and the largest density of each spectrum."""
    vary = (found.kinds != STATIC) & (found.kinds != "") & np.isfinite(found.rms)
    for kind in np.unique(found.kinds[vary]).tolist():
        places = np.argwhere(vary & (found.kinds == kind))
        words = [f"{found.elements[element]} {found.axes[axis]}" for axis, element in places]
        if kind == RMS:
            yield f"Anew at every instant (rms): {_some(words)}."
            continue
        peak = max(found.spectra[kind].psd)
        at = found.spectra[kind].frequency_hz[found.spectra[kind].psd.index(peak)]
        parts = []
        for word, (axis, element) in zip(words, places, strict=True):
            scale, unit = _units(found)[axis]
            parts.append(f"{word} {number(scale * np.sqrt(found.levels[axis, element] * peak))} {unit}/√Hz")
        yield f"Spectrum {kind}, at its largest ({at:g} Hz): {_some(parts)}."


def _some(words: Sequence[str]) -> str:
    more = len(words) - _FEW
    return ", ".join(words[:_FEW]) + (f" and {more} more" if more > 0 else "")


def _named(names: Sequence[str], places: NDArray[np.int64]) -> str:
    if len(places) == len(names) > 1:
        return "all elements"
    return _some([names[place] for place in places])


@rc_context(STYLE)
def allow_figure(found: Allowances, measure: str) -> Figure:
    """Draw how far every element may be off along every axis, a panel for shifts, turns and figures each."""
    limited = [bool(np.isfinite(values).any()) for values in found.rms]
    kinds = list(dict.fromkeys(_kind(axis) for axis, one in zip(found.axes, limited, strict=True) if one))
    has = [bool(row.any()) for row in _has_spectrum(found)]
    spectral = list(dict.fromkeys(_kind(axis) for axis, one in zip(found.axes, has, strict=True) if one))
    count = len(kinds) + len(spectral)
    figure = Figure(figsize=(WIDTH, 0.55 * HEIGHT * count), layout="constrained")
    every = figure.subplots(count, 1, squeeze=False)[:, 0]
    panels = every[: len(kinds)]
    for axes in panels[:-1]:
        axes.sharex(panels[-1])
        axes.tick_params(labelbottom=False)
    at, units = np.arange(len(found.elements)), _units(found)
    for axes, kind in zip(panels, kinds, strict=True):
        rows = [row for row, axis in enumerate(found.axes) if _kind(axis) == kind and limited[row]]
        for index, row in enumerate(rows):
            scale, unit = units[row]
            beside = (index - (len(rows) - 1) / 2.0) * min(0.1, 0.6 / len(rows))
            style = {"color": COLORS[index % len(COLORS)], "marker": _MARKS[index % len(_MARKS)]}
            values = np.where(np.isfinite(found.rms[row]), scale * found.rms[row], np.nan)
            axes.plot(at + beside, values, linestyle="none", markersize=5.0, label=found.axes[row], **style)
            axes.set_ylabel(f"{kind} ({unit} rms)")
        axes.set_yscale("log")
        axes.set_ylim(axes.get_ylim())
        number_powers(axes.yaxis)
        axes.grid(axis="y", color="#dddddd", linewidth=0.6)
        axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
    panels[0].set_title(f"What every element is allowed: {measure}")
    if len(at) <= _NAMES:
        panels[-1].set_xticks(at, found.elements, rotation=0 if len(at) <= 8 else 90)
    else:
        panels[-1].set_xlabel("element")
    for axes, kind in zip(every[len(kinds) :], spectral, strict=True):
        _draw_spectra(axes, found, kind)
    return figure


def _has_spectrum(found: Allowances) -> NDArray[np.bool_]:
    return np.isfinite(found.levels) & np.isfinite(found.rms)


def _draw_spectra(axes: Axes, found: Allowances, kind: str) -> None:
    """Draw the spectra that are allowed along the axes of a kind, the largest first."""
    rows = [row for row, axis in enumerate(found.axes) if _kind(axis) == kind]
    places = [(row, column) for row, column in np.argwhere(_has_spectrum(found)).tolist() if row in rows]
    places.sort(key=lambda place: -found.rms[place])
    scale, unit = _units(found)[rows[0]]
    for index, place in enumerate(places):
        section = found.spectra[found.kinds[place]]
        knots = np.array(section.frequency_hz)
        frequency = np.union1d(np.geomspace(knots[0], knots[-1], 200), knots)
        density = scale * np.sqrt(found.levels[place] * np.interp(frequency, knots, section.psd))
        label = f"{found.elements[place[1]]} {found.axes[place[0]]}" if index < _FEW else None
        line = {"color": COLORS[index % len(COLORS)], "linestyle": "-" if index < len(COLORS) else "--"}
        axes.loglog(frequency, np.where(density > 0.0, density, np.nan), label=label, **line)
    axes.set(xlim=axes.get_xlim(), ylim=axes.get_ylim())
    for axis in (axes.xaxis, axes.yaxis):
        number_powers(axis)
    axes.set_xlabel("frequency (Hz)")
    axes.set_ylabel(f"{kind} ({unit}/√Hz)")
    axes.grid(color="#dddddd", linewidth=0.6)
    axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))


def require_writable(file: Path) -> None:
    """Raise UserError unless the name of a file says what it holds, and its folder is there."""
    if file.suffix.lower() not in (".csv", *_PICTURES):
        raise UserError(
            f"{file} must end in .csv (a table) or {', '.join(_PICTURES[:-1])} or .pdf (a figure)."
        )
    if not file.absolute().parent.is_dir():
        raise UserError(f"{file} cannot be written: there is no folder {file.parent}.")


def write_allowances(found: Allowances, file: Path, measure: str = "") -> None:
    """Write a row per element and axis, or draw the figure.

    Raises
    ------
    UserError
        If the file cannot be written.
    """
    require_writable(file)
    try:
        if file.suffix.lower() == ".svg":
            file.write_text(svg_text(allow_figure(found, measure)), encoding="utf-8")
        elif file.suffix.lower() in _PICTURES:
            allow_figure(found, measure).savefig(file, dpi=150)
        else:
            with file.open("w", encoding="utf-8", newline="") as out:
                csv.writer(out, lineterminator="\n").writerows(_rows(found))
    except OSError as error:
        raise UserError(f"{file} cannot be written: {error.strerror}.") from None


def _rows(found: Allowances) -> Iterator[tuple[object, ...]]:
    yield ("element", "axis", "rms", "unit", "share", "kind", "level")
    for row, axis in enumerate(found.axes):
        unit = "rad" if axis in _TURNS else "m"
        columns = (found.rms[row], found.shares[row], found.kinds[row], found.levels[row])
        for name, value, part, kind, level in zip(
            found.elements, *(column.tolist() for column in columns), strict=True
        ):
            if not np.isnan(value):
                yield name, axis, value, unit, part, kind, "" if np.isnan(level) else level
