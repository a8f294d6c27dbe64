"""The disturbances of a study: any registered sources and their sums, and how a case of them is drawn."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Annotated, Any, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from wavequake.errors import UserError
from wavequake.mechanics.disturbances.layout import NO_SEGMENTS, SegmentLayout
from wavequake.mechanics.disturbances.motion import (
    Motion,
    add,
    generator,
    line_of_sight_rms_mas,
    piston_rms_nm,
)
from wavequake.mechanics.disturbances.population import Population, time_axis
from wavequake.mechanics.disturbances.source import AnySource, Randoms, SegmentSource, Source, require_length
from wavequake.mechanics.disturbances.sources.element_history import own_axis, same_instants
from wavequake.mechanics.disturbances.sources.segment_wind import segment_wind_rms_nm
from wavequake.mechanics.disturbances.streams import Streams, own_streams

__all__ = [
    "Combine",
    "Disturbance",
    "Motion",
    "analytic_rms",
    "draw",
    "draw_case",
    "draw_sight",
    "generator",
    "instants_of",
    "line_of_sight_rms_mas",
    "parts",
    "piston_rms_nm",
    "segment_wind_rms_nm",
    "time_axis",
    "with_own_axes",
]

Array = NDArray[np.float64]


class Combine(Population):
    """The sum of other disturbances of the study, drawn on this population's own time axis."""

    model: Literal["combine"] = "combine"
    of: tuple[str, ...] = Field(min_length=2, strict=False, description="names of disturbances of this study")


Entry = TypeVar("Entry", bound=Population)
Disturbance = Annotated[Population, AnySource("segments", Combine)]


def draw(source: Source, layout: SegmentLayout, time: Array, randoms: Randoms) -> Motion:
    """Draw one realization of a single disturbance at the instants `time` (n,) in s.

    Raises
    ------
    UserError
        If it has other instants of its own, or moves what there is not.
    """
    return _draw_several(source, [layout], time, [randoms], [0])[0]


def _draw_several(
    source: Source,
    layouts: Sequence[SegmentLayout],
    time: Array,
    randoms: Sequence[Randoms],
    realizations: Sequence[int],
) -> list[Motion]:
    own = source.instants_of_file()
    if own is not None:
        _require_instants(source, own, time, "those of what it is a part of")
    drawn = source.draw_several(layouts, time, randoms, realizations)
    return [_of_moving(source, motion, layout) for motion, layout in zip(drawn, layouts, strict=True)]


def _of_moving(source: Source, motion: Motion, layout: SegmentLayout) -> Motion:
    """Return a motion of those segments alone that the source moves."""
    motion = on_elements(motion, layout)
    moving = source.moving(layout) if isinstance(source, SegmentSource) else None
    if moving is None:
        return motion
    return replace(
        motion,
        segment_motion=np.where(moving[:, None], motion.segment_motion, 0.0),
        segment_figure=np.where(moving[:, None], motion.segment_figure, 0.0),
    )


def on_elements(motion: Motion, layout: SegmentLayout) -> Motion:
    """Return a motion in which bodies move what they carry, and segments named alone stand among all."""
    return _on_segments(_with_carried(motion, layout), layout)


def _with_carried(motion: Motion, layout: SegmentLayout) -> Motion:
    """Return a motion in which bodies move what they carry."""
    bodies = [name for name in motion.rigid if name in layout.carried]
    if not bodies:
        return motion
    rigid = {name: values for name, values in motion.rigid.items() if name not in bodies}
    for name in bodies:
        carried = layout.carried[name]
        moved = np.einsum("eij,nj->eni", carried.follows, motion.rigid[name])
        for element, values in zip(carried.names, moved, strict=True):
            rigid[element] = rigid[element] + values if element in rigid else values
    return replace(motion, rigid=rigid)


def _on_segments(motion: Motion, layout: SegmentLayout) -> Motion:
    """Return a motion in which segments that were addressed by their names move with all the others."""
    known = set(layout.names)
    rigid, bent = (
        {name: values for name, values in one.items() if name in known}
        for one in (motion.rigid, motion.figure)
    )
    if not (rigid or bent):
        return motion
    moved, figure = motion.segment_motion.copy(), motion.segment_figure
    place = {name: index for index, name in enumerate(layout.names)}
    for name, values in rigid.items():
        moved[:, place[name]] += values
    if bent:
        terms = max(figure.shape[-1], *(values.shape[-1] for values in bent.values()))
        over_time = (len(moved),) * any(values.ndim > 1 for values in bent.values())
        total = np.zeros((*over_time, len(layout), terms))
        total[..., : figure.shape[-1]] += figure
        for name, values in bent.items():
            total[..., place[name], : values.shape[-1]] += values
        figure = total
    return replace(
        motion,
        segment_motion=moved,
        segment_figure=figure,
        rigid={name: values for name, values in motion.rigid.items() if name not in rigid},
        figure={name: values for name, values in motion.figure.items() if name not in bent},
    )


