"""What the signals of a record see of a study: motions of its elements, and modes of its structure."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from wavequake.errors import UserError
from wavequake.kernels.device.devices import choose_device
from wavequake.mechanics.assembly.plant import Plant
from wavequake.mechanics.telemetry.columns import ANGLES, SIGHT, WAVEFRONT, Channel
from wavequake.optics.derivatives.central import DOFS, SensitivityMatrix
from wavequake.optics.derivatives.sensitivity import rigid_sensitivity
from wavequake.optics.systems.paraxial import paraxial
from wavequake.workflows.mirrors.study import FULL
from wavequake.workflows.systems.bench import MM_PER_M, SystemBench, system_bench
from wavequake.workflows.systems.study import WITHOUT_IMAGES, SystemStudy

Array = NDArray[np.float64]

_NOTHING = 1e-3  # of the largest column of the same kind: as little as sampled rays know of a symmetry
_ALIKE = 0.9999  # cosine of columns that no data tell apart


@dataclass(frozen=True)
class Seen:
    """What signals see of motions in m and rad, and of the modes of a structure.

    Attributes
    ----------
    elements : tuple of str, length E
        Bodies, and surfaces that are in none.
    motions : ndarray, shape (c, E, 6)
        Signal per motion, in the signals' units; of accelerations per acceleration.
    modes : ndarray, shape (c, r)
        Signal per modal coordinate.
    accelerations : ndarray of bool, shape (c,)
        Which signals are accelerations.
    plant : Plant or None
    """

    elements: tuple[str, ...]
    motions: Array
    modes: Array
    accelerations: NDArray[np.bool_]
    plant: Plant | None

    def at(self, frequency_hz: float) -> tuple[Array, Array]:
        """Return motions and modes as the signals see them at a frequency."""
        factor = np.where(self.accelerations, -((2.0 * np.pi * frequency_hz) ** 2), 1.0)
        return self.motions * factor[:, None, None], self.modes * factor[:, None]


def seen_by(study: SystemStudy, channels: Sequence[Channel]) -> Seen:
    """Return what signals see of a study.

    Raises
    ------
    UserError
        If a column names no element, node or field point of the study, or an angle at a system whose object
        is near.
    """
    plain = study.model_copy(update={**WITHOUT_IMAGES, "reduction": None})
    bench = system_bench(plain.identity_text())
    carried = {bench.system.surfaces[k].name: body.name for body in bench.bodies for k in body.surfaces}
    names = [body.name for body in bench.bodies]
    names += [surface.name for surface in bench.system.surfaces if surface.name not in carried]
    elements = tuple(dict.fromkeys(names))
    fields = sorted({one.field for one in channels if one.element in (SIGHT, WAVEFRONT)})
    optical: dict[int, SensitivityMatrix] = {}
    device, light = choose_device(study.campaign.device), bench.system.primary_wavelength
    with threadpool_limits(1):
        for field in fields:
            if field >= len(bench.prepared):
                one = next(one for one in channels if one.field == field)
                raise UserError(
                    f"The column {one.name!r} is of field point {field + 1}; the study has "
                    f"{len(bench.prepared)}."
                )
            optical[field] = rigid_sensitivity(bench.prepared[field][light], bench.bodies, device)
    plant = bench.plants.get(FULL)
    motions = np.zeros((len(channels), len(elements), 6))
    for row, one in enumerate(channels):
        if one.element in (SIGHT, WAVEFRONT):
            found = _optical(bench, one, optical[one.field])
            order = [optical[one.field].elements.index(name) for name in elements]
            motions[row] = found[order] / one.si
        elif one.element in elements:
            axis = ("d" if one.axis[0] == "a" else one.axis[0]) + one.axis[1]
            motions[row, elements.index(one.element), DOFS.index(axis)] = 1.0 / one.si
        elif one.element in carried:
            raise UserError(
                f"The column {one.name!r} is of a surface that a body carries; write the body's motion, "
                f"{carried[one.element]}.{one.name.rsplit('.', 1)[-1]}."
            )
        elif plant is None or one.element not in plant.places:
            places = [*elements, *(name for name in (plant.places if plant else ()) if "/" not in name)]
            places = list(dict.fromkeys(places))
            some = ", ".join(places[:12]) + (", ..." if len(places) > 12 else "")
            raise UserError(
                f"The column {one.name!r} is of {one.element!r}, which is no surface, body or node of the "
                f"study; there are {some}."
            )
    modes = np.zeros((len(channels), 0))
    if plant is not None:
        modes = _of_modes(plant, channels, elements, motions)
    accelerations = np.array([one.axis[0] == "a" for one in channels])
    return Seen(elements, motions, modes, accelerations, plant)


def _optical(bench: SystemBench, one: Channel, matrix: SensitivityMatrix) -> Array:
    """Return the change (E, 6), in m or rad, of a coefficient or of the line of sight per m and rad."""
    scale = np.repeat([MM_PER_M, 1.0], 3)
    if one.element == WAVEFRONT:
        term, known = int(one.axis[1:]), matrix.zernike.shape[-1]
        if term > known:
            raise UserError(
                f"The column {one.name!r} is of Noll term {term}, but the study fits {known}: raise "
                "wavefront.zernike_terms."
            )
        wavelength = bench.system.wavelengths[bench.system.primary_wavelength] / MM_PER_M
        return np.asarray(matrix.zernike[..., term - 1] * wavelength * scale)
    found = matrix.los[..., "xy".index(one.axis)] * scale / MM_PER_M
    if one.unit not in ANGLES:
        return np.asarray(found)
    if np.isfinite(bench.system.object_distance):
        raise UserError(
            f"The column {one.name!r} is an angle on the sky, but the object of {bench.system.name} is near: "
            f"give the motion of the image, such as {one.element}.{one.axis}_um."
        )
    return np.asarray(found / (paraxial(bench.system).focal_length / MM_PER_M))


def _of_modes(plant: Plant, channels: Sequence[Channel], elements: Sequence[str], motions: Array) -> Array:
    """Return what signals see of the modal coordinates: by the elements that move, and nodes themselves."""
    rows = np.zeros((len(elements), 6, plant.shapes.shape[1]))
    for number, name in enumerate(elements):
        if ("rigid", name) in plant.outputs:
            rows[number] = plant.shapes[plant.outputs["rigid", name]]
    modes = np.einsum("ced,edr->cr", motions, rows)
    for row, one in enumerate(channels):
        if one.element not in (SIGHT, WAVEFRONT, *elements):
            force, moment = plant.places[one.element]
            place = moment if one.axis[0] == "r" else force
            if place is None:
                raise UserError(
                    f"The column {one.name!r} is a turn, but {one.element!r} has none of its own."
                )
            # What a force does to a mode is how far the mode moves the place where it acts.
            modes[row] = plant.modal.inputs[:, place][:, "xyz".index(one.axis[1])] / one.si
    return np.asarray(modes)


def unseen(seen: Seen) -> tuple[list[str], list[tuple[str, ...]]]:
    """Return motions that signals hardly see, and groups of motions that look alike to all signals."""
    columns = seen.motions.reshape(len(seen.motions), -1)
    names = [f"{element}.{dof}" for element in seen.elements for dof in DOFS]
    scaled = columns / np.maximum(np.abs(columns).max(axis=1, keepdims=True), np.finfo(float).tiny)
    size = np.linalg.norm(scaled, axis=0)
    turns = np.tile(np.repeat([False, True], 3), len(seen.elements))
    largest = np.where(turns, size[turns].max(initial=0.0), size[~turns].max(initial=0.0))
    dark = size <= _NOTHING * largest
    left, groups = np.flatnonzero(~dark).tolist(), []
    while left:
        first = left[0]
        cosine = np.abs(scaled[:, first] @ scaled[:, left]) / (size[first] * size[left])
        group = [one for one, same in zip(left, cosine > _ALIKE, strict=True) if same]
        left = [one for one in left if one not in group]
        if len(group) > 1:
            groups.append(tuple(names[one] for one in group))
    return [names[k] for k in np.flatnonzero(dark)], groups


def rank_of(seen: Seen) -> int:
    """Return how many combinations of motions the signals tell apart."""
    columns = seen.motions.reshape(len(seen.motions), -1)
    scaled = columns / np.maximum(np.abs(columns).max(axis=1, keepdims=True), np.finfo(float).tiny)
    size = np.linalg.norm(scaled, axis=0)
    lit = scaled[:, size > 0.0] / size[size > 0.0]
    values = np.linalg.svd(lit, compute_uv=False) if lit.size else np.zeros(1)
    return int(np.count_nonzero(values > 1e-4 * values[0]))
