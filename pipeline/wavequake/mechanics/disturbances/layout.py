"""What there is to move: where the segments of a primary mirror are, and names of surfaces and bodies."""

import difflib
import fnmatch
import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from wavequake.errors import UserError
from wavequake.mechanics.assembly.plant import Plant
from wavequake.mechanics.disturbances.supports import Supports


@dataclass(frozen=True)
class Moved:
    """What was fitted to displacements of a surface's nodes at n instants.

    Attributes
    ----------
    rigid : ndarray, shape (n, 6)
        dx, dy, dz in m and rx, ry, rz in rad in the surface's own frame at rest.
    figure : ndarray, shape (n, terms)
        Noll coefficients in m.
    grid : ndarray, shape (n, rows, columns), or None
        Heights in m that come on top of the figure.
    words : str
        How much of the displacements that is.
    """

    rigid: NDArray[np.float64]
    figure: NDArray[np.float64]
    grid: NDArray[np.float64] | None
    words: str


@dataclass(frozen=True, eq=False)
class Carried:
    """Elements that move with a body, or with a node of it.

    Attributes
    ----------
    names : tuple of str, length E
    follows : ndarray, shape (E, 6, 6)
        Their motions, m and rad in their own frames, per unit of that of what carries them.
    """

    names: tuple[str, ...]
    follows: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class SegmentLayout:
    """Segments in sky orientation (z to the sky), lengths in m; hashed by content, so that caches find it.

    Attributes
    ----------
    names : tuple of str, length S
    centers_m : ndarray, shape (S, 3)
        Pivots of the rigid motion.
    axes : ndarray, shape (S, 3, 3)
        Columns are the local x axis, y axis and normal of each segment.
    corners_m : ndarray, shape (S, V, 2)
        Projected glass corners, counter-clockwise; a polygon with fewer than V corners repeats its last one.
    areas_m2 : ndarray, shape (S,)
        Area of glass.
    others : tuple of str, or None
        Names of further elements: surfaces and bodies. None: they are not known, and any name is one.
    owner : str
        Whose elements they are, for messages.
    plant : Plant or None
        The bodies with mass that carry some of them.
    carried : mapping of str to Carried
        What moves with bodies, and with nodes of theirs, by the names of these.
    segment : Plant or None
        What stands for every segment, where they are elastic.
    moved : mapping of str to Moved
        Of disturbances that are fitted to the surfaces of a system, by their names.
    supports : Supports or None
        How far the segments' supports are off in a case, where they are not known.
    """

    names: tuple[str, ...]
    centers_m: NDArray[np.float64]
    axes: NDArray[np.float64]
    corners_m: NDArray[np.float64]
    areas_m2: NDArray[np.float64]
    others: tuple[str, ...] | None = ()
    owner: str = "the telescope"
    plant: Plant | None = None
    carried: Mapping[str, Carried] = field(default_factory=dict)
    segment: Plant | None = None
    moved: Mapping[str, Moved] = field(default_factory=dict)
    supports: Supports | None = None

    def __len__(self) -> int:
        return len(self.names)

    @cached_property
    def digest(self) -> bytes:
        """Fingerprint of all numbers."""
        arrays = (self.centers_m, self.axes, self.corners_m, self.areas_m2)
        return hashlib.blake2b(b"".join(np.ascontiguousarray(array).tobytes() for array in arrays)).digest()

    def __hash__(self) -> int:
        return hash(self.digest)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, SegmentLayout) and self.names == other.names and self.digest == other.digest

    def chosen(self, patterns: tuple[str, ...], who: str) -> tuple[str, ...]:
        """Return the elements that patterns name, in their order; ``*`` and ``?`` stand for any letters.

        Raises
        ------
        UserError
            If there is none for a pattern; `who` asks.
        """
        if self.others is None:
            return patterns
        names = (*self.names, *self.others)
        found: list[str] = []
        for pattern in patterns:
            matching = [pattern] if pattern in names else fnmatch.filter(names, pattern)
            if not matching:
                near = difflib.get_close_matches(pattern, names, n=1)
                some = ", ".join(names[-12:]) + (", ..." if len(names) > 12 else "")
                hint = f"did you mean {near[0]!r}?" if near else f"there are {some}."
                kinds = "segment or surface" if self.names else "surface or body"
                raise UserError(
                    f"The disturbance {who!r} acts on {pattern!r}, but {self.owner} has no such {kinds}; "
                    f"{hint}"
                )
            found += matching
        return tuple(dict.fromkeys(found))


NO_SEGMENTS = SegmentLayout(
    (), np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros((0, 0, 2)), np.zeros(0), None, "the system"
)
"""Of systems without segments, whose elements need not be known."""
