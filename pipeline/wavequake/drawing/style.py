"""How every figure looks: sizes, fonts, the Okabe-Ito colors with a line style each."""

import io
import json
import re
from collections.abc import Iterator, Sequence
from html import escape
from typing import Any
from urllib.parse import quote, unquote

from matplotlib import rc_context
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.cbook import is_math_text
from matplotlib.figure import Figure
from matplotlib.text import Text

from wavequake.words import printable

WIDTH, HEIGHT = 5.5, 4.7  # inches
STYLE: dict[Any, Any] = {
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],
    "font.size": 9.0,
    "axes.titlesize": 9.5,
    "axes.titlelocation": "left",
    "axes.linewidth": 0.7,
    "axes.formatter.limits": (-3, 5),
    "axes.edgecolor": "#444444",
    "axes.labelcolor": "#222222",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "xtick.color": "#444444",
    "ytick.color": "#444444",
    "xtick.major.width": 0.7,
    "ytick.major.width": 0.7,
    "legend.frameon": False,
    "legend.fontsize": 8.5,
    "figure.facecolor": "white",
    "svg.fonttype": "none",
    "svg.hashsalt": "wavequake",
}
COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#000000")
LINES = ("-", (0, (5, 1.5)), (0, (1.5, 1.2)), (0, (6, 1.5, 1.5, 1.5)))


_HOVER = "hover:"
_GROUP = re.compile(rf'<g id="{_HOVER}(?P<texts>[^"]*)">(?P<marks>.*?)</g>', re.DOTALL)
_MARK = re.compile(r"<(path|use)( [^>]*?)/>", re.DOTALL)


def one_panel(width: float = WIDTH, height: float = HEIGHT) -> tuple[Figure, Axes]:
    """Return a figure of this size in inches with one set of axes."""
    figure = Figure(figsize=(width, height), layout="constrained")
    return figure, figure.add_subplot()


def stacked(rows: int = 2, width: float = WIDTH, height: float = HEIGHT) -> tuple[Figure, list[Axes]]:
    """Return a figure of this size in inches with axes above each other, of one x."""
    figure = Figure(figsize=(width, height), layout="constrained")
    return figure, list(figure.subplots(rows, 1, sharex=True, squeeze=False)[:, 0])


def curve_style(place: int) -> dict[str, Any]:
    """Return color and line of one of many curves."""
    return {"color": COLORS[place % len(COLORS)], "linestyle": LINES[place % len(LINES)], "linewidth": 1.2}


class Drawing(Figure):
    """A figure that knows its canvas and shows itself in a notebook, whatever the backend."""

    def __init__(self, *arguments: Any, **keywords: Any) -> None:
        super().__init__(*arguments, **keywords)
        FigureCanvasAgg(self)

    def _repr_svg_(self) -> str:
        return svg_text(self)


def svg_text(figure: Figure, salt: str = "wavequake") -> str:
    """Return a figure as SVG, the same bytes every time; its ids are unique as long as `salt` is."""
    buffer = io.StringIO()
    show_names(figure)
    engine, canvas, dots = figure.get_layout_engine(), figure.canvas, figure.dpi
    with rc_context({**STYLE, "svg.hashsalt": salt}):
        try:
            svg = FigureCanvasSVG(figure)
            if engine is not None:  # `savefig` would draw all of the figure for nothing but its layout
                figure.dpi = 72  # as an SVG has
                engine.execute(figure)
                figure.set_layout_engine("none")
            figure.dpi = 150  # of pictures in it
            svg.print_svg(buffer, metadata={"Date": None})  # type: ignore[no-untyped-call]
        finally:
            figure.set_layout_engine(engine)
            figure.set_canvas(canvas)
            figure.dpi = dots
    return printable(buffer.getvalue())


def hover(texts: Sequence[str]) -> str:
    """Return the id of an artist (`set_gid`) whose marks say these texts when pointed at, in a page."""
    return _HOVER + quote(json.dumps([printable(one) for one in texts]))


def with_titles(svg: str) -> str:
    """Return an SVG in which the marks of artists with such ids have titles; a single text is that of all."""

    def titled(group: re.Match[str]) -> str:
        texts = json.loads(unquote(group["texts"]))
        left = iter(texts)

        def mark(one: re.Match[str]) -> str:
            text = escape(texts[0] if len(texts) == 1 else next(left, ""))
            return f"<{one[1]}{one[2]}><title>{text}</title></{one[1]}>" if text else one[0]

        definitions, end, marks = group["marks"].rpartition("</defs>")
        return f"<g>{definitions}{end}{_MARK.sub(mark, marks)}</g>"

    return _GROUP.sub(titled, svg)


def as_name(name: str) -> str:
    """Return a name for a figure that measures it before `show_names`: no formula, and nothing is obeyed."""
    return printable(name).replace("$", r"\$")


def show_names(figure: Figure) -> None:
    """Have names in a figure shown as they are: they are no formulas, and nothing in them is obeyed."""
    for text in _texts(figure):
        words = text.get_text()
        if is_math_text(words) and r"\math" not in words:  # which stands in powers on axes
            text.set_parse_math(False)
        text.set_text(printable(words))


def _texts(artist: Artist) -> Iterator[Text]:
    """Yield all texts of an artist and its parts; an axis that is not visible makes no ticks for that."""
    if isinstance(artist, Axis) and not artist.get_visible():
        yield artist.label
        return
    if isinstance(artist, Text):
        yield artist
    for part in artist.get_children():
        yield from _texts(part)
