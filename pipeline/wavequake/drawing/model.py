"""Finite-element mirrors: their optical surface from above and from the side, with the mounts by number."""

from collections.abc import Sequence

from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection

from wavequake.drawing.solid import MOUNT, Scene, model_scene
from wavequake.drawing.style import STYLE, Drawing
from wavequake.mechanics.model import Model

_MANY = 4000  # faces beyond which vectors would make pages of tens of megabytes
_NODE, _SURFACE, _EDGE = "#8a97a3", "#dbe8f3", "#7f9ab0"


def model_figure(models: Sequence[Model], width: float = 6.0) -> Drawing:
    """Return nodes, optical surface and mounts of models side by side, along z and along y.

    Parameters
    ----------
    models : sequence of FiniteElementModel or ReducedModel
        One or more.
    width : float
        Of each, inches.

    Raises
    ------
    UserError
        As `wavequake.drawing.solid.model_scene`.
    """
    scenes = [model_scene(model) for model in models]
    spans = [_span(model) for model in models]
    across = width - 1.0
    tall = max(across * (high[1] - low[1]) / (high[0] - low[0]) for low, high in spans)
    thin = max(across * (high[2] - low[2]) / (high[0] - low[0]) for low, high in spans)
    whole_x, whole_y = width * len(models), tall + thin + 1.75
    with rc_context(STYLE):
        figure = Drawing(figsize=(whole_x, whole_y))
        for place, (model, scene, (low, high)) in enumerate(zip(models, scenes, spans, strict=True)):
            left = (place * width + 0.75) / whole_x
            above = figure.add_axes((left, (thin + 1.15) / whole_y, across / whole_x, tall / whole_y))
            beside = figure.add_axes((left, 0.5 / whole_y, across / whole_x, thin / whole_y))
            for axes, second in ((above, 1), (beside, 2)):
                _draw(axes, model, scene, second)
                axes.set(xlim=(low[0], high[0]), ylim=(low[second], high[second]), aspect="equal")
                axes.set_ylabel(f"{'xyz'[second]} (m)")
            beside.set_xlabel("x (m)")
            for number, point in enumerate(scene.dots, 1):
                above.annotate(str(number), point[:2], (6, 5), textcoords="offset points", zorder=5)
            above.set_title(
                f"{model.name}: {model.order} degrees of freedom\n"
                f"blue: optical surface, {len(model.surface_nodes)} nodes; ▲: {len(scene.dots)} mounts"
            )
    return figure


def _span(model: Model) -> tuple[list[float], list[float]]:
    """Return the lowest and highest coordinates with a border; thin bodies get room for their mounts."""
    low, high = model.nodes.min(axis=0), model.nodes.max(axis=0)
    border = 0.06 * float((high - low).max())
    low, high = low - border, high + border
    return low.tolist(), high.tolist()


def _draw(axes: Axes, model: Model, scene: Scene, second: int) -> None:
    skin, plane = scene.skins[0], [0, second]
    faces = [skin.points[face][:, plane] for face in skin.faces]
    drawn = PolyCollection(faces, facecolors=_SURFACE, edgecolors=_EDGE, linewidths=0.3)
    drawn.set_rasterized(len(faces) > _MANY)
    axes.add_collection(drawn)
    axes.plot(*model.nodes[:, plane].T, ".", color=_NODE, markersize=1.2, zorder=2, rasterized=True)
    axes.plot(*scene.dots[:, plane].T, "^", color=MOUNT, markersize=7, zorder=4)
