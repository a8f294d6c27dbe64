"""Surfaces of an optical system that shift and turn, with what the store says of the light."""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import xarray as xr
from threadpoolctl import threadpool_limits

from wavequake.campaign.contract import DONE
from wavequake.campaign.store.store import Manifest, open_store
from wavequake.drawing.solid import system_scene
from wavequake.errors import UserError
from wavequake.viewer.film import Array, Stage, Take, stage_of
from wavequake.workflows.systems.system_bench import MM_PER_M, SystemBench, system_bench, system_states
from wavequake.workflows.systems.system_disturbance import draw

_MOST_INSTANTS = 400
_SERIES = (("change of the wavefront error", "wfe_change"), ("line of sight", "los_mm"))


def film_of(
    store: Path, manifest: Manifest, chosen: Sequence[int], tell: Callable[[str], None]
) -> tuple[tuple[Stage, ...], tuple[Take, ...]]:
    """Return the system, and the chosen cases or those that change the wavefront most."""
    dataset, bench = open_store(store), system_bench(manifest.study)
    stage, surfaces = _stage(bench)
    takes = []
    with threadpool_limits(1):
        for case in list(chosen) or _worst(dataset):
            takes.append(_take(bench, dataset, case, surfaces))
            tell(f"case {case}: {takes[-1].label}")
    return (stage,), tuple(takes)


def _worst(dataset: xr.Dataset) -> list[int]:
    """Return the case of each disturbance whose wavefront changes most."""
    change = dataset["wfe_change"] if "wfe_change" in dataset else dataset["wfe_rms"]
    size = change.max([dim for dim in change.dims if dim != "case"]).to_numpy()
    size = np.where(dataset["status"].to_numpy() == DONE, size, -1.0)
    names, ids = dataset["disturbance"].to_numpy(), dataset["case"].to_numpy()
    found = []
    for name in dict.fromkeys(names.tolist()):
        best = int(np.argmax(np.where(names == name, np.nan_to_num(size, nan=-1.0), -2.0)))
        found += [int(ids[best])] if size[best] >= 0.0 else []
    if not found:
        raise UserError("No case of the store is done yet; there is nothing to view.")
    return found


def _stage(bench: SystemBench) -> tuple[Stage, list[int]]:
    """Return the system with a body for every surface that is drawn, and which surface each one is."""
    whole = stage_of(system_scene(bench.system))
    names, surfaces = [surface.name for surface in bench.system.surfaces], list[int]()
    for name in whole.names:
        surfaces.append(names.index(name, surfaces[-1] + 1 if surfaces else 0))
    there = [bench.system.surfaces[number] for number in surfaces]
    pivots = np.stack([surface.position for surface in there]) / MM_PER_M
    axes = np.stack([surface.rotation for surface in there])
    parts = (whole.points, whole.faces, whole.body, whole.colors, whole.names, pivots, axes)
    return Stage(*parts, whole.lines, whole.labels, whole.up), surfaces


def _take(bench: SystemBench, dataset: xr.Dataset, case: int, surfaces: list[int]) -> Take:
    population, drawn = draw(bench, case)
    states, stored = system_states(bench, drawn), dataset.sel(case=case)
    motion = states.surface_motion[:, surfaces].copy()
    motion[..., :3] /= MM_PER_M
    step = -(-len(motion) // _MOST_INSTANTS)
    time = np.asarray(stored["time_s"].to_numpy(), dtype=np.float64)
    notes = (
        [] if motion.any() else ["No surface moves as a body in this case: it deforms, or the light turns."]
    )
    notes += ["Of the image the first field point is shown."]
    return Take(
        f"{population.name}, case {case}",
        time[: len(motion) : step],
        note=" ".join(notes),
        poses=motion[::step],
        series={
            words: (str(stored[name].attrs.get("units", "")), _history(stored[name], len(motion))[::step])
            for words, name in _SERIES
            if name in stored and "time" in stored[name].dims
        },
    )


def _history(values: xr.DataArray, instants: int) -> Array:
    """Return (time, k) of the first field point at the first wavelength."""
    first = values.isel({dim: 0 for dim in values.dims if dim in ("field", "wavelength")})
    others = [dim for dim in first.dims if dim != "time"]
    return np.asarray(
        first.transpose("time", *others).to_numpy()[:instants].reshape(instants, -1), np.float64
    )
