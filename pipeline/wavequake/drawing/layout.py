"""The section of an optical system: what of every surface is used, glass, stop and rays, in one plane.

Nothing here draws: `wavequake.drawing.section` does. Tests compare these points with the trace.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from wavequake.drawing.light import Way, all_ways, beginnings, in_surface
from wavequake.optics.media.glasses import Medium
from wavequake.optics.media.gradients import GradientIndex, medium_index
from wavequake.optics.shapes.sag import shape_sag
from wavequake.optics.shapes.shapes import Opening
from wavequake.optics.systems.system import OpticalSystem, Surface, wavelength_of

Array = NDArray[np.float64]
Kind = Literal["mirror", "glass", "image", "stop", "surface", "object"]

_MARGIN = 0.05  # beyond the beam, of its width
_RING = 0.02  # the same of mirrors with a hole, next to which others may stand
_POINTS = 61  # of a curve
_FLAT = 0.05  # a system that leaves its plane by less than this share of its spread is drawn in one
_ON_AXIS = 1e-9  # of the length: rounding
_THICK = 0.014  # of the drawing: a mirror's body
_TICK = 0.035  # of the drawing: each tick of the stop
_SHORTEST = 0.03  # of the drawing: an image plane that is smaller is drawn as large
_THIN, _TALL = 0.12, 0.3  # of its length: what is lower is stretched up to the second
_OPTICAL = 1.01  # index from which on a medium is drawn as glass


@dataclass(frozen=True)
class Part:
    """A piece of a drawing: lines of points (K, 2), z along the light first, mm.

    What needs no label has no name. The lines of glass and mirrors are outlines; the first half of a
    mirror's is the face that light meets.
    """

    name: str
    kind: Kind
    lines: tuple[Array, ...]


@dataclass(frozen=True)
class Layout:
    """The section of a system with the plane that z and ``across`` (3,) span, mm.

    Attributes
    ----------
    across : ndarray, shape (3,)
        Direction of the drawing's second axis in the system's frame.
    parts : tuple of Part
    rays : tuple of (int, ndarray of shape (P, 2))
        Number of the field, and the points of a ray up to where it ends.
    """

    across: Array
    parts: tuple[Part, ...]
    rays: tuple[tuple[int, Array], ...]


def layouts(system: OpticalSystem, count: int = 7, across: Array | None = None) -> tuple[Layout, ...]:
    """Return the section of a system with the plane of its fields and folds; two where it leaves one plane.

    Parameters
    ----------
    system : OpticalSystem
    count : int
        Rays of each field.
    across : ndarray, shape (3,), optional
        Draw the plane that it spans with z, whichever that of the fields is.

    Raises
    ------
    UserError
        If the system is out of range or no light reaches its stop.
    """
    rims = all_ways(system)
    chosen = planes(system, rims) if across is None else [across]
    return tuple(_layout(system, rims, one, count) for one in chosen)


def planes(system: OpticalSystem, rims: list[Way]) -> list[Array]:
    """Return the directions (3,) that with z span the planes of a system's drawings, the main one first."""
    vertices = np.array([surface.position[:2] for surface in system.surfaces])
    middles = [_middles(one.points)[:, :2] for one in rims]
    places = np.concatenate([vertices, *middles])
    places = places[np.isfinite(places).all(axis=1)]
    _, spread, axes = np.linalg.svd(places - places.mean(axis=0), full_matrices=False)
    if not spread[0] > _ON_AXIS * np.ptp([surface.position[2] for surface in system.surfaces]):
        return [np.array([0.0, 1.0, 0.0])]
    if spread[1] > _FLAT * spread[0]:
        both = [np.array([0.0, 1.0, 0.0]), np.array([1.0, 0.0, 0.0])]
        return both if np.ptp(places[:, 1]) >= np.ptp(places[:, 0]) else both[::-1]
    main = np.round(axes[0], 3) + 0.0 if np.abs(axes[0]).min() < 0.05 else axes[0]
    main = np.where(np.abs(main) < 0.05, 0.0, main)
    main = main / np.hypot(*main)
    return [np.array([*(main * np.sign(main[np.argmax(np.abs(main))])), 0.0])]


def _middles(points: Array) -> Array:
    """Return the mean (S, 3) of the rays (S, 3, N) that are there; NaN where none is."""
    there = np.isfinite(points)
    count = there.sum(axis=2)
    sums = np.where(count, np.where(there, points, 0.0).sum(axis=2), np.nan)
    return np.asarray(sums / np.maximum(count, 1), dtype=np.float64)


