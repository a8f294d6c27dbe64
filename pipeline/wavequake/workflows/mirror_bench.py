"""What a mirror study prepares once per process: models, optical maps, reference responses, pupil."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from wavequake.errors import UserError
from wavequake.imaging.matrix_fourier import MatrixFourier, matrix_fourier
from wavequake.imaging.pupil_function import annular_pupil
from wavequake.kernels.devices import choose_device
from wavequake.kernels.surfaces import conic_slopes
from wavequake.mechanics.excitations import drive_of
from wavequake.mechanics.material import Material
from wavequake.mechanics.mirrors import AnnularMirror, CircularMirror, annular_mirror, circular_mirror
from wavequake.mechanics.modal import modal_model
from wavequake.mechanics.model import FiniteElementModel, RayleighDamping, ReducedModel
from wavequake.mechanics.response import displacements, respond
from wavequake.optics.fits import weighted_fit
from wavequake.optics.pupils import sunflower
from wavequake.optics.shapes import Conic, ZernikeDeformation
from wavequake.optics.system import OpticalSystem, Pupil, Surface
from wavequake.optics.system_kinematics import rest_states
from wavequake.optics.system_wavefront import PreparedSystem, measure_system, prepare_system
from wavequake.optics.zernike import annular_zernike
from wavequake.reduction.intermediate import Intermediate, intermediate
from wavequake.reduction.metrics import eps_mor, full_receptance, receptance
from wavequake.reduction.two_stage import reduce_variants, reference
from wavequake.workflows.mirror_study import FULL, MirrorStudy
from wavequake.workflows.model_store import digest, kept_intermediate, kept_model
from wavequake.workflows.schema import study_from_identity

Array = NDArray[np.float64]

MM_PER_M, NM_PER_MM = 1e3, 1e6
# Step of the central differences of a deformation, mm; twice the step has to give the same.
_STEP = 1e-5
_AGREEMENT = 1e-4
_TERMS = {"circular": 231, "annular": 105}
_NODES_PER_TERM = 4


@dataclass(frozen=True)
class Optics:
    """A mirror as an optical system, and what its surface nodes do to the light.

    Attributes
    ----------
    prepared : PreparedSystem
    radius : float
        Pupil radius, mm.
    obscuration : float
    resolution : float
        lambda/D in the image, mm.
    fit : ndarray, shape (J, 3 p)
        Displacements of the surface nodes (m) to Noll coefficients of the deformation along z of the optics
        (mm): the linearized sag residual of Störkle 2018, Eq. 4.7-4.10.
    sensitivity : ndarray, shape (2 + J, J)
        Line of sight (mm) and Noll coefficients of the wavefront (nm) per mm of each deformation, Eq. 4.26.
    """

    prepared: PreparedSystem
    radius: float
    obscuration: float
    resolution: float
    fit: Array
    sensitivity: Array


@dataclass(frozen=True)
class MirrorModel:
    """One model of a study with the answers of its reference.

    Attributes
    ----------
    name : str
    stage : Intermediate
    full : callable
        Builds the finite-element model, for variants that the intermediate one does not cover.
    optics : Optics
    reference : ReducedModel
    mechanical, optical : ndarray
        Transfer matrices of the reference, (f, 3 k, 3 k) in m/N and (f, J - 1, 3 k) in nm/N.
    aberrations : ndarray, shape (excitation, time, 2 + J)
        Of the reference over time: line of sight in mm, Noll coefficients in nm.
    """

    name: str
    stage: Intermediate
    full: Callable[[], FiniteElementModel]
    optics: Optics
    reference: ReducedModel
    mechanical: NDArray[np.complex128]
    optical: NDArray[np.complex128]
    aberrations: Array


@lru_cache(maxsize=2)
def study_of(text: str) -> MirrorStudy:
    """Rebuild a mirror study from its identity."""
    study: MirrorStudy = study_from_identity(MirrorStudy, text)
    return study


@lru_cache(maxsize=4)
def model_of(text: str, name: str) -> MirrorModel:
    """Prepare one model of a study; one BLAS thread, so that its bits are the same in every process."""
    with threadpool_limits(1):
        study = study_of(text)
        full = lru_cache(maxsize=1)(lambda: build_model(study, name))
        stage = _stage(study, name, full)
        optics = optics_of(study, name, stage)
        (chosen,) = (
            [reference(stage)]
            if study.reduction.reference == FULL
            else reduce_variants(stage, [study.reduction.reference], full())
        )
        rows = optical_rows(optics, chosen)
        frequencies = frequencies_of(study)
        return MirrorModel(
            name=name,
            stage=stage,
            full=full,
            optics=optics,
            reference=chosen,
            mechanical=receptance(chosen, frequencies),
            optical=receptance(chosen, frequencies, rows[3:]),
            aberrations=aberrations_over_time(study, chosen, rows),
        )


def frequencies_of(study: MirrorStudy) -> Array:
    """Return the frequencies of a study, Hz."""
    section = study.reduction
    return np.asarray(np.linspace(section.first_hz, section.last_hz, section.frequencies), dtype=np.float64)


def time_of(study: MirrorStudy) -> Array:
    """Return the instants of a study, s."""
    return np.arange(study.time.instants, dtype=np.float64) * study.time.step_s


def build_model(study: MirrorStudy, name: str) -> FiniteElementModel:
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
        return annular_mirror(AnnularMirror(inner_diameter=section.inner_diameter_m, **common))  # type: ignore[arg-type]
    return circular_mirror(CircularMirror(**common))  # type: ignore[arg-type]


def _stage(study: MirrorStudy, name: str, full: Callable[[], FiniteElementModel]) -> Intermediate:
    """Return the intermediate model, which is the same for all studies of one mirror and band."""
    highest = study.reduction.last_hz
    record = {
        "model": study.model.model_dump(mode="json", exclude={"shapes"}),
        "name": name,
        "highest_hz": highest,
    }
    return kept_intermediate(digest(record), lambda: intermediate(full(), highest=highest))


def spot_check(text: str, name: str) -> tuple[Array, Array]:
    """Compare the intermediate model with the full one where its basis was not built.

    Returns
    -------
    frequencies, errors : ndarray, shape (checks,)
        Hz, and the relative error of the transfer matrix (Störkle 2018, Eq. 2.10).
    """
    study, model = study_of(text), model_of(text, name)
    count, section = study.reduction.spot_checks, study.reduction
    # Irrational parts of the band: no expansion point of the basis lies there.
    parts = np.modf((np.arange(count) + 1) * (np.sqrt(5.0) - 1) / 2)[0]
    frequencies = np.sort(section.first_hz + parts * (section.last_hz - section.first_hz))
    if not count:
        return frequencies, frequencies.copy()
    with threadpool_limits(1):
        truth = full_receptance(model.full(), frequencies)
        return frequencies, eps_mor(truth, receptance(reference(model.stage), frequencies))


def optics_of(study: MirrorStudy, name: str, stage: Intermediate) -> Optics:
    """Return the mirror as an optical system, with the maps from its nodes to the light.

    Raises
    ------
    UserError
        If the surface has too few nodes for the Zernike terms, or the mirror has no focal length.
    """
    nodes = stage.nodes[stage.surface_nodes] * MM_PER_M
    distance = np.hypot(nodes[:, 0], nodes[:, 1])
    radius, obscuration = float(distance.max()), 0.0
    if name == "annular":
        obscuration = study.model.inner_diameter_m / study.model.diameter_m
    terms = study.optics.zernike_terms or min(_TERMS.get(name, 105), len(nodes) // _NODES_PER_TERM)
    if len(nodes) < terms:
        raise UserError(
            f"the optical surface of the model {name} has {len(nodes)} nodes, which do not determine {terms} "
            "Zernike terms; lower optics.zernike_terms, or refine the mesh"
        )
    own_focal_length = study.model.focal_length_m if name != "file" else np.inf
    focal_length = (study.optics.focal_length_m or study.model.focal_length_m) * MM_PER_M
    system = mirror_system(focal_length, radius, obscuration, terms)
    rays = sunflower(obscuration, 1.0, study.optics.rays)
    prepared = prepare_system(
        system, rays.x, rays.y, np.ones(len(rays.x)), terms, wavelength=study.optics.wavelength_nm / NM_PER_MM
    )
    return Optics(
        prepared=prepared,
        radius=radius,
        obscuration=obscuration,
        resolution=prepared.wavelength * focal_length / (2 * radius),
        fit=sag_fit(nodes, stage.surface_weights, own_focal_length * MM_PER_M, radius, obscuration, terms),
        sensitivity=deformation_sensitivity(prepared, terms),
    )


def mirror_system(focal_length: float, radius: float, obscuration: float, terms: int) -> OpticalSystem:
    """Return a parabolic mirror that images a star on its axis; lengths in mm."""
    mirror = Surface(
        "mirror",
        Conic(-2 * focal_length, -1.0),
        action="reflect",
        deformation=ZernikeDeformation(terms, radius, obscuration),
    )
    image = Surface("image", position=np.array([0.0, 0.0, -focal_length]))
    pupil = Pupil("entrance_diameter", 2 * radius, obscuration)
    return OpticalSystem("mirror", (mirror, image), 0, pupil)


def sag_fit(
    nodes: Array, weights: Array, focal_length: float, radius: float, obscuration: float, terms: int
) -> Array:
    """Return the matrix (J, 3 p) from displacements in m to Noll coefficients in mm along the optics' z.

    The sag residual u_z - grad z . (u_x, u_y) of a surface that faces +z; the light comes against that axis,
    so the sign turns.
    """
    x, y = nodes[:, 0], nodes[:, 1]
    slope_x, slope_y = conic_slopes(x, y, 0.5 / focal_length, -1.0)
    fit = weighted_fit(annular_zernike(x / radius, y / radius, terms, obscuration), weights)
    parts = np.stack([-slope_x, -slope_y, np.ones_like(x)], axis=1)
    matrix: Array = -MM_PER_M * (fit.matrix[:, :, None] * parts).reshape(terms, -1)
    return matrix


def deformation_sensitivity(prepared: PreparedSystem, terms: int) -> Array:
    """Return line of sight (mm) and wavefront (nm) per mm of each Zernike deformation, (2 + J, J).

    Raises
    ------
    UserError
        If steps of h and 2 h do not agree.
    """
    states = rest_states(prepared.system, 4 * terms)
    steps = states.deformations[0]
    assert steps is not None
    for number, factor in enumerate((1.0, -1.0, 2.0, -2.0)):
        steps[number * terms : (number + 1) * terms] = factor * _STEP * np.eye(terms)
    found = measure_system(prepared, states, choose_device("auto"))
    to_nm = prepared.wavelength * NM_PER_MM
    values = np.concatenate([found.los, found.zernike * to_nm], axis=1).reshape(4, terms, -1)
    once, twice = (values[0] - values[1]) / (2 * _STEP), (values[2] - values[3]) / (4 * _STEP)
    apart = np.abs(once - twice).max(axis=0) / np.abs(once).max(axis=0)
    if not apart.max() < _AGREEMENT:
        raise UserError(
            f"the sensitivities of the mirror differ by {apart.max():.2g} between two steps; it is too fast "
            "for its number of rays or terms"
        )
    return np.ascontiguousarray(once.T)


def optical_rows(optics: Optics, model: ReducedModel) -> Array:
    """Return aberrations per unit of a model's coordinates, (2 + J, r): Störkle 2018, Eq. 4.22."""
    rows: Array = optics.sensitivity @ (optics.fit @ model.surface)
    return rows


def aberrations_over_time(study: MirrorStudy, model: ReducedModel, rows: Array) -> Array:
    """Return the modal method's aberrations, (excitation, time, 2 + J): mm of line of sight, nm."""
    time, interfaces = time_of(study), model.inputs.shape[1] // 3
    found = []
    for excitation in study.excitation:
        drive = drive_of(excitation, interfaces, time, study.study.seed)
        found.append(displacements(respond(modal_model(model, drive.prescribed), [drive], time), rows)[0])
    return np.array(found)


@lru_cache(maxsize=4)
def image_of(samples: int, pixels: int, sampling: float, obscuration: float, terms: int) -> "ImageMaker":
    """Prepare the images of wavefronts that are given by their Noll coefficients."""
    pupil = annular_pupil(samples, obscuration)
    basis = annular_zernike(pupil.x, pupil.y, terms, obscuration)
    return ImageMaker(matrix_fourier(pupil, pixels, sampling), np.ascontiguousarray(basis.T))


@dataclass(frozen=True)
class ImageMaker:
    """A prepared transform, and the Zernike polynomials (J, m) at its pupil's cells."""

    transform: MatrixFourier
    basis: Array
