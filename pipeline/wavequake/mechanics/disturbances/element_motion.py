"""Random motion and figure of the surfaces and bodies of any optical system: alignment, vibration, polishing.

An element is a surface or a body, addressed by its name. Each has random numbers of its own: choosing further
elements never changes another one's draws.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import reduce
from typing import Annotated, Any, Literal, cast

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from wavequake.errors import UserError
from wavequake.mechanics.disturbances.element_history import SurfaceHistory, history_of, same_instants
from wavequake.mechanics.disturbances.history_facts import MOST_INSTANTS, GridHistory
from wavequake.mechanics.disturbances.line_of_sight import LineOfSight, draw_sight
from wavequake.mechanics.disturbances.motion import generator
from wavequake.mechanics.disturbances.population import NonNegative, Population, time_axis
from wavequake.mechanics.disturbances.registry import Combine, parts
from wavequake.mechanics.disturbances.streams import Random, Streams, own_streams
from wavequake.mechanics.disturbances.vibration_lines import VibrationLines, draw_lines

Array = NDArray[np.float64]
Names = Annotated[tuple[str, ...], Field(min_length=1, strict=False)]
NollIndex = Annotated[int, Field(ge=4, le=2016, strict=False)]

_MICRO = 1e-6
_NANO = 1e-9


class RigidSizes(BaseModel):
    """How much an element moves in its own frame at rest: shifts along x, y, z and turns about them."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)

    dx_um: NonNegative = 0.0
    dy_um: NonNegative = 0.0
    dz_um: NonNegative = 0.0
    rx_urad: NonNegative = 0.0
    ry_urad: NonNegative = 0.0
    rz_urad: NonNegative = 0.0


class SurfaceRandom(Population):
    """Independent Gaussian misalignment of surfaces and bodies, constant over the instants of a case."""

    model: Literal["surface-random"] = "surface-random"
    instants: int = Field(default=1, ge=1, le=4096, description="all alike")
    of: Names = Field(description="names of surfaces and bodies; each moves for itself")
    rms: RigidSizes = Field(description="dx_um, dy_um, dz_um, rx_urad, ry_urad, rz_urad of each element")


