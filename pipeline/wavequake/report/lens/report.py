"""The report of a lens-experiment store: what each controller leaves, and the reference's figures."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from rich.table import Table
from rich.text import Text

from wavequake.campaign.contract import DONE
from wavequake.chain.loops.controllers.off import Off
from wavequake.chain.loops.controllers.perfect import Perfect
from wavequake.report.histories import has_all_instants, what_is_kept
from wavequake.report.lens import figures as draw
from wavequake.report.lens.firmware import Firmware, firmware_of, left_beside, off_exact
from wavequake.report.lens.over_frequency import over_frequency
from wavequake.report.page import Page, Picture, Section, picture
from wavequake.report.populations import left_out
from wavequake.report.table import MISSING, empty_table, number
from wavequake.words import counted
from wavequake.workflows.kinds import study_of
from wavequake.workflows.lens.bench import bench_of, stage_of

Array = NDArray[np.float64]

# What the reference measured, peak-to-peak and standard deviation in % (Störkle 2018, Fig. 5.33); FF+FI it
# could only simulate, "by a factor of almost 4" (Section 5.3.2).
_REFERENCE = {"FF": ("30", "30"), "FI": ("54", "17"), "FF+FI": ("about 25", "about 25")}
_NAMES = {
    "modal": "modal, nominal",
    "identified": "modal, identified",
    "firmware-float": "firmware, float",
    "firmware-q31": "firmware, q31",
    "firmware-q16": "firmware, q16",
}
_SMALL_PRINT = (
    "Image displacement after one blow of the hammer: range, and standard deviation later than 1 s, in % of "
    "the uncontrolled one. Median over plants; in small print from the smallest to the largest. The bench is "
    "synthetic: fitted to what is published about the real one. The reference's values are those measured on "
    "the real one with the initial springs (FF+FI: simulated)."
)
_DEFINITIONS = (
    ("FF", "Kalman filter with the hammer's force, then the all-pass inverse of the stage (Eq. 5.21), 2 ms."),
    ("FI", "Kalman filter without it, predicting two steps (Eq. 5.20), 8 ms."),
    ("FF+FI", "Both in a row, 2 ms: the reference's hardware could not run it."),
    ("modal, nominal", "Observer of 11 modes and one row that inverts stage, hold and delay at their poles."),
    ("modal, identified", "The same with poles, image row and blow identified from one uncontrolled run."),
    (
        "firmware",
        "The C code of the boards, built for this machine in float, 32-bit (q31) or 16-bit (q16) arithmetic, "
        "runs a modal regulator on the same readings. Images carry the hash of their gains.",
    ),
    (
        "all errors",
        "Springs, friction, strip, converters, stage, strength of the blow and trigger, as the study says.",
    ),
)


# How to read the figures of a plant, by their key.
_LEFT = "What is left of the image motion: the lower the curve beside the uncontrolled one, the better."
_HOW = {
    "model": "The nominal model beside the plant: where both part, the plant has other springs and friction.",
    "filter": "The estimate begins at nothing and finds the motion within the first swings.",
    "filter-late": "What the filter still knows when the motion has nearly died down.",
    "target": "The stage has to move so that the image stands still; the command runs ahead by its delay.",
    "remaining-both": _LEFT,
    "remaining": _LEFT,
    "remaining-modal": _LEFT,
    "stage-ff": "The position follows the command late; feedforward reckons with that.",
    "stage-fi": "Held commands are steps; the position behind them is smooth and late.",
    "sensor": "Readings scatter about the motion by the strip's error and the converter's noise.",
    "firmware-off": "The share of plants below a difference: within a step of the converter nothing is lost.",
    "firmware-left": "Points at zero: the board leaves as much of the motion as double precision does.",
}


@dataclass(frozen=True)
class Configuration:
    """The finished plants of one configuration of springs.

    Attributes
    ----------
    springs : str
    controllers : tuple of str
    own : tuple of str
        Those of the study itself that act as anything could.
    rows : ndarray of int, shape (c,)
        In the dataset.
    ranges, deviations : ndarray, shape (c, controller)
        In % of uncontrolled.
    ranges_mm, deviations_mm : ndarray, shape (c, controller)
    shown : int or None
        Row of the plant that is drawn: that of the median range under FF.
    firmware : Firmware or None
        What its images did, if there are any.
    """

    springs: str
    controllers: tuple[str, ...]
    own: tuple[str, ...]
    rows: NDArray[np.int64]
    ranges: Array
    deviations: Array
    ranges_mm: Array
    deviations_mm: Array
    shown: int | None
    firmware: Firmware | None


def configurations(dataset: xr.Dataset) -> list[Configuration]:
    """Split a store by springs, in the order of the study."""
    springs = np.array([str(one) for one in dataset["springs"].to_numpy()])
    done = dataset["status"].to_numpy() == DONE
    controllers = tuple(str(one) for one in dataset["controller"].to_numpy())
    found, study = [], study_of(dataset.attrs["study"])
    own = tuple(one.name for one in study.loop if not isinstance(one, Off | Perfect))
    for name in study.bench.springs:
        rows = np.flatnonzero(done & (springs == name))
        ranges, deviations, ranges_mm, deviations_mm = (
            dataset[key].isel(case=rows).to_numpy()
            for key in ("peak_to_peak", "deviation", "peak_to_peak_mm", "deviation_mm")
        )
        order = np.argsort(ranges[:, controllers.index("FF")], kind="stable")
        shown = int(rows[order[len(rows) // 2]]) if len(rows) else None
        firmware = firmware_of(dataset, rows) if len(rows) else None
        found.append(
            Configuration(
                name, controllers, own, rows, ranges, deviations, ranges_mm, deviations_mm, shown, firmware
            )
        )
    return found


def table_of(store: Path, dataset: xr.Dataset) -> Table:
    """Return the table of a store for the terminal."""
    found = configurations(dataset)
    table = empty_table(_HEADERS, caption=answer(found))
    for one in found:
        table.add_row(Text(f"{one.springs} springs, {counted(len(one.rows), 'plant')}", style="bold"))
        for place in range(len(one.controllers)):
            cells = [_row(one, place)[header] for header in _HEADERS]
            table.add_row("  " + cells[0][0], *(_with_small(*cell) for cell in cells[1:]))
    return table


_HEADERS = (
    "controller", "range (%)", "std (%)", "range (mm)", "std (mm)", "reference (%)",
)  # fmt: skip
_FIRMWARE_HEADERS = ("image", "off exact (µm rms)")


def _with_small(value: str, small: str) -> str:
    return f"{value} ({small})" if small else value


def _row(one: Configuration, place: int) -> dict[str, tuple[str, str]]:
    """Return header -> (median, smallest to largest) of one controller."""
    name = one.controllers[place]
    reference = ", ".join(_REFERENCE[name]) if name in _REFERENCE and one.springs == "initial" else ""
    values = (
        _median(one.ranges[:, place], name != "uncontrolled"),
        _median(one.deviations[:, place], name != "uncontrolled"),
        _median(one.ranges_mm[:, place], False),
        _median(one.deviations_mm[:, place], False),
    )
    cells = dict(zip(_HEADERS, ((_NAMES.get(name, name), ""), *values, (reference, "")), strict=True))
    if one.firmware:
        cells |= dict(zip(_FIRMWARE_HEADERS, one.firmware.cells(name), strict=True))
    return cells


def _median(values: Array, varies: bool) -> tuple[str, str]:
    if not len(values):
        return MISSING, ""
    spread = f"{number(float(values.min()), 2)}–{number(float(values.max()), 2)}"
    return number(float(np.median(values))), spread if varies and len(values) > 1 else ""


def answer(found: list[Configuration]) -> str:
    """Say what the best controller and the reference's best one leave."""
    words = []
    for one in found:
        if not len(one.rows):
            words.append(f"{one.springs.capitalize()} springs: no plant is done.")
            continue
        medians = [
            (float(np.median(one.ranges[:, place])), float(np.median(one.deviations[:, place])))
            for place in (one.controllers.index("identified"), one.controllers.index("FF"))
        ]
        (best, best_late), (old, old_late) = medians
        words.append(
            f"{one.springs.capitalize()} springs: the identified modal regulator leaves {number(best, 2)} % "
            f"of the image's range and {number(best_late, 2)} % of its standard deviation "
            f"({draw.median_of(len(one.rows))}), "
            f"FF {number(old, 2)} % and {number(old_late, 2)} %."
        )
        if own := _best_of_study(one):
            words.append(own)
        if one.firmware:
            words.append(one.firmware.answer())
    return " ".join(words)