def _layout(system: OpticalSystem, rims: list[Way], across: Array, count: int) -> Layout:
    normal = np.cross(across, [0.0, 0.0, 1.0])
    fans = all_ways(system, normal, count)
    seen = np.stack([np.array([0.0, 0.0, 1.0]), across])
    lines = beginnings(system, fans)
    rays = []
    for one, points in zip(fans, lines, strict=True):
        for ray in np.moveaxis(points, 2, 0):
            known = ray[np.isfinite(ray).all(axis=1)]
            rays.append((one.field, known @ seen.T))
    size = float(np.ptp(np.concatenate([ray for _, ray in rays]), axis=0).max())
    arcs = [_arc(system, number, [*rims, *fans], normal) for number in range(len(system.surfaces))]
    drawn = _Drawn(system, arcs, seen, size, fans, lines)
    return Layout(across, tuple(drawn.parts()), tuple(rays))


@dataclass(frozen=True)
class _Arc:
    """What is used of a surface: its section from ``low`` to ``high`` along ``along`` (2,), ``off`` beside.

    ``hole`` is the range in its middle that is not there.
    """

    surface: Surface
    along: Array
    off: float
    low: float
    high: float
    hole: tuple[float, float] | None

    def points(self, s: Array) -> Array:
        """Return points (K, 3) in the system's frame; NaN where the surface does not reach out so far."""
        across = np.array([-self.along[1], self.along[0]])
        x, y = np.outer(self.along, s) + (self.off * across)[:, None]
        z = np.asarray(shape_sag(self.surface.shape, x, y)[0])
        return np.asarray(self.surface.position + np.stack([x, y, z], axis=1) @ self.surface.rotation.T)


def _arc(system: OpticalSystem, number: int, ways: list[Way], normal: Array) -> _Arc | None:
    """Return the used part of a surface, or its opening; None where no light comes."""
    surface = system.surfaces[number]
    along = in_surface(surface.rotation, normal)
    beside = np.array([-along[1], along[0]])
    hits = np.concatenate([one.hits[number] for one in ways], axis=1)
    hits = surface.rotation.T @ (hits[:, np.isfinite(hits).all(axis=0)] - surface.position[:, None])
    if not hits.size:
        return None
    s, t = along @ hits[:2], beside @ hits[:2]
    off = float(t.min() + t.max()) / 2.0
    off = 0.0 if abs(off) < 1e-3 * (np.ptp(s) + np.ptp(t)) else off
    ring = surface.action == "reflect" and system.pupil.obscuration > 0.0
    margin = (_RING if ring else _MARGIN) * float(np.ptp(s))
    low, high = float(s.min()) - margin, float(s.max()) + margin
    hole = None
    upright = not np.any(surface.position[:2]) and np.array_equal(surface.rotation, np.eye(3))
    if low < 0.0 < high and (surface.action == "refract" or (ring and upright)):  # round about their axis
        low, high = min(low, -high), max(high, -low)
    opening = surface.opening
    if opening is not None:
        low, high, hole = _opened(opening, along, off, (low, high))
    return _Arc(surface, along, off, low, high, hole)


def _opened(
    opening: Opening, along: Array, off: float, used: tuple[float, float]
) -> tuple[float, float, tuple[float, float] | None]:
    """Return where a line crosses an opening: its ends, and the hole in its middle."""
    beside = np.array([-along[1], along[0]])
    center = np.array(opening.center)
    middle, away = float(along @ center), off - float(beside @ center)
    low, high = used
    if opening.corners:
        corners = np.array(opening.corners) + center
        s, t = corners @ along, corners @ beside - off
        s_next, t_next = np.roll(s, -1), np.roll(t, -1)
        crossed = np.flatnonzero((t > 0.0) != (t_next > 0.0))
        if crossed.size:
            share = t[crossed] / (t[crossed] - t_next[crossed])
            ends = s[crossed] + share * (s_next[crossed] - s[crossed])
            low, high = float(ends.min()), float(ends.max())
    elif np.isfinite(opening.outer) and opening.outer > abs(away):
        half = float(np.sqrt(opening.outer**2 - away**2))
        low, high = middle - half, middle + half
    if opening.inner > abs(away):
        half = float(np.sqrt(opening.inner**2 - away**2))
        return low, high, (middle - half, middle + half)
    return low, high, None


