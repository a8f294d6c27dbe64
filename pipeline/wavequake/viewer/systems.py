"""Surfaces of an optical system that shift and turn, with what the store says of the light."""

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
import xarray as xr
from threadpoolctl import threadpool_limits

from wavequake.campaign.store.store import Manifest
from wavequake.drawing.solid import system_scene
from wavequake.mechanics.assembly.answers import watching
from wavequake.mechanics.disturbances.motion import Motion
from wavequake.optics.polynomials.zernike import annular_zernike
from wavequake.optics.shapes.shapes import ZernikeDeformation
from wavequake.optics.systems.system import States
from wavequake.viewer.chosen import worst_cases
from wavequake.viewer.film import Array, Stage, Take, principal, stage_of
from wavequake.viewer.structure import members_of, nodes_of, with_members
from wavequake.workflows.mirrors.study import FULL
from wavequake.workflows.systems.bench import MM_PER_M, SystemBench, system_bench, system_states
from wavequake.workflows.systems.draws import drawn_with
from wavequake.workflows.systems.variants import slot_of

_MOST_INSTANTS = 400
_EXACT = 2e-5
_SERIES = (("change of the wavefront error", "wfe_change"), ("line of sight", "los_mm"))


def film_of(
    dataset: xr.Dataset, manifest: Manifest, chosen: Sequence[int], tell: Callable[[str], None]
) -> tuple[tuple[Stage, ...], tuple[Take, ...]]:
    """Return the system, and the chosen cases or those that change the wavefront most."""
    bench = system_bench(manifest.study)
    stage, surfaces = stage_of_system(bench)
    plant = bench.plants.get(FULL)
    members = members_of(bench.study, plant) if plant else []
    nodes = nodes_of(members)
    stage = with_members(stage, plant, members, nodes) if plant and members else stage
    takes = []
    with threadpool_limits(1):
        for case in list(chosen) or _worst(dataset):
            takes.append(_take(bench, dataset, case, stage, surfaces, nodes))
            tell(takes[-1].label)
    return (stage,), tuple(takes)


def _worst(dataset: xr.Dataset) -> list[int]:
    """Return the case of each disturbance whose wavefront changes most."""
    change = dataset["wfe_change"] if "wfe_change" in dataset else dataset["wfe_rms"]
    return worst_cases(dataset, change.max([dim for dim in change.dims if dim != "case"]).to_numpy())


def stage_of_system(bench: SystemBench) -> tuple[Stage, list[int]]:
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


def figures_of(bench: SystemBench, states: States, stage: Stage, surfaces: list[int]) -> tuple[Array, Array]:
    """Return shapes (r, V, 3) and weights (T, r) by which surfaces deform, m.

    The fewest shapes that give the Noll terms' heights to 2e-5 of the largest; heights on grids are left out.
    """
    count = len(states.surface_motion)
    moved = np.zeros((count, len(stage.points), 3))
    for body, index in enumerate(surfaces):
        surface, given = bench.system.surfaces[index], states.deformations[index]
        if given is None or not isinstance(surface.deformation, ZernikeDeformation):
            continue
        form, mine = surface.deformation, stage.body == body
        x, y = ((stage.points[mine] * MM_PER_M - surface.position) @ surface.rotation)[:, :2].T
        size = np.maximum(form.pupil_radius, np.hypot(x, y))  # beyond the rim, what is at the rim
        basis = annular_zernike(x / size, y / size, form.terms, form.obscuration)
        heights = given[:, : form.terms] @ basis.T / MM_PER_M
        moved[:, mine] = heights[..., None] * surface.rotation[:, 2]
    return principal(moved, _EXACT)


def _take(
    bench: SystemBench,
    dataset: xr.Dataset,
    case: int,
    stage: Stage,
    surfaces: list[int],
    nodes: Sequence[str] = (),
) -> Take:
    population, realization, model = slot_of(bench.study, case)
    watched = partial(watching, nodes={name: name for name in nodes})
    drawn = drawn_with(bench, population, realization, model, watched=watched)
    label = f"{population.name}, case {case}" + (f", {model}" if bench.study.reduction else "")
    return take_of(bench, dataset.sel(case=case), drawn, label, stage, surfaces, nodes)


def take_of(
    bench: SystemBench,
    stored: xr.Dataset,
    drawn: Motion,
    label: str,
    stage: Stage,
    surfaces: list[int],
    nodes: Sequence[str] = (),
    of: str = "",
) -> Take:
    """Return a stored case that moves as drawn, with what its store says of the light."""
    states = system_states(bench, drawn)
    motion = states.surface_motion[:, surfaces].copy()
    motion[..., :3] /= MM_PER_M
    still = np.zeros((len(motion), 6))
    motion = np.concatenate([motion, *(drawn.rigid.get(name, still)[:, None] for name in nodes)], axis=1)
    step = -(-len(motion) // _MOST_INSTANTS)
    time = np.asarray(stored["time_s"].to_numpy(), dtype=np.float64)
    shapes, weights = figures_of(bench, states, stage, surfaces)
    quiet = not motion.any()
    notes = ["No surface moves in this case: the light turns."] if quiet and not weights.any() else []
    notes += (
        ["No surface moves as a body in this case: what deforms is drawn."] if quiet and not notes else []
    )
    notes += ["Of the image the first field point is shown."]
    return Take(
        label,
        time[: len(motion) : step],
        note=" ".join(notes),
        poses=motion[::step],
        shapes=shapes if weights.any() else None,
        weights=weights[::step] if weights.any() else None,
        case=int(stored["case"]),
        series={
            words: (str(stored[name].attrs.get("units", "")), _history(stored[name], len(motion))[::step])
            for words, name in _SERIES
            if name in stored and "time" in stored[name].dims
        },
        of=of,
    )


def _history(values: xr.DataArray, instants: int) -> Array:
    """Return (time, k) of the first field point at the first wavelength."""
    first = values.isel({dim: 0 for dim in values.dims if dim in ("field", "wavelength")})
    others = [dim for dim in first.dims if dim != "time"]
    return np.asarray(
        first.transpose("time", *others).to_numpy()[:instants].reshape(instants, -1), np.float64
    )
