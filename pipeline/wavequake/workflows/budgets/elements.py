"""What a budget varies of motions: disturbances, rings of segments, surfaces and bodies, on, off, redrawn."""

from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wavequake.mechanics.disturbances.layout import SegmentLayout
from wavequake.mechanics.disturbances.motion import Motion, add, scaled, still
from wavequake.mechanics.disturbances.registry import Combine, draw, instants_of, randoms_of
from wavequake.mechanics.disturbances.source import Source
from wavequake.workflows.budgets.factors import AGAIN, Factor
from wavequake.workflows.budgets.tree import SIGHT, Branch, Part, branches_of, require_free_names
from wavequake.workflows.disturbed_study import DisturbedStudy

Array = NDArray[np.float64]

_NAMED = ("rigid", "figure", "grid")


@dataclass(frozen=True)
class Factors:
    """Sources of a sum of disturbances, and what they move.

    ``rings`` (S,) is the number of each segment's ring, from 1; ``surfaces`` are the names of all else that
    moves.
    """

    sources: tuple[Source, ...]
    rings: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    surfaces: tuple[str, ...] = ()

    @property
    def ring_numbers(self) -> list[int]:
        """Rings that there are; none where all segments are in one."""
        found: list[int] = np.unique(self.rings).tolist()
        return found if len(found) > 1 else []

    def elements(self, layout: SegmentLayout) -> list[Factor]:
        """Return a factor for each surface or body."""
        whole = [part for part in self.sources if part.independent == "whole"]
        together = {name for part in whole for name in part.elements(layout)}
        return [Factor(name, "element", 1, independent=name not in together) for name in self.surfaces]

    def branches(
        self,
        study: DisturbedStudy,
        population: Combine,
        layout: SegmentLayout,
        names: Sequence[str],
        inside: Mapping[str, Sequence[str]],
    ) -> tuple[Branch, ...]:
        """Return the groups of a study, by what each disturbance moves in the first case.

        `names` are those of the factors, `inside` the segments of rings. Raises as `require_free_names` and
        `branches_of`.
        """
        require_free_names(study.budget, names)
        if study.budget is None:
            return branches_of(None, frozenset(), inside)
        time, seed = time_of(population, self.sources), study.study.seed
        drawn = [
            (part.name, draw(part, layout, time, randoms_of(part, len(layout), seed, 0)))
            for part in self.sources
        ]
        return branches_of(study.budget, moving_parts(drawn, layout), inside)


def time_of(population: Combine, sources: Sequence[Source]) -> Array:
    """Return the instants (n,) of a sum of sources, which may be no population of the study, s."""
    return instants_of(sources, population.model_copy(update={"of": tuple(one.name for one in sources)}))


def variants(
    population: Combine,
    factors: Factors,
    layout: SegmentLayout,
    seed: int,
    realization: int,
    branches: Sequence[Branch] = (),
    time: Array | None = None,
) -> list[Motion]:
    """Return the motions of one case: of all factors, of all drawn again, without each, with each redrawn.

    And those of each group alone. At the instants of the population, or at others given as `time`.
    """
    time = time_of(population, factors.sources) if time is None else time

    def drawn(part: Source) -> Motion:
        return draw(part, layout, time, randoms_of(part, len(layout), seed, realization))

    nothing = still(len(time), len(layout))
    one = [drawn(part) for part in factors.sources]
    other = [drawn(part.model_copy(update={"name": part.name + AGAIN})) for part in factors.sources]

    def total(motions: Sequence[Motion]) -> Motion:
        return add([nothing, *motions])

    indices = range(len(one))
    without = [total([one[k] for k in indices if k != i]) for i in indices]
    redrawn = [total([other[k] if k == i else one[k] for k in indices]) for i in indices]
    for ring in factors.ring_numbers:
        mine = factors.rings == ring
        without.append(_with_segments(total(one), nothing, mine))
        ringwise = [
            _with_segments(first, second, mine) if part.independent == "element" else first
            for part, first, second in zip(factors.sources, one, other, strict=True)
        ]
        redrawn.append(total(ringwise))
    for name in factors.surfaces:
        without.append(with_element(total(one), nothing, name))
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


def _with_segments(motion: Motion, other: Motion, mine: NDArray[np.bool_]) -> Motion:
    """Return a motion in which some segments move as in another."""
    motion, other = add([motion, scaled(other, 0.0)]), add([other, scaled(motion, 0.0)])
    return replace(
        motion,
        segment_motion=np.where(mine[:, None], other.segment_motion, motion.segment_motion),
        segment_figure=np.where(mine[:, None], other.segment_figure, motion.segment_figure),
    )


def with_element(motion: Motion, other: Motion, element: str) -> Motion:
    """Return a motion in which one surface or body moves and deforms as in another."""
    found: dict[str, Any] = {}
    for key in _NAMED:
        mine, theirs = getattr(motion, key), getattr(other, key)
        others = {name: values for name, values in mine.items() if name != element}
        found[key] = others | {name: values for name, values in theirs.items() if name == element}
    return replace(motion, **found)


def only_elements(motion: Motion, mine: Set[str]) -> Motion:
    """Return a motion in which of all surfaces and bodies some move and deform alone."""
    found: dict[str, Any] = {
        key: {name: values for name, values in getattr(motion, key).items() if name in mine} for key in _NAMED
    }
    return replace(motion, **found)


def moving_elements(source: str, motion: Motion) -> set[Part]:
    """Return which surfaces and bodies a disturbance moves or deforms."""
    return {(source, name) for key in _NAMED for name, values in getattr(motion, key).items() if values.any()}
