"""The workflow "segment-mor": reduced models of a segment, judged by the image of the whole telescope.

A case is one variant with one or with all segments shaken. The segment's response becomes the rigid motion
and the figure of segments at every instant; the telescope is ray traced, and its wavefront, line of sight and
image are compared with those of the reference variant (Störkle 2018, Figs. 4.39 and 4.46).
"""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from wavequake.campaign.contract import Fixed
from wavequake.campaign.measured import Block, CaseTable, one_by_one, study_kind
from wavequake.campaign.measures import Axis, Measure, stored
from wavequake.campaign.stopwatch import Stopwatch
from wavequake.chain.images.camera import frame_axes
from wavequake.errors import UserError
from wavequake.kernels.device.devices import Device, choose_device
from wavequake.kernels.device.tiles import TILE, padded
from wavequake.kernels.trace.train import Traced
from wavequake.mechanics.model import ReducedModel
from wavequake.optics.segments.prepared import PreparedTrace, chief_rays, trace_states
from wavequake.optics.segments.wavefront import analyse
from wavequake.optics.systems.kinematics import rest_states
from wavequake.optics.systems.system import States
from wavequake.optics.wavefronts.record import Wavefront
from wavequake.prepared import prepared
from wavequake.reduction.metrics import eps_mor, frobenius, pseudo_frequencies, receptance
from wavequake.reduction.names import parse
from wavequake.reduction.two_stage import check_variants
from wavequake.workflows.kinds import study_of
from wavequake.workflows.mirrors.compared_models import (
    checked_models,
    image_error,
    reduction_measures,
    stage_words,
    variant_labels,
)
from wavequake.workflows.mirrors.segment_body import NM_PER_MM, height_rows, variant_of
from wavequake.workflows.mirrors.study import FULL
from wavequake.workflows.segments.bench import Bench, bench_of
from wavequake.workflows.segments.images import summed_images
from wavequake.workflows.segments.mor_bench import (
    SegmentModel,
    chosen_segments,
    model_of,
    motions,
    spot_check,
    traced_instants,
)
from wavequake.workflows.segments.mor_study import SegmentMorStudy

Array = NDArray[np.float64]

# What a report calls the two kinds of cases.
SHAKEN = {"one": "one segment", "all": "all segments"}
# Tiles per launch: about 20 MB per output array at 18000 rays.
_LAUNCH_TILES = 8


def cases_of(study: SegmentMorStudy) -> list[tuple[str, str]]:
    """Return which segments are shaken ("one", "all") and the variant, of every case; references first."""
    return [(disturbed, variant) for disturbed in study.segments.disturbed for variant in study.compared]


def compute(study: SegmentMorStudy, table: CaseTable, device_name: str, clock: Stopwatch) -> Iterator[Block]:
    """Reduce, trace and judge variants; one that fails is quarantined with the reason."""
    text, each = study.identity_text(), cases_of(study)
    return one_by_one(table["case"], lambda case: judged(text, *each[case], device_name, clock))


def judged(
    study_text: str, disturbed: str, variant: str, device_name: str, clock: Stopwatch
) -> dict[str, Array | float]:
    """Return all stored numbers of one case."""
    study, model = study_of(study_text), model_of(study_text)
    with clock("reference"):
        truth = traced_reference(study_text, disturbed, device_name)
    if variant == study.reduction.reference:
        chosen, moved, seen = model.reference, truth[0], truth[1]
    else:
        with clock("response"):
            chosen = variant_of(model, variant)
            moved = motions(study, model, chosen, chosen_segments(study, model.bench, disturbed).tolist())
        with clock("light"):
            seen = traced(study, model.bench, disturbed, moved, choose_device(device_name))
    return {
        **_mechanical(study, model, chosen),
        "segment_piston_rms": np.sqrt(np.mean(moved[..., 2] ** 2, axis=2)) * NM_PER_MM,
        "segment_figure_rms": np.sqrt(np.mean(np.sum(moved[..., 6:] ** 2, axis=3), axis=2)) * NM_PER_MM,
        **{name: value for name, value in seen.items() if name != "opd"},
        "wfe_error": _apart(model.bench.prepared, seen["opd"], truth[1]["opd"], seen["wfe_rms"].shape[1]),
        "los_error": np.linalg.norm(seen["los_mm"] - truth[1]["los_mm"], axis=2),
        "image_error": image_error(seen["exposure"], truth[1]["exposure"]),
        "resolution_mm": resolution(model.bench),
    }


def resolution(bench: Bench) -> float:
    """Return lambda/D in the image, mm."""
    prepared = bench.prepared
    return abs(prepared.wavelength * prepared.focal_length / (2.0 * bench.system.annulus.outer))


