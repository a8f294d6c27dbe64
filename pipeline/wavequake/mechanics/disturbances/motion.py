"""What a disturbance draws: motions over the instants of one case, and the random numbers behind them."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import reduce
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

RAD_PER_MAS = np.pi / 180 / 3600 / 1000


@dataclass(frozen=True)
class Motion:
    """Disturbances of one case over n instants, SI units.

    Attributes
    ----------
    segment_motion : ndarray, shape (n, S, 6)
        dx, dy, dz in m and rx, ry, rz in rad in each segment's local frame, dz along the normal to the sky.
    segment_figure : ndarray, shape (S, terms) or (n, S, terms)
        Circular Noll coefficients in m, j = 1..terms, over the segment's circumscribed circle; static, or of
        each instant.
    mount : ndarray, shape (n, 2)
        Pointing of the telescope on the sky, rad, along x and y.
    m2 : ndarray, shape (n, 2)
        Line-of-sight motion on the sky that is produced by tilting M2, rad, along x and y.
    rigid : dict of ndarray, shape (n, 6)
        Of surfaces and bodies by name: dx, dy, dz in m and rx, ry, rz in rad in their own frames at rest.
    figure : dict of ndarray, shape (terms,) or (n, terms)
        By the surface's name: Noll coefficients from j = 1 in m; static, or of each instant.
    grid : dict of ndarray, shape (n, rows, columns)
        By the surface's name: heights in m that come on top of the figure.
    """

    segment_motion: NDArray[np.float64]
    segment_figure: NDArray[np.float64]
    mount: NDArray[np.float64]
    m2: NDArray[np.float64]
    rigid: dict[str, NDArray[np.float64]] = field(default_factory=dict)
    figure: dict[str, NDArray[np.float64]] = field(default_factory=dict)
    grid: dict[str, NDArray[np.float64]] = field(default_factory=dict)

    def at(self, instants: Sequence[int] | NDArray[np.int64]) -> "Motion":
        """Return the motion at some of its instants, in the order given."""
        chosen = np.asarray(instants)

        def taken(named: dict[str, NDArray[np.float64]], static: int = 0) -> dict[str, NDArray[np.float64]]:
            return {name: one if one.ndim == static else one[chosen] for name, one in named.items()}

        moved = {name: getattr(self, name)[chosen] for name in ("segment_motion", "mount", "m2")}
        moved |= taken({"segment_figure": self.segment_figure}, static=2)
        return replace(
            self, **moved, rigid=taken(self.rigid), figure=taken(self.figure, static=1), grid=taken(self.grid)
        )


def still(instants: int, segments: int = 0, figure_terms: int = 0, **named: dict[str, Any]) -> Motion:
    """Return no motion at all, but for what is given of surfaces and bodies: rigid, figure, grid."""
    return Motion(
        segment_motion=np.zeros((instants, segments, 6)),
        segment_figure=np.zeros((segments, figure_terms)),
        mount=np.zeros((instants, 2)),
        m2=np.zeros((instants, 2)),
        **named,
    )


def add(motions: list[Motion]) -> Motion:
    """Return the sum of at least one motion of the same instants and segments, in the order given."""
    terms = max(motion.segment_figure.shape[-1] for motion in motions)

    return Motion(
        segment_motion=reduce(np.add, [motion.segment_motion for motion in motions]),
        segment_figure=reduce(np.add, [_grown(motion.segment_figure, terms) for motion in motions]),
        mount=reduce(np.add, [motion.mount for motion in motions]),
        m2=reduce(np.add, [motion.m2 for motion in motions]),
        rigid=summed([motion.rigid for motion in motions]),
        figure=summed([motion.figure for motion in motions]),
        grid=summed([motion.grid for motion in motions]),
    )


def summed(maps: list[dict[str, NDArray[np.float64]]]) -> dict[str, NDArray[np.float64]]:
    """Return the sums by name; the arrays of a name may differ in the length of their last axis."""
    total: dict[str, NDArray[np.float64]] = {}
    for one in maps:
        for name, values in one.items():
            before = total.get(name, np.zeros_like(values))
            size = max(before.shape[-1], values.shape[-1])
            total[name] = _grown(before, size) + _grown(values, size)
    return total


def _grown(values: NDArray[np.float64], size: int) -> NDArray[np.float64]:
    if values.shape[-1] == size:
        return values
    return np.pad(values, [(0, 0)] * (values.ndim - 1) + [(0, size - values.shape[-1])])


def scaled(motion: Motion, factor: float) -> Motion:
    """Return a motion times a factor."""

    def times(named: dict[str, NDArray[np.float64]]) -> dict[str, NDArray[np.float64]]:
        return {name: values * factor for name, values in named.items()}

    return Motion(
        motion.segment_motion * factor,
        motion.segment_figure * factor,
        motion.mount * factor,
        motion.m2 * factor,
        times(motion.rigid),
        times(motion.figure),
        times(motion.grid),
    )


def line_of_sight_motion(
    act: Literal["mount", "m2"],
    along: NDArray[np.float64],
    across: NDArray[np.float64],
    direction_deg: float,
    segments: int,
) -> Motion:
    """Return a motion of the line of sight alone, rad, from its parts (n,) along and across a direction."""
    angle = np.deg2rad(direction_deg)
    on_sky = np.outer(along, [np.cos(angle), np.sin(angle)]) + np.outer(
        across, [-np.sin(angle), np.cos(angle)]
    )
    rest = still(len(along), segments)
    return replace(rest, mount=on_sky) if act == "mount" else replace(rest, m2=on_sky)


def line_of_sight_rms_mas(motion: Motion) -> float:
    """Return the radial rms of mount and M2 motion on the sky over the instants, mas."""
    on_sky = motion.mount + motion.m2
    return float(np.sqrt(np.mean(np.sum(on_sky**2, axis=1)))) / RAD_PER_MAS


def piston_rms_nm(motion: Motion) -> float:
    """Return the rms over segments and instants of the motion along the segments' normals, nm."""
    return float(np.sqrt(np.mean(motion.segment_motion[..., 2] ** 2))) * 1e9


def generator(seed: int, stream_name: str, realization: int) -> np.random.Generator:
    """Return the random numbers of one disturbance in one realization.

    The stream is a 32-bit fingerprint of the disturbance's name: adding, dropping or reordering disturbances
    never changes another one's numbers, and a realization of a name is one draw for all that is compared.
    """
    return np.random.Generator(
        np.random.Philox(np.random.SeedSequence(seed, spawn_key=(_stream(stream_name), realization)))
    )


def counted_generator(seed: int, stream_name: str, steps: int) -> np.random.Generator:
    """Return the random numbers of a disturbance in all realizations, from a step of the counter on.

    Where every realization takes a fixed number of steps, each of four 64-bit numbers, those of any run of
    realizations are drawn at once and do not depend on where the run begins.
    """
    return np.random.Generator(np.random.Philox(counter=steps, key=counted_key(seed, stream_name)))


def counted_key(seed: int, stream_name: str) -> NDArray[np.uint64]:
    """Return the key (2,) of a disturbance's counted numbers."""
    key = np.random.SeedSequence(seed, spawn_key=(_stream(stream_name),)).generate_state(2, np.uint64)
    return np.asarray(key, dtype=np.uint64)


def _stream(name: str) -> int:
    return int.from_bytes(hashlib.blake2b(name.encode(), digest_size=4).digest(), "little")
