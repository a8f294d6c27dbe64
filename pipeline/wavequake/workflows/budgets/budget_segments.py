"""The budget of a segment-disturbance study: sources and rings of segments, on, off and drawn again."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import cast

import numpy as np
from numpy.typing import NDArray

from wavequake.campaign.contract import DONE
from wavequake.mechanics.disturbances.layout import SegmentLayout
from wavequake.mechanics.disturbances.motion import Motion, add, scaled
from wavequake.mechanics.disturbances.registry import Combine, draw, instants_of, parts, randoms_of
from wavequake.mechanics.disturbances.source import Source, time_axis_of
from wavequake.workflows.budgets.budget_factors import AGAIN, Experiment, Factor
from wavequake.workflows.segments.bench import Bench, bench_of
from wavequake.workflows.segments.segment_disturbance import CaseDraw, trace_draws
from wavequake.workflows.segments.segment_study import SegmentStudy
from wavequake.workflows.study import study_with

Array = NDArray[np.float64]

QUANTITIES = ("wfe_rms_raw", "wfe_rms", "los")
_AT_ONCE = 64  # draws that are in memory together


_TRACED = {
    "imaging.enabled": False,
    "optics.method": "standard",
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
    population: Combine, factors: Factors, layout: SegmentLayout, seed: int, realization: int
) -> list[Motion]:
    """Return the motions of one case: of all factors, of all drawn again, without each, with each redrawn."""
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
        without.append(_with_surface(total(one), still, name))
        redrawn.append(
            total(
                [
                    _with_surface(first, second, name) if part.independent == "element" else first
                    for part, first, second in zip(factors.sources, one, other, strict=True)
                ]
            )
        )
    return [total(one), total(other), *without, *redrawn]


def _with_segments(motion: Motion, other: Motion, mine: NDArray[np.bool_]) -> Motion:
    """Return a motion in which some segments move as in another."""
    motion, other = add([motion, scaled(other, 0.0)]), add([other, scaled(motion, 0.0)])
    return replace(
        motion,
        segment_motion=np.where(mine[:, None], other.segment_motion, motion.segment_motion),
        segment_figure=np.where(mine[:, None], other.segment_figure, motion.segment_figure),
    )


def _with_surface(motion: Motion, other: Motion, name: str) -> Motion:
    """Return a motion in which one surface after M1 moves as in another."""
    rigid = {key: values for key, values in motion.rigid.items() if key != name}
    if name in other.rigid:
        rigid[name] = other.rigid[name]
    return replace(motion, rigid=rigid)


def moves_segments_together(source: Source, layout: SegmentLayout) -> bool:
    """Return whether a source moves segments, and those not independently of each other."""
    if source.independent == "element":
        return False
    randoms = randoms_of(source, len(layout), 0, 0)
    return bool(draw(source, layout, time_axis_of(source)[:1], randoms).segment_motion.any())


def time_of(population: Combine, sources: Sequence[Source]) -> Array:
    """Return the instants (n,) of a sum of sources, which may be no population of the study, s."""
    return instants_of(sources, population.model_copy(update={"of": tuple(one.name for one in sources)}))


def evaluate(bench: Bench, population: Combine, motions: Sequence[Motion], device: str) -> Array:
    """Return the QUANTITIES (rms over instants) of motions, and the most rays that mirrors stop, (B, 4).

    NaN where one cannot be traced.
    """
    time, found = time_of(population, parts(bench.study.disturbance, population)), []
    for first in range(0, len(motions), _AT_ONCE):
        draws = [CaseDraw(population, 0, time, motion) for motion in motions[first : first + _AT_ONCE]]
        result = trace_draws(bench.text, draws, device)
        squares = [
            np.sum(result.arrays[name][:, : len(time)].reshape(len(draws), len(time), -1) ** 2, axis=2)
            for name in QUANTITIES
        ]
        values = np.stack([*np.sqrt(np.mean(squares, axis=2)), result.arrays["vignetted"]], axis=1)
        found.append(np.where((result.status == DONE)[:, None], values, np.nan))
    return np.concatenate(found)


def experiment(study: SegmentStudy, population: Combine, device: str) -> Experiment:
    """Return how the cases of a sum of disturbances are varied and traced on a device."""
    traced = cast(SegmentStudy, study_with(study, _TRACED))
    bench = bench_of(traced.identity_text())
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
    count = 2 + 2 * (len(sources) + len(rings) + len(elements))

    def drawn(realization: int) -> list[Motion]:
        return variants(population, factors, bench.layout, study.study.seed, realization)

    def values(first: int, last: int) -> Array:
        motions = [motion for realization in range(first, last) for motion in drawn(realization)]
        found = evaluate(bench, population, motions, device)
        return found.reshape(last - first, count, found.shape[1])

    def rest() -> Array:
        return np.asarray(evaluate(bench, population, [scaled(drawn(0)[0], 0.0)], device)[0])

    return Experiment(
        (*sources, *rings, *elements),
        QUANTITIES,
        max(1, _AT_ONCE // count),
        values,
        rest,
        rays=bench.stopped.rays,
        light="All numbers are those of the light that arrives.",
    )
