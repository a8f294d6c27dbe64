"""The report of a segment-mor store: variants of a segment's model, judged by the whole telescope."""

from collections.abc import Iterable
from pathlib import Path

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from rich.table import Table
from threadpoolctl import threadpool_limits

from wavequake.campaign.store.store import read_manifest
from wavequake.kernels.device.devices import choose_device
from wavequake.report.figures import opd_map, segment_map
from wavequake.report.histories import has_all_instants, what_is_kept
from wavequake.report.mirrors import figures as draw
from wavequake.report.mirrors import report as mirrors
from wavequake.report.mirrors.variants import ModelResult, VariantResult, representatives
from wavequake.report.page import Page, Picture, Section, picture
from wavequake.report.populations import left_out
from wavequake.report.segments.detail import Detail
from wavequake.workflows.kinds import study_of
from wavequake.workflows.mirrors.segment_body import variant_of
from wavequake.workflows.segments.bench import MAS_PER_RAD, MM_PER_M, Bench
from wavequake.workflows.segments.mor import SHAKEN, at_rest, launches
from wavequake.workflows.segments.mor_bench import chosen_segments, model_of, motions

Array = NDArray[np.float64]

_SMALL_PRINT = (
    "ε: largest relative error of a segment's transfer matrix over frequency, in small print over the lower "
    "third of the band; opt: of its Zernike coefficients. WFE: largest error of the telescope's wavefront "
    "over time as a share of the reference's largest value; LOS: largest error; image: L2 norm of the "
    "difference of unit-energy exposures; each for the worst of the excitations that decide."
)
_DEFINITIONS = [
    ("ε mech", "‖H - H_ref‖ / ‖H_ref‖ of the receptance at the supports (Störkle 2018, Eq. 2.10)."),
    ("ε opt", "The same of the Zernike coefficients of the segment's surface, its piston and tilt included."),
    ("WFE", "Rms over the rays on glass of the telescope's wavefront relative to rest, plane removed."),
    ("LOS", "Direction of the best-fit plane in the image, Eq. 3.39."),
    ("f max", "Largest eigenfrequency of the reduced model: an integrator's step would have to follow it."),
    ("one, all", "Whether one segment of the telescope is shaken, or all of them."),
    ("full", "The rich intermediate model from which the variants are made; spot_error says how good it is."),
]


def table_of(store: Path, dataset: xr.Dataset) -> Table:
    """Return the table of a store for the terminal."""
    return mirrors.table_of(store, dataset)


def page_of(store: Path, dataset: xr.Dataset, device: str) -> Page:
    """Return the HTML report.

    The wavefront of the reference at its worst instant is recomputed for the maps, and that of the variant
    that is recommended, less the reference's.
    """
    models, criterion = mirrors.results_of(dataset)
    study = read_manifest(store).study
    return Page(
        answer=mirrors.answer(models, criterion),
        table=[
            {"shaken": (model.name, ""), **mirrors.row_of(one, criterion)}
            for model in models
            for one in model.variants
        ],
        small_print=_SMALL_PRINT + what_is_kept(dataset),
        overview=[
            picture(
                "order",
                "Error of all variants over their order",
                draw.errors_over_order(models, criterion),
                "Left is cheaper, lower is better: the first variant below the dashed bound is small enough.",
            )
        ],
        sections=[
            Section("segment model", list(_segment_figures(dataset, models))),
            *(
                Section(model.name, list(_telescope_figures(dataset, model, study, device)))
                for model in models
            ),
        ],
        definitions=_DEFINITIONS,
        kind="variant",
        left_out=left_out(dataset, ["model", "variant"]),
    )


def _segment_figures(dataset: xr.Dataset, models: list[ModelResult]) -> Iterable[Picture]:
    """Draw what one segment's model is worth, which does not depend on how many segments are shaken."""
    model = next((model for model in models if model.variants), None)
    if model is None:
        return
    shown = representatives(model)
    responses = "receptance at the supports", "response of the segment's surface"
    yield from mirrors.over_frequency(dataset, "segment", shown, model.reference, *responses)
    yield picture(
        "segment-fmax",
        "Largest pseudo-eigenfrequencies",
        draw.pseudo_frequencies(shown),
        "The highest frequency sets the time step of explicit simulations: lower is faster.",
    )


