"""The budget of a system-disturbance study: its sources and the surfaces and bodies that they move."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from wavequake.campaign.measures import template_of
from wavequake.campaign.stopwatch import Stopwatch
from wavequake.chain.images.system import SystemImager
from wavequake.kernels.device.devices import choose_device
from wavequake.mechanics.disturbances.layout import NO_SEGMENTS, SegmentLayout
from wavequake.mechanics.disturbances.motion import Motion, still
from wavequake.mechanics.disturbances.registry import Combine, instants_of, parts
from wavequake.mechanics.disturbances.source import Source
from wavequake.workflows.budgets.elements import Factors, variants
from wavequake.workflows.budgets.factors import Experiment, Factor, chosen
from wavequake.workflows.budgets.kept import LOSSES
from wavequake.workflows.systems.bench import SystemBench, imager_on, system_bench
from wavequake.workflows.systems.measure import measured_cases
from wavequake.workflows.systems.measures import axes, measures
from wavequake.workflows.systems.streaks import places_between, places_of_rows, streaked_times
from wavequake.workflows.systems.study import SystemStudy

Array = NDArray[np.float64]

QUANTITIES = ("wfe_change", "wfe_rms", "image_motion")
_OF_IMAGES = ("peak", "ee50", "ee80")
_UM_PER_MM = 1e3


def elements_of(sources: Sequence[Source], layout: SegmentLayout = NO_SEGMENTS) -> tuple[str, ...]:
    """Return the surfaces and bodies that disturbances move or deform, in the order of their mention.

    None if it is one alone, whose share is that of its disturbances.
    """
    found = tuple(dict.fromkeys(name for part in sources for name in part.elements(layout)))
    return found if len(found) > 1 else ()


def evaluate(
    bench: SystemBench,
    time: Array,
    motion: Motion,
    device: str,
    quantities: Sequence[str] = QUANTITIES,
    imager: SystemImager | None = None,
    away: Array | None = None,
) -> Array:
    """Return quantities, rms over instants and field points, and the most rays lost at one of them (Q + 1,).

    ``away`` (fields, exposed instants, m, 2) in mm is where the line of sight is between the instants. NaN
    where a chief ray is lost, or too many others. Numbers of images are of all colors, the others of the
    primary wavelength.
    """
    [(found, trouble)] = measured_cases(
        bench, [(time, motion)], choose_device(device), Stopwatch(), imager, [away]
    )
    if trouble:
        return np.full(len(quantities) + 1, np.nan)
    light = bench.system.primary_wavelength if len(bench.prepared[0]) > 1 else 0
    found["image_motion"] = np.linalg.norm(found["los_mm"], axis=-1) * _UM_PER_MM
    values = []
    for name in quantities:
        one = found[name]
        if one.ndim > 1 and one.shape[1:3] == (len(bench.prepared), len(bench.prepared[0])):
            one = one[:, :, light]  # (time, field, wavelength, ...)
        lost = 1.0 - one if name in LOSSES else one
        values.append(np.sqrt(np.mean(np.sum(lost.reshape(*lost.shape[:2], -1) ** 2, axis=-1))))
    return np.array([*values, found["lost"].max()])


def experiment(
    study: SystemStudy, population: Combine, device: str, measure: str | None = None
) -> Experiment:
    """Return how the cases of a sum of disturbances are varied and traced, at the primary wavelength.

    Raises
    ------
    UserError
        If there is no number `measure` of a case.
    """
    bench = system_bench(study.identity_text())
    numbers = template_of(measures(study, {}), axes(bench)).per_case
    quantities, units = chosen(measure, QUANTITIES, numbers)
    imager = imager_on(bench.text, device) if measure in _OF_IMAGES else None
    if imager is None:
        light = bench.system.primary_wavelength
        bench = replace(
            bench,
            prepared=tuple((row[light],) for row in bench.prepared),
            static=tuple((row[light],) for row in bench.static),
        )
    sources = tuple(parts(study.disturbance, population))
    time = instants_of(study.disturbance, population)
    varied = Factors(sources, surfaces=elements_of(sources, bench.layout))
    factors = [Factor(part.name, "source", len(part.elements(bench.layout))) for part in sources]
    factors += varied.elements(bench.layout)
    names = [factor.name for factor in factors]
    branches = varied.branches(study, population, bench.layout, names, {})
    between = None if imager is None else streaked_times(study, population)

    def case_of(realization: int) -> list[Array]:
        def moved(at: Array | None = None) -> list[Motion]:
            seed = study.study.seed
            return variants(population, varied, bench.layout, seed, realization, branches, at)

        motions = moved()
        away = [places_of_rows(bench, population, one) for one in motions]
        if between is not None:
            away = [places_between(bench, between.shape, one) for one in moved(between.ravel())]
        return [
            evaluate(bench, time, motion, device, quantities, imager, there)
            for motion, there in zip(motions, away, strict=True)
        ]

    def values(first: int, last: int) -> Array:
        return np.array([case_of(one) for one in range(first, last)])

    def rest() -> Array:
        return evaluate(bench, time, still(len(time)), device, quantities, imager)

    return Experiment(
        tuple(factors),
        branches,
        quantities,
        1,
        values,
        rest,
        rays=study.optics.rays,
        light="All numbers are those of fits that go on over the full pupil, also where no light arrives.",
        units=units,
    )