def _mechanical(
    study: SegmentMorStudy, model: SegmentModel, variant: ReducedModel
) -> dict[str, Array | float]:
    """Return what one segment's model is worth by itself."""
    frequencies = study.reduction.hertz
    mechanical = receptance(variant, frequencies)
    optical = receptance(variant, frequencies, height_rows(model.fit, model.turn, variant))
    return {
        "order": float(variant.order),
        "reduce_seconds": variant.seconds,
        "pseudo_frequency_max": float(pseudo_frequencies(variant)[-1]),
        "frf_mech": frobenius(mechanical),
        "eps_mech": eps_mor(model.mechanical, mechanical),
        "frf_opt": frobenius(optical),
        "eps_opt": eps_mor(model.optical, optical),
    }


@prepared(maxsize=2)
def traced_reference(study_text: str, disturbed: str, device_name: str) -> tuple[Array, dict[str, Array]]:
    """Return motions and optical numbers of the reference, computed once per process."""
    study, model = study_of(study_text), model_of(study_text)
    which = chosen_segments(study, model.bench, disturbed).tolist()
    moved = motions(study, model, model.reference, which)
    return moved, traced(study, model.bench, disturbed, moved, choose_device(device_name))


def surface_states(bench: Bench, which: NDArray[np.int64], moved: Array) -> States:
    """Return motions (time, segment, 6 + J) of the segments `which` as states of the telescope.

    They are padded with rest to whole tiles.
    """
    states, count = rest_states(bench.prepared.system, padded(len(moved))), len(moved)
    states.segment_motion[:count, which] = moved[..., :6]
    states.segment_figure[:count, which] = moved[..., 6:]
    return states


def traced(
    study: SegmentMorStudy, bench: Bench, disturbed: str, moved: Array, device: Device
) -> dict[str, Array]:
    """Trace motions (excitation, time, segment, 6 + J); return what is seen, and the ``opd`` of every ray.

    ``opd`` (excitation, tile, ray, 16) is that beyond rest, in nm about its best-fit plane.

    Raises
    ------
    UserError
        If a ray is lost: there is no wavefront to compare then.
    """
    which = chosen_segments(study, bench, disturbed)
    parts = [_traced_history(bench, which, history, device) for history in moved]
    return {name: np.stack([part[name] for part in parts]) for name in parts[0]}


def _traced_history(
    bench: Bench, which: NDArray[np.int64], history: Array, device: Device
) -> dict[str, Array]:
    to_nm, still = bench.study.optics.wavelength_nm, at_rest(bench.text, device.name)
    pieces: dict[str, list[Array]] = {}
    exposure = np.zeros((bench.study.imaging.pixels,) * 2)
    for first, last, rays, wavefront in launches(bench, which, history, device):
        count = last - first
        here = slice(0, count)
        if wavefront.lost[here].any():
            raise UserError(
                f"{int(wavefront.lost[here].max())} rays are lost at an instant: the motion takes "
                "segments out of the beam; lower the amplitude of the excitations."
            )
        exposure += summed_images(bench, rays, wavefront, here)
        opd = flattened(bench.prepared, rays.opd - still)
        zernike = wavefront.zernike[here, 3:] - bench.static.zernike[0, 3:]
        for name, values in (
            ("wfe_rms", _rms(bench.prepared, opd)[here]),
            ("wfe_zernike", np.linalg.norm(zernike, axis=1) * to_nm),
            ("strehl", wavefront.strehl[here]),
            ("los_mm", wavefront.los[here] - bench.static.los[0]),
            ("opd", opd),
        ):
            pieces.setdefault(name, []).append(values)
    return {name: np.concatenate(values) for name, values in pieces.items()} | {
        "exposure": exposure / len(history)
    }


def launches(
    bench: Bench, which: NDArray[np.int64], history: Array, device: Device
) -> Iterator[tuple[int, int, Traced, Wavefront]]:
    """Trace a history (time, segment, 6 + J): first and last instant, rays and wavefront of every launch."""
    size = _LAUNCH_TILES * TILE
    for first in range(0, len(history), size):
        last = min(first + size, len(history))
        states = surface_states(bench, which, history[first:last])
        rays = trace_states(bench.prepared, states, device)
        yield first, last, rays, analyse(bench.prepared, rays, chief_rays(bench.prepared, states), device)


@prepared(maxsize=2)
def at_rest(bench_text: str, device_name: str) -> Array:
    """Return the path differences of the undisturbed telescope's rays, (ray, 1) in mm."""
    bench = bench_of(bench_text)
    nothing = np.zeros((TILE, 0, 6 + bench.figure_terms))
    _, _, rays, _ = next(launches(bench, np.arange(0), nothing, choose_device(device_name)))
    return rays.opd[0, :, :1].copy()


