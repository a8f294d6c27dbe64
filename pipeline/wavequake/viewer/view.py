"""Write the viewer's page of a store, or of what can be drawn."""

import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from wavequake.campaign.store.store import Manifest, open_store, read_manifest
from wavequake.drawing.draw import look, scene_of
from wavequake.errors import UserError
from wavequake.report.page import write_page
from wavequake.viewer import mirrors, segments, systems
from wavequake.viewer.film import Film, Stage, Take, stage_of
from wavequake.viewer.page import render_film

Tell = Callable[[str], None]
Maker = Callable[[Path, Manifest, Sequence[int], Tell], tuple[tuple[Stage, ...], tuple[Take, ...]]]

VIEW = "view.html"
MOST_CASES = 24
_MAKERS: Mapping[str, Maker] = {
    "segment-disturbance": segments.film_of,
    "system-disturbance": systems.film_of,
    "mirror-mor": mirrors.film_of,
    "mirror-exposure": mirrors.film_of,
    "mirror-trace": mirrors.film_of,
}


def _silent(line: str) -> None:
    """Say nothing."""


def view(
    store: str | Path,
    case: int | Sequence[int] | None = None,
    file: str | Path | None = None,
    tell: Tell = _silent,
) -> Path:
    """Write one offline page that shows cases of a store in motion, and return its path.

    The cases are computed anew, as no store keeps motions; the page works from a file, without a network.

    Parameters
    ----------
    store : str or Path
        Of segments, an optical system or vibrating mirrors.
    case : int or sequence of int, optional
        Ids; by default the worst case of each disturbance, or all variants of a mirror, 24 at most.
    file : str or Path, optional
        By default ``view.html`` in the store's folder.
    tell : callable, optional
        Called with a line for every case.

    Returns
    -------
    Path
        Absolute.

    Raises
    ------
    UserError
        If there is no such store or case, or nothing in it moves.

    Examples
    --------
    >>> view("runs/tmt-segments-1a2b3c4d", case=[3, 17])  # doctest: +SKIP
    """
    folder = Path(store)
    manifest = read_manifest(folder)
    if manifest.workflow not in _MAKERS:
        raise UserError(
            f"A store of {manifest.workflow} cannot be viewed; those of {', '.join(_MAKERS)} can."
        )
    chosen = [case] if isinstance(case, int | np.integer) else list(case or ())
    for one in chosen:
        if one not in range(manifest.cases):
            raise UserError(f"{store} has cases 0 to {manifest.cases - 1}; there is no case {one}.")
    if len(chosen) > MOST_CASES:
        raise UserError(f"{len(chosen)} cases are too many for a page; choose {MOST_CASES} at most.")
    stages, takes = _MAKERS[manifest.workflow](folder, manifest, chosen, tell)
    title = str(open_store(folder).attrs.get("study_title", "")) or manifest.workflow
    film = Film(title, f"{folder.name}, study {manifest.identity[:12]}", stages, takes)
    return write_page(render_film(film), Path(file) if file else folder / VIEW)


def write_scene(what: Any, file: Path, overrides: Any = ()) -> Path:
    """Write a page on which a system, telescope or model can be turned; raises as `wavequake.draw`."""
    scene = scene_of(look(what, overrides))
    take = Take("at rest", np.zeros(1))
    name = os.fspath(what) if isinstance(what, str | os.PathLike) else scene.name
    return write_page(render_film(Film(scene.name, str(name), (stage_of(scene),), (take,))), file)
