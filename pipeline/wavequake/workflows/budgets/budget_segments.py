"""The budget of a segment-disturbance study: sources and rings of segments, on, off and drawn again."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import cast

import numpy as np
from numpy.typing import NDArray

from wavequake.campaign.contract import DONE
from wavequake.mechanics.disturbances.common_history import CommonHistory
from wavequake.mechanics.disturbances.edge_sensors import EdgeSensorNoise
from wavequake.mechanics.disturbances.layout import SegmentLayout
from wavequake.mechanics.disturbances.motion import Motion, add
from wavequake.mechanics.disturbances.registry import (
    Combine,
    SingleDisturbance,
    draw,
    parts,
    stream_of,
    time_axis,
)
from wavequake.mechanics.disturbances.segment_history import SegmentHistory
from wavequake.mechanics.disturbances.segment_wind import SegmentWind
from wavequake.mechanics.disturbances.static_random import StaticRandom
from wavequake.workflows.budgets.budget_factors import AGAIN, Experiment, Factor
from wavequake.workflows.segments.bench import Bench, bench_of
from wavequake.workflows.segments.segment_disturbance import CaseDraw, trace_draws
from wavequake.workflows.segments.segment_study import SegmentStudy
from wavequake.workflows.study import study_with

Array = NDArray[np.float64]

QUANTITIES = ("wfe_rms_raw", "wfe_rms", "los")
_AT_ONCE = 64  # draws that are in memory together
# Their segments are drawn independently of each other, so that a ring of them is a factor, too.
_RING_BY_RING = (StaticRandom, CommonHistory)
_TOGETHER = (SegmentHistory, SegmentWind, EdgeSensorNoise)


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
    """Sources of a sum of disturbances, and rings of segments: (S,) number of each segment's ring, from 1."""

    sources: tuple[SingleDisturbance, ...]
    rings: NDArray[np.int64]

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
    time = time_axis(population)

    def drawn(part: SingleDisturbance) -> Motion:
        return draw(part, layout, time, stream_of(part, len(layout), seed, realization))

    still = _scaled(add([drawn(part) for part in factors.sources[:1]]), 0.0)
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
            _with_segments(first, second, mine) if isinstance(part, _RING_BY_RING) else first
            for part, first, second in zip(factors.sources, one, other, strict=True)
        ]
        redrawn.append(total(ringwise))
    return [total(one), total(other), *without, *redrawn]


def _scaled(motion: Motion, factor: float) -> Motion:
    return Motion(
        motion.segment_motion * factor,
        motion.segment_figure * factor,
        motion.mount * factor,
        motion.m2 * factor,
    )


def _with_segments(motion: Motion, other: Motion, mine: NDArray[np.bool_]) -> Motion:
    """Return a motion in which some segments move as in another."""
    motion, other = add([motion, _scaled(other, 0.0)]), add([other, _scaled(motion, 0.0)])
    return replace(
        motion,
        segment_motion=np.where(mine[:, None], other.segment_motion, motion.segment_motion),
        segment_figure=np.where(mine[:, None], other.segment_figure, motion.segment_figure),
    )


def evaluate(bench: Bench, population: Combine, motions: Sequence[Motion], device: str) -> Array:
    """Return the QUANTITIES (rms over instants) of motions, and the most rays that mirrors stop, (B, 4).

    NaN where one cannot be traced.
    """
    time, found = time_axis(population), []
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
    factors = Factors(tuple(parts(study.disturbance, population)), rings_of(bench.layout))
    segments = len(bench.layout)
    sources = [Factor(part.name, "source", segments) for part in factors.sources]
    together = any(isinstance(part, _TOGETHER) for part in factors.sources)
    rings = [
        Factor(f"ring {ring}", "ring", int(np.count_nonzero(factors.rings == ring)), independent=not together)
        for ring in factors.ring_numbers
    ]
    count = 2 + 2 * (len(sources) + len(rings))

    def drawn(realization: int) -> list[Motion]:
        return variants(population, factors, bench.layout, study.study.seed, realization)

    def values(first: int, last: int) -> Array:
        motions = [motion for realization in range(first, last) for motion in drawn(realization)]
        found = evaluate(bench, population, motions, device)
        return found.reshape(last - first, count, found.shape[1])

    def rest() -> Array:
        return np.asarray(evaluate(bench, population, [_scaled(drawn(0)[0], 0.0)], device)[0])

    return Experiment(
        (*sources, *rings),
        QUANTITIES,
        max(1, _AT_ONCE // count),
        values,
        rest,
        rays=bench.stopped.rays,
        light="All numbers are those of the light that arrives.",
    )
