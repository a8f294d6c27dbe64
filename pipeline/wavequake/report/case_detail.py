"""What no store keeps of a case: what was drawn for it, what moves, and the path of every ray."""

from collections.abc import Callable

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from wavequake.report.segments import detail
from wavequake.workflows.store import Manifest

Array = NDArray[np.float64]

_DEGREES = ["dx", "dy", "dz", "rx", "ry", "rz"]


def detail_of(manifest: Manifest, case: int, device: str) -> xr.Dataset:
    """Return what a workflow can tell of a case beyond the numbers that it computes for the store.

    Instants are those that the case has (``instant``); nothing for workflows that draw and trace nothing.
    """
    found = _DETAILS.get(manifest.workflow)
    return found(manifest.study, case, device) if found else xr.Dataset()


def _variable(dims: tuple[str, ...], values: NDArray[np.generic], units: str, long_name: str) -> xr.Variable:
    return xr.Variable(dims, values, {"units": units, "long_name": long_name})


def _of_segments(study: str, case: int, device: str) -> xr.Dataset:
    """Return the motion of every segment and the path of every ray at every instant."""
    found = detail(study, case, device, xr.Dataset())
    over = ("instant", "ray")
    return xr.Dataset(
        {
            "segment_motion": _variable(
                ("instant", "segment", "dof"), found.segment_motion, "m, rad", "motion in the segment's frame"
            ),
            "opd": _variable(over, found.opd, "nm", "optical path difference; NaN: lost"),
            "spot": _variable((*over, "axis"), found.spot, "mas", "where rays meet the image"),
            "ray_x": _variable(("ray",), found.ray_x, "mm", "where rays meet the aperture"),
            "ray_y": _variable(("ray",), found.ray_y, "mm", "where rays meet the aperture"),
            "ray_segment": _variable(("ray",), found.ray_segment, "1", "segment that a ray hits, -1: none"),
        },
        {"segment": list(found.segment_names), "dof": _DEGREES},
    )


_DETAILS: dict[str, Callable[[str, int, str], xr.Dataset]] = {"segment-disturbance": _of_segments}
