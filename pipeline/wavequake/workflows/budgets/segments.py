"""The budget of a segment-disturbance study: sources and rings of segments, on, off and drawn again."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from wavequake.campaign.contract import DONE
from wavequake.campaign.measures import template_of
from wavequake.chain.images.streak import times_between
from wavequake.mechanics.disturbances.layout import SegmentLayout
from wavequake.mechanics.disturbances.motion import Motion, scaled
from wavequake.mechanics.disturbances.registry import (
    Combine,
    draw,
    draw_sight,
    parts,
    randoms_of,
)
from wavequake.mechanics.disturbances.source import Source, time_axis_of
from wavequake.mechanics.disturbances.streams import own_streams
from wavequake.workflows.budgets.elements import Factors, time_of, variants
from wavequake.workflows.budgets.factors import AGAIN, Experiment, Factor, chosen
from wavequake.workflows.budgets.kept import LOSSES
from wavequake.workflows.budgets.tree import SIGHT, Branch
from wavequake.workflows.segments.bench import Bench, bench_of
from wavequake.workflows.segments.disturbance import trace_draws
from wavequake.workflows.segments.launches import CaseDraw
from wavequake.workflows.segments.study import TRACED, SegmentStudy, without_images
from wavequake.workflows.segments.template import axes, traced_measures
from wavequake.workflows.study import study_with

Array = NDArray[np.float64]

QUANTITIES = ("wfe_rms_raw", "wfe_rms", "los")
_AT_ONCE = 64  # draws that are in memory together


def rings_of(layout: SegmentLayout) -> NDArray[np.int64]:
    """Return the ring of every segment (S,): its distance from the axis over the distance of neighbors.

    Rounded, from 1 for the innermost ring that there is; a mirror of one piece is one ring.
    """
    centers = layout.centers_m[:, :2]
    if len(centers) < 2:
        return np.ones(len(centers), dtype=np.int64)
    apart = np.linalg.norm(centers[:, None] - centers, axis=2)
    pitch = np.median(np.where(apart > 0.0, apart, np.inf).min(axis=1))
    number = np.rint(np.linalg.norm(centers, axis=1) / pitch).astype(np.int64)
    return np.unique(number, return_inverse=True)[1].astype(np.int64) + 1


def ways(
    population: Combine,
    factors: Factors,
    layout: SegmentLayout,
    seed: int,
    realization: int,
    branches: Sequence[Branch] = (),
) -> list[Array | None]:
    """Return how the line of sight runs between the instants of each of `variants`; None where it rests."""
    at = times_between(time_of(population, factors.sources), population.duration_s)

    def way(part: Source) -> Array:
        names = {"of": (part.name,)}
        whole = population.model_copy(update=names)
        sight = draw_sight((part,), whole, layout, seed, realization, own_streams, at.ravel())
        return np.zeros((*at.shape, 2)) if sight is None else sight.reshape(*at.shape, 2)

    one = [way(part) for part in factors.sources]
    other = [way(part.model_copy(update={"name": part.name + AGAIN})) for part in factors.sources]
    total = np.asarray(sum(one))
    alike = [total] * (len(factors.ring_numbers) + len(factors.surfaces))
    without = [total - mine for mine in one]
    redrawn = [total - mine + theirs for mine, theirs in zip(one, other, strict=True)]
    names = [part.name for part in factors.sources]
    alone = [
        np.asarray(
            sum(
                (way for name, way in zip(names, one, strict=True) if (name, SIGHT) in branch.parts),
                0 * total,
            )
        )
        for branch in branches
    ]
    found = [total, np.asarray(sum(other)), *without, *alike, *redrawn, *alike, *alone]
    return [each if any(part.sight for part in factors.sources) else None for each in found]


def moves_segments_together(source: Source, layout: SegmentLayout) -> bool:
    """Return whether a source moves segments, and those not independently of each other."""
    if source.independent == "element":
        return False
    randoms = randoms_of(source, len(layout), 0, 0)
    return bool(draw(source, layout, time_axis_of(source)[:1], randoms).segment_motion.any())


def evaluate(
    bench: Bench,
    population: Combine,
    motions: Sequence[Motion],
    device: str,
    quantities: Sequence[str] = QUANTITIES,
    between: Sequence[Array | None] | None = None,
) -> Array:
    """Return quantities (rms over instants) of motions, and the most rays that mirrors stop, (B, Q + 1).

    NaN where one cannot be traced. `between` are the ways of the line of sight where images are made.
    """
    time, found = time_of(population, parts(bench.study.disturbance, population)), []
    ways_ = between or [None] * len(motions)
    for first in range(0, len(motions), _AT_ONCE):
        part = slice(first, first + _AT_ONCE)
        draws = [
            CaseDraw(population, 0, time, motion, way)
            for motion, way in zip(motions[part], ways_[part], strict=True)
        ]
        result = trace_draws(bench.text, draws, device)
        values = [rms_of(name, result.arrays[name]) for name in quantities]
        columns = np.stack([*values, result.arrays["vignetted"]], axis=1)
        found.append(np.where((result.status == DONE)[:, None], columns, np.nan))
    return np.concatenate(found)


def rms_of(name: str, values: Array) -> Array:
    """Return the rms over the instants of cases (B, ...) of a measure, of vectors that of their lengths.

    What is missing to 1 of a measure of which more is better. NaN beyond the instants of a case is left out.
    """
    lost = 1.0 - values if name in LOSSES else values
    if lost.ndim == 1:
        return np.abs(lost)
    squares = (lost**2).reshape(*lost.shape[:2], -1).sum(axis=2)
    known = np.isfinite(squares)
    total = np.where(known, squares, 0.0).sum(axis=1)
    return np.asarray(np.sqrt(total / np.maximum(known.sum(axis=1), 1)))


def experiment(
    study: SegmentStudy, population: Combine, device: str, measure: str | None = None
) -> Experiment:
    """Return how the cases of a sum of disturbances are varied and traced on a device.

    Raises
    ------
    UserError
        If there is no number `measure` of a case.
    """
    study.require_one_place("A budget is")
    if measure is None:
        traced_study = study_with(without_images(study), TRACED)
    else:
        traced_study = study_with(study, TRACED | {"imaging.enabled": True})
    bench = bench_of(traced_study.identity_text())
    quantities, units = chosen(measure, QUANTITIES, template_of(traced_measures(bench), axes(bench)).per_case)
    found, segments = tuple(parts(study.disturbance, population)), len(bench.layout)
    moved = dict.fromkeys(name for part in found for name in part.elements(bench.layout))
    surfaces = tuple(name for name in moved if name not in bench.layout.names)
    factors = Factors(found, rings_of(bench.layout), surfaces)
    sources = [Factor(part.name, "source", segments) for part in factors.sources]
    together = any(moves_segments_together(part, bench.layout) for part in factors.sources)
    rings = [
        Factor(f"ring {ring}", "ring", int(np.count_nonzero(factors.rings == ring)), independent=not together)
        for ring in factors.ring_numbers
    ]
    elements = factors.elements(bench.layout)
    inside = {
        f"ring {ring}": [bench.layout.names[place] for place in np.flatnonzero(factors.rings == ring)]
        for ring in factors.ring_numbers
    }
    names = [factor.name for factor in (*sources, *rings, *elements)]
    branches = factors.branches(study, population, bench.layout, names, inside)
    count = 2 + 2 * (len(sources) + len(rings) + len(elements)) + len(branches)

    def drawn(realization: int) -> list[Motion]:
        return variants(population, factors, bench.layout, study.study.seed, realization, branches)

    def values(first: int, last: int) -> Array:
        motions = [motion for realization in range(first, last) for motion in drawn(realization)]
        between = None
        if bench.study.imaging.enabled:
            seed = study.study.seed
            cases = range(first, last)
            between = [
                way for one in cases for way in ways(population, factors, bench.layout, seed, one, branches)
            ]
        found = evaluate(bench, population, motions, device, quantities, between)
        return found.reshape(last - first, count, found.shape[1])

    def rest() -> Array:
        return np.asarray(evaluate(bench, population, [scaled(drawn(0)[0], 0.0)], device, quantities)[0])

    return Experiment(
        (*sources, *rings, *elements),
        branches,
        quantities,
        max(1, _AT_ONCE // count),
        values,
        rest,
        rays=bench.stopped.rays,
        light="All numbers are those of the light that arrives.",
        units=units,
    )