def _best_of_study(one: Configuration) -> str:
    """Say what the best of the study's own loops leaves; "" if it has none."""
    places = {name: one.controllers.index(name) for name in one.own}
    if not places:
        return ""
    medians = {
        name: (float(np.median(one.ranges[:, place])), float(np.median(one.deviations[:, place])))
        for name, place in places.items()
    }
    name, (span, late) = min(medians.items(), key=lambda item: sum(item[1]))
    return f"Of the study's own loops {name} leaves least, {number(span, 2)} % and {number(late, 2)} %."


def page_of(store: Path, dataset: xr.Dataset, device: str) -> Page:
    """Return the HTML report."""
    found = configurations(dataset)
    return Page(
        answer=answer(found),
        table=[
            {"springs": (one.springs, counted(len(one.rows), "plant")), **_row(one, place)}
            for one in found
            for place in range(len(one.controllers))
        ],
        small_print=_SMALL_PRINT + _without_histories(dataset),
        overview=[
            picture(
                f"bars-{one.springs}",
                f"Residuals of the controllers, {one.springs} springs",
                draw.bars(
                    one.ranges,
                    one.deviations,
                    one.springs,
                    [_NAMES.get(name, name) for name in one.controllers],
                ),
                "What is left of the image motion under each controller, over all plants: shorter is better.",
            )
            for one in found
            if len(one.rows)
        ],
        sections=[
            Section(f"{one.springs} springs", list(_figures(dataset, one)))
            for one in found
            if len(one.rows) and has_all_instants(dataset)
        ]
        + [Section("hammer and stage", list(_hardware(dataset, found)))],
        definitions=list(_DEFINITIONS),
        kind="configuration",
        left_out=left_out(dataset, "springs"),
    )


