"""The budget of a segment-disturbance study: sources and rings of segments, on, off and drawn again."""

from collections.abc import Sequence, Set
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from wavequake.campaign.contract import DONE
from wavequake.chain.images.streak import times_between
from wavequake.mechanics.disturbances.layout import SegmentLayout
from wavequake.mechanics.disturbances.motion import Motion, add, scaled
from wavequake.mechanics.disturbances.registry import (
    Combine,
    draw,
    draw_sight,
    instants_of,
    parts,
    randoms_of,
)
from wavequake.mechanics.disturbances.source import Source, time_axis_of
from wavequake.mechanics.disturbances.streams import own_streams
from wavequake.workflows.budgets.elements import moving_elements, only_elements, with_element
from wavequake.workflows.budgets.factors import AGAIN, Experiment, Factor, chosen
from wavequake.workflows.budgets.kept import LOSSES
from wavequake.workflows.budgets.tree import SIGHT, Branch, Part, branches_of, require_free_names
from wavequake.workflows.segments.bench import Bench, bench_of
from wavequake.workflows.segments.disturbance import trace_draws
from wavequake.workflows.segments.launches import CaseDraw
from wavequake.workflows.segments.study import SegmentStudy, without_images
from wavequake.workflows.segments.template import traced
from wavequake.workflows.study import study_with

Array = NDArray[np.float64]

QUANTITIES = ("wfe_rms_raw", "wfe_rms", "los")
_AT_ONCE = 64  # draws that are in memory together


_TRACED = {
    "optics.light": "traced",
    "store.reduce": "none",
    "store.every": 1,
    "store.keep": [],
    "campaign.sampling": "random",
    "campaign.until": None,
}


@dataclass(frozen=True)
class Factors:
    """Sources of a sum of disturbances, and what they move.

    ``rings`` (S,) is the number of each segment's ring, from 1; ``surfaces`` are the names of those after M1
    that move.
    """

    sources: tuple[Source, ...]
    rings: NDArray[np.int64]
    surfaces: tuple[str, ...] = ()

    @property
    def ring_numbers(self) -> list[int]:
        """Rings that there are; none where all segments are in one."""
        found: list[int] = np.unique(self.rings).tolist()
        return found if len(found) > 1 else []


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


def variants(
    population: Combine,
    factors: Factors,
    layout: SegmentLayout,
    seed: int,
    realization: int,
    branches: Sequence[Branch] = (),
) -> list[Motion]:
    """Return the motions of one case: of all factors, of all drawn again, without each, with each redrawn.

    And those of each group alone.
    """
    time = time_of(population, factors.sources)

    def drawn(part: Source) -> Motion:
        return draw(part, layout, time, randoms_of(part, len(layout), seed, realization))

    still = scaled(add([drawn(part) for part in factors.sources[:1]]), 0.0)
    one = [drawn(part) for part in factors.sources]
    other = [drawn(part.model_copy(update={"name": part.name + AGAIN})) for part in factors.sources]

    def total(motions: Sequence[Motion]) -> Motion:
        return add([still, *motions])

    indices = range(len(one))
    without = [total([one[k] for k in indices if k != i]) for i in indices]
    redrawn = [total([other[k] if k == i else one[k] for k in indices]) for i in indices]
    for ring in factors.ring_numbers:
        mine = factors.rings == ring
        without.append(_with_segments(total(one), still, mine))
        ringwise = [
            _with_segments(first, second, mine) if part.independent == "element" else first
            for part, first, second in zip(factors.sources, one, other, strict=True)
        ]
        redrawn.append(total(ringwise))
    for name in factors.surfaces:
        without.append(with_element(total(one), still, name))
        redrawn.append(
            total(
                [
                    with_element(first, second, name) if part.independent == "element" else first
                    for part, first, second in zip(factors.sources, one, other, strict=True)
                ]
            )
        )
    names = [part.name for part in factors.sources]
    alone = [
        total(
            [
                _of_elements(motion, layout, {element for source, element in branch.parts if source == name})
                for name, motion in zip(names, one, strict=True)
            ]
        )
        for branch in branches
    ]
    return [total(one), total(other), *without, *redrawn, *alone]


def _of_elements(motion: Motion, layout: SegmentLayout, mine: Set[str]) -> Motion:
    """Return a motion in which some elements move alone."""
    moved = np.array([name in mine for name in layout.names], dtype=bool)[:, None]
    sight = float(SIGHT in mine)
    return replace(
        only_elements(motion, mine),
        segment_motion=np.where(moved, motion.segment_motion, 0.0),
        segment_figure=np.where(moved, motion.segment_figure, 0.0),
        mount=sight * motion.mount,
        m2=sight * motion.m2,
    )


def moving_parts(drawn: Sequence[tuple[str, Motion]], layout: SegmentLayout) -> frozenset[Part]:
    """Return which elements each of some disturbances moves."""
    found: set[Part] = set()
    for source, motion in drawn:
        bent = np.atleast_2d(motion.segment_figure.any(axis=-1)).any(axis=0)
        moved = motion.segment_motion.any(axis=(0, 2)) | bent
        found |= {(source, layout.names[place]) for place in np.flatnonzero(moved)}
        found |= moving_elements(source, motion)
        if motion.mount.any() or motion.m2.any():
            found.add((source, SIGHT))
    return frozenset(found)


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


def _with_segments(motion: Motion, other: Motion, mine: NDArray[np.bool_]) -> Motion:
    """Return a motion in which some segments move as in another."""
    motion, other = add([motion, scaled(other, 0.0)]), add([other, scaled(motion, 0.0)])
    return replace(
        motion,
        segment_motion=np.where(mine[:, None], other.segment_motion, motion.segment_motion),
        segment_figure=np.where(mine[:, None], other.segment_figure, motion.segment_figure),
    )


def moves_segments_together(source: Source, layout: SegmentLayout) -> bool:
    """Return whether a source moves segments, and those not independently of each other."""
    if source.independent == "element":
        return False
    randoms = randoms_of(source, len(layout), 0, 0)
    return bool(draw(source, layout, time_axis_of(source)[:1], randoms).segment_motion.any())


def time_of(population: Combine, sources: Sequence[Source]) -> Array:
    """Return the instants (n,) of a sum of sources, which may be no population of the study, s."""
    return instants_of(sources, population.model_copy(update={"of": tuple(one.name for one in sources)}))


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


def _moving(
    study: SegmentStudy, population: Combine, sources: Sequence[Source], layout: SegmentLayout
) -> frozenset[Part]:
    """Return which elements each disturbance moves in the first case, if groups ask for it."""
    if study.budget is None:
        return frozenset()
    time, seed = time_of(population, sources), study.study.seed
    drawn = [
        (part.name, draw(part, layout, time, randoms_of(part, len(layout), seed, 0))) for part in sources
    ]
    return moving_parts(drawn, layout)


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
        traced_study = study_with(without_images(study), _TRACED)
    else:
        traced_study = study_with(study, _TRACED | {"imaging.enabled": True})
    bench = bench_of(traced_study.identity_text())
    quantities, units = chosen(measure, QUANTITIES, traced(bench.text))
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
    whole = {name for part in found if part.independent == "whole" for name in part.elements(bench.layout)}
    elements = [Factor(name, "element", 1, independent=name not in whole) for name in surfaces]
    inside = {
        f"ring {ring}": [bench.layout.names[place] for place in np.flatnonzero(factors.rings == ring)]
        for ring in factors.ring_numbers
    }
    require_free_names(study.budget, [factor.name for factor in (*sources, *rings, *elements)])
    branches = branches_of(study.budget, _moving(study, population, found, bench.layout), inside)
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
