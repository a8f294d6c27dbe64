"""Disturbances of any optical system without segments: sources by surfaces and bodies, and their sums."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from wavequake.mechanics.disturbances.history_facts import MOST_INSTANTS
from wavequake.mechanics.disturbances.layout import NO_SEGMENTS, SegmentLayout
from wavequake.mechanics.disturbances.motion import summed
from wavequake.mechanics.disturbances.population import Population
from wavequake.mechanics.disturbances.registry import Combine, draw_case
from wavequake.mechanics.disturbances.source import AnySource
from wavequake.mechanics.disturbances.streams import Streams, own_streams

Array = NDArray[np.float64]


class CombinedElements(Combine):
    """The sum of other disturbances of the study, drawn at this population's own instants.

    With a surface-history among them these are the rows of its file, and `instants` and `duration_s` are left
    out.
    """

    instants: int = Field(
        default=16, ge=1, le=MOST_INSTANTS, description="of the sum, evenly spread over duration_s"
    )


ElementDisturbance = Annotated[Population, AnySource("surfaces", CombinedElements)]


@dataclass(frozen=True)
class ElementMotion:
    """Disturbances of one case over n instants, SI units.

    Attributes
    ----------
    rigid : dict of ndarray, shape (n, 6)
        By the element's name: dx, dy, dz in m and rx, ry, rz in rad in its own frame at rest.
    figure : dict of ndarray, shape (terms,) or (n, terms)
        By the surface's name: Noll coefficients from j = 1 in m; static, or of each instant.
    sight : ndarray, shape (n, 2)
        Rotation of the incoming bundle on the sky, rad, along x and y.
    grid : dict of ndarray, shape (n, rows, columns)
        By the surface's name: heights in m that come on top of the figure.
    """

    rigid: dict[str, Array]
    figure: dict[str, Array]
    sight: Array
    grid: dict[str, Array] = field(default_factory=dict)


def add_elements(one: ElementMotion, other: ElementMotion) -> ElementMotion:
    """Return the sum of two motions of the same instants."""
    return ElementMotion(
        summed([one.rigid, other.rigid]),
        summed([one.figure, other.figure]),
        one.sight + other.sight,
        summed([one.grid, other.grid]),
    )


def draw_elements(
    populations: Sequence[Population],
    population: Population,
    seed: int,
    realization: int,
    streams: Streams = own_streams,
    time: Array | None = None,
    layout: SegmentLayout = NO_SEGMENTS,
) -> ElementMotion:
    """Draw one case of a population of a system, whose elements `layout` names; as `registry.draw_case`."""
    motion = draw_case(populations, population, layout, seed, realization, streams, time)
    return ElementMotion(motion.rigid, motion.figure, motion.mount, motion.grid)
