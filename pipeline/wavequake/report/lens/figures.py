"""Figures of lens-experiment, after those of Störkle 2018, Chapter 5."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
import xarray as xr
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from wavequake.control.bench import COMPENSATOR, SENSITIVITIES, Bench
from wavequake.control.hammer import HAMMER, equivalent_force, hammer_force, impulse
from wavequake.control.linear import bogacki_shampine, linear_model, simulate, zero_order_hold
from wavequake.control.plant import swing
from wavequake.control.stage import Stage, stage_model
from wavequake.control.stage_identification import IdentifiedStage, identify_stage, smoothed
from wavequake.control.thesis import KalmanFilter, kalman_filter
from wavequake.report.figures import COLORS, HEIGHT, LINES, STYLE, WIDTH
from wavequake.report.mirrors.variants import few

Array = NDArray[np.float64]

_LABELS = {
    "uncontrolled": "uncontrolled",
    "modal": "modal, nominal",
    "identified": "modal, identified",
}
_SHORT = (0.0, 3.0)
_POSITION = "position (mm)"
_MOST_PLANTS = 1000  # whose points a figure shows


@dataclass(frozen=True)
class Shown:
    """One plant of a store: histories in mm over time in s."""

    case: int
    time: Array
    image: dict[str, Array]
    command: dict[str, Array]
    stage: dict[str, Array]
    lens: Array
    sensor: Array

    @classmethod
    def of(cls, dataset: xr.Dataset, row: int) -> Self:
        """Read the plant in a row of a dataset."""
        one = dataset.isel(case=row)
        controllers = [str(name) for name in dataset["controller"].to_numpy()]

        def histories(name: str) -> dict[str, Array]:
            return dict(zip(controllers, one[name].to_numpy().astype(np.float64), strict=True))

        return cls(
            int(dataset["case"].to_numpy()[row]),
            dataset["time"].to_numpy(),
            histories("image"),
            histories("command"),
            histories("stage_position"),
            one["lens_position"].to_numpy().astype(np.float64),
            one["sensor"].to_numpy().astype(np.float64),
        )


@dataclass(frozen=True)
class Nominal:
    """What nominal models make of a plant's sensor readings, mm.

    Attributes
    ----------
    free : ndarray
        Image motion of the nominal bench after a blow, uncontrolled.
    with_force, without_force : ndarray
        Image motion that the Kalman filter estimates (Eq. 5.18).
    direct : ndarray
        Position of the nominal stage if the filter's target is commanded as it is.
    stage : dict
        Position of the nominal stage under each controller's command.
    """

    free: Array
    with_force: Array
    without_force: Array
    direct: Array
    stage: dict[str, Array]

    @property
    def target(self) -> Array:
        """Target of the stage (Eq. 5.6)."""
        return -self.with_force / SENSITIVITIES[COMPENSATOR]


def nominal_of(bench: Bench, stage: Stage, case: Shown) -> Nominal:
    """Run nominal bench, Kalman filter and stage beside a plant."""
    step = float(case.time[1] - case.time[0])
    free = swing([bench, bench], np.ones(2), duration=float(case.time[-1])).image[0]
    every = round(step / 1e-3)
    known, unknown = (
        _estimate(kalman_filter(bench, with_force=given), case.sensor, step) for given in (True, False)
    )
    follow = zero_order_hold(stage_model(stage), step)
    direct = simulate(follow, -known / SENSITIVITIES[COMPENSATOR])[:, 0]
    moved = {name: simulate(follow, given)[:, 0] for name, given in case.command.items()}
    return Nominal(1e3 * free[::every][: len(case.time)], known, unknown, direct, moved)


def _estimate(estimator: KalmanFilter, sensor: Array, step: float) -> Array:
    model = linear_model(estimator.a, estimator.b, estimator.image)
    steps = max(1, round(0.004 / step))
    force = np.zeros(len(sensor))
    force[:steps] = 1e3 * equivalent_force(HAMMER, steps * step)  # lengths are mm here
    return simulate(bogacki_shampine(model, step), np.column_stack([sensor, force]))[:, 0]


def _figure(width: float = WIDTH) -> tuple[Figure, Axes]:
    figure = Figure(figsize=(width, HEIGHT))
    left = 0.7 / width
    return figure, figure.add_axes((left, 0.15, 0.98 - left, 0.75))  # automatic layouts are slow


def _lines(
    axes: Axes,
    time: Array,
    histories: Mapping[str, Array],
    span: tuple[float, float] = _SHORT,
    most: int = 1500,
) -> None:
    """Draw histories over a span of time, thinned to what can be seen."""
    kept = np.flatnonzero((time >= span[0]) & (time <= span[1]))
    kept = kept[:: max(1, len(kept) // most)]
    for number, (name, values) in enumerate(histories.items()):
        axes.plot(
            time[kept], values[kept], color=COLORS[number % len(COLORS)],
            linestyle=LINES[number % len(LINES)], linewidth=1.0, label=name,
        )  # fmt: skip
    low, high = axes.get_ylim()
    axes.set_ylim(low, high + 0.17 * (high - low))  # room for the legend
    axes.set_xlim(*span)
    axes.set_xlabel("time (s)")
    axes.legend(loc="upper right", ncols=min(3, len(histories)))


@rc_context(STYLE)
def _histories(
    case: Shown,
    histories: Mapping[str, Array],
    span: tuple[float, float] = _SHORT,
    label: str = "image displacement (mm)",
) -> Figure:
    figure, axes = _figure()
    _lines(axes, case.time, histories, span)
    axes.set_ylabel(label)
    axes.set_title(f"case {case.case}")
    return figure


def model(case: Shown, nominal: Nominal) -> Figure:
    """Compare the nominal bench with a plant, uncontrolled (Fig. 5.5)."""
    return _histories(case, {"plant": case.image["uncontrolled"], "nominal model": nominal.free})


def filtered(case: Shown, nominal: Nominal, start: float = 0.0) -> Figure:
    """Compare the Kalman filter's image motion with the plant's within 1.5 s (Figs. 5.28, 5.29)."""
    histories = {
        "plant": case.image["uncontrolled"],
        "KF with force": nominal.with_force,
        "KF without": nominal.without_force,
        "model alone": nominal.free,
    }
    return _histories(case, histories, (start, start + 1.5))


def targets(case: Shown, nominal: Nominal) -> Figure:
    """Show the stage's target, its motion if commanded directly, and that under FF+FI (Fig. 5.30)."""
    histories = {
        "target": nominal.target,
        "target commanded": nominal.direct,
        "command FF+FI": case.command["FF+FI"],
        "stage FF+FI": case.stage["FF+FI"],
    }
    return _histories(case, histories, (0.0, 0.6), _POSITION)