def analytic_rms(parameters: Population, layout: SegmentLayout) -> tuple[float, str] | None:
    """Return the rms that a disturbance has by its parameters alone, and its unit; None where there is none.

    ``mas``: radial motion of the line of sight, which :func:`line_of_sight_rms_mas` samples. ``nm``: motion
    of the segments along their normals, which :func:`piston_rms_nm` samples.
    """
    found = parameters.analytic_rms(layout) if isinstance(parameters, Source) else None
    moving = parameters.moving(layout) if isinstance(parameters, SegmentSource) else None
    return found if found is None or moving is None else (found[0] * float(np.sqrt(moving.mean())), found[1])


def draw_case(
    populations: Sequence[Population],
    population: Population,
    layout: SegmentLayout,
    seed: int,
    realization: int,
    streams: Streams = own_streams,
    time: Array | None = None,
) -> Motion:
    """Draw one case of a population, at its own instants unless others are given as `time`.

    Every part of a combination has the random numbers that it has alone in the same realization, so that a
    combination is the sum of its parts wherever their time axes agree. Where `streams` gives something for
    a name, that of a part or ``part/element``, it draws from that instead.

    Raises
    ------
    UserError
        If a combination names what is none of `populations`, or contains itself, or a history has other
        instants.
    """
    return draw_cases(populations, population, [layout], seed, [realization], [streams], time)[0]


def draw_cases(
    populations: Sequence[Population],
    population: Population,
    layouts: Sequence[SegmentLayout],
    seed: int,
    realizations: Sequence[int],
    streams: Sequence[Streams],
    time: Array | None = None,
) -> list[Motion]:
    """Draw different cases of a population at once, each as :func:`draw_case` does, to the bit.

    They are of the same `TOGETHER` realizations; layouts differ in supports and plant at most.
    """
    at = instants_of(populations, population) if time is None else time
    drawn = [
        _draw_several(
            part,
            layouts,
            at,
            [
                randoms_of(part, len(layout), seed, realization, own)
                for layout, realization, own in zip(layouts, realizations, streams, strict=True)
            ],
            realizations,
        )
        for part in parts(populations, population)
    ]
    return [add(list(of_case)) for of_case in zip(*drawn, strict=True)]


def draw_sight(
    populations: Sequence[Population],
    population: Population,
    layout: SegmentLayout,
    seed: int,
    realization: int,
    streams: Streams,
    time: Array,
) -> Array | None:
    """Draw where a case's line of sight is (n, 2), rad on the sky, at any instants `time`; None if it rests.

    Of the parts that move nothing else: with the numbers that `draw_case` gives them.
    """
    moving = [part for part in parts(populations, population) if part.sight]
    if not moving:
        return None
    drawn = [
        part.draw(NO_SEGMENTS, time, randoms_of(part, len(layout), seed, realization, streams))
        for part in moving
    ]
    return np.asarray(sum(motion.mount + motion.m2 for motion in drawn))


def randoms_of(
    part: Source, segments: int, seed: int, realization: int, streams: Streams = own_streams
) -> Randoms:
    """Return what gives the random numbers of a disturbance in a realization, stream by stream."""
    return lambda name: streams(name) or part.generator(name, segments, seed, realization)


def parts(
    populations: Sequence[Population], population: Population, within: tuple[str, ...] = ()
) -> list[Source]:
    """Return the single disturbances that a population is made of: itself, or a combination's parts.

    Raises
    ------
    UserError
        If a combination names what is none of `populations`, or contains itself.
    """
    if isinstance(population, Source):
        return [population]
    assert isinstance(population, Combine)
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


def instants_of(populations: Sequence[Population], population: Population) -> Array:
    """Return the instants (n,) of a population in s: those of the history in it, or else of its time axis.

    Raises
    ------
    UserError
        If it combines histories of different instants, or as `draw_case`.
    """
    found = [
        (part, own) for part in parts(populations, population) if (own := part.instants_of_file()) is not None
    ]
    if not found:
        return time_axis(population)
    (first, time), *others = found
    for part, own in others:
        _require_instants(part, own, time, f"those of the history {first.name!r}")
    return time


def with_own_axes(entries: tuple[Entry, ...]) -> tuple[Entry, ...]:
    """Return the disturbances of a study; combinations that hold a history have its instants.

    Raises
    ------
    ValueError
        If one is given others, histories in it have different ones, or what it holds ends before it does.
    """
    return tuple(_with_own_axis(entries, entry) for entry in entries)


def _with_own_axis(entries: Sequence[Any], entry: Any) -> Any:
    if not isinstance(entry, Combine):
        return entry
    try:
        held = parts(entries, entry)
        for part in held:
            require_length(part, entry)
        if all(part.instants_of_file() is None for part in held):
            return entry
        time = instants_of(entries, entry)
    except UserError as error:
        raise ValueError(f"{entry.name!r}: {error}") from None
    given = {key: getattr(entry, key) for key in entry.model_fields_set}
    what = f"{entry.name!r} holds a history of {len(time)} rows"
    return entry.model_copy(update=own_axis(time, given, what))


def _require_instants(part: Source, own: Array, time: Array, what: str) -> None:
    if not same_instants(own, time):
        raise UserError(
            f"the history {part.name!r} has {len(own)} instants from {own[0]:g} to {own[-1]:g} s, which "
            f"are not {what}, {len(time)} from {time[0]:g} to {time[-1]:g} s; to combine them, sample both "
            "at the same instants."
        )
