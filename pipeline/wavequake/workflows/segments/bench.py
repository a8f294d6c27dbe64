"""What a segment-disturbance study prepares once per process: telescope, rays, fit, PSF basis, LOS gains."""

import io
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from wavequake.campaign.schema import study_from_identity
from wavequake.errors import UserError
from wavequake.kernels.trace.status import OK
from wavequake.mechanics.assembly.plant import Plant
from wavequake.mechanics.disturbances.layout import SegmentLayout
from wavequake.mechanics.disturbances.registry import parts
from wavequake.mechanics.disturbances.source import SegmentSource
from wavequake.optics.derivatives.central import checked_derivative
from wavequake.optics.polynomials.transforms import known_transformed
from wavequake.optics.rays.pupils import PupilRays, on_glass, segment_rays, sunflower
from wavequake.optics.segments.at_rest import STEP, at_rest
from wavequake.optics.segments.catalog import telescope
from wavequake.optics.segments.layout import areas, is_monolithic
from wavequake.optics.segments.prepared import PreparedTrace, at_field, prepare
from wavequake.optics.segments.slopes import slope_fit
from wavequake.optics.segments.telescope import (
    FirstOrder,
    first_order,
    footprints,
    semi_diameters,
    with_segments,
)
from wavequake.optics.shapes.corner_table import distorted
from wavequake.optics.systems.system import OpticalSystem
from wavequake.optics.wavefronts.fits import tells_apart
from wavequake.optics.wavefronts.record import Wavefront
from wavequake.optics.wavefronts.sphere_fit import reference_fit
from wavequake.prepared import prepared
from wavequake.workflows.bodies.segments import CarryingBodies, carrying_bodies
from wavequake.workflows.bodies.telescope import elastic_segments, masses_of, with_bodies
from wavequake.workflows.mirrors.study import FULL
from wavequake.workflows.segments.study import SegmentStudy
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
    what of its light does not arrive, ``field`` (2,) the field point in rad. ``figure_terms`` and
    ``mirror_terms`` are those of the figures of segments and of mirrors after M1. ``place`` is that of the
    field point, times the number of wavelengths, plus that of the wavelength in the study.
    ``plants`` are elastic segments by the models that are compared, the full one first; ``bodies`` are those
    of mass that carry segments and mirrors.
    """

    text: str
    study: SegmentStudy
    system: OpticalSystem
    first_order: FirstOrder
    layout: SegmentLayout
    prepared: PreparedTrace
    static: Wavefront
    stopped: Stopped
    m2_tilt: NDArray[np.float64]
    figure_terms: int
    field: NDArray[np.float64]
    plants: Mapping[str, Plant]
    bodies: CarryingBodies
    mirror_terms: int = 0
    place: int = 0

    @property
    def wavelength_nm(self) -> float:
        """Wavelength of the light."""
        colors = self.study.optics.colors_nm
        return colors[self.place % len(colors)]

    @property
    def unit_mm(self) -> float:
        """Wavelength whose lambda/D is the unit of images, mm: the first one of the study."""
        return self.study.optics.wavelength_nm * 1e-6

    @property
    def where(self) -> str:
        """Field point and wavelength in words, where a study has several; else nothing."""
        optics = self.study.optics
        points, colors = optics.points_arcmin, optics.colors_nm
        field = field_names(points)[self.place // len(colors)]
        words = [f"the field {field}"] * (optics.fields_arcmin is not None)
        words += [f"{self.wavelength_nm:g} nm"] * (optics.wavelengths_nm is not None)
        return " and ".join(words)


def field_names(points: tuple[tuple[float, float], ...]) -> list[str]:
    """Return field points in arcmin in words, such as ``(0, 3) arcmin``."""
    return [f"({x:g}, {y:g}) arcmin" for x, y in points]


@prepared(maxsize=2)
def benches_of(study_text: str) -> tuple[Bench, ...]:
    """Return the study's bench at each field point, and there at each wavelength; raises as `bench_of`."""
    first = bench_of(study_text)
    optics = first.study.optics
    others = range(1, len(optics.points_arcmin) * len(optics.colors_nm))
    return (first, *(_beside(first, place) for place in others))


def bench_at(study_text: str, place: int) -> Bench:
    """Return the study's bench at one of its places; raises as :func:`bench_of`."""
    return benches_of(study_text)[place] if place else bench_of(study_text)


def _beside(first: Bench, place: int) -> Bench:
    """Return the bench of a further place, which shares with the first what is of the pupil."""
    optics = first.study.optics
    point, color = divmod(place, len(optics.colors_nm))
    field = np.array(optics.points_arcmin[point]) * _ARCMIN
    light = _in_color(first, optics.colors_nm[color] * 1e-6)
    system, prepared = light.system, _at_field(light, first.study, field)
    static, stopped, _ = _reference(first.study, prepared)
    own = replace(first, system=system, prepared=prepared, static=static, stopped=stopped, field=field)
    return replace(own, place=place, first_order=first_order(system))