@dataclass(frozen=True)
class _Drawn:
    """What the parts of a drawing are made from."""

    system: OpticalSystem
    arcs: list[_Arc | None]
    seen: Array
    size: float
    fans: list[Way]
    lines: list[Array]

    def parts(self) -> list[Part]:
        """Return the parts, those behind others first."""
        glass, found = self._glass(), []
        last = len(self.arcs) - 1
        if np.isfinite(self.system.object_distance):
            found += self._object()
        for number, arc in enumerate(self.arcs):
            if arc is None:
                continue
            if number == self.system.stop:
                found.append(self._stop(number, arc))
            if number == last:
                found.append(Part(arc.surface.name, "image", (self._image(arc),)))
            elif arc.surface.action == "reflect":
                found.append(self._mirror(number, arc))
            elif arc.surface.action == "pass" and number != self.system.stop:
                found.append(Part(arc.surface.name, "surface", (self._curve(arc, arc.low, arc.high),)))
        return [*glass, *found]

    def _curve(self, arc: _Arc, low: float, high: float) -> Array:
        points = arc.points(np.linspace(low, high, _POINTS))
        return np.asarray(points[np.isfinite(points).all(axis=1)] @ self.seen.T)

    def _image(self, arc: _Arc) -> Array:
        middle, half = (arc.low + arc.high) / 2.0, (arc.high - arc.low) / 2.0
        half = max(half, _SHORTEST * self.size)
        return self._curve(arc, middle - half, middle + half)

    def _object(self) -> list[Part]:
        heights = np.concatenate([points[0].T for points in self.lines]) @ self.seen.T
        first = np.concatenate([one.points[0].T for one in self.fans]) @ self.seen.T
        if not np.allclose(heights, first):
            return []  # it is too far away to be drawn
        half = max(0.5 * float(np.ptp(heights[:, 1])), _SHORTEST * self.size)
        middle = float(heights[:, 1].min() + heights[:, 1].max()) / 2.0
        z = float(heights[0, 0])
        return [Part("object", "object", (np.array([[z, middle - half], [z, middle + half]]),))]

    def _stop(self, number: int, arc: _Arc) -> Part:
        """Return two ticks that end where the rays of the rim pass."""
        hits = np.concatenate([one.hits[number].T for one in self.fans])
        hits = hits[np.isfinite(hits).all(axis=1)]
        local = (hits - arc.surface.position) @ arc.surface.rotation
        s = local[:, :2] @ arc.along
        low, high = float(s.min()), float(s.max())
        ticks = []
        for end, sign in ((low, -1.0), (high, 1.0)):
            points = arc.points(np.array([end]))[0]
            outwards = arc.surface.rotation[:, :2] @ arc.along * sign
            ticks.append(np.stack([points, points + _TICK * self.size * outwards]) @ self.seen.T)
        named = "" if arc.surface.action == "reflect" else "stop"
        return Part(arc.surface.name if arc.surface.action == "pass" else named, "stop", tuple(ticks))

    def _mirror(self, number: int, arc: _Arc) -> Part:
        """Return closed outlines; the first half of each is the face that light meets."""
        ways = [one.hits[number] - one.hits[number - 1] if number else one.direction for one in self.fans]
        along = arc.surface.rotation[:, 2] @ np.nanmean(np.concatenate(ways, axis=1), axis=1)
        back = arc.surface.rotation[:, 2] * np.sign(along) * _THICK * self.size
        ranges = [(arc.low, arc.high)]
        hole = arc.hole or self._hole(number, arc)
        if hole is not None:
            ranges = [(arc.low, hole[0]), (hole[1], arc.high)]
        outlines = []
        for low, high in ranges:
            face = self._curve(arc, low, high)
            outlines.append(np.concatenate([face, (face + self.seen @ back)[::-1]]))
        name = arc.surface.name + (" (stop)" if number == self.system.stop else "")
        return Part(name, "mirror", tuple(outlines))

    def _hole(self, number: int, arc: _Arc) -> tuple[float, float] | None:
        """Return the gap in the middle of a mirror that its own light leaves and other light goes through."""
        if not self.system.pupil.obscuration > 0.0:
            return None
        surface, gaps, crossing = arc.surface, [], False
        for one in self.fans:
            local = (np.moveaxis(one.hits[number], 0, 1) - surface.position) @ surface.rotation
            s = np.sort(local[:, :2] @ arc.along)
            s = s[np.isfinite(s)]
            if len(s) < 2:
                return None
            inner = len(s) // 2  # the rays next to the obscuration stand in the middle of the fan
            gaps.append((float(s[inner - 1]), float(s[inner])))
        low, high = max(gap[0] for gap in gaps), min(gap[1] for gap in gaps)
        shrink = _RING * (high - low)
        low, high = low + shrink, high - shrink
        if not low < high:
            return None
        sag = float(shape_sag(surface.shape, (low + high) / 2.0 * arc.along[0], 0.0)[0])
        for one, begun in zip(self.fans, self.lines, strict=True):
            ways = np.concatenate([begun[:1], one.hits])
            local = (np.moveaxis(ways, 1, 2) - surface.position) @ surface.rotation
            for step in range(len(ways) - 1):
                if step in (number, number + 1):  # light that comes to it, or goes from it
                    continue
                a, b = local[step], local[step + 1]
                with np.errstate(invalid="ignore", divide="ignore"):
                    share = (sag - a[:, 2]) / (b[:, 2] - a[:, 2])
                    at = ((a + share[:, None] * (b - a))[:, :2]) @ arc.along
                    crossing |= bool(((share > 0.0) & (share < 1.0) & (at > low) & (at < high)).any())
        return (low, high) if crossing else None

    def _glass(self) -> list[Part]:
        """Return the outline of every space between two surfaces that glass fills."""
        wavelength = wavelength_of(self.system)
        medium: Medium | GradientIndex = self.system.medium
        before, parts = -1, []
        spaces: list[tuple[int, int, str]] = []
        for number, surface in enumerate(self.system.surfaces):
            if surface.action == "pass":
                continue
            if before >= 0 and medium_index(medium, wavelength) > _OPTICAL:
                spaces.append((before, number, medium.name))
            before = number
            medium = surface.medium if surface.action == "refract" else medium
        ends = self._edges([(first, last) for first, last, _ in spaces])
        for first, last, name in spaces:
            one, other = self.arcs[first], self.arcs[last]
            if one is None or other is None:
                continue
            front, back = (self._flanged(arc, ends.get(k)) for arc, k in ((one, first), (other, last)))
            if np.linalg.norm(front[0] - back[0]) > np.linalg.norm(front[0] - back[-1]):
                back = back[::-1]
            parts.append(Part(_lens_name(one.surface, other.surface, name), "glass", (_closed(front, back),)))
        return parts

    def _edges(self, pairs: list[tuple[int, int]]) -> dict[int, tuple[float, float]]:
        """Return the common ends of surfaces of one lens or group, where they stand upright to each other."""
        ends = {k: (a.low, a.high) for k, a in enumerate(self.arcs) if a is not None}
        for pair in (*pairs, *reversed(pairs)):
            one, other = (self.arcs[k] for k in pair)
            if one is None or other is None:
                continue
            shift = (other.surface.position - one.surface.position) @ one.surface.rotation
            aligned = np.allclose(one.surface.rotation, other.surface.rotation, atol=1e-9)
            if aligned and np.abs(shift[:2]).max() < 1e-6 and np.allclose(one.along, other.along):
                low, high = zip(*(ends[k] for k in pair), strict=True)
                ends[pair[0]] = ends[pair[1]] = (min(low), max(high))
        return ends

    def _flanged(self, arc: _Arc, ends: tuple[float, float] | None) -> Array:
        """Return the section of a surface of a lens, with a flat flange to the edge of the lens."""
        curve = arc.points(np.linspace(arc.low, arc.high, _POINTS))
        curve = curve[np.isfinite(curve).all(axis=1)]
        if ends is not None:
            out = arc.surface.rotation[:, :2] @ arc.along
            low = curve[0] - (arc.low - ends[0]) * out
            high = curve[-1] + (ends[1] - arc.high) * out
            curve = np.concatenate([low[None], curve, high[None]])
        return np.asarray(curve @ self.seen.T)


def _closed(front: Array, back: Array) -> Array:
    return np.concatenate([front, back[::-1], front[:1]])


def _lens_name(front: Surface, back: Surface, medium: str) -> str:
    """Return what the names of both sides begin with, such as ``L1`` of ``L1 front``, or else the glass."""
    one, other = front.name.split(), back.name.split()
    shared = [a for a, b in zip(one, other, strict=False) if a == b]
    return " ".join(shared) if shared and shared != ["surface"] else medium


def stretching(share: float) -> float:
    """Return how many times to stretch what is so high, of its length: 1, 2, 5, 10, 20 ..."""
    if not 0.0 < share < _THIN:
        return 1.0
    power = 10.0 ** np.floor(np.log10(_TALL / share))
    return float(power * max(step for step in (1.0, 2.0, 5.0) if step * power <= _TALL / share))