def remaining(case: Shown, controllers: Sequence[str]) -> Figure:
    """Show what controllers leave of the image's displacement (Figs. 5.31, 5.32, 5.38)."""
    return _histories(case, {_LABELS.get(name, name): case.image[name] for name in controllers})


def stage_history(case: Shown, nominal: Nominal, controller: str) -> Figure:
    """Show command and position of the stage within a short time (Figs. 5.34, 5.35)."""
    start = min(3.0, float(case.time[-1]) - 0.5)
    histories = {
        "target": nominal.target,
        f"command {controller}": case.command[controller],
        "stage": case.stage[controller],
        "stage, simulated": nominal.stage[controller],
    }
    return _histories(case, histories, (start, start + 0.5), _POSITION)


@rc_context(STYLE)
def sensor(case: Shown) -> Figure:
    """Show lens 4, and by how much the control unit's reading is off."""
    figure = Figure(figsize=(WIDTH, HEIGHT))
    lower = figure.add_axes((0.13, 0.15, 0.85, 0.35))
    upper = figure.add_axes((0.13, 0.57, 0.85, 0.38), sharex=lower)
    _lines(upper, case.time, {"lens 4": case.lens, "as read": case.sensor}, (0.0, 2.0))
    upper.set_xlabel("")
    upper.set_ylabel(_POSITION)
    kept = case.time <= 2.0
    lower.plot(case.time[kept], 1e3 * (case.sensor - case.lens)[kept], color=COLORS[0], linewidth=0.6)
    lower.set_ylabel("error (µm)")
    lower.set_xlabel("time (s)")
    return figure


@rc_context(STYLE)
def bars(ranges: Array, deviations: Array, springs: str, names: Sequence[str]) -> Figure:
    """Show range and standard deviation of all controllers, points per plant, evenly in rank (Fig. 5.33)."""
    figure, axes = _figure(1.4 * WIDTH)
    places = np.arange(len(names))
    for number, (values, label) in enumerate(
        ((ranges, "range"), (deviations, "standard deviation, t > 1 s"))
    ):
        at = places + 0.38 * number - 0.19
        middle = np.median(values, axis=0)
        axes.bar(at, middle, 0.36, color=COLORS[number], alpha=0.55, label=label)
        drawn = np.sort(values, axis=0)[few(range(len(values)), _MOST_PLANTS)]
        across = np.repeat(at[None], len(drawn), axis=0)
        axes.scatter(across, drawn, s=5, color=COLORS[number], linewidths=0)
        for x, value, top in zip(at, middle, values.max(axis=0), strict=True):
            text = f"{value:.0f}" if value >= 10 else f"{value:.1f}"
            axes.annotate(text, (x, top + 2), ha="center", size=8)  # above the points
    axes.set_xticks(places, [name.replace(", ", "\n") for name in names])
    axes.set_ylabel("of uncontrolled (%)")
    axes.set_ylim(0, 115)
    axes.legend(loc="upper right")
    axes.set_title(f"{springs} springs, {median_of(len(ranges))}")
    return figure


