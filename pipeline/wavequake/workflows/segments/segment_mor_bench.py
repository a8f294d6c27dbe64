"""What a ``segment-mor`` study prepares once per process: telescope, segment model, maps to the optics."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from wavequake.campaign.schema import study_from_identity
from wavequake.errors import UserError
from wavequake.mechanics.disturbances.motion import generator
from wavequake.mechanics.disturbances.sources.static_random import StaticRandom
from wavequake.mechanics.mirrors.material import Material
from wavequake.mechanics.mirrors.models import HexagonalSegment, hexagonal_segment, on_springs
from wavequake.mechanics.model import FiniteElementModel, RayleighDamping, ReducedModel
from wavequake.mechanics.vibration.drive import Drive
from wavequake.mechanics.vibration.excitations import AnyExcitation, RandomVibration, drive_of
from wavequake.mechanics.vibration.modal import modal_model
from wavequake.mechanics.vibration.response import displacements, respond
from wavequake.optics.segments.layout import Segments, is_monolithic
from wavequake.optics.segments.telescope import SegmentedTelescope
from wavequake.optics.shapes.fit import SurfaceFit, apply, separate_pose, surface_fit
from wavequake.optics.shapes.shapes import Conic
from wavequake.prepared import prepared
from wavequake.reduction.intermediate import Intermediate, intermediate
from wavequake.reduction.metrics import eps_mor, full_receptance, receptance
from wavequake.reduction.names import parse
from wavequake.reduction.two_stage import covers, reduce_variants, reference
from wavequake.workflows.mirrors.mirror_study import FULL
from wavequake.workflows.mirrors.model_store import digest, kept_arrays, kept_intermediate
from wavequake.workflows.segments.bench import Bench, bench_of
from wavequake.workflows.segments.segment_mor_study import SegmentMorStudy
from wavequake.workflows.segments.segment_study import (
    ImagingSection,
    OpticsSection,
    SegmentStudy,
    WavefrontSection,
)
from wavequake.workflows.segments.vignetting import require_all_rays

Array = NDArray[np.float64]

MM_PER_M, NM_PER_MM = 1e3, 1e6
# Segments whose responses are held at once.
_BLOCK = 32
# How far a corner may stand off its place of a regular hexagon: segments of a curved mirror are not regular.
_SKEW_DEG = 3.0
_MOUNTS = 0.6


@dataclass(frozen=True)
class SegmentModel:
    """The segment of a study, its optical fit, and the answers of its reference.

    Attributes
    ----------
    bench : Bench
        The telescope.
    stage : Intermediate
    full : callable
        Builds the finite-element model, for variants that the intermediate one does not cover.
    fit : SurfaceFit
        Of the figure over the segment's circle, in the segment's local frame.
    turn : float
        Angle in rad from the local x axis to the first corner, which is the x axis of the model.
    reference : ReducedModel
    mechanical, optical : ndarray
        Transfer matrices of the reference, (f, 9, 9) in m/N and (f, J, 9) in nm/N.
    """

    bench: Bench
    stage: Intermediate
    full: Callable[[], FiniteElementModel]
    fit: SurfaceFit
    turn: float
    reference: ReducedModel
    mechanical: NDArray[np.complex128]
    optical: NDArray[np.complex128]


def study_of(text: str) -> SegmentMorStudy:
    """Rebuild a study from its identity."""
    study: SegmentMorStudy = study_from_identity(SegmentMorStudy, text)
    return study


def telescope_study(study: SegmentMorStudy) -> SegmentStudy:
    """Return the telescope, light and image as a study of ``segment-disturbance``, whose bench is reused.

    Its only disturbance is a figure of zero, which says how many terms a segment's figure has.
    """
    optics = OpticsSection(**study.optics.model_dump(exclude={"zernike_terms"}))
    return SegmentStudy(
        study=study.study.model_copy(update={"workflow": "segment-disturbance", "title": ""}),
        telescope=study.telescope,
        disturbance=(StaticRandom(name="figure", figure_nm={study.segments.figure_terms: 0.0}, instants=1),),
        optics=optics,
        wavefront=WavefrontSection(zernike_terms=study.optics.zernike_terms),
        imaging=ImagingSection(pixels=study.imaging.pixels, sampling=study.imaging.sampling),
    )


@prepared(maxsize=2)
def model_of(text: str) -> SegmentModel:
    """Prepare a study; one BLAS thread, so that its bits are the same in every process.

    Raises
    ------
    UserError
        If the telescope has no hexagonal segments, a dimension is not possible, or the surface has too few
        nodes for the Zernike terms.
    """
    with threadpool_limits(1):
        study = study_of(text)
        bench = bench_of(telescope_study(study).identity_text())
        require_all_rays(bench.stopped, "so that there are no wavefronts of all segments to compare")
        side, turn = hexagon_of(bench.system)
        record = _stage_record(study, bench.system)
        build = partial(build_segment, study, side, bench.system.primary_radius)
        full = prepared(maxsize=1)(build)
        stage = kept_intermediate(
            digest(record), lambda: intermediate(full(), highest=study.reduction.last_hz)
        )
        fit = figure_fit(study, bench.system, stage, side, turn)
        name = study.reduction.reference
        chosen = reference(stage) if name == FULL else _variant(stage, full, name)
        frequencies = frequencies_of(study)
        return SegmentModel(
            bench=bench,
            stage=stage,
            full=full,
            fit=fit,
            turn=turn,
            reference=chosen,
            mechanical=receptance(chosen, frequencies),
            optical=receptance(chosen, frequencies, height_rows(fit, turn, chosen)),
        )


def _stage_record(study: SegmentMorStudy, system: SegmentedTelescope) -> dict[str, object]:
    """Return what determines the intermediate model."""
    return {
        "segment": study.model.model_dump(mode="json"),
        "side_mm": hexagon_of(system)[0],
        "parent_mm": system.primary_radius,
        "highest_hz": study.reduction.last_hz,
    }


def frequencies_of(study: SegmentMorStudy) -> Array:
    """Return the frequencies of a study, Hz."""
    section = study.reduction
    return np.asarray(np.linspace(section.first_hz, section.last_hz, section.frequencies), dtype=np.float64)


def time_of(study: SegmentMorStudy) -> Array:
    """Return the instants of the time response, s."""
    return np.arange(study.time.instants, dtype=np.float64) * study.time.step_s


def traced_instants(study: SegmentMorStudy) -> NDArray[np.int64]:
    """Return which instants of the time response are traced: evenly spread, the last one among them.

    The first instant, at which all is at rest, is left out.
    """
    count = study.fewest_instants
    places = np.rint(np.arange(1, count + 1) * ((study.time.instants - 1) / count))
    return np.asarray(places, dtype=np.int64)


def hexagon_of(system: SegmentedTelescope) -> tuple[float, float]:
    """Return the side of the largest segment in mm, and the angle in rad of a corner to the local x axis.

    Raises
    ------
    UserError
        If the segments are not hexagons that all lie alike in their local frames.
    """
    segments = system.segments
    if not is_monolithic(segments) and segments.corners.shape[1] == 6:
        angles = np.exp(6j * _corner_angles(segments))
        turn = float(np.angle(angles.mean())) / 6
        if np.abs(np.angle(angles * np.exp(-6j * turn))).max() / 6 <= np.deg2rad(_SKEW_DEG):
            radii = np.linalg.norm(segments.corners - segments.centers[:, None, :2], axis=2)
            return float(radii.max()), turn if turn > -np.deg2rad(_SKEW_DEG) else turn + np.pi / 3
    raise UserError(
        f"The segments of the telescope {system.name} are not hexagons that lie alike in their local frames; "
        "segment-mor models such segments: choose tmt, tmt-18 or jwst."
    )


def _corner_angles(segments: Segments) -> Array:
    """Return the angles (S, 6) of the corners in the segments' local frames, rad."""
    across = segments.corners - segments.centers[:, None, :2]
    # Corners are lifted onto the tangent plane: their height is what their normal leaves no other choice.
    normal = segments.axes[:, None, :, 2]
    height = -np.sum(across * normal[..., :2], axis=2) / normal[..., 2]
    corners = np.concatenate([across, height[..., None]], axis=2)
    local = np.einsum("svk,skl->svl", corners, segments.axes)
    return np.asarray(np.arctan2(local[..., 1], local[..., 0]))


