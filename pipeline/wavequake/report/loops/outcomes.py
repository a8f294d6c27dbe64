"""What became of every reduced model's controller, read from a store, and which one is enough."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr

from wavequake.campaign.contract import DONE
from wavequake.report.table import number

# Numbers of a case that the report shows.
_TAKEN = (
    "order",
    "error_median",
    "error_max",
    "error_beyond",
    "shift_over_zeta",
    "missing_modes",
    "unstable_poles",
    "growth",
    "growth_hz",
    "growth_full",
    "controller_growth",
    "truncation",
    "spill_mode",
    "spill_hz",
    "spill_shift",
    "sensitivity_peak",
    "gain_up",
    "gain_down",
    "phase_margin",
    "delay_margin",
    "last_hz",
    "wavefront_open",
    "wavefront",
    "wavefront_promised",
    "strehl",
)


@dataclass(frozen=True)
class Outcome:
    """A variant and its controller; `numbers` are the measures of the case by name."""

    case: int
    row: int
    variant: str
    method: str
    effort: float
    numbers: dict[str, float]

    def __getitem__(self, name: str) -> float:
        return self.numbers[name]

    @property
    def order(self) -> int:
        """Number of coordinates of the variant."""
        return int(self["order"])

    @property
    def stable(self) -> bool:
        """Whether the loop with the full model is stable."""
        return self["unstable_poles"] == 0


@dataclass(frozen=True)
class Level:
    """All controllers of one effort.

    Attributes
    ----------
    effort : float
    outcomes : tuple of Outcome
    best : float
        Smallest wavefront of the stable ones, nm; NaN: there are none.
    enough : Outcome or None
        The one of the fewest coordinates that is good enough.
    """

    effort: float
    outcomes: tuple[Outcome, ...]
    best: float
    enough: Outcome | None

    @property
    def sharp(self) -> Outcome | None:
        """The unstable one of the smallest open-loop error."""
        growing = (one for one in self.outcomes if not one.stable)
        return min(growing, key=lambda one: one["error_median"], default=None)

    @property
    def blunt(self) -> Outcome | None:
        """The stable one of the largest open-loop error."""
        calm = (one for one in self.outcomes if one.stable)
        return max(calm, key=lambda one: one["error_median"], default=None)

    @property
    def telling(self) -> tuple[Outcome, ...]:
        """The one that is enough, the sharp and the blunt one, each once."""
        every = (self.enough, self.sharp, self.blunt)
        return tuple({one.row: one for one in every if one is not None}.values())

    def excess(self, one: Outcome) -> float:
        """Return how far a wavefront is above the smallest, as a share."""
        return one["wavefront"] / self.best - 1.0


def levels_of(dataset: xr.Dataset) -> list[Level]:
    """Return the finished cases of a store by effort, and which one is enough."""
    criterion = json.loads(dataset.attrs["study"])["criterion"]
    names, methods, efforts = (dataset[one].to_numpy() for one in ("variant", "method", "effort"))
    unknown = np.full(dataset.sizes["case"], np.nan)  # 0.3 kept no images
    numbers = {name: dataset[name].to_numpy() if name in dataset else unknown for name in _TAKEN}
    done = np.flatnonzero(dataset["status"].to_numpy() == DONE)
    cases = dataset["case"].to_numpy()
    outcomes = [
        Outcome(
            int(cases[row]),
            int(row),
            str(names[row]),
            str(methods[row]),
            float(efforts[row]),
            {name: float(values[row]) for name, values in numbers.items()},
        )
        for row in done
    ]
    return [
        _level(effort, [one for one in outcomes if one.effort == effort], criterion)
        for effort in dict.fromkeys(one.effort for one in outcomes)
    ]


def _level(effort: float, outcomes: Sequence[Outcome], criterion: dict[str, Any]) -> Level:
    best = min((one["wavefront"] for one in outcomes if one.stable), default=np.nan)
    good = [
        one
        for one in outcomes
        if one.stable
        and one["wavefront"] <= best * (1 + criterion["excess"])
        and one["sensitivity_peak"] <= criterion["peak"]
    ]
    enough = min(good, key=lambda one: (one.order, one["wavefront"]), default=None)
    return Level(effort, tuple(outcomes), best, enough)


def answer(levels: Sequence[Level]) -> str:
    """Say for every effort which reduced model is good enough, and how the open-loop error would mislead."""
    if not levels:
        return "No variant is done yet."
    return " ".join(_sentence(level) for level in levels)


def _sentence(level: Level) -> str:
    count = len(level.outcomes)
    growing = [one for one in level.outcomes if not one.stable]
    head = f"Effort {level.effort:g}: "
    if level.enough is None:
        head += "no variant is good enough for this controller"
    else:
        one = level.enough
        head += (
            f"{one.variant} ({one.order} coordinates) is the smallest model that is good enough for this "
            f"controller, {number(one['wavefront'])} nm ({number(one['wavefront_open'])} nm without), "
            f"sensitivity at most {number(one['sensitivity_peak'])}"
        )
    if not growing:
        return head + f"; all {count} loops are stable."
    return f"{head}; {len(growing)} of {count} loops are unstable.{_misled(level)}"


def _misled(level: Level) -> str:
    """Name an accurate model that destabilizes beside a less accurate one that does not."""
    sharp, blunt = level.sharp, level.blunt
    if sharp is None or blunt is None or blunt["error_median"] <= sharp["error_median"]:
        return ""
    return (
        f" The open-loop error would mislead: {sharp.variant} errs by "
        f"{number(100 * sharp['error_median'], 2)} % (median) and makes {spilled(sharp)} grow, "
        f"{blunt.variant} errs by {number(100 * blunt['error_median'], 2)} % and is stable."
    )


def spilled(one: Outcome) -> str:
    """Name the mode that grows."""
    known = "not in the model" if np.isnan(one["spill_shift"]) else f"{number(one['spill_shift'], 2)} ζ off"
    return f"mode {one['spill_mode']:.0f} ({number(one['spill_hz'])} Hz, {known})"


def certificate(levels: Sequence[Level]) -> str:
    """Say how far the modes that were left out can change the count of unstable poles."""
    every = [one for level in levels for one in level.outcomes]
    if not every:
        return ""
    worst = max(one["truncation"] for one in every)
    moved = [abs(one["growth_full"] / one["growth"] - 1) for one in every if np.isfinite(one["growth_full"])]
    proven = (
        f"Modes of the full model that are not followed one by one change no number of unstable poles "
        f"(certificate {number(worst, 2)}, below 1)."
        if worst < 1
        else f"The certificate of the modes left out is {number(worst, 2)}, not below 1: raise model.modes."
    )
    return proven + (
        f" With all degrees of freedom the largest growth moves by at most {number(100 * max(moved), 2)} %."
        if moved
        else ""
    )