def median_of(plants: int) -> str:
    """Say of how many plants numbers are the median, if of more than one."""
    return "one plant" if plants == 1 else f"median of {plants} plants"


@rc_context(STYLE)
def hammer() -> Figure:
    """Show the hammer's force and the constant one of equal momentum (Fig. 5.15)."""
    figure, axes = _figure()
    time = np.linspace(0, 0.012, 241)
    axes.plot(1e3 * time, hammer_force(HAMMER, time), color=COLORS[0], label="force (Eq. 5.9)")
    force = equivalent_force(HAMMER)
    axes.fill_between([0, 4], [force, force], color=COLORS[1], alpha=0.3, lw=0, label="equivalent (Eq. 5.14)")
    axes.set_xlabel("time (ms)")
    axes.set_ylabel("force (N)")
    axes.set_title(f"momentum {float(impulse(HAMMER)):.4f} N s")
    axes.legend()
    return figure


@dataclass(frozen=True)
class StepRecord:
    """A step response of the stage as it would be measured, mm, and what is identified from it."""

    time: Array
    command: Array
    measured: Array
    identified: IdentifiedStage


def step_record(stage: Stage, noise: float = 0.01, step: float = 2e-4, seed: int = 1) -> StepRecord:
    """Command a step of 1 mm, record it with noise, and identify the stage (Section 5.2.1)."""
    time = np.arange(1500) * np.float64(step)
    command = (time >= 0.02).astype(np.float64)
    clean = simulate(zero_order_hold(stage_model(stage), step), command)[:, 0]
    measured = clean + noise * np.random.default_rng(seed).standard_normal(len(time))
    found = identify_stage(command, measured, step, poles=len(stage.poles), zeros=len(stage.zeros))
    return StepRecord(time, command, measured, found)


@rc_context(STYLE)
def step(record: StepRecord) -> Figure:
    """Show command, measured and identified step response (Figs. 5.9, 5.10)."""
    figure, axes = _figure()
    interval = float(record.time[1])
    found = simulate(zero_order_hold(stage_model(record.identified.stage), interval), record.command)[:, 0]
    histories = {
        "command": record.command,
        "measured": record.measured,
        "smoothed, 100 Hz": smoothed(record.measured, interval),
        "identified": found,
    }
    _lines(axes, record.time, histories, (0.01, 0.08))
    axes.set_ylabel(_POSITION)
    axes.set_title(
        f"fit {100 * record.identified.fit:.2f} % of the variance, gain {record.identified.stage.gain:.3f}"
    )
    axes.legend(loc="lower right")
    return figure


@rc_context(STYLE)
def pole_zero_map(stage: Stage, record: StepRecord) -> Figure:
    """Show poles and zeros of the stage and of what is identified (Fig. 5.11)."""
    figure, axes = _figure()
    for number, (name, one) in enumerate((("stage", stage), ("identified", record.identified.stage))):
        for marker, roots, kind in (("x", one.poles, "poles"), ("o", one.zeros, "zeros")):
            axes.plot(
                np.real(roots), np.imag(roots), marker, color=COLORS[number], markersize=7 - 2 * number,
                fillstyle="none", label=f"{kind}, {name}",
            )  # fmt: skip
    axes.axvline(0.0, color="#888888", linewidth=0.6)
    axes.set_xlabel("real part (1/s)")
    axes.set_ylabel("imaginary part (1/s)")
    axes.legend(loc="upper left")
    return figure


def following(case: Shown, record: StepRecord) -> Figure:
    """Show the stage during a blow beside the simulation with the identified stage (Fig. 5.12)."""
    model = zero_order_hold(stage_model(record.identified.stage), float(case.time[1] - case.time[0]))
    histories = {
        "command": case.command["FF"],
        "stage": case.stage["FF"],
        "simulated": simulate(model, case.command["FF"])[:, 0],
    }
    return _histories(case, histories, (0.0, 0.4), _POSITION)
