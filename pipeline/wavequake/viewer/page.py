"""The page of a film: one HTML file that asks for nothing, under a strict content security policy."""

import io
from base64 import b64encode
from hashlib import sha256
from html import escape
from importlib.resources import files

from matplotlib import rc_context
from matplotlib.collections import LineCollection, PolyCollection

from wavequake.drawing.still import viewing
from wavequake.drawing.style import STYLE, Drawing
from wavequake.viewer.encode import encode
from wavequake.viewer.film import Film, Stage, Take
from wavequake.words import printable

_PAGE = """<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" content="default-src 'none'; script-src 'sha256-{script_hash}'; \
style-src 'sha256-{style_hash}'; img-src data:">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}</title>
<style>{style}</style>
</head>
<body>
<h1>{title}</h1>
<p id="status" role="status"></p>
<noscript>
<p>This page moves by a script, which is switched off here. A still:</p>
<img alt="The bodies at rest, or the histories" src="data:image/svg+xml;base64,{still}">
<table><tr><th>case</th><th>instants</th><th>largest displacement</th></tr>
{rows}
</table>
</noscript>
<main id="viewer" hidden></main>
<script type="application/json" id="film">{record}</script>
{blocks}
<script>{script}</script>
</body>
</html>
"""


def render_film(film: Film) -> str:
    """Return a film as HTML; the same bytes for the same film."""
    record, blocks = encode(film)
    script, style = (
        files("wavequake.viewer").joinpath(name).read_text(encoding="utf-8")
        for name in ("viewer.js", "viewer.css")
    )
    rows = [
        f"<tr><td>{escape(printable(take.label))}</td><td>{len(take.time)}</td><td>{escape(printable(take.note))}</td></tr>"
        for take in film.takes
    ]
    return _PAGE.format(
        title=escape(printable(film.title)),
        script=script,
        style=style,
        script_hash=_hash(script),
        style_hash=_hash(style),
        still=_still(film.stages[0], film.takes[0]),
        rows="\n".join(rows),
        record=record,
        blocks="\n".join(
            f'<script type="text/plain" id="{name}">{text}</script>' for name, text in blocks.texts.items()
        ),
    )


def _hash(text: str) -> str:
    return b64encode(sha256(text.encode()).digest()).decode()


def _still(stage: Stage, take: Take) -> str:
    """Return the stage at rest, or of no bodies the histories of a take, as SVG in base64."""
    with rc_context({**STYLE, "svg.hashsalt": "still"}):
        figure = Drawing(figsize=(6.0, 4.5))
        if len(stage.points):
            _bodies(figure, stage)
        else:
            axes = figure.add_subplot(xlabel="time (s)")
            for name, (unit, values) in list(take.series.items())[:1]:
                axes.plot(take.time, values)
                axes.set_title(f"{name} ({unit})", fontsize=9)
        buffer = io.BytesIO()
        figure.savefig(buffer, format="svg", metadata={"Date": None})
    return b64encode(buffer.getvalue()).decode()


def _bodies(figure: Drawing, stage: Stage) -> None:
    """Draw bodies at rest."""
    eye = viewing(stage.up)
    seen = stage.points @ eye.T
    order = seen[stage.faces, 2].mean(axis=1).argsort(kind="stable")
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.add_collection(
        PolyCollection(
            list(seen[stage.faces[order], :2].round(4)),
            facecolors=[stage.colors[k] for k in order],
            edgecolors="#5b6670",
            linewidths=0.2,
        )
    )
    lines = [points @ eye[:2].T for _, points in stage.lines]
    axes.add_collection(LineCollection(lines, colors=[color for color, _ in stage.lines], linewidths=0.5))
    axes.set(aspect="equal")
    axes.autoscale_view()
    axes.set_axis_off()
