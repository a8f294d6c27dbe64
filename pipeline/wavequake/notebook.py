"""Wavequake in a notebook: objects draw themselves, errors are a sentence, runs show their progress.

`import wavequake` calls `install` where IPython runs; nothing here loads before an object is shown.
"""

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from html import escape
from typing import Any

from wavequake.errors import StoreDamageError, UserError
from wavequake.words import counted, printable

_DRAWN = (
    ("wavequake.optics.systems.system", "OpticalSystem"),
    ("wavequake.mechanics.model", "FiniteElementModel"),
    ("wavequake.mechanics.model", "ReducedModel"),
)
_STUDIES = ("wavequake.campaign.schema", "Study")
_REDRAW_S = 0.2


def shell() -> Any:
    """Return the running IPython shell, or None."""
    module = sys.modules.get("IPython")
    return module.get_ipython() if module is not None else None


def install(ipython: Any) -> None:
    """Teach an IPython shell to show Wavequake's objects and to say its errors in one sentence."""
    html = ipython.display_formatter.formatters["text/html"]
    for module, name in _DRAWN:
        html.for_type_by_name(module, name, shown)
    html.for_type_by_name(*_STUDIES, shown_study)
    ipython.set_custom_exc((UserError, StoreDamageError), explain)


def explain(ipython: Any, kind: type[Exception], error: Exception, trace: Any, tb_offset: Any = None) -> None:
    """Print an error as a sentence, without a traceback."""
    what = "Damaged store" if isinstance(error, StoreDamageError) else "Error"
    print(f"{what}: {error}", file=sys.stderr)


def shown(thing: Any) -> str:
    """Return the drawing of a system, telescope or model, and its table if there is one."""
    from wavequake.drawing.draw import draw
    from wavequake.optics.systems.info import info
    from wavequake.optics.systems.system import OpticalSystem

    table = ""
    try:
        if isinstance(thing, OpticalSystem):
            table = f"<pre>{_text(info(thing))}</pre>"
        svg = draw(thing)._repr_svg_()
    except UserError as error:
        return f"<p>{_text(repr(thing))}</p>{table}<p>{_text(str(error))}</p>"
    return f"{svg[svg.index('<svg') :]}{table}"


def shown_study(study: Any) -> str:
    """Return what a study is about: title, drawing, and its sections."""
    import json

    name, title = _text(study.study.name), _text(study.study.title)
    sections = json.dumps(study.model_dump(mode="json", exclude_defaults=True), indent=2, ensure_ascii=False)
    picture = shown(study)
    return (
        f"<h4>{name}</h4><p>{title}</p>{picture}"
        f"<details><summary>{counted(study.cases, 'case')} of {_text(study.study.workflow)}</summary>"
        f"<pre>{_text(sections[:20000])}</pre></details>"
    )


def _text(words: str) -> str:
    """Return words as HTML that shows them."""
    return escape(printable(words))


@contextmanager
def progress_bar() -> Iterator[Callable[[int, int, int], None] | None]:
    """Give a callback (done, total, quarantined) that draws a bar in a notebook; None elsewhere."""
    running = shell()
    if running is None or not hasattr(running, "kernel"):
        yield None
        return
    from IPython.display import HTML, display

    handle = display(HTML("<progress></progress> preparing"), display_id=True)
    last = [0.0]

    def update(done: int, total: int, quarantined: int) -> None:
        now = time.monotonic()
        if now - last[0] < _REDRAW_S and done < total:
            return
        last[0] = now
        handle.update(HTML(bar(done, total, quarantined)))

    yield update


def bar(done: int, total: int, quarantined: int) -> str:
    """Return a progress bar with its numbers as HTML."""
    words = f", {quarantined} quarantined" if quarantined else ""
    return (
        f'<progress value="{done}" max="{max(1, total)}"></progress> {done}/{counted(total, "case")}{words}'
    )
