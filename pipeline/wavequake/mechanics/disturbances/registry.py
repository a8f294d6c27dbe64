"""The disturbance models of a study: one union of parameters, and functions that draw them."""

from collections.abc import Sequence
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from wavequake.errors import UserError
from wavequake.mechanics.disturbances.common_history import (
    CommonHistory,
    amplitude_generator,
    draw_common,
    history,
)
from wavequake.mechanics.disturbances.edge_sensors import EdgeSensorNoise, draw_edge_noise, edge_noise_rms_nm
from wavequake.mechanics.disturbances.layout import SegmentLayout
from wavequake.mechanics.disturbances.line_of_sight import LineOfSight, draw_sight, sight_rms_mas
from wavequake.mechanics.disturbances.motion import (
    Motion,
    add,
    generator,
    line_of_sight_rms_mas,
    piston_rms_nm,
)
from wavequake.mechanics.disturbances.population import Population, time_axis
from wavequake.mechanics.disturbances.segment_history import SegmentHistory, draw_history
from wavequake.mechanics.disturbances.segment_wind import SegmentWind, draw_wind, segment_wind_rms_nm
from wavequake.mechanics.disturbances.static_random import StaticRandom, draw_static
from wavequake.mechanics.disturbances.streams import Random, Streams, own_streams
from wavequake.mechanics.disturbances.vibration_lines import VibrationLines, draw_lines, lines_rms_mas

__all__ = [
    "Combine",
    "Disturbance",
    "Motion",
    "analytic_rms",
    "draw",
    "draw_case",
    "generator",
    "line_of_sight_rms_mas",
    "parts",
    "piston_rms_nm",
    "segment_wind_rms_nm",
    "time_axis",
]


class Combine(Population):
    """The sum of other disturbances of the study, drawn on this population's own time axis."""

    model: Literal["combine"] = "combine"
    of: tuple[str, ...] = Field(min_length=2, strict=False, description="names of disturbances of this study")


SingleDisturbance = (
    StaticRandom
    | LineOfSight
    | VibrationLines
    | SegmentHistory
    | CommonHistory
    | SegmentWind
    | EdgeSensorNoise
)
Disturbance = Annotated[SingleDisturbance | Combine, Field(discriminator="model")]


def draw(
    parameters: SingleDisturbance,
    layout: SegmentLayout,
    time: NDArray[np.float64],
    random: Random,
) -> Motion:
    """Draw one realization of a single disturbance at the instants `time` (n,) in s."""
    match parameters:
        case StaticRandom():
            return draw_static(parameters, layout, time, random)
        case LineOfSight():
            return draw_sight(parameters, len(layout), time, random)
        case SegmentHistory():
            return draw_history(parameters, layout, time, random)
        case CommonHistory():
            return draw_common(parameters, layout, time, random)
        case SegmentWind():
            return draw_wind(parameters, layout, time, random)
        case EdgeSensorNoise():
            return draw_edge_noise(parameters, layout, time, random)
        case VibrationLines():
            return draw_lines(parameters, len(layout), time, random)


def analytic_rms(parameters: Disturbance, layout: SegmentLayout) -> tuple[float, str] | None:
    """Return the rms that a disturbance has by its parameters alone, and its unit; None where there is none.

    ``mas``: radial motion of the line of sight, which :func:`line_of_sight_rms_mas` samples. ``nm``: motion
    of the segments along their normals, which :func:`piston_rms_nm` samples.
    """
    match parameters:
        case LineOfSight():
            return sight_rms_mas(parameters), "mas"
        case VibrationLines():
            return lines_rms_mas(parameters), "mas"
        case SegmentWind():
            return _root_mean_square(segment_wind_rms_nm(parameters, layout)), "nm"
        case StaticRandom():
            return parameters.piston_nm, "nm"
        case CommonHistory():
            swing = history(parameters, time_axis(parameters))
            return parameters.piston_nm * _root_mean_square(swing), "nm"
        case EdgeSensorNoise():
            return edge_noise_rms_nm(parameters, layout), "nm"
        case _:
            return None


def _root_mean_square(values: NDArray[np.float64]) -> float:
    return float(np.sqrt(np.mean(values**2)))


def draw_case(
    populations: Sequence[Disturbance],
    population: Disturbance,
    layout: SegmentLayout,
    seed: int,
    realization: int,
    streams: Streams = own_streams,
) -> Motion:
    """Draw one case of a population.

    Every part of a combination has the random numbers that it has alone in the same realization, so that a
    combination is the sum of its parts wherever their time axes agree. Where `streams` gives something for
    the name of a part, it draws from that instead.

    Raises
    ------
    UserError
        If a combination names what is none of `populations`, or contains itself.
    """
    time = time_axis(population)
    return add(
        [
            draw(part, layout, time, streams(part.name) or stream_of(part, len(layout), seed, realization))
            for part in parts(populations, population)
        ]
    )


def stream_of(part: SingleDisturbance, segments: int, seed: int, realization: int) -> np.random.Generator:
    """Return the random numbers that a disturbance has of its own in a realization."""
    if isinstance(part, CommonHistory):
        return amplitude_generator(part, segments, seed, realization)
    return generator(seed, part.name, realization)


def parts(
    populations: Sequence[Disturbance], population: Disturbance, within: tuple[str, ...] = ()
) -> list[SingleDisturbance]:
    """Return the single disturbances that a population is made of: itself, or a combination's parts.

    Raises
    ------
    UserError
        If a combination names what is none of `populations`, or contains itself.
    """
    if not isinstance(population, Combine):
        return [population]
    if population.name in within:
        raise UserError(
            f"The combination {population.name!r} contains itself; leave it out of what it combines."
        )
    by_name = {entry.name: entry for entry in populations}
    for name in population.of:
        if name not in by_name:
            raise UserError(
                f"{population.name!r} combines {name!r}, but this study has {', '.join(by_name)}."
            )
    inside = (*within, population.name)
    return [part for name in population.of for part in parts(populations, by_name[name], inside)]
