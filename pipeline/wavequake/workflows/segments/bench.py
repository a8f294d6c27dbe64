"""What a segment-disturbance study prepares once per process: telescope, rays, fit, PSF basis, LOS gains."""

import io
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from wavequake.campaign.schema import study_from_identity
from wavequake.errors import UserError
from wavequake.kernels.device.devices import choose_device
from wavequake.kernels.device.tiles import TILE
from wavequake.kernels.trace.train import OK
from wavequake.mechanics.disturbances.layout import SegmentLayout
from wavequake.mechanics.disturbances.registry import Disturbance, parts
from wavequake.mechanics.disturbances.source import SegmentSource
from wavequake.optics.derivatives.central import SIGNS, checked_derivative
from wavequake.optics.polynomials.transforms import known_transformed
from wavequake.optics.rays.pupils import PupilRays, on_glass, segment_rays, sunflower
from wavequake.optics.segments.catalog import telescope
from wavequake.optics.segments.layout import areas, is_monolithic
from wavequake.optics.segments.prepared import PreparedTrace, chief_rays, prepare, trace_states
from wavequake.optics.segments.slopes import slope_fit
from wavequake.optics.segments.states import SurfaceStates, rest
from wavequake.optics.segments.telescope import FirstOrder, SegmentedTelescope, first_order, footprints
from wavequake.optics.segments.wavefront import Wavefront, analyse
from wavequake.optics.shapes.corner_table import distorted
from wavequake.optics.wavefronts.fits import tells_apart
from wavequake.optics.wavefronts.sphere_fit import reference_fit
from wavequake.prepared import prepared
from wavequake.workflows.segments.segment_study import SegmentStudy
from wavequake.workflows.segments.vignetting import Stopped, refuse_dark_segment, stopped_at_rest

MM_PER_M = 1e3
MAS_PER_RAD = 180.0 / np.pi * 3600.0 * 1e3
_TRIANGLE_POINTS = {6: 1, 18: 3, 36: 6, 72: 12}
_ARCMIN = np.pi / 180.0 / 60.0


@dataclass(frozen=True)
class Bench:
    """Everything of a study that does not change from case to case.

    ``text`` is the study's identity text; ``m2_tilt`` (2, 2) gives M2's rotations about x and y in rad per
    rad of line of sight on the sky; ``static`` is the wavefront of the reference configuration, ``stopped``
    what of its light does not arrive, ``field`` (2,) the field point in rad.
    """

    text: str
    study: SegmentStudy
    system: SegmentedTelescope
    first_order: FirstOrder
    layout: SegmentLayout
    prepared: PreparedTrace
    static: Wavefront
    stopped: Stopped
    m2_tilt: NDArray[np.float64]
    figure_terms: int
    field: NDArray[np.float64]


@prepared(maxsize=2)
def bench_of(study_text: str) -> Bench:
    """Prepare the study with this identity text.

    It runs on one BLAS thread wherever it is called from, because the last bits of a factorization depend on
    their number.

    Raises
    ------
    UserError
        If no ray of the pupil meets glass, or none of a segment the image, polygons overlap, or the study is
        otherwise impossible.
    """
    with threadpool_limits(1):
        return _prepared(study_text)


def _prepared(study_text: str) -> Bench:
    study = study_from_identity(SegmentStudy, study_text)
    system = build_telescope(study)
    _require_m2(study, system)
    layout = layout_of(system)
    _require_elements(study, layout)
    rays = build_rays(study, system)
    terms = figure_terms(study.disturbance)
    wavelength = study.optics.wavelength_nm * 1e-6
    prepared = prepare(system, rays, wavelength, study.wavefront.zernike_terms, figure_terms=terms)
    field = np.array(study.optics.field_arcmin) * _ARCMIN
    at = (float(field[0]), float(field[1]))
    if _beam_clears_mirrors(prepared, field):  # looking at their edges takes a tenth of the trace
        prepared = replace(prepared, train=replace(prepared.train, semi_diameters=None))
    if study.wavefront.method == "slopes":
        prepared = replace(prepared, slopes=slope_fit(prepared, at))
    if study.wavefront.reference == "fitted":
        prepared = replace(prepared, sphere=reference_fit(prepared, at))
    static, stopped, tilt = _reference(system, prepared, field, terms)
    return Bench(
        study_text,
        study,
        system,
        first_order(system),
        layout,
        prepared,
        static,
        stopped,
        tilt,
        terms,
        field,
    )


def _beam_clears_mirrors(prepared: PreparedTrace, field: NDArray[np.float64]) -> bool:
    """Return whether the beam stays inside all mirrors by 1 %, more than any motion that can be imaged needs.

    From the axial footprint and, generously, four times the way of light from the field point.
    """
    system, rays = prepared.system, prepared.rays
    edges = np.array([mirror.semi_diameter for mirror in system.surfaces[:-1]])
    places = np.array([np.zeros(3), *(surface.position for surface in system.surfaces)])
    way = np.linalg.norm(np.diff(places, axis=0), axis=1).sum()
    reach = max(1.0, np.hypot(rays.x, rays.y).max() / system.pupil_outer)  # glass beyond the pupil's annulus
    beam = reach * footprints(system) + 4.0 * way * np.tan(np.abs(field)).sum()
    return bool((beam <= 0.99 * edges).all())