def build_segment(study: SegmentMorStudy, side: float, parent_radius: float) -> FiniteElementModel:
    """Return the finite-element model of a segment, on its springs if it has any; `side`, radius in mm."""
    section = study.model
    side = side / MM_PER_M
    mirror = HexagonalSegment(
        side=side,
        thickness=section.thickness_m,
        parent_radius=abs(parent_radius) / MM_PER_M,
        material=Material(section.youngs_modulus_pa, section.poisson_ratio, section.density_kg_m3),
        mount_radius=section.mount_radius_m or _MOUNTS * side,
        damping=RayleighDamping(section.damping_alpha, section.damping_beta),
        divisions=section.divisions,
        layers=section.layers,
    )
    model = hexagonal_segment(mirror)
    return model if section.support == "rigid" else on_springs(model, section.spring_n_m)


def figure_fit(
    study: SegmentMorStudy, system: SegmentedTelescope, stage: Intermediate, side: float, turn: float
) -> SurfaceFit:
    """Return the fit of Zernike terms over the circle about the segment, in its local frame, mm."""
    nodes = (stage.nodes[stage.surface_nodes] * MM_PER_M) @ _turned(turn).T
    return surface_fit(
        nodes[:, :2],
        stage.surface_weights,
        study.segments.figure_terms,
        side,
        0.0,
        Conic(abs(system.primary_radius), -1.0),
    )


