"""The workflow "mirror-trace": every instant traced, or sensitivities times modal coordinates.

A case is one reduced model of one mirror. For each excitation the standard method fits the displaced nodes of
every instant (`wavequake.optics.shapes.motion_fit`) and traces all rays; the modal method adds up what each
mode does to the light (Störkle 2018, Sections 4.1 and 4.5.2). A third way, the linear fit traced, tells where
the two part: in the sag that is taken at the displaced x and y, or in the optics. Where the polynomials of
the fit miss much of the deformation, both methods add what they leave, as a grid (Eq. 4.11).
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from wavequake.campaign.measured import Block, CaseTable, one_by_one, study_kind
from wavequake.campaign.measures import Axis, Measure, stored
from wavequake.campaign.stopwatch import Stopwatch
from wavequake.kernels.device.devices import Device, choose_device
from wavequake.mechanics.vibration.modal import modal_model
from wavequake.mechanics.vibration.response import Response, respond
from wavequake.optics.shapes.fit import apply
from wavequake.optics.shapes.motion_fit import MotionFit, figures, motion_fit
from wavequake.optics.wavefronts.fits import fit_instants
from wavequake.optics.wavefronts.wavefront import PreparedSystem, line_of_sight, trace_light
from wavequake.reduction.metrics import pseudo_frequencies
from wavequake.words import counted
from wavequake.workflows.mirrors.base import driven
from wavequake.workflows.mirrors.bench import (
    Bench,
    bench_of,
    case_labels,
    cases_of,
    check_variants_of,
    drive_at,
    import_notices,
    import_record,
    variant_of,
)
from wavequake.workflows.mirrors.compared_models import variant_measures, wavefront_rms
from wavequake.workflows.mirrors.model_store import shown_name
from wavequake.workflows.mirrors.optics import NM_PER_MM, Optics, displacements_mm, with_deformation
from wavequake.workflows.mirrors.residual import (
    Residual,
    coordinates_of,
    deformed_light,
    grid_of,
    left_by,
    missed_over_time,
    residual_of,
    rms_of,
)
from wavequake.workflows.mirrors.study import TraceStudy

Array = NDArray[np.float64]

# Like the rows of Table 4.1: what is done once per model or variant, and per excitation by either method.
SET_UP = ("sensitivities", "reduction", "fits of coordinates", "residual of modes", "modal form")
STANDARD = ("surface fit", "residual grids", "ray trace", "wavefront fit")
MODAL = ("maps of modes", "products")
# Instants that are traced at a time.
_INSTANTS = 1024
STAGES = (*SET_UP, "time response", *STANDARD, *MODAL)


@dataclass(frozen=True)
class Wavefronts:
    """What either method gives at T instants.

    Attributes
    ----------
    aberrations : ndarray, shape (T, 2 + J)
        Line of sight in mm, Noll coefficients in nm.
    rms_raw : ndarray, shape (T,)
        Rms of the wavefront over the rays less its plane, which the coefficients need not catch, nm. Of
        it the modal method knows what coefficients and residual grids make.
    """

    aberrations: Array
    rms_raw: Array


def compute(study: TraceStudy, table: CaseTable, device_name: str, clock: Stopwatch) -> Iterator[Block]:
    """Compute variants by both methods; one that does not suit the model is quarantined."""
    text, device, variants = study.identity_text(), choose_device(device_name), cases_of(study)

    def of_case(case: int) -> dict[str, Array | float]:
        name, variant = variants[case]
        return judged(study, bench_of(text, name), variant, device)

    return one_by_one(table["case"], of_case)


def judged(study: TraceStudy, bench: Bench, variant: str, device: Device) -> dict[str, Array | float]:
    """Return all stored numbers of one variant."""
    reduced, optics, instants = variant_of(bench, variant), bench.optics, study.time.seconds
    left, residual, set_up = left_by(optics, reduced), None, Stopwatch()
    with set_up("fits of coordinates"):
        motion = motion_fit(optics.surface, displacements_mm(reduced.surface.T))
    rows: dict[str, list[Array]] = {}
    for excitation in study.excitation:
        clock = Stopwatch()
        drive = drive_at(excitation, reduced, study)
        held, drive = driven(reduced, drive, excitation.name)
        with clock("modal form"):
            modal = modal_model(held, drive.prescribed)
        with clock("time response"):
            response = respond(modal, [drive], instants)
        with clock("surface fit"):
            coordinates = coordinates_of(response)
        share = left.share(coordinates)
        needed = share > study.optics.residual_limit
        if needed and residual is None:
            with set_up("residual of modes"):
                residual = residual_of(optics, left, device)
        added = residual if needed else None
        summed = modal_method(optics, reduced.surface, response, clock, added)
        found = compared(optics, motion, coordinates, summed.aberrations, device, clock, added)
        found["fit_residual"] = missed_over_time(motion, coordinates)
        found["wfe_rms_raw_modal"] = summed.rms_raw
        untraced = np.zeros(len(instants))
        found["wfe_rms_residual"] = untraced if added is None else rms_of(added.whole, coordinates)
        found["missed_share"] = np.array(share)
        clock.seconds |= {"sensitivities": optics.seconds, "reduction": reduced.seconds}
        clock.seconds |= {key: value for key, value in set_up.seconds.items() if needed or "fits" in key}
        found["seconds"] = np.array([clock.seconds.get(stage, 0.0) for stage in STAGES])
        for key, value in found.items():
            rows.setdefault(key, []).append(value)
    return {
        "order": float(reduced.order),
        "pseudo_frequency_max": float(pseudo_frequencies(reduced)[-1]),
        "resolution_mm": optics.resolution,
        **{key: np.array(values) for key, values in rows.items()},
    }


def _parts(count: int) -> list[slice]:
    """Return parts of so many instants that all their rays and grids fit the memory."""
    return [slice(first, first + _INSTANTS) for first in range(0, count, _INSTANTS)]


def compared(
    optics: Optics,
    motion: MotionFit,
    coordinates: Array,
    summed: Array,
    device: Device,
    clock: Stopwatch,
    residual: Residual | None = None,
) -> dict[str, Array]:
    """Trace all instants and compare them with what the modal method gives, `summed` (T, 2 + J)."""
    traced = standard_method(optics, motion, coordinates, device, clock, residual)
    linear = trace_figures(optics, coordinates @ motion.linear, coordinates, device, Stopwatch(), residual)
    apart = traced.aberrations - summed
    return {
        "wfe_rms_standard": wavefront_rms(traced.aberrations),
        "wfe_rms_modal": wavefront_rms(summed),
        "wfe_rms_raw": traced.rms_raw,
        "wfe_difference": wavefront_rms(apart),
        "wfe_difference_sag": wavefront_rms(traced.aberrations - linear.aberrations),
        "wfe_difference_optics": wavefront_rms(linear.aberrations - summed),
        "los_standard": traced.aberrations[:, :2],
        "los_modal": summed[:, :2],
        "los_difference": np.linalg.norm(apart[:, :2], axis=1),
    }


def standard_method(
    optics: Optics,
    motion: MotionFit,
    coordinates: Array,
    device: Device,
    clock: Stopwatch,
    residual: Residual | None = None,
) -> Wavefronts:
    """Return what tracing all rays at every instant gives.

    The figure of each instant is fitted to the displaced nodes with the undeformed surface taken where they
    are (DeformOnlyTrafo, Störkle 2018, Eq. 4.7 to 4.10).

    Parameters
    ----------
    optics : Optics
    motion : MotionFit
        Of the reduced model's coordinates.
    coordinates : ndarray, shape (T, r)
    device : Device
    clock : Stopwatch
    residual : Residual, optional
        What the polynomials leave, to be traced with them.
    """
    with clock("surface fit"):
        fitted = figures(motion, coordinates)
    return trace_figures(optics, fitted, coordinates, device, clock, residual)


def trace_figures(
    optics: Optics,
    fitted: Array,
    coordinates: Array,
    device: Device,
    clock: Stopwatch,
    residual: Residual | None = None,
) -> Wavefronts:
    """Trace all rays at T instants with the figures (T, J) and what they leave, mm."""
    prepared = optics.prepared if residual is None else with_deformation(optics, grid_of(optics))
    parts = []
    for part in _parts(len(fitted)):
        with clock("residual grids"):
            splines = None if residual is None else residual.at(coordinates[part])
        with clock("ray trace"):
            light = deformed_light(optics, fitted[part], splines)
            opd, _, chief = trace_light(prepared, light, device)
        parts.append(_wavefronts(prepared, opd, chief, device, clock))
    return Wavefronts(*(np.concatenate(values) for values in zip(*parts, strict=True)))


def _wavefronts(
    prepared: PreparedSystem, opd: Array, chief: Array, device: Device, clock: Stopwatch
) -> tuple[Array, Array]:
    """Return aberrations and raw rms of `Wavefronts` from traced rays."""
    with clock("wavefront fit"):
        zernike = fit_instants(prepared.fit, opd, device)
        to_nm = prepared.wavelength * NM_PER_MM
        aberrations = np.hstack([line_of_sight(prepared, chief, zernike), to_nm * zernike])
    flat = opd - zernike[:, :3] @ prepared.fit.basis[:, :3].T
    weight = prepared.fit.weight
    raw = to_nm * np.sqrt(np.square(flat) @ (weight / weight.sum()))
    return aberrations, raw


def modal_method(
    optics: Optics, surface: Array, response: Response, clock: Stopwatch, residual: Residual | None = None
) -> Wavefronts:
    """Return sensitivities of modes times their coordinates.

    What the modes do to the light follows from their linear fits (Störkle 2018, Eq. 4.22) and from the traces
    of what these leave; time enters products of small matrices only.
    """
    with clock("maps of modes"):
        shapes = np.hstack([response.modes, response.rigid_modes, response.lift])
        maps = optics.sensitivity @ apply(optics.surface, displacements_mm((surface @ shapes).T)).T
        rough = np.zeros((shapes.shape[1], shapes.shape[1]))
        if residual is not None:
            maps += residual.aberrations @ shapes
            rough = shapes.T @ residual.rough @ shapes
    with clock("products"):
        amplitudes = np.hstack([response.coordinates[0], response.rigid[0], response.drive[0]])
        aberrations: Array = amplitudes @ maps.T
        fitted = rms_of(optics.prepared.fit.normal[3:, 3:], aberrations[:, 5:])
        raw = np.hypot(fitted, rms_of(rough, amplitudes))
    return Wavefronts(aberrations, raw)


def measures(study: TraceStudy) -> Iterator[Measure]:
    """Yield the measures of a variant."""
    history = ("excitation", "time")
    yield from variant_measures()
    words = "wavefront error rms of the fitted Zernikes j >= 4, every ray traced"
    yield stored("wfe_rms_standard", "nm", words, history)
    yield stored("wfe_rms_modal", "nm", "the same by sensitivities of modes", history)
    words = "wavefront error rms over the traced rays, best-fit plane removed"
    yield stored("wfe_rms_raw", "nm", words, history)
    words = "the same by sensitivities of modes and of what their fit leaves"
    yield stored("wfe_rms_raw_modal", "nm", words, history)
    words = "rms of what the residual grid adds to the wavefront; 0 where none is traced"
    yield stored("wfe_rms_residual", "nm", words, history)
    words = "largest deformation that the Zernikes miss over the largest one (Störkle 2018, Eq. 4.11)"
    yield stored("missed_share", "1", words, ("excitation",))
    yield stored("wfe_difference", "nm", "rms of the difference of the two wavefronts, j >= 4", history)
    yield stored("wfe_difference_sag", "nm", "its part from the sag at displaced x and y", history)
    yield stored("wfe_difference_optics", "nm", "its part from the optics beyond first order", history)
    words = "share of the deformation that the Zernikes miss (Störkle 2018, Eq. 4.11)"
    yield stored("fit_residual", "1", words, history)
    for name, way in (
        ("standard", "in the image, every ray traced"),
        ("modal", "by sensitivities of modes"),
    ):
        words = f"line of sight {way} (Störkle 2018, Eq. 3.39)"
        yield stored(f"los_{name}", "mm", words, (*history, "axis"))
    yield stored("los_difference", "mm", "distance of the two lines of sight", history)
    words = "time that each stage took in one process"
    yield stored("seconds", "s", words, ("excitation", "stage"), measured=True)


def axes(study: TraceStudy) -> dict[str, Axis]:
    """Return the dimensions of the measures."""
    return {
        "time": Axis(study.time.seconds, "time", "s"),
        "excitation": Axis([excitation.name for excitation in study.excitation], "excitation"),
        "axis": Axis(["x", "y"], "axis of the image plane"),
        "stage": Axis(STAGES, "stage of the computation"),
    }


def describe(study: TraceStudy) -> dict[str, str]:
    """Return the size of each model and of its trace, for the plan."""
    text, lines = study.identity_text(), {}
    for name in study.models:
        bench = bench_of(text, name)
        lines[f"model {shown_name(study.model.content, name)}"] = (
            f"{bench.stage.full_order} degrees of freedom, {counted(study.time.instants, 'instant')} of "
            f"{study.optics.rays} rays, {bench.optics.terms} Zernike terms"
        )
    return lines


def check(study: TraceStudy) -> None:
    """Raise UserError for a study that no variant of can succeed: model, excitations or optics do not fit."""
    text = study.identity_text()
    for name in study.models:
        check_variants_of(study, bench_of(text, name), study.reduction.variants)


KIND = study_kind(
    "mirror-trace",
    TraceStudy,
    cases=case_labels,
    compute=compute,
    measures=measures,
    axes=axes,
    fixed=import_record,
    describe=describe,
    check=check,
    notices=import_notices,
)
