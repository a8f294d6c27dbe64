"""What a case of a segmented telescope draws: motions by generators, by a sampling plan, or near a limit."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import groupby

import numpy as np
from numpy.typing import NDArray

from wavequake.chain.images.streak import around_rows, leaves_dots, times_between
from wavequake.chain.sampling import Plan, plan_of
from wavequake.chain.uncertain import STREAM
from wavequake.mechanics.assembly.plant import Plant
from wavequake.mechanics.disturbances.layout import SegmentLayout
from wavequake.mechanics.disturbances.registry import (
    Disturbance,
    Motion,
    draw_cases,
    draw_sight,
    parts,
)
from wavequake.mechanics.disturbances.source import TOGETHER
from wavequake.mechanics.disturbances.streams import Streams
from wavequake.mechanics.disturbances.supports import Supports
from wavequake.prepared import prepared
from wavequake.workflows.bodies.sight import bodies_sight
from wavequake.workflows.bodies.uncertain import uncertain_plant
from wavequake.workflows.mirrors.study import FULL
from wavequake.workflows.segments.bench import Bench, bench_of
from wavequake.workflows.segments.rare import rare_cases
from wavequake.workflows.segments.study import SegmentStudy

Array = NDArray[np.float64]


@prepared(maxsize=2)
def sampling_plan(study_text: str) -> Plan:
    """Return what spreads the random numbers of the study with this identity text.

    Raises
    ------
    UserError
        If they are too many for the plan that the study asks for.
    """
    bench = bench_of(study_text)
    return plan_of(bench.study.campaign, bench.study.study.seed, bench.study.disturbance, bench.layout)


def draw_realization(bench: Bench, population: Disturbance, realization: int, model: str = FULL) -> Motion:
    """Draw a realization, of study, population and number alone, with a model of elastic segments."""
    return next(draw_realizations(bench, population, [realization], model))


def draw_realizations(
    bench: Bench, population: Disturbance, realizations: Sequence[int], model: str = FULL
) -> Iterator[Motion]:
    """Draw realizations in the order given, ascending: neighbors together, to the bit as each alone."""
    study, segment = bench.study, bench.plants.get(model, bench.layout.segment)
    for _, neighbors in groupby(realizations, lambda realization: realization // TOGETHER):
        group = list(neighbors)
        layouts = [
            _with(bench.layout, _supports(study, realization), segment, _bodies(bench, realization, model))
            for realization in group
        ]
        streams = [_streams(bench, realization) for realization in group]
        yield from draw_cases(study.disturbance, population, layouts, study.study.seed, group, streams)


def _bodies(bench: Bench, realization: int, model: str) -> Plant | None:
    """Return the bodies that a realization has with one of the models that the study compares."""
    study, plants = bench.study, bench.bodies.plants
    known = model if model in plants else FULL
    return uncertain_plant(plants, study.structure, study.study.seed, realization, known)


def _with(
    layout: SegmentLayout, supports: Supports | None, segment: Plant | None, plant: Plant | None
) -> SegmentLayout:
    """Return a layout on supports, with bodies; the same one, whose digest is known, if there are none."""
    if supports is None and segment is None and plant is None:
        return layout
    return replace(layout, supports=supports, segment=segment, plant=plant)


def _supports(study: SegmentStudy, realization: int) -> Supports | None:
    """Return the model of the supports that a realization has, which all disturbances share."""
    uncertain = study.structure.uncertain if study.structure else None
    if uncertain is None:
        return None
    key = (study.study.seed, STREAM, realization // uncertain.repeats)
    return Supports(uncertain.frequency, uncertain.damping, uncertain.supports == "apart", key)


def way_between(
    bench: Bench, population: Disturbance, realization: int, time: Array, motion: Motion, model: str = FULL
) -> Array | None:
    """Return the line of sight from each instant of a realization back to the one before, (n, m, 2) in rad.

    As far as it moves by itself or with bodies; None if it does not. Of histories from files it is linear
    between rows.
    """
    own = _own_way(bench, population, realization, time, motion)
    if (plant := _bodies(bench, realization, model)) is None:
        return own
    at = times_between(time, population.duration_s)
    streams = _streams(bench, realization)
    known = model if model in bench.bodies.plants else FULL
    sight = bodies_sight(bench, plant, known, population, realization, streams, at[:, ::-1].ravel())
    if sight is None:
        return own
    way = sight.reshape(*at.shape, 2)[:, ::-1]
    if not leaves_dots((way - way[:, :1]) * (2.0 * bench.system.annulus.outer / bench.unit_mm)):
        return own
    if own is not None and own.shape != way.shape:  # of rows of a file, each with its own place first
        return own
    return way if own is None else own + way


def _own_way(
    bench: Bench, population: Disturbance, realization: int, time: Array, motion: Motion
) -> Array | None:
    """Return the way of the line of sight where sources move it alone; as `way_between`."""
    at = times_between(time, population.duration_s)
    sight = _sight_at(bench, population, realization, at[:, ::-1].ravel())  # evenly spaced, ascending
    way = None if sight is None else sight.reshape(*at.shape, 2)[:, ::-1]
    if all(one.instants_of_file() is None for one in parts(bench.study.disturbance, population)):
        return way
    given = motion.mount + motion.m2
    if way is None:
        return around_rows(time, np.arange(len(time)), given) if given.any() else None
    given = given - way[:, 0]
    return way + np.stack([np.interp(at, time, given[:, axis]) for axis in (0, 1)], axis=-1)


def _sight_at(bench: Bench, population: Disturbance, realization: int, time: Array) -> Array | None:
    """Return the line of sight (n, 2) of a realization at any instants, rad; None if it rests."""
    study, streams = bench.study, _streams(bench, realization)
    populations, seed = study.disturbance, study.study.seed
    return draw_sight(populations, population, bench.layout, seed, realization, streams, time)


def _streams(bench: Bench, realization: int) -> Streams:
    plan = sampling_plan(bench.text) if bench.study.rare is None else rare_cases(bench.text)
    return plan.of(realization)