def _turned(angle: float) -> Array:
    """Return the rotation about z that brings a vector of the model's frame into the local frame."""
    cosine, sine = np.cos(angle), np.sin(angle)
    return np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])


def _shapes(fit: SurfaceFit, turn: float, model: ReducedModel) -> Array:
    """Return what each coordinate of a model does to the surface nodes: (r, p, 3) in mm, local frame."""
    shapes = (model.surface.T * MM_PER_M).reshape(model.order, len(fit.nodes), 3)
    turned: Array = shapes @ _turned(turn).T
    return turned


def height_rows(fit: SurfaceFit, turn: float, model: ReducedModel) -> Array:
    """Return the Noll coefficients of the surface's heights, rigid motion included: (J, r) in nm per m."""
    rows: Array = apply(fit, _shapes(fit, turn, model)).T * NM_PER_MM
    return rows


def motion_rows(fit: SurfaceFit, turn: float, model: ReducedModel) -> Array:
    """Return rigid motion (mm, rad) and figure (mm) of a segment per coordinate of a model: (6 + J, r).

    The rigid motion is the one that fits the displacements of the surface best; the figure, Noll coefficients
    of the heights of what it leaves (Störkle 2018, Eq. 4.7 to 4.10), so that together nothing is counted
    twice.
    """
    poses, rest = separate_pose(fit, _shapes(fit, turn, model))
    rows: Array = np.concatenate([poses, apply(fit, rest)], axis=1).T
    return rows


def reduced(model: SegmentModel, variant: str) -> ReducedModel:
    """Return a variant of the segment's model."""
    return _variant(model.stage, model.full, variant)


def _variant(stage: Intermediate, full: Callable[[], FiniteElementModel], name: str) -> ReducedModel:
    whole = None if covers(stage, parse(name)) else full()
    return reduce_variants(stage, [name], whole)[0]


def chosen_segments(study: SegmentMorStudy, bench: Bench, disturbed: str) -> NDArray[np.int64]:
    """Return which segments are shaken.

    Raises
    ------
    UserError
        If the telescope has no segment of the name that the study gives.
    """
    names = bench.system.segments.names
    if disturbed == "all":
        return np.arange(len(names))
    wanted = study.segments.name or names[0]
    if wanted not in names:
        raise UserError(
            f"segments.name is {wanted!r}, but the segments of {bench.system.name} are called {names[0]} to "
            f"{names[-1]}."
        )
    return np.array([names.index(wanted)])