def _telescope_figures(
    dataset: xr.Dataset, model: ModelResult, study_text: str, device: str
) -> Iterable[Picture]:
    if model.reference is None:
        return
    name, reference = model.name.replace(" ", "-"), model.reference
    if has_all_instants(dataset):
        truth = detail(dataset, reference, study_text, device)
        yield picture(
            f"{name}-segments",
            "Motion of the segments at the worst instant",
            segment_map(truth),
            "Red segments are nearer to the light, blue ones further. Pointing at one tells its name and "
            "value.",
        )
        yield picture(
            f"{name}-wavefront",
            "Wavefront of the telescope at the worst instant",
            opd_map(truth),
            "What the moving segments do to the light at that instant.",
        )
    if not model.variants:
        return
    if has_all_instants(dataset):
        one = model.enough or min(model.variants, key=lambda found: float(found.errors["wfe"].max()))
        off = detail(dataset, reference, study_text, device, one)
        yield picture(
            f"{name}-off",
            f"Wavefront of {one.variant} less that of the reference",
            opd_map(off),
            "What the reduction alone does wrong; compare its scale with that of the wavefront.",
        )
    yield from mirrors.excitation_pictures(dataset, name, model, reference)


def detail(
    dataset: xr.Dataset,
    reference: VariantResult,
    study_text: str,
    device_name: str,
    less: VariantResult | None = None,
) -> Detail:
    """Recompute the reference's worst instant with the OPD of every ray, for the maps.

    With `less`, motions and wavefront are those of that variant less those of the reference.
    """
    study, model = study_of(study_text), model_of(study_text)
    case = dataset.sel(case=reference.case)
    errors = case["wfe_rms"].to_numpy()
    excitation, instant = np.unravel_index(int(np.argmax(errors)), errors.shape)
    shaken = {long: short for short, long in SHAKEN.items()}[str(case["model"].to_numpy())]
    which = chosen_segments(study, model.bench, shaken)
    bench, parts = model.bench, []
    alone = study.model_copy(update={"excitation": study.excitation[excitation : excitation + 1]})
    with threadpool_limits(1):
        for variant in [model.reference, *([variant_of(model, less.variant)] if less else [])]:
            moved = motions(alone, model, variant, which.tolist())[0, instant]
            (launched,) = launches(bench, which, moved[None], choose_device(device_name))
            spot = np.stack([launched[2].x[0, :, 0], launched[2].y[0, :, 0]], axis=1)
            opd = launched[2].opd[0] - at_rest(bench.text, device_name)
            parts.append((moved, opd[:, 0], spot - bench.static.chief[0]))
    moved, opd, spot = parts[0] if less is None else (two - one for one, two in zip(*parts, strict=True))
    return _detail(case, bench, which, moved, opd, spot, float(dataset["time"][instant]), str(excitation))


def _detail(
    case: xr.Dataset,
    bench: Bench,
    which: NDArray[np.int64],
    moved: Array,
    opd: Array,
    spot: Array,
    time: float,
    excitation: str,
) -> Detail:
    segments, rays = bench.system.segments, bench.prepared.rays
    motion = np.zeros((1, len(segments), 6))
    motion[0, which] = moved[:, :6] / [MM_PER_M, MM_PER_M, MM_PER_M, 1.0, 1.0, 1.0]
    return Detail(
        case=int(case["case"]),
        disturbance=excitation,
        segment_names=segments.names,
        corners=segments.corners,
        centers=segments.centers[:, :2],
        time_s=np.array([time]),
        segment_motion=motion,
        ray_x=rays.x,
        ray_y=rays.y,
        ray_segment=rays.segment,
        opd=opd[None] * 1e6,
        spot=spot[None] * MAS_PER_RAD / bench.first_order.focal_length,
        airy_mas=1.22 * bench.prepared.wavelength / (2.0 * bench.system.annulus.outer) * MAS_PER_RAD,
        image=np.zeros((0, 0)),  # nothing here shows it
        image_x=np.zeros(0),
        image_y=np.zeros(0),
    )