def _in_color(first: Bench, wavelength: float) -> PreparedTrace:
    """Return what is prepared, for light of another wavelength (mm), which lenses refract otherwise."""
    if not has_lenses(first.system):
        return replace(first.prepared, wavelength=wavelength)
    terms, rays = first.study.wavefront.zernike_terms, first.prepared.rays
    return prepare(first.system, rays, wavelength, terms, first.figure_terms, first.mirror_terms)


def has_lenses(system: OpticalSystem) -> bool:
    """Return whether light is refracted after M1."""
    return any(surface.action == "refract" for surface in system.after_primary)


@prepared(maxsize=2)
def bench_of(study_text: str) -> Bench:
    """Prepare the study with this identity text, at its first field point and wavelength.

    It runs on one BLAS thread wherever it is called from, because the last bits of a factorization depend on
    their number.

    Raises
    ------
    UserError
        If no ray of the pupil meets glass, or none of a segment the image, polygons overlap, or the study is
        otherwise impossible.
    """
    return _prepared(study_text)


def _prepared(study_text: str) -> Bench:
    study = study_from_identity(SegmentStudy, study_text)
    wavelength = study.optics.wavelength_nm * 1e-6
    system = replace(build_telescope(study), wavelengths=np.array([wavelength]))
    _require_m2(study, system)
    _require_mirrors_for_colors(study, system)
    plants = elastic_segments(study, system)
    bodies = carrying_bodies(masses_of(study), system)
    layout = with_bodies(replace(layout_of(system), segment=plants.get(FULL)), study, bodies)
    _require_elements(study, layout, (*system.bodies, *(one.name for one in study.body)))
    rays = build_rays(study, system)
    terms, mirror_terms = deformed_terms(study, layout)
    prepared = prepare(
        system, rays, wavelength, study.wavefront.zernike_terms, figure_terms=terms, mirror_terms=mirror_terms
    )
    at = np.array(study.optics.points_arcmin[0]) * _ARCMIN
    prepared = _at_field(prepared, study, at)
    static, stopped, tilt = _reference(study, prepared)
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
        at,
        plants,
        bodies,
        mirror_terms,
    )


def _at_field(prepared: PreparedTrace, study: SegmentStudy, field: NDArray[np.float64]) -> PreparedTrace:
    """Return what is prepared, for the light of a field point (2,) in rad."""
    prepared = at_field(prepared, field)
    edges = None  # looking at them takes a tenth of the trace
    if not _beam_clears_mirrors(prepared, field):
        edges = semi_diameters(prepared.system.after_primary)
    prepared = replace(
        prepared, train=replace(prepared.train, semi_diameters=edges), slopes=None, sphere=None
    )
    if study.wavefront.method == "slopes":
        prepared = replace(prepared, slopes=slope_fit(prepared))
    if study.wavefront.reference == "fitted":
        prepared = replace(prepared, sphere=reference_fit(prepared))
    return prepared


@np.errstate(invalid="ignore", over="ignore")
def _beam_clears_mirrors(prepared: PreparedTrace, field: NDArray[np.float64]) -> bool:
    """Return whether the beam stays inside all mirrors by 1 %, more than any motion that can be imaged needs.

    From the axial footprint and, generously, four times the way of light from the field point.
    """
    system, rays = prepared.system, prepared.rays
    edges = semi_diameters(system.after_primary[:-1])
    places = np.array([np.zeros(3), *(surface.position for surface in system.after_primary)])
    way = np.linalg.norm(np.diff(places, axis=0), axis=1).sum()
    reach = max(
        1.0, np.hypot(rays.x, rays.y).max() / system.annulus.outer
    )  # glass beyond the pupil's annulus
    beam = reach * footprints(system) + 4.0 * way * np.tan(np.abs(field)).sum()
    return bool((beam <= 0.99 * edges).all())


