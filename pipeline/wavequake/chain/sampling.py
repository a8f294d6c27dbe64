"""Sampling plans: random cases, Latin hypercubes and scrambled Sobol points (``campaign.sampling``).

What a case draws depends on the study and the number of its realization alone. Realizations are dealt in turn
to a few independent sets, the replicates: the numbers of a set are not independent of each other, so that
what is known of an estimate's error is the scatter between sets.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, TypeVar

import numpy as np
import scipy
from numpy.typing import NDArray
from pydantic import Field, model_validator

from wavequake.campaign.schema import CampaignSection
from wavequake.errors import UserError
from wavequake.mechanics.disturbances.layout import SegmentLayout
from wavequake.mechanics.disturbances.motion import generator
from wavequake.mechanics.disturbances.population import Population
from wavequake.mechanics.disturbances.registry import draw_case
from wavequake.mechanics.disturbances.source import Source
from wavequake.mechanics.disturbances.streams import Coordinates, Random, Streams, own_streams
from wavequake.prepared import prepared

Array = NDArray[np.float64]

Kind = TypeVar("Kind", bound=Population)

_STREAM = "~sampling"  # no disturbance can have this name
_MOST_NUMBERS = 2**26  # of all Latin hypercubes together: 0.5 GB
_MOST_POINTS = 2**30  # of one Sobol sequence


def slots(shares: Sequence[int], cases: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the index of the population and the realization of each case.

    Cases repeat a pattern in which population p has ``shares[p]`` rows, so that adding cases changes no
    earlier one, and the n-th case of every population is realization n: comparisons between populations are
    paired.
    """
    rows = np.asarray(shares, dtype=np.int64)
    pattern = np.repeat(np.arange(len(rows)), rows)
    first = np.cumsum(rows) - rows
    round_, place = np.divmod(cases, len(pattern))
    population = pattern[place]
    return population, round_ * rows[population] + place - first[population]


def slot(populations: tuple[Kind, ...], case: int) -> tuple[Kind, int]:
    """Return the population and realization of a case; see `slots`."""
    which, realization = slots([population.share for population in populations], np.array([case]))
    return populations[which[0]], int(realization[0])


class SampledCampaignSection(CampaignSection):
    """How much of the study to run, how its random numbers are spread, and on which device.

    The identity of a study holds what is not random sampling, and the number of cases of a Latin hypercube.
    """

    sampling: Literal["random", "latin-hypercube", "sobol"] = Field(
        default="random",
        description="independent draws, or sets of points that fill the space of the random numbers evenly "
        "(docs/statistics.md); part of the identity, for latin-hypercube with the number of cases",
    )
    replicates: int = Field(
        default=8,
        ge=1,
        le=32,
        description="latin-hypercube, sobol: independent sets that cases belong to in turn; the scatter "
        "between them gives confidence intervals, a single set has none",
    )

    @model_validator(mode="after")
    def _sets_are_complete(self) -> "SampledCampaignSection":
        if self.sampling == "latin-hypercube" and self.until is not None:
            raise ValueError(
                "until cannot stop a latin-hypercube, which is stratified only when it is complete; "
                'take sampling = "sobol", or leave until out'
            )
        if self.sampling == "sobol" and self.until is not None and self.replicates < 2:
            raise ValueError("until needs confidence intervals, hence replicates of at least 2")
        return self

    def identity_record(self) -> dict[str, object]:
        """Return what of the sampling determines a case's numbers."""
        if self.sampling == "random":
            return {}
        cases = {"cases": self.cases} if self.sampling == "latin-hypercube" else {}
        return {"sampling": self.sampling, "replicates": self.replicates, **cases}


def whole_sets(campaign: SampledCampaignSection, shares: Sequence[int]) -> None:
    """Raise ValueError if the cases of a Latin hypercube do not fill its strata."""
    if campaign.sampling != "latin-hypercube":
        return
    if len({share for share in shares if share}) > 1:
        raise ValueError(
            "a latin-hypercube needs the same share for all disturbances, or share = 0; "
            'take campaign.sampling = "sobol" for others'
        )
    step = sum(shares) * campaign.replicates
    if campaign.cases % step:
        raise ValueError(
            f"campaign.cases = {campaign.cases} does not fill {campaign.replicates} latin hypercubes; take a "
            f"multiple of {step} (disturbances times campaign.replicates), such as "
            f"{step * max(1, round(campaign.cases / step))}"
        )


def replicate_labels(
    campaign: SampledCampaignSection, realizations: NDArray[np.int64]
) -> dict[str, NDArray[np.int64]]:
    """Return the column of the case table that says to which set a case belongs; none if all are random."""
    return {} if campaign.sampling == "random" else {"replicate": realizations % campaign.replicates}


