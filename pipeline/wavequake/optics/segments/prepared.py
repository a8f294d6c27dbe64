"""What a telescope, its rays and a wavelength determine once for all instants, and the trace of a batch.

`prepare` collects what does not change from instant to instant; `trace_states` traces a batch of instants.
The optics are in mm.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix

from wavequake.errors import UserError
from wavequake.kernels.device.devices import Device
from wavequake.kernels.device.tiles import TILE
from wavequake.kernels.trace.segmented import SegmentedTrain, Traced, trace_chief, trace_segmented
from wavequake.optics.polynomials.zernike import annular_zernike
from wavequake.optics.rays.pupils import PupilRays
from wavequake.optics.segments.aspheres import asphere_polynomials, figures_at_rest, with_aspheres
from wavequake.optics.segments.figures import figure_frames, segment_radii
from wavequake.optics.segments.kinematics import (
    after_m1,
    field_directions,
    relative_transforms,
    segment_poses,
)
from wavequake.optics.segments.layout import candidates, edges_of
from wavequake.optics.segments.telescope import (
    M2,
    first_order,
    footprints,
    refractive_indices,
    semi_diameters,
    with_figures,
)
from wavequake.optics.shapes.basis import ZernikeBasis, zernike_basis
from wavequake.optics.systems.system import OpticalSystem, States
from wavequake.optics.wavefronts.fits import (
    MORE_SEGMENT_RAYS,
    Fit,
    segment_planes,
    weighted_fit,
    well_determined,
)
from wavequake.optics.wavefronts.reference_sphere import sphere_radius

Array = NDArray[np.float64]

_NO_FIGURE = ZernikeBasis(-1, np.zeros((0, 0)))


@dataclass(frozen=True)
class PreparedTrace:
    """What a telescope, its rays and a wavelength determine once for all instants; lengths in mm.

    Attributes
    ----------
    system : OpticalSystem
    rays : PupilRays
        The N rays that meet glass in the reference configuration.
    wavelength : float
    train : SegmentedTrain
    candidates : ndarray of int32, shape (N, C)
        Segments that a ray may meet while motions stay below `margin`.
    margin : float
    weight : ndarray, shape (N,)
        Share of the pupil that each ray stands for; the sum is 1.
    fit : Fit
        Of the annular Noll Zernike polynomials.
    plane : Fit
        Of piston, x and y over the outer pupil radius.
    segment_fit : csr_matrix, shape (3 S, N)
        Values to piston at the center, slope in x and slope in y (1/mm) of each segment.
    figure_matrix : ndarray, shape (S, M, terms)
        From Noll coefficients (heights along the segment's normal, to the sky) to coefficients of the
        kernel's polynomials (heights along z, with the light); M = 0 without a figure.
    mirror_matrix : ndarray, shape (M', terms)
        From Noll coefficients of a mirror after M1 (heights along its z axis) to those of its polynomials.
    aspheres : ndarray, shape (L - 1, M'), optional
        What mirrors after M1 have beyond their conics, in the same polynomials.
    numerical_aperture, focal_length : float
    field : int
        Index of the field point.
    slopes : Fit, optional
        From `slopes.slope_fit`: coefficients come from where rays meet the image, not from path lengths.
    sphere : Fit, optional
        From `sphere_fit.reference_fit`: the reference sphere is about the image point of the sphere that fits
        the wavefront best, not about that of the chief ray.
    """

    system: OpticalSystem
    rays: PupilRays
    wavelength: float
    train: SegmentedTrain
    candidates: NDArray[np.int32]
    margin: float
    weight: Array
    fit: Fit
    plane: Fit
    segment_fit: csr_matrix
    figure_matrix: Array
    mirror_matrix: Array
    numerical_aperture: float
    focal_length: float
    field: int = 0
    slopes: Fit | None = None
    sphere: Fit | None = None
    aspheres: Array | None = None

    @property
    def tilt_factor(self) -> float:
        """Of annular tilt, see `los_eq339`; negative where the pupil is upside down."""
        return float(np.copysign(1.0 / np.sqrt(1.0 + self.system.pupil.obscuration**2), self.focal_length))

    @property
    def point(self) -> Array:
        """Field point (2,), rad."""
        return np.asarray(self.system.fields[self.field], dtype=np.float64)


def prepare(
    system: OpticalSystem,
    rays: PupilRays,
    wavelength: float,
    terms: int,
    figure_terms: int = 0,
    mirror_terms: int = 0,
    margin: float = 5.0,
) -> PreparedTrace:
    """Collect what does not change from instant to instant.

    Parameters
    ----------
    system : OpticalSystem
    rays : PupilRays
        Those that meet no segment are left out.
    wavelength : float
        In mm.
    terms : int
        Number of annular Noll Zernike polynomials, at least 3.
    figure_terms : int
        Number of circular Noll Zernike polynomials of each segment's figure.
    mirror_terms : int
        The same of each mirror after M1, over the axial beam's footprint (`footprints`).
    margin : float
        How far (mm) a ray may wander across M1 before its candidate segments are searched anew.

    Raises
    ------
    UserError
        If the wavelength is not positive, no ray meets glass, or the rays determine not all Zernike terms
        or not the tilt of every segment.
    """
    if not (np.isfinite(wavelength) and wavelength > 0.0):
        raise UserError(f"the wavelength is {wavelength} mm, it must be a positive number")
    if terms < 3:
        raise UserError(f"{terms} Zernike terms were asked for, the line of sight needs at least 3")
    used = (rays.segment >= 0) & (rays.weight > 0.0)
    if not used.any():
        raise UserError(
            f"none of the {len(rays.x)} rays meets a segment of {system.name}, so there is no wavefront"
        )
    system = with_figures(replace(system, wavelengths=np.array([wavelength])), figure_terms, mirror_terms)
    rays = PupilRays(rays.x[used], rays.y[used], rays.weight[used], rays.segment[used])
    weight = rays.weight / np.sum(rays.weight)
    x, y = rays.x / system.annulus.outer, rays.y / system.annulus.outer
    optics = first_order(system)
    figure, mirror = (zernike_basis(count) if count else _NO_FIGURE for count in (figure_terms, mirror_terms))
    mirror, aspheres = with_aspheres(mirror, asphere_polynomials(system))
    train = _train(system, figure, mirror, sphere_radius(optics.exit_pupil_distance))
    rows, solved = segment_planes(rays.x, rays.y, weight, rays.segment, system.segments.centers[:, :2])
    if not solved.all():
        name = system.segments.names[int(np.argmin(solved))]
        raise UserError(
            f"segment {name} has too few rays for its tilt (at least 3 not in a line); raise optics.rays."
        )
    places = np.add.outer(np.arange(3), 3 * rays.segment).ravel(), np.tile(np.arange(len(x)), 3)
    return PreparedTrace(
        system=system,
        rays=rays,
        wavelength=wavelength,
        train=train,
        candidates=candidates(system.segments, rays.x, rays.y, margin),
        margin=margin,
        weight=weight,
        fit=well_determined(
            weighted_fit(annular_zernike(x, y, terms, system.pupil.obscuration), weight, MORE_SEGMENT_RAYS)
        ),
        plane=weighted_fit(np.stack([np.ones_like(x), x, y], axis=1), weight, MORE_SEGMENT_RAYS),
        segment_fit=csr_matrix((rows.ravel(), places), shape=(3 * len(system.segments), len(x))),
        figure_matrix=figure.matrix / -system.segments.axes[:, 2, 2, None, None],
        mirror_matrix=mirror.matrix,
        numerical_aperture=optics.numerical_aperture,
        focal_length=optics.focal_length,
        aspheres=aspheres,
    )


def _train(
    system: OpticalSystem, figure: ZernikeBasis, mirror: ZernikeBasis, sphere_radius: float
) -> SegmentedTrain:
    """Pack the parts of a system that do not move."""
    indices = refractive_indices(system)
    return SegmentedTrain(
        primary_curvature=1.0 / system.primary.shape.radius,
        primary_conic=system.primary.shape.conic,
        edges=edges_of(system.segments),
        figure_frames=figure_frames(system),
        figure_degree=figure.degree,
        surface_curvatures=np.array([1.0 / surface.shape.radius for surface in system.after_primary]),
        surface_conics=np.array([surface.shape.conic for surface in system.after_primary]),
        sphere_radius=sphere_radius,
        semi_diameters=semi_diameters(system.after_primary),
        mirror_degree=mirror.degree,
        mirror_radii=footprints(system) if mirror.degree >= 0 else None,
        figure_basis=figure.basis,
        mirror_basis=mirror.basis,
        indices=None if np.isnan(indices).all() else indices,
    )


def chief_rays(prepared: PreparedTrace, states: States) -> Array:
    """Return the virtual chief ray of every instant, shape (T, 3, 16), mm.

    It has image x, y and the path length to the reference sphere, and is traced through the undisturbed
    parent of M1 and the displaced surfaces after it.
    """
    return trace_chief(
        prepared.train,
        relative_transforms(*after_m1(prepared.system, states.surface_motion)),
        directions(prepared, states),
        prepared.system.stop_z,
        mirror_figure=_mirror_figure(prepared, states),
    )


def _mirror_figure(prepared: PreparedTrace, states: States) -> Array | None:
    """Return the coefficients (T, L - 1, M, 16) of the figures of the mirrors after M1."""
    shape = (len(states), prepared.mirror_matrix.shape[1])
    figures = [one for one in states.deformations[M2:-1] if one is not None]
    if not shape[1] and not figures:
        return figures_at_rest(prepared.aspheres, len(states) // TILE)
    found = [one.shape for one in figures]
    if found != [shape] * (len(prepared.system.after_primary) - 1):
        raise UserError(f"the figures of mirrors after M1 have the shapes {found}, each must be {shape}")
    lanes_last = np.stack([one.reshape(-1, TILE, shape[1]) for one in figures], axis=1).swapaxes(2, 3)
    coefficients: Array = np.matmul(prepared.mirror_matrix, lanes_last)
    return coefficients if prepared.aspheres is None else coefficients + prepared.aspheres[:, :, None]


def trace_states(
    prepared: PreparedTrace, states: States, device: Device, chief: Array | None = None
) -> Traced:
    """Trace all rays at all instants in one launch.

    Parameters
    ----------
    prepared : PreparedTrace
    states : States
        The batch is a whole number of tiles; NaN motions lose the rays that they concern.
    device : Device
    chief : ndarray, shape (T, 3, 16), optional
        From `chief_rays`, where they are known.

    Raises
    ------
    UserError
        If the states do not fit the telescope.
    """
    system = prepared.system
    if not len(states) or len(states) % TILE or states.line_of_sight.shape != (len(states), 2):
        raise UserError(
            f"the line of sight has the shape {states.line_of_sight.shape}, it must be "
            f"(whole number of tiles of {TILE}, 2)"
        )
    if states.surface_motion[:, :M2].any():
        raise UserError(
            f"the stop and M1 of {system.name} stand still where segments are traced; its segments move"
        )
    shape = (len(states), *prepared.figure_matrix.shape[::2])
    if states.segment_figure.shape != shape:
        raise UserError(
            f"the segment figures have the shape {states.segment_figure.shape}, it must be {shape}"
        )
    figure = None
    if prepared.figure_matrix.size:
        lanes_last = states.segment_figure.reshape(-1, TILE, *shape[1:]).transpose(0, 2, 3, 1)
        figure = np.matmul(prepared.figure_matrix, lanes_last)
    wander = _wander(prepared, states)
    chosen = prepared.candidates
    if wander > prepared.margin:
        chosen = candidates(system.segments, prepared.rays.x, prepared.rays.y, wander)
    return trace_segmented(
        prepared.train,
        prepared.rays.x,
        prepared.rays.y,
        system.stop_z,
        chosen,
        segment_poses(system.segments, states.segment_motion),
        figure,
        relative_transforms(*after_m1(system, states.surface_motion)),
        directions(prepared, states),
        chief_rays(prepared, states) if chief is None else chief,
        device,
        _mirror_figure(prepared, states),
    )


def at_field(prepared: PreparedTrace, field: Array) -> PreparedTrace:
    """Return what is prepared, for the light of a field point (2,) in rad."""
    return replace(prepared, system=replace(prepared.system, fields=np.array([field], dtype=np.float64)))


def _angles(prepared: PreparedTrace, states: States) -> Array:
    return prepared.point + states.line_of_sight


def directions(prepared: PreparedTrace, states: States) -> Array:
    """Return the unit vectors (T / 16, 3, 16) of the incoming light."""
    unit: Array = field_directions(_angles(prepared, states))
    return unit


def _wander(prepared: PreparedTrace, states: States) -> float:
    """Return a bound (mm) of how far rays wander across segments by the motions and the field angles."""
    system, motion, angle = prepared.system, states.segment_motion, np.abs(_angles(prepared, states))
    # Instants first is five times as fast as both at once; no magnitudes are stored.
    largest = np.maximum(motion.max(axis=0), -motion.min(axis=0)).max(axis=0)
    if not np.isfinite(largest).all():  # such rays are lost anyhow
        largest = np.where(np.isfinite(motion), np.abs(motion), 0.0).max(axis=(0, 1))
    angle[~np.isfinite(angle)] = 0.0
    steepest = np.sqrt(2.0) * np.tan(angle.max())
    radius = segment_radii(system).max()
    depth = np.abs(system.segments.centers[:, 2] - system.stop_z).max() + radius
    return float(np.sum(largest[:3]) + np.sum(largest[3:]) * radius + steepest * depth)
