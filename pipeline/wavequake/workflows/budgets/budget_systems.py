"""The budget of a system-disturbance study: its sources and the surfaces and bodies that they move."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from wavequake.kernels.device.devices import choose_device
from wavequake.mechanics.disturbances.element_motion import (
    ElementMotion,
    draw_elements,
)
from wavequake.mechanics.disturbances.layout import NO_SEGMENTS, SegmentLayout
from wavequake.mechanics.disturbances.registry import Combine, instants_of, parts
from wavequake.mechanics.disturbances.source import Source
from wavequake.workflows.budgets.budget_factors import AGAIN, Experiment, Factor
from wavequake.workflows.systems.system_bench import SystemBench, system_bench
from wavequake.workflows.systems.system_measure import measured
from wavequake.workflows.systems.system_study import SystemStudy

Array = NDArray[np.float64]

QUANTITIES = ("wfe_change", "wfe_rms", "image_motion")
_UM_PER_MM = 1e3


def elements_of(sources: Sequence[Source], layout: SegmentLayout = NO_SEGMENTS) -> list[str]:
    """Return the surfaces and bodies that disturbances move or deform, in the order of their mention.

    None if it is one alone, whose share is that of its disturbances.
    """
    found = list(dict.fromkeys(name for part in sources for name in part.elements(layout)))
    return found if len(found) > 1 else []


def variants(
    population: Combine,
    sources: Sequence[Source],
    seed: int,
    realization: int,
    layout: SegmentLayout = NO_SEGMENTS,
) -> list[ElementMotion]:
    """Return the motions of one case: of all factors, of all drawn again, without each, with each redrawn."""
    time = instants_of(sources, population.model_copy(update={"of": tuple(part.name for part in sources)}))
    again = [part.model_copy(update={"name": part.name + AGAIN}) for part in sources]

    def total(chosen: Sequence[Source]) -> ElementMotion:
        if not chosen:
            return ElementMotion({}, {}, np.zeros((len(time), 2)))
        names = tuple(part.name for part in chosen)
        whole = population.model_copy(update={"of": names})
        return draw_elements(chosen, whole, seed, realization, time=time, layout=layout)

    one, other = total(sources), total(again)
    indices = range(len(sources))
    without = [total([sources[k] for k in indices if k != i]) for i in indices]
    redrawn = [total([again[k] if k == i else sources[k] for k in indices]) for i in indices]
    for name in elements_of(sources, layout):
        without.append(_with_element(one, ElementMotion({}, {}, one.sight), name))
        redrawn.append(_with_element(one, other, name))
    return [one, other, *without, *redrawn]


def _with_element(motion: ElementMotion, other: ElementMotion, element: str) -> ElementMotion:
    """Return a motion in which one surface or body moves and deforms as in another."""

    def chosen(mine: dict[str, Array], theirs: dict[str, Array]) -> dict[str, Array]:
        others = {name: values for name, values in mine.items() if name != element}
        return others | {name: values for name, values in theirs.items() if name == element}

    moved, figure = chosen(motion.rigid, other.rigid), chosen(motion.figure, other.figure)
    return ElementMotion(moved, figure, motion.sight, chosen(motion.grid, other.grid))


def evaluate(bench: SystemBench, time: Array, motion: ElementMotion, device: str) -> Array:
    """Return the QUANTITIES, rms over instants and field points, and the most rays lost at one of them (4,).

    NaN where a chief ray is lost, or too many others.
    """
    found, trouble = measured(bench, time, motion, choose_device(device))
    if trouble:
        return np.full(len(QUANTITIES) + 1, np.nan)
    moved = np.linalg.norm(found["los_mm"], axis=-1) * _UM_PER_MM
    values = [found["wfe_change"], found["wfe_rms"], moved]
    return np.array([*(np.sqrt(np.mean(one**2)) for one in values), found["lost"].max()])


def experiment(study: SystemStudy, population: Combine, device: str) -> Experiment:
    """Return how the cases of a sum of disturbances are varied and traced, at the primary wavelength."""
    bench = system_bench(study.identity_text())
    light = bench.system.primary_wavelength
    bench = replace(
        bench,
        prepared=tuple((row[light],) for row in bench.prepared),
        static=tuple((row[light],) for row in bench.static),
    )
    sources = parts(study.disturbance, population)
    names, time = elements_of(sources, bench.layout), instants_of(study.disturbance, population)
    factors = [Factor(part.name, "source", len(part.elements(bench.layout))) for part in sources]
    together = {
        name for part in sources if part.independent == "whole" for name in part.elements(bench.layout)
    }
    factors += [Factor(name, "element", 1, independent=name not in together) for name in names]

    def values(first: int, last: int) -> Array:
        cases = [
            variants(population, sources, study.study.seed, one, bench.layout) for one in range(first, last)
        ]
        return np.array([[evaluate(bench, time, motion, device) for motion in case] for case in cases])

    def rest() -> Array:
        return evaluate(bench, time, ElementMotion({}, {}, np.zeros((len(time), 2))), device)

    return Experiment(
        tuple(factors),
        QUANTITIES,
        1,
        values,
        rest,
        rays=study.optics.rays,
        light="All numbers are those of fits that go on over the full pupil, also where no light arrives.",
    )
