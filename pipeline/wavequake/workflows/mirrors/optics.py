"""A mirror of a study as an optical system, and what the nodes of its surface do to the light.

The models have the light come from +z, in m; the optics let it travel to +z, in mm. x and y are the same, z
turns: this module is the one place where displacements cross over.
"""

import time
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wavequake.errors import UserError
from wavequake.kernels.device.devices import NUMPY, Device, choose_device
from wavequake.mechanics.model import ReducedModel
from wavequake.optics.derivatives.central import SIGNS, checked_derivative
from wavequake.optics.rays.packing import pack
from wavequake.optics.rays.pupils import sunflower
from wavequake.optics.shapes.fit import (
    SurfaceFit,
    apply,
    coefficients,
    heights,
    relative_residual,
    surface_fit,
)
from wavequake.optics.shapes.shapes import Conic, GridDeformation, ZernikeDeformation
from wavequake.optics.systems.kinematics import rest_states
from wavequake.optics.systems.system import OpticalSystem, Pupil, Surface
from wavequake.optics.wavefronts.wavefront import PreparedSystem, measure_system, prepare_system
from wavequake.reduction.intermediate import Intermediate
from wavequake.reduction.metrics import surface_modes
from wavequake.workflows.mirrors.study import AnyMirrorStudy

Array = NDArray[np.float64]