@dataclass(frozen=True)
class Plan:
    """What spreads the numbers of a study's realizations.

    ``streams`` are the names and numbers of coordinates of the streams that are stratified, in order;
    ``points`` the number of points of a set (0: no end).
    """

    method: Literal["random", "latin-hypercube", "sobol"]
    seed: int
    replicates: int
    points: int
    streams: tuple[tuple[str, int], ...]

    @property
    def dimensions(self) -> int:
        """Number of coordinates of a point."""
        return sum(count for _, count in self.streams)

    def of(self, realization: int) -> Streams:
        """Return what the streams of a realization draw from."""
        if self.method == "random" or not self.streams:
            return own_streams
        point = self.point(realization)
        ends = np.cumsum([count for _, count in self.streams])
        parts = dict(zip([name for name, _ in self.streams], np.split(point, ends[:-1]), strict=True))
        return lambda name: Coordinates(parts[name]) if name in parts else None

    def point(self, realization: int) -> Array:
        """Return the coordinates (dimensions,) of a realization, between 0 and 1, both excluded.

        Raises
        ------
        UserError
            If the plan has not so many points.
        """
        index, replicate = divmod(realization, self.replicates)
        if index >= (self.points or _MOST_POINTS):
            raise UserError(f"The sampling plan has no point for realization {realization}.")
        if self.method == "sobol":
            drawn = _sobol(self.seed, replicate, self.dimensions).at(index)
        else:
            drawn = _hypercube(self.seed, replicate, self.dimensions, self.points)[index]
        return np.clip(drawn, 2.0**-53, 1.0 - 2.0**-52)

    def words(self) -> dict[str, str]:
        """Return what is stratified, for the plan of a campaign."""
        if self.method == "random":
            return {}
        size = f" of {self.points} points" if self.points else ""
        streams = ", ".join(f"{name} ({count})" for name, count in self.streams) or "nothing"
        return {
            "sampling": f"{self.replicates} {self.method} sets{size} in {self.dimensions} dimensions",
            "stratified": f"{streams}; everything else is random",
        }


def plan_of(
    campaign: SampledCampaignSection, seed: int, populations: Sequence[Population], layout: SegmentLayout
) -> Plan:
    """Return the plan of a study whose populations move what a layout names.

    Every disturbance is drawn once to see how many numbers it takes.

    Raises
    ------
    UserError
        If there are more numbers than Sobol's sequence has dimensions, or memory has room for.
    """
    if campaign.sampling == "random":
        return Plan("random", seed, 1, 0, ())
    counters: dict[str, Coordinates] = {}
    singles = [entry for entry in populations if isinstance(entry, Source)]
    stratified = {source.name: source.stratified for source in singles}

    def counting(name: str) -> Random | None:
        if stratified[name.partition("/")[0]]:
            counters[name] = Coordinates()
        return counters.get(name)

    for entry in (one for one in singles if one.random):
        draw_case(singles, entry, layout, seed, 0, counting)
    sizes = tuple((name, counter.taken) for name, counter in counters.items())
    points = 0
    if campaign.sampling == "latin-hypercube":
        shares = [entry.share for entry in populations]
        points = campaign.cases // sum(shares) * max(shares) // campaign.replicates
    plan = Plan(campaign.sampling, seed, campaign.replicates, points, sizes)
    if plan.method == "sobol" and plan.dimensions > scipy.stats.qmc.Sobol.MAXDIM:
        most = scipy.stats.qmc.Sobol.MAXDIM
        raise UserError(
            f"A case draws {plan.dimensions} numbers, and Sobol's sequence has {most} "
            'dimensions; take campaign.sampling = "latin-hypercube" or fewer disturbances.'
        )
    if points * plan.replicates * plan.dimensions > _MOST_NUMBERS:
        raise UserError(
            f"Latin hypercubes of {points * plan.replicates} cases and {plan.dimensions} numbers each do not "
            f'fit into memory ({_MOST_NUMBERS} numbers); take campaign.sampling = "sobol" or fewer cases.'
        )
    return plan


class _Sobol:
    """A scrambled Sobol sequence that is read in any order."""

    def __init__(self, seed: int, replicate: int, dimensions: int) -> None:
        self._engine = scipy.stats.qmc.Sobol(
            dimensions, scramble=True, rng=generator(seed, _STREAM, replicate)
        )

    def at(self, index: int) -> Array:
        """Return the point (dimensions,) of an index: in the middle of its cell of 2^-30."""
        if index < self._engine.num_generated:
            self._engine.reset()
        if index > self._engine.num_generated:
            self._engine.fast_forward(index - self._engine.num_generated)
        return np.asarray(self._engine.random(1)[0] + 0.5 / _MOST_POINTS)


@prepared(maxsize=32)
def _sobol(seed: int, replicate: int, dimensions: int) -> _Sobol:
    return _Sobol(seed, replicate, dimensions)


@prepared(maxsize=32)
def _hypercube(seed: int, replicate: int, dimensions: int, points: int) -> Array:
    engine = scipy.stats.qmc.LatinHypercube(dimensions, rng=generator(seed, _STREAM, replicate))
    drawn: Array = engine.random(points)
    return drawn
