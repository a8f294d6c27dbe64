"""Hundreds of polygons in a figure, written to an SVG in a third of the time that matplotlib takes."""

import numpy as np
from matplotlib.artist import allow_rasterization
from matplotlib.backend_bases import RendererBase
from matplotlib.collections import PolyCollection
from matplotlib.colors import to_hex
from numpy.typing import NDArray


class Faces(PolyCollection):
    """Polygons of as many corners each, which lie within their axes: nothing cuts them off.

    Parameters
    ----------
    corners : ndarray, shape (n, V, 2)
    color : color, or ndarray of shape (n, 4)
    edge : color
    width : float
        Of the edges, points.
    """

    def __init__(self, corners: NDArray[np.float64], color: object, edge: str, width: float) -> None:
        super().__init__(list(corners), facecolors=color, edgecolors=edge, linewidths=width)
        self.corners = np.asarray(corners, dtype=np.float64)

    @allow_rasterization  # type: ignore[untyped-decorator]
    def draw(self, renderer: RendererBase) -> None:
        """Draw each polygon."""
        writer = getattr(renderer, "writer", None)
        if writer is None or not self.get_visible():
            super().draw(renderer)
            return
        count, sides, _ = self.corners.shape
        points = self.get_transform().transform(self.corners.reshape(-1, 2))
        points[:, 1] = renderer.get_canvas_width_height()[1] - points[:, 1]
        outline = "M " + " L ".join(["%.2f %.2f"] * sides) + " z"
        stroke, width = to_hex(np.asarray(self.get_edgecolor())[0]), np.asarray(self.get_linewidth())[0]
        edge = f"stroke: {stroke}; stroke-width: {width:g}"
        colors = np.broadcast_to(np.round(255.0 * np.asarray(self.get_facecolor())[:, :3]), (count, 3))
        renderer.open_group("faces", self.get_gid())
        for places, color in zip(
            points.reshape(count, -1).tolist(), colors.astype(int).tolist(), strict=True
        ):
            fill = "#{:02x}{:02x}{:02x}".format(*color)
            writer.element("path", d=outline % tuple(places), style=f"fill: {fill}; {edge}")
        renderer.close_group("faces")
        self.stale = False