class VibrationLine(BaseModel):
    """A sinusoid of fixed frequency and amplitude and of random phase."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)

    frequency_hz: float = Field(gt=0, le=1e6)
    amplitude: RigidSizes


class SurfaceVibration(Population):
    """Vibration of surfaces and bodies: sinusoids whose phases are random and independent per motion."""

    model: Literal["surface-vibration"] = "surface-vibration"
    of: Names = Field(description="names of surfaces and bodies; each moves for itself")
    lines: tuple[VibrationLine, ...] = Field(
        min_length=1,
        strict=False,
        description="frequency_hz and amplitude = { dx_um, ..., rz_urad }; a motion's rms is amplitude / "
        "sqrt(2)",
    )


class SurfaceDeformation(Population):
    """Independent Gaussian figure errors of surfaces, constant over the instants of a case."""

    model: Literal["surface-deformation"] = "surface-deformation"
    instants: int = Field(default=1, ge=1, le=4096, description="all alike")
    of: Names = Field(description="names of surfaces")
    rms_nm: dict[NollIndex, NonNegative] = Field(
        min_length=1,
        description="surface rms by Noll index j >= 4 over the radius that the surface deforms in: its "
        "normalization radius or semi-diameter, or else what the beams of all fields fill",
    )


class CombinedElements(Combine):
    """The sum of other disturbances of the study, drawn at this population's own instants.

    With a surface-history among them these are the rows of its file, and `instants` and `duration_s` are left
    out.
    """

    instants: int = Field(default=16, ge=1, le=MOST_INSTANTS)


SingleElementDisturbance = (
    SurfaceRandom | SurfaceVibration | SurfaceDeformation | SurfaceHistory | LineOfSight | VibrationLines
)
AnyElements = SingleElementDisturbance | Combine
ElementDisturbance = Annotated[SingleElementDisturbance | CombinedElements, Field(discriminator="model")]


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


def draw_elements(
    populations: Sequence[ElementDisturbance],
    population: AnyElements,
    seed: int,
    realization: int,
    streams: Streams = own_streams,
    time: Array | None = None,
) -> ElementMotion:
    """Draw one case of a population; every part of a combination is drawn as it is alone.

    Where `streams` gives something for a name, a disturbance or ``disturbance/element``, it draws from that.
    The instants are those of the population, unless others are given as `time`.

    Raises
    ------
    UserError
        If a combination names what is none of `populations`, or contains itself, or a history has other
        instants.
    """
    if time is None:
        time = instants_of(populations, population)

    def random(name: str) -> Random:
        return streams(name) or generator(seed, name, realization)

    drawn = [_draw(part, time, random) for part in single_parts(populations, population)]
    return ElementMotion(
        _summed([one.rigid for one in drawn]),
        _summed([one.figure for one in drawn]),
        reduce(np.add, [one.sight for one in drawn]),
        _summed([one.grid for one in drawn]),
    )


def instants_of(populations: Sequence[ElementDisturbance], population: AnyElements) -> Array:
    """Return the instants (n,) of a population in s: those of the history in it, or else of its time axis.

    Raises
    ------
    UserError
        If it combines histories of different instants, or as `draw_elements`.
    """
    found = [part for part in single_parts(populations, population) if isinstance(part, SurfaceHistory)]
    if not found:
        return time_axis(population)
    time = history_of(found[0]).time
    for other in found[1:]:
        _require_instants(other, time, f"those of the history {found[0].name!r}")
    return time


def _require_instants(history: SurfaceHistory, time: Array, what: str) -> None:
    own = history_of(history).time
    if not same_instants(own, time):
        raise UserError(
            f"the history {history.name!r} has {len(own)} instants from {own[0]:g} to {own[-1]:g} s, which "
            f"are not {what}, {len(time)} from {time[0]:g} to {time[-1]:g} s; to combine them, sample both "
            "at the same instants."
        )


def figure_terms(part: SingleElementDisturbance) -> dict[str, int]:
    """Return up to which Noll coefficient a disturbance deforms surfaces, by their names."""
    match part:
        case SurfaceDeformation():
            return dict.fromkeys(part.of, max(part.rms_nm))
        case SurfaceHistory():
            return {name: form.shape[1] for name, form in history_of(part).figure.items()}
        case _:
            return {}


def figure_grids(part: SingleElementDisturbance) -> dict[str, GridHistory]:
    """Return the grids on which a disturbance deforms surfaces, by their names."""
    return history_of(part).grid if isinstance(part, SurfaceHistory) else {}


def single_parts(
    populations: Sequence[ElementDisturbance], population: AnyElements
) -> list[SingleElementDisturbance]:
    """Return the single disturbances that a population is made of; raises as `draw_elements`."""
    return cast(
        list[SingleElementDisturbance], parts(cast(Any, populations), cast(Any, population))
    )  # it handles names and combinations alone


def _draw(part: SingleElementDisturbance, time: Array, random_of: Callable[[str], Random]) -> ElementMotion:
    still = np.zeros((len(time), 2))
    match part:
        case LineOfSight():
            sight = draw_sight(part, 0, time, random_of(part.name)).mount
            return ElementMotion({}, {}, sight)
        case VibrationLines():
            sight = draw_lines(part, 0, time, random_of(part.name)).mount
            return ElementMotion({}, {}, sight)
        case SurfaceHistory():
            _require_instants(part, time, "those of what it is a part of")
            found = history_of(part)
            heights = {name: one.heights for name, one in found.grid.items()}
            return ElementMotion(found.rigid, found.figure, found.sight, heights)
    own = {name: random_of(f"{part.name}/{name}") for name in part.of}
    match part:
        case SurfaceRandom():
            moved = {name: _misalignment(part, time, random) for name, random in own.items()}
            return ElementMotion(moved, {}, still)
        case SurfaceVibration():
            moved = {name: _vibration(part, time, random) for name, random in own.items()}
            return ElementMotion(moved, {}, still)
        case SurfaceDeformation():
            return ElementMotion({}, {name: _figure(part, random) for name, random in own.items()}, still)


def _misalignment(part: SurfaceRandom, time: Array, random: Random) -> Array:
    return np.tile(random.standard_normal(6) * _sizes(part.rms), (len(time), 1))


def _vibration(part: SurfaceVibration, time: Array, random: Random) -> Array:
    """Return the sum of the lines; every phase is drawn whether its amplitude is zero or not."""
    phase = random.uniform(0.0, 2.0 * np.pi, (len(part.lines), 6))
    frequency = np.array([line.frequency_hz for line in part.lines])
    amplitude = np.array([_sizes(line.amplitude) for line in part.lines])
    angle = 2.0 * np.pi * frequency[:, None] * time
    moved: Array = np.sum(amplitude[:, None] * np.sin(angle[..., None] + phase[:, None]), axis=0)
    return moved


def _figure(part: SurfaceDeformation, random: Random) -> Array:
    terms = max(part.rms_nm)
    rms = np.array([part.rms_nm.get(noll, 0.0) * _NANO for noll in range(1, terms + 1)])
    return np.asarray(random.standard_normal(terms) * rms)


def _sizes(sizes: RigidSizes) -> Array:
    """Return the six numbers in m and rad."""
    return _MICRO * np.array(
        [sizes.dx_um, sizes.dy_um, sizes.dz_um, sizes.rx_urad, sizes.ry_urad, sizes.rz_urad]
    )


def _summed(maps: Sequence[dict[str, Array]]) -> dict[str, Array]:
    """Return the sums by name; the arrays of a name may differ in the length of their last axis."""
    total: dict[str, Array] = {}
    for one in maps:
        for name, values in one.items():
            before = total.get(name, np.zeros_like(values))
            size = max(before.shape[-1], values.shape[-1])
            total[name] = _grown(before, size) + _grown(values, size)
    return total


def _grown(values: Array, size: int) -> Array:
    return np.pad(values, [(0, 0)] * (values.ndim - 1) + [(0, size - values.shape[-1])])