def in_basis(bench: Bench, coefficients: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return annular Noll coefficients (..., J) as the study wants them; an unknown piston stays unknown."""
    if bench.study.wavefront.basis == "annular":
        return coefficients
    return known_transformed(coefficients, bench.prepared.obscuration, 0.0)


def monolithic(system: SegmentedTelescope) -> bool:
    """Return whether M1 is one mirror without edges."""
    return is_monolithic(system.segments)


def build_telescope(study: SegmentStudy) -> SegmentedTelescope:
    """Build the telescope that a study describes."""
    section = study.telescope
    if section.name == "custom":
        surfaces = [surface.model_dump() for surface in section.surfaces]
        return telescope(
            "custom",
            polygons=io.StringIO(section.polygons_csv or ""),
            primary_radius=section.primary_radius_mm,
            primary_conic=section.primary_conic,
            surfaces=surfaces,
        )
    options = {"side": section.side_mm, "gap": section.gap_mm}
    system = telescope(section.name, **{key: value for key, value in options.items() if value is not None})
    if section.corners_csv is None:
        return system
    return replace(system, segments=distorted(system.segments, io.StringIO(section.corners_csv)))


def build_rays(study: SegmentStudy, system: SegmentedTelescope) -> PupilRays:
    """Sample the pupil; rays that meet no glass are dropped.

    Raises
    ------
    UserError
        If no ray is left.
    """
    optics = study.optics
    if optics.sampling == "segments" and not monolithic(system):
        return segment_rays(system.segments, _TRIANGLE_POINTS[optics.rays_per_segment])
    return on_glass(system, sunflower(system.pupil_inner, system.pupil_outer, optics.rays))


def figure_terms(populations: Iterable[Disturbance]) -> int:
    """Return the highest Noll index of any segment figure in the study (0: none)."""
    return max(
        (max(getattr(population, "figure_nm", {}), default=0) for population in populations), default=0
    )


def layout_of(system: SegmentedTelescope) -> SegmentLayout:
    """Return the segments for the mechanics: SI units, z to the sky."""
    segments = system.segments
    annulus = np.array([np.pi * (system.pupil_outer**2 - system.pupil_inner**2)])
    return SegmentLayout(
        names=segments.names,
        centers_m=segments.centers * [1.0, 1.0, -1.0] / MM_PER_M,
        axes=segments.axes,
        corners_m=segments.corners / MM_PER_M,
        areas_m2=(annulus if monolithic(system) else areas(segments)) / MM_PER_M**2,
        others=tuple(surface.name for surface in system.surfaces),
        owner=f"the telescope {system.name}",
    )


def _require_m2(study: SegmentStudy, system: SegmentedTelescope) -> None:
    for population in study.disturbance:
        if getattr(population, "act", "") == "m2" and not system.surfaces[0].reflects:
            raise UserError(
                f"The disturbance {population.name!r} tilts M2, but the telescope {system.name} has no "
                "mirror after the primary one; choose act = 'mount'."
            )


def _require_elements(study: SegmentStudy, layout: SegmentLayout) -> None:
    """Raise UserError if a disturbance moves what there is not, or deforms what cannot."""
    for population in study.disturbance:
        for part in parts(study.disturbance, population):
            for name in part.elements(layout):
                if layout.others and name in layout.others and name in layout.names:
                    raise UserError(
                        f"The disturbance {part.name!r} acts on {name!r}, which is both a segment and a "
                        f"surface of {layout.owner}; rename the segment."
                    )
            if isinstance(part, SegmentSource):
                part.moving(layout)
            deformed = next(iter({**part.figure_terms(layout), **part.figure_grids()}), None)
            if deformed is not None:
                raise UserError(
                    f"The disturbance {part.name!r} deforms {deformed!r} of {layout.owner}: only segments "
                    'deform, by the model "static-random"; leave the figures out of its file.'
                )


def _reference(
    system: SegmentedTelescope, prepared: PreparedTrace, field: NDArray[np.float64], terms: int
) -> tuple[Wavefront, Stopped, NDArray[np.float64]]:
    """Measure the reference configuration, its lost light, and M2's rotations for 1 rad of line of sight.

    Without a mirror after M1 the rotations are zero. Both come from NumPy whatever the study's device, so
    that they are the same on every worker.
    """
    step = 1e-6
    still = rest(TILE, len(system.segments), len(system.surfaces), terms)
    motion = still.surface_motion.copy()
    for place, axis in enumerate((3, 4)):
        motion[1 + place : 9 : 2, 0, axis] = SIGNS * step
    states = SurfaceStates(still.segment_motion, still.segment_figure, motion, still.field + field)
    traced = trace_states(prepared, states, choose_device("numpy"))
    wavefront = analyse(prepared, traced, chief_rays(prepared, states))
    status = np.asarray(traced.status[0, :, 0])
    refuse_dark_segment(prepared, status, wavefront.lost_segments[0])
    stopped = stopped_at_rest(prepared, status)
    if stopped.words() and not tells_apart(prepared.zernike, status == OK):
        raise UserError(
            f"{stopped.words()}; the others do not determine {prepared.zernike.basis.shape[1]} "
            "Zernike terms: take fewer wavefront.zernike_terms, or a larger semi_diameter_mm."
        )
    if not system.surfaces[0].reflects:
        return wavefront, stopped, np.zeros((2, 2))
    los = wavefront.los[1:9].reshape(4, 2, 2)
    per_tilt = checked_derivative(los, step, "M2's tilt", "take other optics.rays").T
    return wavefront, stopped, np.asarray(np.linalg.inv(per_tilt / prepared.focal_length), dtype=np.float64)
