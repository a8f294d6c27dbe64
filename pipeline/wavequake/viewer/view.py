"""Write the viewer's page of a store, or of what can be drawn."""

import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from wavequake.campaign.store.layout import refuse_older
from wavequake.campaign.store.store import Manifest, open_store, read_manifest
from wavequake.drawing.draw import look, scene_of
from wavequake.errors import UserError
from wavequake.report.page import write_page
from wavequake.viewer import (
    exposures,
    lenses,
    loops,
    mirrors,
    reduced_segments,
    segment_controls,
    segments,
    sights,
    sweeps,
    system_loops,
    systems,
    telescope_loops,
)
from wavequake.viewer.film import Film, Stage, Take, stage_of
from wavequake.viewer.page import render_film
from wavequake.workflows import sweep
from wavequake.workflows.kinds import find_kind

Tell = Callable[[str], None]

VIEW = "view.html"
MOST_CASES = 24
_MAKERS: Mapping[str, sweeps.Maker] = {
    "segment-disturbance": segments.film_of,
    "system-disturbance": systems.film_of,
    "telescope-exposure": exposures.film_of,
    "mirror-mor": mirrors.film_of,
    "mirror-exposure": mirrors.film_of,
    "mirror-trace": mirrors.film_of,
    "segment-mor": reduced_segments.film_of,
    "lens-experiment": lenses.film_of,
    "lens-passive": lenses.film_of,
    "controller-mor": loops.film_of,
    "segment-control": segment_controls.film_of,
    "telescope-loop": telescope_loops.film_of,
    "system-loop": system_loops.film_of,
    "tip-tilt-vibration": sights.film_of,
}


def silent(line: str) -> None:
    """Say nothing."""


def view(
    store: str | Path,
    case: int | Sequence[int] | None = None,
    file: str | Path | None = None,
    tell: Tell = silent,
) -> Path:
    """Write one offline page that shows cases of a store in motion, and return its path.

    The cases are computed anew, as no store keeps motions; the page works from a file, without a network.

    Parameters
    ----------
    store : str or Path
        Of any study that has bodies: segments, systems, mirrors, exposures, reduced models, lenses.
    case : int or sequence of int, optional
        Ids; by default the worst case of each disturbance, or some variants, plants or models; 24 at most.
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
    chosen = [case] if isinstance(case, int | np.integer) else list(case or ())
    return write_page(render_film(film_of(folder, chosen, tell)), Path(file) if file else folder / VIEW)


def film_of(store: Path, cases: Sequence[int], tell: Tell = silent) -> Film:
    """Return cases of a store in motion, those worth seeing where none is given; raises as `view`."""
    manifest = read_manifest(store)
    refuse_older(store, manifest, find_kind)
    for one in cases:
        if one not in range(manifest.cases):
            raise UserError(f"{store} has cases 0 to {manifest.cases - 1}; there is no case {one}.")
    if len(cases) > MOST_CASES:
        raise UserError(f"{len(cases)} cases are too many for a page; choose {MOST_CASES} at most.")
    dataset = open_store(store)
    stages, takes = _made(dataset, manifest, cases, tell)
    title = str(dataset.attrs.get("study_title", "")) or manifest.workflow
    return Film(title, f"{store.name}, study {manifest.identity[:12]}", stages, takes)


def _made(
    dataset: xr.Dataset, manifest: Manifest, cases: Sequence[int], tell: Tell
) -> tuple[tuple[Stage, ...], tuple[Take, ...]]:
    if manifest.workflow == sweep.NAME:
        return sweeps.film_of(dataset, manifest, cases, tell, _made)
    if manifest.workflow not in _MAKERS:
        raise UserError(
            f"A store of {manifest.workflow} cannot be viewed; those of {', '.join(_MAKERS)} can, and sweeps."
        )
    return _MAKERS[manifest.workflow](dataset, manifest, cases, tell)


def write_scene(what: Any, file: Path, overrides: Any = ()) -> Path:
    """Write a page on which a system, telescope or model can be turned; raises as `wavequake.draw`."""
    scene = scene_of(look(what, overrides))
    take = Take("at rest", np.zeros(1))
    name = os.fspath(what) if isinstance(what, str | os.PathLike) else scene.name
    return write_page(render_film(Film(scene.name, str(name), (stage_of(scene),), (take,))), file)
