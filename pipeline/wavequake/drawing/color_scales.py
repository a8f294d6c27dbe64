"""What colors of a map mean: a scale beside it."""

from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, NullFormatter

from wavequake.drawing.ticks import BareAxes, draw_ticks_at_once, power_of_ten


def colorbar(figure: Figure, axes: Axes, mappable: ScalarMappable, label: str) -> None:
    """Draw what colors mean beside axes in inches."""
    box, (across, _) = axes.get_position(), figure.get_size_inches()
    color_scale(figure, (box.x1 + 0.1 / across, box.y0, 0.13 / across, box.height), mappable, label)


def color_scale(
    figure: Figure, place: tuple[float, float, float, float], mappable: ScalarMappable, label: str
) -> None:
    """Draw the scale of colors at a place in shares of the figure; a logarithmic one at powers of ten."""
    side = figure.add_axes(place, axes_class=BareAxes)
    logarithmic = isinstance(mappable.norm, LogNorm)
    bar = figure.colorbar(
        mappable, cax=side, label=label, format=FuncFormatter(power_of_ten) if logarithmic else None
    )
    if logarithmic:
        bar.ax.yaxis.set_minor_formatter(NullFormatter())
    side.spines[:].set_visible(False)
    draw_ticks_at_once(side)