def motions(
    study: SegmentMorStudy, model: SegmentModel, variant: ReducedModel, which: Sequence[int]
) -> Array:
    """Return motion and figure of segments at the traced instants: (excitation, time, segment, 6 + J), mm.

    A random vibration is a realization of its own at every segment, the same for all variants; others are
    alike but for the sign.
    """
    rows = motion_rows(model.fit, model.turn, variant)
    time, instants = time_of(study), traced_instants(study)
    found = np.empty((len(study.excitation), len(instants), len(which), len(rows)))
    for number, excitation in enumerate(study.excitation):
        if isinstance(excitation, RandomVibration):
            for place, drives in _blocks(study, excitation, which, time):
                response = respond(modal_model(variant, drives[0].prescribed), drives, time)
                moved = displacements(response, rows)[:, instants]
                found[number, :, place] = moved.transpose(1, 0, 2)
        else:
            drive = segment_drive(study, excitation, time, 0)
            response = respond(modal_model(variant, drive.prescribed), [drive], time)
            moved = displacements(response, rows)[0, instants]
            signs = segment_signs(study, excitation, model.bench)[list(which)]
            found[number] = moved[:, None, :] * signs[:, None]
    return found


def _blocks(
    study: SegmentMorStudy, excitation: AnyExcitation, which: Sequence[int], time: Array
) -> Iterator[tuple[slice, list[Drive]]]:
    for first in range(0, len(which), _BLOCK):
        part = which[first : first + _BLOCK]
        yield (
            slice(first, first + len(part)),
            [segment_drive(study, excitation, time, int(segment)) for segment in part],
        )


def segment_drive(study: SegmentMorStudy, excitation: AnyExcitation, time: Array, segment: int) -> Drive:
    """Return what an excitation does at the three supports of one segment."""
    drive = _drawn(excitation, len(time), study.time.step_s, study.study.seed, segment)
    return drive if study.model.support == "rigid" else through_springs(drive, study.model.spring_n_m)


@prepared(maxsize=2048)
def _drawn(excitation: AnyExcitation, instants: int, step: float, seed: int, segment: int) -> Drive:
    """Draw an excitation once for all variants."""
    return drive_of(excitation, 3, np.arange(instants, dtype=np.float64) * step, seed, segment)


def through_springs(drive: Drive, stiffness: tuple[float, float, float]) -> Drive:
    """Return the forces by which the moving far ends of the springs shake a body; forces stay as they are.

    The dampers beside the springs (of a damping proportional to stiffness) are taken to end on still ground:
    their share is damping_beta times the angular frequency.
    """
    held = drive.prescribed
    factor = np.where(held, np.tile(stiffness, len(held) // 3), 1.0)
    return replace(
        drive,
        prescribed=np.zeros_like(held),
        harmonics=tuple(
            replace(wave, cosine=factor * wave.cosine, sine=factor * wave.sine) for wave in drive.harmonics
        ),
        samples=None if drive.samples is None else factor * drive.samples,
    )


def segment_signs(study: SegmentMorStudy, excitation: AnyExcitation, bench: Bench) -> Array:
    """Return the sign (S,) of an excitation at every segment, which does not depend on other excitations."""
    count = len(bench.system.segments)
    if study.segments.signs == "alike":
        return np.ones(count)
    random = generator(study.study.seed, f"{excitation.name} sign", 0)
    signs: Array = random.choice([-1.0, 1.0], count)
    return signs


def spot_check(text: str) -> tuple[Array, Array]:
    """Compare the intermediate model with the full one where its basis was not built; kept on disk.

    Returns
    -------
    frequencies, errors : ndarray, shape (checks,)
        Hz, and the relative error of the transfer matrix (Störkle 2018, Eq. 2.10).
    """
    study, model = study_of(text), model_of(text)
    section = study.reduction
    # Irrational parts of the band: no expansion point of the basis lies there.
    parts = np.modf((np.arange(section.spot_checks) + 1) * (np.sqrt(5.0) - 1) / 2)[0]
    frequencies = np.sort(section.first_hz + parts * (section.last_hz - section.first_hz))
    if not len(frequencies):
        return frequencies, frequencies.copy()

    def checked() -> dict[str, Array]:
        with threadpool_limits(1):
            truth = full_receptance(model.full(), frequencies)
            return {"errors": eps_mor(truth, receptance(reference(model.stage), frequencies))}

    record = {"check": frequencies.tolist(), **_stage_record(study, model.bench.system)}
    return frequencies, kept_arrays(digest(record), checked)["errors"]