def _rms(prepared: PreparedTrace, flat: Array) -> Array:
    """Return the rms over the rays of wavefronts (tile, ray, 16), over the instants."""
    rms: Array = np.sqrt(np.einsum("n,tnl->tl", prepared.weight, flat**2)).ravel()
    return rms


def flattened(prepared: PreparedTrace, opd: Array) -> Array:
    """Return path differences (tile, ray, 16) in nm without their best-fit plane."""
    plane = prepared.plane
    flat = np.stack([values - plane.basis @ (plane.matrix @ values) for values in opd])
    return np.asarray(flat * NM_PER_MM)


def _apart(prepared: PreparedTrace, opd: Array, reference: Array, instants: int) -> Array:
    """Return the rms over the rays of the differences of wavefronts, (excitation, time), nm."""
    return np.stack([_rms(prepared, part)[:instants] for part in opd - reference])


def case_labels(study: SegmentMorStudy, ids: NDArray[np.int64]) -> CaseTable:
    """Return the labels of cases: what is shaken, variant, method and seed.

    The first is called ``model``, as in ``mirror-mor``: variants are compared within it.
    """
    rows = [cases_of(study)[one] for one in ids]
    methods = [FULL if variant == FULL else parse(variant).method for _, variant in rows]
    named = [(SHAKEN[disturbed], variant) for disturbed, variant in rows]
    return variant_labels(named, methods, study.study.seed)


def axes(study: SegmentMorStudy) -> dict[str, Axis]:
    """Return the dimensions of the measures."""
    return {
        "frequency": Axis(study.reduction.hertz, "frequency", "Hz"),
        "time": Axis(study.time.seconds[traced_instants(study)], "time of the traced instants", "s"),
        "excitation": Axis([excitation.name for excitation in study.excitation], "excitation"),
        "axis": Axis(["x", "y"], "axis of the image plane"),
        **frame_axes(study.imaging.pixels, study.imaging.sampling),
    }


def fixed(study: SegmentMorStudy) -> dict[str, Fixed]:
    """Return what a store of a study holds beside its measures."""
    return checked_models(["segment"], [spot_check(study.identity_text())])


def measures(study: SegmentMorStudy) -> Iterator[Measure]:
    """Yield the measures of a case."""
    history, spectrum = ("excitation", "time"), ("frequency",)
    yield from reduction_measures("supports")
    words = "Frobenius norm of the response of the segment's Zernike coefficients, piston and tilt too"
    yield stored("frf_opt", "nm/N", words, spectrum)
    words = "relative error of the response of the segment's Zernike coefficients"
    yield stored("eps_opt", "1", words, spectrum)
    words = "rms over the rays on glass of the wavefront relative to rest, best-fit plane removed"
    yield stored("wfe_rms", "nm", words, history)
    words = "rms over the rays on glass of the difference from the reference's, best-fit plane removed"
    yield stored("wfe_error", "nm", words, history)
    words = "root of the sum of squares of the annular Zernikes j >= 4, relative to rest"
    yield stored("wfe_zernike", "nm", words, history)
    yield stored("strehl", "1", "Strehl ratio in the direction of the best-fit plane", history)
    words = "line of sight relative to rest, in the image (Störkle 2018, Eq. 3.39)"
    yield stored("los_mm", "mm", words, (*history, "axis"))
    words = "rms over the shaken segments of the rigid displacement along their normals"
    yield stored("segment_piston_rms", "nm", words, history)
    words = "rms over the shaken segments of the root of the sum of squares of their figure's coefficients"
    yield stored("segment_figure_rms", "nm", words, history)


def describe(study: SegmentMorStudy) -> dict[str, str]:
    """Return the segment's model and how well its intermediate basis stands for it, for the plan."""
    model = model_of(study.identity_text())
    system = model.bench.system
    return {
        "segment": stage_words(model.stage, *spot_check(study.identity_text())),
        "rays": f"{len(model.bench.prepared.weight)} on {len(system.segments)} segments of {system.name}",
    }


def check(study: SegmentMorStudy) -> None:
    """Raise UserError where telescope, segment, variants or excitations do not fit."""
    model = model_of(study.identity_text())
    check_variants(model.stage, study.reduction.variants)
    firsts = {int(chosen_segments(study, model.bench, one)[0]) for one in study.segments.disturbed}
    motions(study, model, model.reference, sorted(firsts))


KIND = study_kind(
    "segment-mor",
    SegmentMorStudy,
    cases=case_labels,
    compute=compute,
    measures=measures,
    axes=axes,
    fixed=fixed,
    describe=describe,
    check=check,
)
