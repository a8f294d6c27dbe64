"""Cases of a segmented telescope: which each is, and in which launches of whole tiles they are traced."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from wavequake.kernels.device.tiles import TILE, padded
from wavequake.mechanics.disturbances.registry import Disturbance, Motion
from wavequake.optics.segments.telescope import M2
from wavequake.optics.systems.bodies import rigid_body, with_bodies
from wavequake.optics.systems.kinematics import rest_states
from wavequake.optics.systems.system import OpticalSystem, States
from wavequake.optics.wavefronts.record import Wavefront
from wavequake.workflows.mirrors.study import FULL
from wavequake.workflows.segments.bench import MM_PER_M, Bench

Array = NDArray[np.float64]

# Tiles per launch: about 10 MB per output array at 9000 rays, however many and long the cases are. Memory of
# more is the system's to find and to clear, launch by launch: a sixth of a campaign.
_LAUNCH_TILES = 8
_TO_MM = np.repeat([MM_PER_M, 1.0], 3)


@dataclass(frozen=True)
class CaseDraw:
    """One case before optics: its population, realization, time axis (n,) in s and motion.

    ``way`` (n, m, 2) is the line of sight from each instant back to the one before, rad on the sky, where it
    moves by itself and images are made of it. ``model`` is that of elastic segments.
    """

    population: Disturbance
    realization: int
    time: Array
    motion: Motion
    way: Array | None = None
    model: str = FULL


@dataclass(frozen=True)
class Piece:
    """Instants first <= i < last of the case in `row` of a chunk, and where in a launch they begin."""

    row: int
    first: int
    last: int
    place: int

    @property
    def here(self) -> slice:
        """Its instants in the launch."""
        return slice(self.place, self.place + self.last - self.first)


def launches(draws: list[CaseDraw], instants: list[int]) -> Iterator[list[Piece]]:
    """Cut the cases, of each so many instants, into launches of at most _LAUNCH_TILES tiles.

    A case takes whole tiles of its own, and is cut only if it is longer than a launch, wherever it stands in
    its chunk: sums over its pieces keep their bits. Cases of a single instant share tiles, each at the place
    that its realization gives it, whatever is beside it; they come last, so that they fill them.
    """
    launch: list[Piece] = []
    tiles, shared = 0, dict[int, set[int]]()  # places that are taken of tiles that cases share
    for row in sorted(range(len(draws)), key=lambda row: instants[row] == 1):
        lane, count = draws[row].realization % TILE, instants[row]
        free = next((tile for tile, taken in shared.items() if lane not in taken), tiles)
        needed = padded(count) // TILE if count > 1 else free + 1 - tiles
        if launch and tiles + needed > _LAUNCH_TILES:
            yield launch
            launch, tiles, shared, free = [], 0, {}, 0
        if count == 1:
            launch.append(Piece(row, 0, 1, free * TILE + lane))
            shared.setdefault(free, set()).add(lane)
            tiles = max(tiles, free + 1)
            continue
        for first in range(0, count, _LAUNCH_TILES * TILE):
            if first:
                yield launch
                launch, tiles, shared = [], 0, {}
            last = min(count, first + _LAUNCH_TILES * TILE)
            launch.append(Piece(row, first, last, tiles * TILE))
            tiles += padded(last - first) // TILE
    if launch:
        yield launch


def traced_instants(drawn: CaseDraw) -> int:
    """Return how many instants of a case are traced: one of a case that stands still."""
    motion = drawn.motion
    figures = [one for one in motion.figure.values() if one.ndim > 1]
    figures += [motion.segment_figure] * (motion.segment_figure.ndim > 2)
    series = (motion.segment_motion, motion.mount, motion.m2, *motion.rigid.values(), *figures)
    return 1 if all((one == one[:1]).all() for one in series) else len(drawn.time)


def lost_segment(system: OpticalSystem, drawn: CaseDraw, wavefront: Wavefront, piece: Piece) -> str:
    """Say which segment loses all its rays in a piece of a case; nothing where none does."""
    instants, segments = np.nonzero(wavefront.lost_segments[piece.here])
    if not len(instants):
        return ""
    instant, segment = piece.first + int(instants[0]), int(segments[0])
    return (
        f"segment {system.segments.names[segment]} lost all its rays at instant {instant} "
        f"(t = {drawn.time[instant]:.4g} s): its motion takes its glass out of the beam"
    )


def surface_states(bench: Bench, drawn: CaseDraw, first: int, last: int) -> States:
    """Convert instants first <= i < last from SI to the optics (mm), padded with rest to whole tiles."""
    states = states_at_rest(bench, padded(last - first))
    put_states(states, 0, bench, drawn, slice(first, last))
    return states


def states_at_rest(bench: Bench, batch: int) -> States:
    """Return a batch of instants at which nothing moves, in the light of the bench's field point."""
    return rest_states(bench.prepared.system, batch)


def put_states(states: States, place: int, bench: Bench, drawn: CaseDraw, part: slice) -> None:
    """Write some instants of a case over instants at rest, from `place` on."""
    motion, here = drawn.motion, slice(place, place + part.stop - part.start)
    segments = states.segment_motion[here]
    segments[:] = motion.segment_motion[part]
    segments[..., :3] *= MM_PER_M
    figure = motion.segment_figure
    states.segment_figure[here, :, : figure.shape[-1]] = (
        figure[part] if figure.ndim > 2 else figure
    ) * MM_PER_M
    states.surface_motion[here, M2, 3:5] = motion.m2[part] @ bench.m2_tilt.T
    add_surfaces(states, here, bench, motion, part)
    states.line_of_sight[here] += motion.mount[part]


def add_surfaces(states: States, here: slice, bench: Bench, motion: Motion, part: slice) -> None:
    """Add how some instants of a motion move and bend surfaces by their names."""
    for index, (surface, form) in enumerate(zip(bench.system.surfaces, states.deformations, strict=True)):
        if surface.name in motion.rigid:
            states.surface_motion[here, index] += motion.rigid[surface.name][part] * _TO_MM
        bent = motion.figure.get(surface.name)
        if bent is not None and form is not None:
            form[here, : bent.shape[-1]] += (bent[part] if bent.ndim > 1 else bent) * MM_PER_M
    moved = [
        (rigid_body(bench.system, name, surfaces), motion.rigid[name][part] * _TO_MM)
        for name, surfaces in bench.system.bodies.items()
        if name in motion.rigid
    ]
    if moved:
        states.surface_motion[here] = with_bodies(bench.system, states.surface_motion[here], moved)