def in_basis(bench: Bench, coefficients: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return annular Noll coefficients (..., J) as the study wants them; an unknown piston stays unknown."""
    if bench.study.wavefront.basis == "annular":
        return coefficients
    return known_transformed(coefficients, bench.prepared.system.pupil.obscuration, 0.0)


def monolithic(system: OpticalSystem) -> bool:
    """Return whether M1 is one mirror without edges."""
    return is_monolithic(system.segments)


def build_telescope(study: SegmentStudy) -> OpticalSystem:
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
    return with_segments(system, distorted(system.segments, io.StringIO(section.corners_csv)))


def build_rays(study: SegmentStudy, system: OpticalSystem) -> PupilRays:
    """Sample the pupil; rays that meet no glass are dropped.

    Raises
    ------
    UserError
        If no ray is left.
    """
    optics = study.optics
    if optics.sampling == "segments" and not monolithic(system):
        return segment_rays(system.segments, _TRIANGLE_POINTS[optics.rays_per_segment])
    return on_glass(system, sunflower(system.annulus.inner, system.annulus.outer, optics.rays))


def deformed_terms(study: SegmentStudy, layout: SegmentLayout) -> tuple[int, int]:
    """Return the highest Noll index of any figure of a segment, and of a mirror after M1 (0: none)."""
    drawn = max((max(getattr(one, "figure_nm", {}), default=0) for one in study.disturbance), default=0)
    named = [
        part.figure_terms(layout)
        for population in study.disturbance
        for part in parts(study.disturbance, population)
    ]
    segments = [count for one in named for name, count in one.items() if name in layout.names]
    mirrors = [count for one in named for name, count in one.items() if name not in layout.names]
    return max(drawn, *segments, 0), max(*mirrors, 0, 0)


def layout_of(system: OpticalSystem) -> SegmentLayout:
    """Return the segments for the mechanics: SI units, z to the sky."""
    segments = system.segments
    annulus = np.array([np.pi * (system.annulus.outer**2 - system.annulus.inner**2)])
    return SegmentLayout(
        names=segments.names,
        centers_m=segments.centers * [1.0, 1.0, -1.0] / MM_PER_M,
        axes=segments.axes,
        corners_m=segments.corners / MM_PER_M,
        areas_m2=(annulus if monolithic(system) else areas(segments)) / MM_PER_M**2,
        others=(*system.bodies, *(surface.name for surface in system.after_primary)),
        owner=f"the telescope {system.name}",
    )


def _require_m2(study: SegmentStudy, system: OpticalSystem) -> None:
    for population in study.disturbance:
        if getattr(population, "act", "") == "m2" and system.after_primary[0].action != "reflect":
            raise UserError(
                f"The disturbance {population.name!r} tilts M2, but the telescope {system.name} has no "
                "mirror after the primary one; choose act = 'mount'."
            )


def _require_mirrors_for_colors(study: SegmentStudy, system: OpticalSystem) -> None:
    if study.imaging.wavelengths_nm is not None and has_lenses(system):
        raise UserError(
            "imaging.wavelengths_nm adds images of colors whose paths are the same, as mirrors make them, "
            f"but the telescope {system.name} has lenses; give optics.wavelengths_nm, each is traced."
        )


def _require_elements(study: SegmentStudy, layout: SegmentLayout, bodies: tuple[str, ...]) -> None:
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
            image = (layout.others or ("",))[-1]
            if image in part.figure_terms(layout):
                raise UserError(
                    f"The disturbance {part.name!r} deforms {image!r} of {layout.owner}, where the image is; "
                    "segments and mirrors deform."
                )
            if body := next((name for name in part.figure_terms(layout) if name in bodies), None):
                raise UserError(
                    f"The disturbance {part.name!r} deforms {body!r} of {layout.owner}, a body of several "
                    "surfaces; name the surface that deforms."
                )
            grid = next(iter(part.figure_grids()), None)
            if grid is not None:
                raise UserError(
                    f"The disturbance {part.name!r} deforms {grid!r} of {layout.owner} on a grid; its "
                    "segments and mirrors deform by Noll coefficients (.zN_nm)."
                )


def _reference(
    study: SegmentStudy, prepared: PreparedTrace
) -> tuple[Wavefront, Stopped, NDArray[np.float64]]:
    """Measure the reference configuration, its lost light, and M2's rotations for 1 rad of line of sight.

    Without a mirror after M1 the rotations are zero.
    """
    sections = study.telescope, study.optics, study.wavefront
    known_by = tuple(section.model_dump_json() for section in sections)
    wavefront, status = at_rest(prepared, known_by)
    refuse_dark_segment(prepared, status, wavefront.lost_segments[0])
    stopped = stopped_at_rest(prepared, status)
    if stopped.words() and not tells_apart(prepared.fit, status == OK):
        raise UserError(
            f"{stopped.words()}; the others do not determine {prepared.fit.basis.shape[1]} "
            "Zernike terms: take fewer wavefront.zernike_terms, or a larger semi_diameter_mm."
        )
    if prepared.system.after_primary[0].action != "reflect":
        return wavefront, stopped, np.zeros((2, 2))
    los = wavefront.los[1:9].reshape(4, 2, 2)
    per_tilt = checked_derivative(los, STEP, "M2's tilt", "take other optics.rays").T
    return wavefront, stopped, np.asarray(np.linalg.inv(per_tilt / prepared.focal_length), dtype=np.float64)
