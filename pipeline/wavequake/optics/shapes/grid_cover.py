"""Whether grids of heights cover what the beams at rest fill of their surfaces."""

from collections.abc import Mapping

import numpy as np

from wavequake.errors import UserError
from wavequake.optics.shapes.shapes import GridDeformation, GridSag
from wavequake.optics.systems.bodies import beam_extents
from wavequake.optics.systems.system import OpticalSystem


def require_cover(system: OpticalSystem, grids: Mapping[int, GridDeformation] | None = None) -> None:
    """Check that no beam at rest reaches beyond the grid of a surface, where the heights of its edge go on.

    Half a step is let pass: grids of pixels end as far inside the rim.

    Parameters
    ----------
    system : OpticalSystem
        Its grids of heights (`GridSag`) are checked.
    grids : mapping of int to GridDeformation, optional
        Further grids to check instead, by surface.

    Raises
    ------
    UserError
        If a beam reaches beyond a grid, or none reaches its surface; the message names it.
    """
    if grids is None:
        sizes = {
            index: (shape.dx, shape.dy, *shape.heights.shape)
            for index, surface in enumerate(system.surfaces)
            if isinstance(shape := surface.shape, GridSag)
        }
    else:
        sizes = {index: (one.dx, one.dy, one.rows, one.columns) for index, one in grids.items()}
    if not sizes:
        return
    for (index, size), reach in zip(sizes.items(), beam_extents(system, list(sizes)), strict=True):
        step, rows, columns = np.array(size[:2]), *size[2:]
        half = step * [columns - 1, rows - 1] / 2.0
        opening = system.surfaces[index].opening
        if opening is not None:
            corners = np.abs(opening.corners).max(axis=0) if opening.corners else np.inf
            reach = np.minimum(reach, np.minimum(opening.outer, corners) + np.abs(opening.center))
        if (reach > (half + step / 2.0) * (1.0 + 1e-9)).any():
            raise UserError(
                f"The grid of heights of {system.surfaces[index].name!r} reaches to x = {half[0]:.6g} and "
                f"y = {half[1]:.6g} mm, the beams of all fields to {reach[0]:.6g} and {reach[1]:.6g} mm; "
                "it must cover them, or the surface needs a smaller opening (are the spacings in mm?)."
            )
