"""What mirrors after M1 stop of a telescope's light at rest, in numbers and in words."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from wavequake.errors import UserError
from wavequake.kernels.trace.status import OK, surface_of
from wavequake.optics.segments.prepared import PreparedTrace
from wavequake.optics.systems.system import OpticalSystem

Codes = NDArray[np.int8]


@dataclass(frozen=True)
class Stopped:
    """Rays of the pupil that do not reach the image at rest.

    Attributes
    ----------
    rays : int
        All rays of the pupil.
    by_mirror : tuple of (str, int)
        Mirrors after M1 that stop rays, and how many.
    otherwise : int
        Rays that are lost in other ways, beside the glass for example.
    light : float
        Share of the glass, by the weights of the rays, whose light no mirror stops; exactly 1 for all.
    """

    rays: int
    by_mirror: tuple[tuple[str, int], ...]
    otherwise: int
    light: float

    @property
    def vignetted(self) -> int:
        """Number of rays that mirrors stop."""
        return sum(count for _, count in self.by_mirror)

    def words(self) -> str:
        """Say who stops how many rays at rest; nothing where all arrive."""
        parts = [
            f"{name} stops {count} of {self.rays} rays ({_percent(count, self.rays)})"
            for name, count in self.by_mirror
        ]
        if self.otherwise:
            parts.append(
                f"{self.otherwise} of {self.rays} rays ({_percent(self.otherwise, self.rays)}) pass beside "
                "the glass"
            )
        return f"{', '.join(parts)} at rest" if parts else ""


def require_all_rays(stopped: Stopped, why: str) -> None:
    """Raise UserError, which says why all are needed, if rays are lost at rest."""
    if words := stopped.words():
        raise UserError(
            f"{words}, {why}: give what stops it a larger semi_diameter_mm, or bring optics.field_arcmin "
            "nearer the axis."
        )


def _percent(count: int, total: int) -> str:
    share = 100.0 * count / total
    return "< 1 %" if share < 1.0 else f"{share:.0f} %" if count == total else f"{min(share, 99.0):.0f} %"


def stopped_at_rest(prepared: PreparedTrace, status: Codes) -> Stopped:
    """Count what the status (N,) of the rays at rest, as `kernels.trace.train.Traced` has it, says."""
    mirrors = prepared.system.after_primary[:-1]
    where = surface_of(status)
    counts = [int(np.count_nonzero(where == index)) for index in range(len(mirrors))]
    dark = (where >= 0) & (where < len(mirrors))
    return Stopped(
        rays=len(status),
        by_mirror=tuple((one.name, count) for one, count in zip(mirrors, counts, strict=True) if count),
        otherwise=int(np.count_nonzero(status != OK)) - sum(counts),
        light=float(prepared.weight[~dark].sum()) if dark.any() else 1.0,
    )


def refuse_dark_segment(prepared: PreparedTrace, status: Codes, lost_segments: NDArray[np.bool_]) -> None:
    """Raise UserError if the rays of a segment that arrive at rest do not determine its tilt.

    Parameters
    ----------
    prepared : PreparedTrace
    status : ndarray, shape (N,)
    lost_segments : ndarray of bool, shape (S,)
    """
    if not lost_segments.any():
        return
    system, segment = prepared.system, int(np.argmax(lost_segments))
    name, own = system.segments.names[segment], status[prepared.rays.segment == segment]
    arriving = int(np.count_nonzero(own == OK))
    what = (
        f"Only {arriving} of the {len(own)} rays of segment {name} of the telescope {system.name} at rest "
        "reach the image, too few for its tilt"
        if arriving
        else f"No ray of segment {name} of the telescope {system.name} at rest reaches the image"
    )
    whole = stopped_at_rest(prepared, status).words()
    raise UserError(f"{what}: {_where(system, own)}. Of the pupil, {whole}.")


def _where(system: OpticalSystem, own: Codes) -> str:
    """Say where most of a segment's rays end, and what would let them pass."""
    ends, counts = np.unique(surface_of(own[own != OK]), return_counts=True)
    end = int(ends[np.argmax(counts)])
    count = f"{counts.max()} of {len(own)}"
    if not 0 <= end < len(system.after_primary) - 1:
        return f"{count} pass beside the glass or the image; check telescope and optics.field_arcmin"
    mirror = system.after_primary[end]
    if mirror.opening is None:
        return f"{count} miss {mirror.name}; check its radius, conic and distance, and optics.field_arcmin"
    return (
        f"{mirror.name}, whose semi-diameter is {mirror.opening.outer:g} mm, stops {count}; "
        "give it a larger semi_diameter_mm, or bring optics.field_arcmin nearer the axis"
    )
