"""What a mirror study prepares once per process: models, optical maps, reference responses, pupil."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wavequake.campaign.contract import Fixed
from wavequake.campaign.measured import CaseTable
from wavequake.errors import UserError
from wavequake.imaging.engines.zernike_psf import ZernikeImager, zernike_imager
from wavequake.imaging.pupils.pupil_function import annular_pupil
from wavequake.kernels.device.devices import Device
from wavequake.mechanics.mirrors.material import Material
from wavequake.mechanics.mirrors.models import AnnularMirror, CircularMirror, annular_mirror, circular_mirror
from wavequake.mechanics.model import FiniteElementModel, RayleighDamping, ReducedModel, rotations
from wavequake.mechanics.vibration.drive import Drive
from wavequake.mechanics.vibration.excitations import AnyExcitation, drive_of
from wavequake.mechanics.vibration.modal import ModalModel, modal_model
from wavequake.mechanics.vibration.response import displacements, respond
from wavequake.prepared import prepared
from wavequake.reduction.intermediate import Intermediate, intermediate
from wavequake.reduction.metrics import Residues, receptance, residues
from wavequake.reduction.names import Variant, parse
from wavequake.reduction.own import own_model
from wavequake.reduction.two_stage import check_variants, covers
from wavequake.workflows import kinds
from wavequake.workflows.mirrors.base import CLAMPED, driven, on_moving_base
from wavequake.workflows.mirrors.compared_models import checked_model, reduced_model, variant_labels
from wavequake.workflows.mirrors.imported_facts import facts, frequencies
from wavequake.workflows.mirrors.model_store import (
    DAMPING,
    digest,
    kept_intermediate,
    kept_model,
    kept_notes,
)
from wavequake.workflows.mirrors.optics import Optics, optical_rows, optics_of
from wavequake.workflows.mirrors.own_models import method_of, own_arrays
from wavequake.workflows.mirrors.study import FULL, AnyMirrorStudy, MirrorStudy

Array = NDArray[np.float64]

# Below, the full-size solution of a free body is itself good to some 1e-7 only.
_LOWEST_CHECK_HZ = 20.0


@dataclass(frozen=True)
class Bench:
    """One model of a study and its optics.

    Attributes
    ----------
    name : str
    stage : Intermediate
    full : callable
        Builds the finite-element model, for variants that the intermediate one does not cover.
    optics : Optics
    own : mapping of str to str
        Files of reduced models of the user's own, in base64.
    """

    name: str
    stage: Intermediate
    full: Callable[[], FiniteElementModel]
    optics: Optics
    own: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Answers:
    """What the reference of a model answers.

    Attributes
    ----------
    reference : ReducedModel
    mechanical : ndarray, shape (f, 3 k, 3 k)
        Transfer matrices, m/N.
    optical : Residues
        Transfer matrices, (f, J - 1, 3 k) in nm/N, and what they are made of.
    aberrations : ndarray, shape (excitation, time, 2 + J)
        Over time: line of sight in mm, Noll coefficients in nm.
    """

    reference: ReducedModel
    mechanical: NDArray[np.complex128]
    optical: Residues
    aberrations: Array


@prepared(maxsize=2)
def study_of(text: str) -> Any:
    """Return the study of any mirror workflow of an identity text."""
    return kinds.study_of(text)


def cases_of(study: AnyMirrorStudy) -> list[tuple[str, str]]:
    """Return model and variant of every case; the first of each model is the reference, if there is one."""
    return [(model, variant) for model in study.models for variant in study.compared]


def case_labels(study: AnyMirrorStudy, ids: NDArray[np.int64]) -> CaseTable:
    """Return the labels of cases: model, variant, its method and the seed."""
    rows = [cases_of(study)[one] for one in ids]
    return variant_labels(rows, [method_of(study, one) for _, one in rows], study.study.seed)


@prepared(maxsize=4)
def bench_of(text: str, name: str) -> Bench:
    """Prepare one model of a study; one BLAS thread, so that its bits are the same in every process."""
    study = study_of(text)
    stage, full = stage_of(text, name)
    return Bench(name, stage, full, optics_of(study, name, stage), study.reduction.own_files)


@prepared(maxsize=4)
def stage_of(text: str, name: str) -> tuple[Intermediate, Callable[[], FiniteElementModel]]:
    """Return the intermediate model, and what builds the full one; one BLAS thread, as `bench_of`."""
    study = study_of(text)
    full = prepared(maxsize=1)(partial(build_model, study, name))
    return _stage(study, name, full), full


def import_notices(study: AnyMirrorStudy) -> Iterator[str]:
    """Yield what the user should check of an imported model, the cheap facts first."""
    section = study.model
    if section.content is not None:
        model, notes = kept_model(section.content), kept_notes(section.content)
        yield from facts(model, section.units or "", notes)
        yield f"imported model: {frequencies(stage_of(study.identity_text(), 'file')[0])}"


def import_record(study: AnyMirrorStudy) -> dict[str, Fixed]:
    """Return the same as a coordinate of a store; nothing for a built-in model."""
    found = np.array(list(import_notices(study)), dtype=object)
    words = {"long_name": "what to check of the imported model"}
    return {"import_notice": (("import_notice",), found, words)} if len(found) else {}


@prepared(maxsize=4)
def answers_of(text: str, name: str) -> Answers:
    """Return what the reference of a model answers; one BLAS thread, as `bench_of`."""
    study, bench = study_of(text), bench_of(text, name)
    chosen = variant_of(bench, study.reduction.reference)
    rows = optical_rows(bench.optics, chosen)
    frequencies = study.reduction.hertz
    return Answers(
        reference=chosen,
        mechanical=receptance(chosen, frequencies),
        optical=residues(chosen, frequencies, rows[3:]),
        aberrations=aberrations_over_time(study, chosen, rows),
    )


def variant_of(bench: Bench, variant: str) -> ReducedModel:
    """Return a variant of a model; "full" is the intermediate model itself.

    Raises
    ------
    UserError
        If the variant does not suit the model.
    """
    if variant in bench.own:
        given = own_arrays(bench.own[variant], variant)
        return own_model(bench.full() if "basis" in given else bench.stage, given, variant)
    if variant != FULL and (chosen := parse(variant)).method == CLAMPED:
        return on_moving_base(bench.stage if covers(bench.stage, chosen) else bench.full(), chosen)
    return reduced_model(bench.stage, bench.full, variant)


def drive_at(excitation: AnyExcitation, model: ReducedModel | Intermediate, study: AnyMirrorStudy) -> Drive:
    """Return the inputs that an excitation of a study is at the interfaces of a model."""
    interfaces = len(model.interfaces)
    return drive_of(excitation, interfaces, study.time.seconds, study.study.seed, turns=rotations(model))


def check_variants_of(study: AnyMirrorStudy, bench: Bench, variants: tuple[str, ...]) -> None:
    """Raise UserError for a variant that does not suit a model or an excitation of a study."""
    for name in study.reduction.own_files:
        if name in variants:
            variant_of(bench, name)
    variants = tuple(name for name in variants if name not in study.reduction.own_files)
    check_variants(bench.stage, variants)
    clamped = [name for name in variants if parse(name).method == CLAMPED]
    for excitation in study.excitation:
        drive = drive_at(excitation, bench.stage, study)
        for name in clamped:
            driven(variant_of(bench, name), drive, excitation.name)
        for variant in map(parse, variants):
            _require_coordinates(variant, int(drive.prescribed.sum()), excitation.name)


def _require_coordinates(variant: Variant, prescribed: int, excitation: str) -> None:
    if variant.method != CLAMPED and variant.order is not None and variant.order < prescribed:
        raise UserError(
            f"the variant {variant} has fewer coordinates than the {prescribed} interface directions that "
            f"the excitation {excitation!r} prescribes; choose an order of {prescribed} at least"
        )


def build_model(study: AnyMirrorStudy, name: str) -> FiniteElementModel:
    """Return the full model: a built-in mirror, or the imported one."""
    section = study.model
    if name == "file":
        return kept_model(section.content or "")
    material = Material(section.youngs_modulus_pa, section.poisson_ratio, section.density_kg_m3)
    common = {
        "diameter": section.diameter_m,
        "thickness": section.thickness_m,
        "focal_length": section.focal_length_m,
        "material": material,
        "mount_radius": section.mount_radius_m,
        "mount_angles": section.mount_angles_deg,
        "damping": RayleighDamping(section.damping_alpha, section.damping_beta),
    }
    if section.rings is not None:
        common["rings"] = section.rings
    if name == "annular":
        if section.rings is not None:
            common["around"] = 6 * -(-8 * section.rings // 6)
        return annular_mirror(AnnularMirror(inner_diameter=section.inner_diameter_m, **common))  # type: ignore[arg-type]
    if section.rings is not None:
        common["core"] = section.rings
    return circular_mirror(CircularMirror(**common))  # type: ignore[arg-type]


def _stage(study: AnyMirrorStudy, name: str, full: Callable[[], FiniteElementModel]) -> Intermediate:
    """Return the intermediate model, which is the same for all studies of one mirror and band."""
    highest, section = study.reduction.last_hz, study.model
    imported = name == "file"  # whose damping its content has
    record = _stage_record(study, name, frozenset() if imported else DAMPING)
    return kept_intermediate(
        digest(record),
        lambda: intermediate(full(), highest=highest),
        None if imported else RayleighDamping(section.damping_alpha, section.damping_beta),
    )


def _stage_record(study: AnyMirrorStudy, name: str, leave: frozenset[str] = frozenset()) -> dict[str, object]:
    return {
        "model": study.model.model_dump(mode="json", exclude={"shapes", *leave}),
        "name": name,
        "highest_hz": study.reduction.last_hz,
    }


def spot_check(study: MirrorStudy, name: str) -> tuple[Array, Array]:
    """Compare the intermediate model with the full one; see `checked_model`."""
    lowest = min(max(study.reduction.first_hz, _LOWEST_CHECK_HZ), study.reduction.last_hz)
    record = _stage_record(study, name)
    return checked_model(study.reduction, lowest, lambda: bench_of(study.identity_text(), name), record)


def aberrations_over_time(study: MirrorStudy, model: ReducedModel, rows: Array) -> Array:
    """Return the modal method's aberrations, (excitation, time, 2 + J): mm of line of sight, nm."""
    return over_time(study, model, rows)[0]


def over_time(study: MirrorStudy, model: ReducedModel, *rows: Array) -> list[Array]:
    """Return what rows (m, r) give of a model's coordinates under every excitation, (excitation, time, m)."""
    time = study.time.seconds
    found: list[list[Array]] = [[] for _ in rows]
    forms: list[tuple[ReducedModel, ModalModel]] = []  # excitations mostly hold the model alike
    for excitation in study.excitation:
        drive = drive_at(excitation, model, study)
        held, drive = driven(model, drive, excitation.name)
        alike = (m for one, m in forms if one is held and np.array_equal(m.prescribed, drive.prescribed))
        if (modal := next(alike, None)) is None:
            modal = modal_model(held, drive.prescribed)
            forms.append((held, modal))
        response = respond(modal, [drive], time)
        for part, chosen in zip(found, rows, strict=True):
            part.append(displacements(response, chosen)[0])
    return [np.array(part) for part in found]


@prepared(maxsize=4)
def imager_of(
    samples: int, pixels: int, sampling: float, terms: int, obscuration: float, device: Device
) -> ZernikeImager:
    """Prepare the images of wavefronts that are given by their Noll terms."""
    return zernike_imager(annular_pupil(samples, obscuration), pixels, sampling, terms, obscuration, device)