MM_PER_M, NM_PER_MM = 1e3, 1e6
# Step of the central differences of a deformation, mm; twice the step has to give the same.
_STEP = 1e-5
_TERMS = {"circular": 231, "annular": 105}
_MOST_TERMS = 105
_NODES_PER_TERM = 4
# What of an imported surface is flat, off its axis, or a hole: sag over radius, offset over radius, and
# distance of the innermost node in mean distances of nodes.
_FLAT, _OFF_AXIS, _HOLE = 1e-6, 0.02, 2.0
_ROUNDING = 1e-9


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
    surface : SurfaceFit
        Displacements of the surface nodes to Noll coefficients of the figure, mm (Störkle 2018, Eq. 4.7 to
        4.10), in the frame of the optics.
    sensitivity : ndarray, shape (2 + J, J)
        Line of sight (mm) and Noll coefficients of the wavefront (nm) per mm of each deformation, Eq. 4.26.
    seconds : float
        Time that the sensitivities took.
    """

    prepared: PreparedSystem
    radius: float
    obscuration: float
    resolution: float
    surface: SurfaceFit
    sensitivity: Array
    seconds: float

    @property
    def terms(self) -> int:
        """Zernike terms of surface and wavefront."""
        return len(self.sensitivity) - 2


def optics_of(study: AnyMirrorStudy, name: str, stage: Intermediate) -> Optics:
    """Return the mirror as an optical system, with the maps from its nodes to the light.

    Raises
    ------
    UserError
        If the surface has too few nodes for the Zernike terms, or the mirror has no focal length, bulges
        towards the light or is not centered about the z axis.
    """
    nodes = stage.nodes[stage.surface_nodes] * MM_PER_M
    shape, focal_length, radius, obscuration = surface_of(study, name, nodes, stage.surface_weights)
    terms = study.optics.zernike_terms or min(_TERMS.get(name, _MOST_TERMS), len(nodes) // _NODES_PER_TERM)
    if len(nodes) < terms:
        raise UserError(
            f"the optical surface of the model {name} has {len(nodes)} nodes, which do not determine {terms} "
            "Zernike terms; lower optics.zernike_terms, or refine the mesh"
        )
    system = mirror_system(focal_length, radius, obscuration, terms)
    rays = sunflower(obscuration, 1.0, study.optics.rays)
    if len(rays.x) < terms:
        raise UserError(f"optics.rays is {study.optics.rays}, which do not determine {terms} Zernike terms")
    prepared = prepare_system(
        system, rays.x, rays.y, np.ones(len(rays.x)), terms, wavelength=study.optics.wavelength_nm / NM_PER_MM
    )
    start = time.perf_counter()
    sensitivity = deformation_sensitivity(prepared, terms)
    return Optics(
        prepared=prepared,
        radius=radius,
        obscuration=obscuration,
        resolution=prepared.wavelength * focal_length / (2 * radius),
        surface=surface_fit(nodes[:, :2], stage.surface_weights, terms, radius, obscuration, shape),
        sensitivity=sensitivity,
        seconds=time.perf_counter() - start,
    )


def surface_of(
    study: AnyMirrorStudy, name: str, nodes: Array, weights: Array
) -> tuple[Conic, float, float, float]:
    """Return the undeformed surface, the system's focal length and the pupil's radius (mm), its obscuration.

    Parameters
    ----------
    study : AnyMirrorStudy
    name : str
        Of the model.
    nodes, weights : ndarray, shape (n, 3) and (n,)
        Of the optical surface, mm; the areas of its nodes, in any unit.

    Raises
    ------
    UserError
        If the mirror has no focal length, bulges towards the light or is not centered about the z axis.
    """
    return *_reference_surface(study, name, nodes, weights), *_pupil_of(study, name, nodes, weights)


def _reference_surface(study: AnyMirrorStudy, name: str, nodes: Array, weights: Array) -> tuple[Conic, float]:
    """Return the undeformed surface in the frame of the optics, and the focal length of the system, mm."""
    wanted = study.optics.focal_length_m
    if name != "file":
        own = study.model.focal_length_m * MM_PER_M
        return Conic(-2 * own, -1.0), own if wanted is None else wanted * MM_PER_M
    square = np.sum(nodes[:, :2] ** 2, axis=1)
    root = np.sqrt(weights)
    columns = np.column_stack([np.ones_like(square), square / square.max()])
    _, sag = np.linalg.lstsq(root[:, None] * columns, root * nodes[:, 2], rcond=None)[0]
    flat = abs(sag) <= _FLAT * np.sqrt(square.max())
    if not flat and sag < 0:
        raise UserError(
            "the optical surface of the imported model bulges towards +z, where the light comes from; turn "
            "the mesh so that the hollow side faces +z"
        )
    if flat and wanted is None:
        raise UserError(
            "the optical surface of the imported model is flat, so it has no focus; say with "
            "optics.focal_length_m which parabola it stands for"
        )
    own = np.inf if flat else square.max() / (4 * sag)
    return Conic(-2 * own, -1.0), own if wanted is None else wanted * MM_PER_M


def _pupil_of(study: AnyMirrorStudy, name: str, nodes: Array, weights: Array) -> tuple[float, float]:
    """Return the radius of the pupil in mm, and its inner over its outer radius."""
    distance = np.hypot(nodes[:, 0], nodes[:, 1])
    radius = float(distance.max())
    if name == "circular":
        return radius, 0.0
    if name == "annular":
        return radius, study.model.inner_diameter_m / study.model.diameter_m
    offset = float(np.hypot(*(weights @ nodes[:, :2] / weights.sum())))
    if offset > _OFF_AXIS * radius:
        raise UserError(
            f"the optical surface of the imported model is centered {offset:.3g} mm off the z axis; move the "
            "mesh so that the axis of the mirror is the z axis"
        )
    apart = radius * np.sqrt(np.pi / len(nodes))
    inner = float(distance.min())
    return radius, inner / radius if inner > _HOLE * apart else 0.0


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


def with_deformation(optics: Optics, residual: GridDeformation) -> PreparedSystem:
    """Return the optical system of a mirror that can also deform by a grid of what the polynomials leave."""
    prepared = optics.prepared
    mirror, image = prepared.system.surfaces
    form = ZernikeDeformation(optics.terms, optics.radius, optics.obscuration, residual)
    system = replace(prepared.system, surfaces=(replace(mirror, deformation=form), image))
    return replace(prepared, system=system, sequence=pack(system, prepared.wavelength))


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
    for number, factor in enumerate(SIGNS):
        steps[number * terms : (number + 1) * terms] = factor * _STEP * np.eye(terms)
    found = measure_system(prepared, states, _device())
    to_nm = prepared.wavelength * NM_PER_MM
    values = np.concatenate([found.los, found.zernike * to_nm], axis=1).reshape(4, terms, -1)
    remedy = "it is too fast for its number of rays or terms"
    return np.ascontiguousarray(checked_derivative(values, _STEP, "the mirror", remedy, axis=0).T)


def _device() -> Device:
    """Return the best device at hand: all give the same to 1e-9 mm, and NumPy is always there."""
    try:
        return choose_device("auto")
    except UserError:
        return NUMPY


def displacements_mm(rows: Any) -> Array:
    """Return displacements of the surface nodes (n, 3 p) in m of the model in the frame and mm of the optics.

    The result has the shape (n, p, 3).
    """
    turned: Array = np.asarray(rows).reshape(len(rows), -1, 3) * (np.array([1.0, 1.0, -1.0]) * MM_PER_M)
    return turned


def optical_rows(optics: Optics, model: ReducedModel) -> Array:
    """Return aberrations per unit of a model's coordinates, (2 + J, r): Störkle 2018, Eq. 4.22."""
    rows: Array = optics.sensitivity @ figure_rows(optics, model)
    return rows


def figure_rows(optics: Optics, model: ReducedModel) -> Array:
    """Return Noll coefficients of the figure along the light per unit of the coordinates, mm, (J, r)."""
    rows: Array = apply(optics.surface, displacements_mm(model.surface.T)).T
    return rows


def mode_residuals(optics: Optics, model: ReducedModel) -> Array:
    """Return how badly the polynomials fit each mode of a model, (r,): Störkle 2018, Eq. 4.11, Fig. 4.36.

    0 for a mode that leaves the surface as it is, such as a turn about the axis.
    """
    shapes = displacements_mm(surface_modes(model).T)
    above = heights(optics.surface, shapes)
    left = relative_residual(optics.surface, above, coefficients(optics.surface, above))
    moved = np.sqrt(np.square(shapes).sum(axis=(1, 2)))
    seen = np.sqrt(np.square(above).sum(axis=1)) > _ROUNDING * moved
    return np.asarray(np.where(seen, left, 0.0))
