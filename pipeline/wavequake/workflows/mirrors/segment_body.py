"""A hexagonal segment as an elastic body: its model on supports, and what of it the optics see."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from wavequake.errors import UserError
from wavequake.mechanics.assembly.plant import Plant
from wavequake.mechanics.mirrors.material import Material
from wavequake.mechanics.mirrors.models import HexagonalSegment, hexagonal_segment, on_springs
from wavequake.mechanics.model import FiniteElementModel, ReducedModel
from wavequake.mechanics.vibration.modal import modal_model
from wavequake.optics.segments.layout import Segments, is_monolithic
from wavequake.optics.shapes.fit import SurfaceFit, apply, separate_pose, surface_fit
from wavequake.optics.shapes.shapes import Conic
from wavequake.optics.systems.system import OpticalSystem
from wavequake.prepared import prepared
from wavequake.reduction.intermediate import Intermediate, intermediate
from wavequake.workflows.mirrors.compared_models import reduced_model
from wavequake.workflows.mirrors.model_store import DAMPING, digest, kept_intermediate
from wavequake.workflows.mirrors.segment_section import ElasticSegmentSection, SegmentModelSection
from wavequake.workflows.mirrors.study import FULL

Array = NDArray[np.float64]

MM_PER_M, NM_PER_MM = 1e3, 1e6
# How far a corner may stand off its place of a regular hexagon: segments of a curved mirror are not regular.
_SKEW_DEG = 3.0
_MOUNTS = 0.6


@dataclass(frozen=True)
class SegmentBody:
    """A segment before a reduced model of it is chosen.

    Attributes
    ----------
    stage : Intermediate
    full : callable
        Builds the finite-element model, for variants that the intermediate one does not cover.
    fit : SurfaceFit
        Of the figure over the segment's circle, in the segment's local frame.
    turn : float
        Angle in rad from the local x axis to the first corner, which is the x axis of the model.
    """

    stage: Intermediate
    full: Callable[[], FiniteElementModel]
    fit: SurfaceFit
    turn: float


def segment_body(
    section: SegmentModelSection, system: OpticalSystem, last_hz: float, figure_terms: int
) -> SegmentBody:
    """Return the segment of a telescope, whose intermediate model is kept on disk.

    Raises
    ------
    UserError
        If the telescope has no hexagonal segments, a dimension is not possible, or the surface has too few
        nodes for the Zernike terms.
    """
    side, turn = hexagon_of(system)
    full = prepared(maxsize=1)(partial(build_segment, section, side, system.primary.shape.radius))
    record = stage_record(section, system, last_hz, *DAMPING)
    stage = kept_intermediate(digest(record), lambda: intermediate(full(), highest=last_hz), section.damping)
    return SegmentBody(stage, full, figure_fit(figure_terms, system, stage, side, turn), turn)


def stage_record(
    section: SegmentModelSection, system: OpticalSystem, last_hz: float, *leave: str
) -> dict[str, object]:
    """Return what determines the intermediate model, but for some keys."""
    keys = SegmentModelSection.model_fields.keys() - {*leave}
    return {
        "segment": section.model_dump(mode="json", include=keys),
        "side_mm": hexagon_of(system)[0],
        "parent_mm": system.primary.shape.radius,
        "highest_hz": last_hz,
    }


def variant_of(body: SegmentBody, name: str) -> ReducedModel:
    """Return a model of a segment by its name: reduced, or "full", the intermediate one."""
    return reduced_model(body.stage, body.full, name)


def segment_plant(section: ElasticSegmentSection, system: OpticalSystem) -> Plant:
    """Return the segment on its springs, which stands for all of a telescope.

    Inputs are the shifts of the cell below its center, m, along the segment's local axes, and its turns about
    that center, rad, which move the far ends of the springs; as in ``segment-mor``, dampers beside them end
    on still ground. Outputs are ("rigid", "segment") and ("figure", "segment"). Whatever the model, it is
    shaken as the full one is.

    Raises
    ------
    UserError
        As `segment_body`, or if the reduced model is not possible.
    """
    body = segment_body(section, system, section.last_hz, section.figure_terms)
    full = _on_springs(section, body, FULL)
    if section.reduced == FULL:
        return full
    return replace(_on_springs(section, body, section.reduced), resonances=full.resonances)


def _on_springs(section: ElasticSegmentSection, body: SegmentBody, name: str) -> Plant:
    model = variant_of(body, name)
    modal = modal_model(model)
    held = model.nodes[model.interfaces]  # (3, 3), m, in the model's axes
    back = _turned(body.turn).T  # from the segment's axes to the model's
    onto = np.zeros((len(held), 3, 6))
    for node, place in enumerate(held):
        onto[node] = np.hstack([back, -np.cross(place, np.eye(3)).T @ back])
    forces = np.array(section.spring_n_m)[:, None] * onto  # far ends of the springs
    modal = replace(
        modal,
        inputs=modal.inputs @ forces.reshape(-1, 6),
        input_rates=np.zeros((len(modal.squared), 6)),
        lift=np.zeros((len(modal.modes), 6)),
        prescribed=np.zeros(6, dtype=bool),
    )
    rows = motion_rows(body.fit, body.turn, model)
    rows[:3] /= MM_PER_M
    rows[6:] /= MM_PER_M
    omega = np.sqrt(modal.squared)
    return Plant(
        modal,
        {},
        {},
        {("rigid", "segment"): slice(0, 6), ("figure", "segment"): slice(6, len(rows))},
        np.asarray(rows @ modal.modes),
        np.zeros((len(rows), 6)),
        np.eye(6),
        True,
        (),
        np.array([omega, 0.5 * np.diag(modal.damping) / omega]),
        np.zeros((len(rows), 0)),
        np.zeros((6, 0)),
    )


def hexagon_of(system: OpticalSystem) -> tuple[float, float]:
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
        "an elastic segment is modeled as such: choose tmt, tmt-18 or jwst."
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


def build_segment(section: SegmentModelSection, side: float, parent_radius: float) -> FiniteElementModel:
    """Return the finite-element model of a segment, on its springs if it has any; `side`, radius in mm."""
    side = side / MM_PER_M
    mirror = HexagonalSegment(
        side=side,
        thickness=section.thickness_m,
        parent_radius=abs(parent_radius) / MM_PER_M,
        material=Material(section.youngs_modulus_pa, section.poisson_ratio, section.density_kg_m3),
        mount_radius=section.mount_radius_m or _MOUNTS * side,
        damping=section.damping,
        divisions=section.divisions,
        layers=section.layers,
    )
    model = hexagonal_segment(mirror)
    return model if section.support == "rigid" else on_springs(model, section.spring_n_m)


def figure_fit(
    terms: int, system: OpticalSystem, stage: Intermediate, side: float, turn: float
) -> SurfaceFit:
    """Return the fit of Zernike terms over the circle about the segment, in its local frame, mm."""
    nodes = (stage.nodes[stage.surface_nodes] * MM_PER_M) @ _turned(turn).T
    return surface_fit(
        nodes[:, :2],
        stage.surface_weights,
        terms,
        side,
        0.0,
        Conic(abs(system.primary.shape.radius), -1.0),
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
