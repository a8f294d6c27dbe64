"""The loops of a study, before anything is run: their margins, and their parts for other tools."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from importlib import import_module

import numpy as np

from wavequake.campaign.schema import Study
from wavequake.chain.loops.blocks import LoopBlocks
from wavequake.chain.loops.closing import grows
from wavequake.chain.loops.designed import Sighted, designs_of
from wavequake.chain.loops.judged import sampled_loops
from wavequake.control.linear import LinearModel
from wavequake.control.robustness.feedback import Loop, closed_poles
from wavequake.control.robustness.margins import Margins, grid, margins
from wavequake.control.sampled.stability import (
    SampledLoop,
    controller_model,
    plant_model,
    sampled_margins,
    worst_pole,
)
from wavequake.errors import UserError
from wavequake.prepared import one_thread

# Modules with loops(study), which returns Makers.
_LOOPS = {
    "controller-mor": "wavequake.workflows.loops.controller_mor",
    "tip-tilt-vibration": "wavequake.workflows.loops.tip_tilt",
    "telescope-loop": "wavequake.workflows.loops.telescope_bench",
    "system-loop": "wavequake.workflows.loops.system_loop",
    "segment-control": "wavequake.workflows.loops.segment_control",
    "lens-experiment": "wavequake.workflows.lens.loops",
}


@dataclass(frozen=True)
class LoopMargins:
    """A loop in Hz, deg and ms; an unstable one has no margins (NaN).

    Attributes
    ----------
    name : str
    growth, growth_hz : float
        Largest real part of its poles, 1/s, and the frequency of that pole.
    peak, gain_up, gain_down, phase_deg, delay_ms, last_hz : float
        As `wavequake.control.robustness.margins.Margins`.
    """

    name: str
    growth: float
    growth_hz: float
    peak: float = np.nan
    gain_up: float = np.nan
    gain_down: float = np.nan
    phase_deg: float = np.nan
    delay_ms: float = np.nan
    last_hz: float = np.nan

    @property
    def stable(self) -> bool:
        """Whether it has margins: nothing grows, but for rounding."""
        return not np.isnan(self.peak)


@dataclass(frozen=True)
class StudyLoop:
    """A loop u = -H y of a study.

    Attributes
    ----------
    plant, controller : LinearModel
        From u to y in SI or by frames, and H.
    margins : callable
        Returns its `LoopMargins`, which takes longer.
    """

    plant: LinearModel
    controller: LinearModel
    margins: Callable[[], LoopMargins]


# What makes each loop of a study, by the loop's name.
Makers = Mapping[str, Callable[[], StudyLoop]]


def margins_of(name: str, loop: Loop, time_unit: float) -> LoopMargins:
    """Return the margins of a loop whose unit of time is so many seconds."""
    poles, worst = closed_poles(loop)
    hertz = 1.0 / time_unit / (2 * np.pi)
    grows = worst.value.real / time_unit, abs(worst.value.imag) * hertz
    if worst.value.real >= 0:
        return LoopMargins(name, *grows)
    return converted(name, *grows, margins(loop, grid(loop, poles)), time_unit)


def converted(
    name: str, growth: float, growth_hz: float, found: Margins, time_unit: float = 1.0
) -> LoopMargins:
    """Return margins in Hz, deg and ms, whose unit of time is so many seconds."""
    return LoopMargins(
        name,
        growth,
        growth_hz,
        found.peak,
        found.gain_up,
        found.gain_down,
        float(np.degrees(found.phase)),
        1e3 * found.delay * time_unit,
        found.last_omega / time_unit / (2 * np.pi),
    )


def sampled_loop(name: str, loop: SampledLoop) -> StudyLoop:
    """Return a loop of this name with its parts."""
    return StudyLoop(plant_model(loop), controller_model(loop), partial(_sampled_margins, name, loop))


def linear_loops(study: LoopBlocks, optics: Sighted) -> Makers:
    """Return every linear controller of a study that acts, each alone."""
    found = sampled_loops(study, optics, designs_of(study, optics))
    return {name: partial(sampled_loop, name, loop) for name, loop in found.items()}


def _sampled_margins(name: str, loop: SampledLoop) -> LoopMargins:
    worst = worst_pole(loop)
    if grows(worst):
        return LoopMargins(name, worst.growth, worst.hertz)
    return converted(name, worst.growth, worst.hertz, sampled_margins(loop))


def makers_of(study: Study) -> Makers:
    """Return what makes each loop of a study, by name.

    Raises
    ------
    UserError
        If its workflow has none.
    """
    name = study.study.workflow
    if name not in _LOOPS:
        *others, last = _LOOPS
        raise UserError(
            f"The workflow {name} of {study.study.name} has no loops; {', '.join(others)} and {last} have."
        )
    makers: Makers = import_module(_LOOPS[name]).loops(study)
    return makers


def loops_of(study: Study) -> Iterator[LoopMargins]:
    """Yield the margins of the loops of a study one by one.

    Raises
    ------
    UserError
        If its workflow has none.
    """
    for make in makers_of(study).values():
        with one_thread():  # products are small, and threads would wait for each other
            found = make().margins()
        yield found


def loop_named(study: Study, name: str | None = None) -> StudyLoop:
    """Return the loop of a study of this name; by default the first one.

    Raises
    ------
    UserError
        If there is none of this name; says which there are.
    """
    makers = makers_of(study)
    wanted = next(iter(makers)) if name is None else name
    if wanted not in makers:
        raise UserError(f"{study.study.name} has no loop {name!r}; it has {'; '.join(makers)}.")
    return makers[wanted]()