def _without_histories(dataset: xr.Dataset) -> str:
    """Say why no plant is drawn where histories are not whole, which filters follow step by step."""
    if has_all_instants(dataset):
        return ""
    return (
        f"{what_is_kept(dataset)} Figures of one plant, whose filters need every step, are left out; the "
        "numbers of the table are of all instants."
    )


def _figures(dataset: xr.Dataset, one: Configuration) -> Iterator[Picture]:
    """Yield the figures of one plant, after Figs. 5.5 and 5.28 to 5.38."""
    assert one.shown is not None
    case = draw.Shown.of(dataset, one.shown)
    study, springs = study_of(dataset.attrs["study"]), one.springs
    nominal = draw.nominal_of(bench_of(study, springs), stage_of(study), case)
    for key, text, figure in (
        ("model", "Simulated and actual image motion, uncontrolled", draw.model(case, nominal)),
        ("filter", "Image motion that the Kalman filter estimates", draw.filtered(case, nominal)),
        ("filter-late", "The same at the end of the run", draw.filtered(case, nominal, case.time[-1] - 1.5)),
        ("target", "Commanded and expected motion of the stage", draw.targets(case, nominal)),
        ("remaining-both", "Remaining error of FF+FI", draw.remaining(case, ("uncontrolled", "FF+FI"))),
        ("remaining", "Remaining error of FF and FI", draw.remaining(case, ("uncontrolled", "FF", "FI"))),
        (
            "remaining-modal",
            "Remaining error of the modal regulators",
            draw.remaining(case, ("FF+FI", "modal", "identified")),
        ),
        ("stage-ff", "Command and position of the stage under FF", draw.stage_history(case, nominal, "FF")),
        ("stage-fi", "Command and position of the stage under FI", draw.stage_history(case, nominal, "FI")),
        ("sensor", "Lens 4 and what the control unit reads", draw.sensor(case)),
    ):
        yield picture(f"{springs}-{key}", f"{text}, {springs} springs", figure, _HOW[key])
    yield from over_frequency(dataset, springs, list(one.rows))
    if one.firmware:
        for key, text, figure in (
            ("firmware-off", "Commands of the firmware against double precision", off_exact(one.firmware)),
            ("firmware-left", "What the firmware leaves against double precision", left_beside(one.firmware)),
        ):
            yield picture(f"{springs}-{key}", f"{text}, {springs} springs", figure, _HOW[key])


def _hardware(dataset: xr.Dataset, found: list[Configuration]) -> Iterator[Picture]:
    """Yield the figures of hammer and stage, after Figs. 5.10 to 5.12 and 5.15."""
    stage = stage_of(study_of(dataset.attrs["study"]))
    yield picture(
        "hammer",
        "Force of the hammer and its equivalent",
        draw.hammer(),
        "Both push equally long and hard; simulations take the simple one.",
    )
    record = draw.step_record(stage)
    yield picture(
        "step",
        "Step response of the stage, measured and identified",
        draw.step(record),
        "The closer both lines are, the better the model that the controllers are made with.",
    )
    yield picture(
        "zeros",
        "Poles and zeros of the stage, true and identified",
        draw.pole_zero_map(stage, record),
        "Crosses are poles, circles zeros; pairs that coincide were identified well.",
    )
    for one in found[:1]:
        if one.shown is not None and has_all_instants(dataset):
            case = draw.Shown.of(dataset, one.shown)
            yield picture(
                "follow",
                "The stage during a blow, actual and simulated",
                draw.following(case, record),
                "What the identified model says of the motion, beside the motion itself.",
            )
