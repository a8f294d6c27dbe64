"""The report of a segment-disturbance store: its table, and its most telling cases recomputed in full."""

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from rich.table import Table

from wavequake.campaign.store.store import read_manifest
from wavequake.kernels.device.devices import choose_device
from wavequake.kernels.device.tiles import from_tiles
from wavequake.mechanics.disturbances.folded import folded_lines
from wavequake.mechanics.disturbances.registry import analytic_rms
from wavequake.optics.segments.figures import figure_terms, glass_triangles
from wavequake.optics.segments.layout import is_monolithic
from wavequake.optics.segments.prepared import trace_states
from wavequake.report.certificate import ERRORS, certificate
from wavequake.report.histories import what_is_kept
from wavequake.report.populations import Population, is_whole, populations, representatives
from wavequake.report.segments.detail import Bent, Detail
from wavequake.report.segments.fields import base_name, by_field, of_population, place_names
from wavequake.report.segments.vignetting import stopped_light
from wavequake.report.table import terminal_table
from wavequake.workflows.segments.bench import MAS_PER_RAD, Bench, bench_at, bench_of
from wavequake.workflows.segments.disturbance import draw
from wavequake.workflows.segments.launches import surface_states

if TYPE_CHECKING:
    from wavequake.report.page import Page

_NEAR = "They are drawn near the limit: how often it is exceeded says wavequake rare."


def table_of(store: Path, dataset: xr.Dataset) -> Table:
    """Return the table of a store for the terminal."""
    dataset = by_field(dataset)
    table = terminal_table(_populations(store, dataset))
    table.caption = "\n\n".join(
        [
            *filter(None, [stopped_light(store, dataset)]),
            f"{table.caption}{what_is_kept(dataset)}",
            *certificate(*_modal(store, dataset)),
        ]
    )
    return table


def page_of(store: Path, dataset: xr.Dataset, device: str) -> "Page":
    """Return the HTML report.

    The worst case of every disturbance is recomputed in full for the maps, where the store is whole; its
    numbers are those of the store, bit for bit, if the device that computed them is at hand.
    """
    from wavequake.report import uncertain  # what draws is slow to load
    from wavequake.report.answers import budget
    from wavequake.report.reduced_models import model_results, verdict
    from wavequake.report.reduced_models import pictures as model_pictures
    from wavequake.report.segments import page

    study = read_manifest(store).study
    places, record = place_names(dataset), bench_of(study).study
    compared = record.reduction
    models = model_results(dataset, compared.variants) if compared is not None else []
    largest = compared.largest if compared is not None else 0.0
    dataset = by_field(dataset)
    found = _populations(store, dataset)
    details = [
        replace(
            detail(
                *(study, worst, device, of_population(dataset, name)),
                place=next(k for k, words in enumerate(places) if name.endswith(words)),
            ),
            disturbance=name,
        )
        for name, (_, worst) in (representatives(found).items() if is_whole(dataset) else ())
    ]
    quantities = {"WFE on glass": "wfe_raw", "line of sight": "los"}
    parts = uncertain.parted_results(
        (one.name, {words: getattr(one, key)[:, None] for words, key in quantities.items()}, one.sets)
        for one in found
        if record.structure is not None
    )
    modal = _modal(store, dataset)
    near = "log_weight" in dataset.variables
    said = (
        verdict(models, largest),
        uncertain.sentence(parts),
        stopped_light(store, dataset),
        *certificate(*modal),
        _NEAR if near else "",
    )
    words = " ".join(one.strip() for one in said if one)
    more = [
        *page.error_pictures(modal[1]),
        *model_pictures(models, largest),
        *uncertain.pictures(parts),
        *budget.pictures(store),
    ]
    return page.page_of(found, dataset, details, more, words)


def _modal(store: Path, dataset: xr.Dataset) -> tuple[float, xr.Dataset]:
    """Return the tolerance of the modal model, and what a store has of its errors, in memory."""
    names = ["status", "traced", *(f"modal_error_{name}" for name in ERRORS)]
    found = dataset[[name for name in names if name in dataset]].load()
    return bench_of(read_manifest(store).study).study.optics.modal_tolerance_nm, found


def detail(study_text: str, case: int, device_name: str, dataset: xr.Dataset, place: int = 0) -> Detail:
    """Recompute one case of a store with the OPD of every ray, for its maps, at one of its places."""
    bench = bench_at(study_text, place)
    drawn = draw(bench, case)
    instants = len(drawn.time)
    states = surface_states(bench, drawn, 0, instants)
    traced = trace_states(bench.prepared, states, choose_device(device_name))
    opd, x, y = (from_tiles(values)[:instants] for values in (traced.opd, traced.x, traced.y))
    to_mas = MAS_PER_RAD / bench.first_order.focal_length
    segments, rays = bench.system.segments, bench.prepared.rays
    images = "exposure" in dataset
    return Detail(
        case=case,
        disturbance=drawn.population.name,
        segment_names=segments.names,
        corners=segments.corners,
        centers=segments.centers[:, :2],
        time_s=drawn.time,
        segment_motion=drawn.motion.segment_motion,
        ray_x=rays.x,
        ray_y=rays.y,
        ray_segment=rays.segment,
        opd=opd * 1e6,
        spot=(np.stack([x, y], axis=-1) - bench.static.chief[0]) * to_mas,
        airy_mas=1.22 * bench.prepared.wavelength / (2.0 * bench.system.annulus.outer) * MAS_PER_RAD,
        image=dataset["exposure"].sel(case=[case]).to_numpy()[0] if images else np.zeros((0, 0)),
        image_x=dataset["x"].to_numpy() if images else np.zeros(0),
        image_y=dataset["y"].to_numpy() if images else np.zeros(0),
        bent=_bent(bench, drawn.motion.segment_figure, instants),
        folded=folded_lines(bench.study.disturbance, drawn.population.name, bench.study.store.every),
    )


def _bent(bench: Bench, figure: NDArray[np.float64], instants: int) -> Bent | None:
    """Return how figures (T, S, J) or (S, J), m, bend the glass; None where there are none."""
    if not figure.any() or is_monolithic(bench.system.segments):
        return None
    points, faces, segment = glass_triangles(bench.system, 2)
    terms = figure_terms(bench.system, segment, points, figure.shape[-1])
    over_time = np.broadcast_to(figure, (instants, *figure.shape[-2:]))
    heights = [1e9 * np.einsum("vj,vj->v", one[segment], terms) for one in over_time]
    return Bent(points, faces, np.stack(heights))


def _populations(store: Path, dataset: xr.Dataset) -> tuple[Population, ...]:
    """Return the populations of a store, with the rms that their disturbances imply by their parameters."""
    bench = bench_of(read_manifest(store).study)
    known = {entry.name: analytic_rms(entry, bench.layout) for entry in bench.study.disturbance}
    names = map(str, dict.fromkeys(dataset["disturbance"].to_numpy().tolist()))
    models = {name: model for name in names if (model := known.get(base_name(name)))}
    return populations(dataset, models)
