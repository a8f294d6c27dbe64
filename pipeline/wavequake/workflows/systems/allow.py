"""What a disturbance of any optical system moves, for allowances: its sensitivities, and full traces."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from wavequake.campaign.statistics.judged import Judged, judged_of_template
from wavequake.campaign.stopwatch import Stopwatch
from wavequake.errors import UserError
from wavequake.kernels.device.devices import Device, choose_device
from wavequake.mechanics.disturbances.gaussian import gaussian_motions
from wavequake.mechanics.disturbances.motion import Motion, still
from wavequake.mechanics.disturbances.registry import draw_case, instants_of
from wavequake.mechanics.disturbances.streams import Streams
from wavequake.optics.derivatives.central import DOFS, SensitivityMatrix
from wavequake.optics.derivatives.sensitivity import figure_sensitivity, rigid_sensitivity
from wavequake.optics.polynomials.transforms import known_transformed
from wavequake.optics.segments.modal_forms import MotionForm, length_form
from wavequake.optics.systems.bodies import surface_index
from wavequake.optics.wavefronts.wavefront import PreparedSystem
from wavequake.workflows.kinds import find_kind
from wavequake.workflows.movable import Movable
from wavequake.workflows.systems.bench import MM_PER_M, NM_PER_MM, SystemBench, system_bench
from wavequake.workflows.systems.measure import measured_cases
from wavequake.workflows.systems.study import WITHOUT_IMAGES, SystemStudy

Array = NDArray[np.float64]
Label = tuple[str, str]  # element and axis

MEASURES = ("wfe_change", "wfe_rms", "zernike", "los_mm", "centroid_mm")
FIGURE = "figure "  # of an axis, before its Noll index
_NOTHING = 1e-9  # share of the largest square of motions of the same unit: steps agree to 1e-5


def system_movable(study: SystemStudy, measure: str, name: str) -> Movable:
    """Return what the disturbance `name` of a study moves, and its effect at the primary wavelength.

    A measure is the rms over the instants of a case and over all field points, or at the one that is chosen.

    Raises
    ------
    UserError
        If the measure has no allowances, or the disturbance moves what is no element.
    """
    study = study.model_copy(update={**WITHOUT_IMAGES, "reduction": None})
    text, seed = study.identity_text(), study.study.seed
    template = find_kind(study.study.workflow).template(text)
    judged = judged_of_template(measure, template)
    if judged.variable not in MEASURES:
        raise UserError(f"{judged.variable!r} has no allowances; use one of {', '.join(MEASURES)}.")
    bench, device = _limited(system_bench(text), judged), choose_device(study.campaign.device)
    population = next(entry for entry in study.disturbance if entry.name == name)
    time = instants_of(study.disturbance, population)

    def moved(realization: int) -> Motion:
        return draw_case(study.disturbance, population, bench.layout, seed, realization, time=time)

    labels = _labels(moved(0), name)

    def gaussian(streams: Streams, at: Array) -> Array:
        return _rows(draw_case(study.disturbance, population, bench.layout, 0, 0, streams, at), labels)

    with threadpool_limits(1):
        form, floor = _linear(bench, judged, labels, device)
    elements, axes = (tuple(dict.fromkeys(words)) for words in zip(*labels, strict=True))
    axes = tuple(sorted(axes, key=_order))
    place = np.array([(axes.index(axis), elements.index(element)) for element, axis in labels])
    return Movable(
        name=name,
        elements=elements,
        axes=axes,
        place=place,
        metric=np.ones(len(labels)),
        form=form,
        moved=np.ones(len(labels), dtype=bool),
        idle=np.diag(form.square) <= floor,
        lasting=np.zeros(len(labels), dtype=bool),
        time=time,
        seed=seed,
        unit=str(template.per_case[judged.variable].attrs["units"]),
        gaussian=lambda: gaussian_motions(name, gaussian, time),
        drawn=lambda realization: _rows(moved(realization), labels),
        traced=lambda cases: _traced(bench, judged, labels, cases, device),
    )


def _order(axis: str) -> int:
    return DOFS.index(axis) if axis in DOFS else len(DOFS) + _noll(axis)


def _noll(axis: str) -> int:
    return int(axis.removeprefix(FIGURE))


def _limited(bench: SystemBench, judged: Judged) -> SystemBench:
    """Return the study's bench at the field points and the wavelength that are limited."""
    light = judged.chosen.get("wavelength", bench.system.primary_wavelength)
    every = range(len(bench.prepared))
    fields = [judged.chosen["field"]] if "field" in judged.chosen else every
    return replace(
        bench,
        prepared=tuple((bench.prepared[field][light],) for field in fields),
        static=tuple((bench.static[field][light],) for field in fields),
    )


def _labels(motion: Motion, name: str) -> list[Label]:
    """Return the elements and axes that a motion moves."""
    if motion.mount.any() or any(heights.any() for heights in motion.grid.values()):
        raise UserError(
            f"The disturbance {name!r} turns the incoming light or deforms surfaces on grids; allowances are "
            "of motions and Zernike figures of surfaces and bodies."
        )
    found = [
        (element, DOFS[dof])
        for element, rows in motion.rigid.items()
        for dof in np.flatnonzero(rows.any(axis=0))
    ]
    found += [
        (element, f"{FIGURE}{term + 1}")
        for element, rows in motion.figure.items()
        for term in np.flatnonzero(np.atleast_2d(rows).any(axis=0))
    ]
    if not found:
        raise UserError(f"The disturbance {name!r} moves nothing: there is nothing to allow.")
    return found


def _rows(motion: Motion, labels: Sequence[Label]) -> Array:
    """Return a motion as rows (n, k) in m and rad."""
    found = np.empty((len(motion.mount), len(labels)))
    for column, (element, axis) in enumerate(labels):
        if axis in DOFS:
            found[:, column] = motion.rigid[element][:, DOFS.index(axis)]
        else:
            found[:, column] = motion.figure[element][..., _noll(axis) - 1]
    return found


def _motion(rows: Array, labels: Sequence[Label]) -> Motion:
    """Return the motion of rows (n, k) in m and rad."""
    count = len(rows)
    motion = still(count)
    terms = max((_noll(axis) for _, axis in labels if axis not in DOFS), default=0)
    for column, (element, axis) in enumerate(labels):
        if axis in DOFS:
            motion.rigid.setdefault(element, np.zeros((count, 6)))[:, DOFS.index(axis)] = rows[:, column]
        else:
            figure = motion.figure.setdefault(element, np.zeros((count, terms)))
            figure[:, _noll(axis) - 1] = rows[:, column]
    return motion


def _linear(
    bench: SystemBench, judged: Judged, labels: Sequence[Label], device: Device
) -> tuple[MotionForm, Array]:
    """Return the square of a measure of motions in m and rad, and what of it is nothing, column by column."""
    groups: dict[int, list[str]] = {}
    for element in dict.fromkeys(element for element, axis in labels if axis not in DOFS):
        groups.setdefault(_terms(labels, element), []).append(element)
    columns, rests, sizes = [], [], []
    for (prepared,), (static,) in zip(bench.prepared, bench.static, strict=True):
        rigid = rigid_sensitivity(prepared, bench.bodies, device)
        moved = _values(bench, judged, prepared, rigid)
        moved[:, :3] *= MM_PER_M
        figures: dict[str, Array] = {}
        for terms, names in groups.items():
            surfaces = [surface_index(bench.system, name) for name in names]
            matrix = figure_sensitivity(prepared, surfaces, terms, device)
            values = MM_PER_M * _values(bench, judged, prepared, matrix)
            figures |= zip(names, values, strict=True)
        columns.append(
            [
                moved[rigid.elements.index(element), DOFS.index(axis)]
                if axis in DOFS
                else figures[element][_noll(axis) - 1]
                for element, axis in labels
            ]
        )
        squares = np.sum(moved**2, axis=2).max(axis=0)
        largest = max((np.sum(one**2, axis=1).max() for one in figures.values()), default=0.0)
        sizes.append((squares[:3].max(), squares[3:].max(), largest))
        rests.append(_at_rest(bench, judged, prepared, static.zernike[0], moved.shape[2]))
    share = np.sqrt(len(rests))  # the mean square over the field points
    form = length_form(np.concatenate(rests) / share, np.concatenate(columns, axis=1) / share)
    shifts, turns, heights = _NOTHING * np.mean(sizes, axis=0)
    kind = [heights if axis not in DOFS else turns if axis in DOFS[3:] else shifts for _, axis in labels]
    return form, np.array(kind)


def _terms(labels: Sequence[Label], element: str) -> int:
    return max(_noll(axis) for one, axis in labels if one == element and axis not in DOFS)


def _values(bench: SystemBench, judged: Judged, prepared: PreparedSystem, matrix: SensitivityMatrix) -> Array:
    """Return the derivatives (E, D, c) of the numbers whose length a measure is, per mm or rad."""
    if judged.variable in ("los_mm", "centroid_mm"):
        found = matrix.los if judged.variable == "los_mm" else matrix.centroid
        return found[..., [judged.chosen["axis"]]] if "axis" in judged.chosen else found.copy()
    return _terms_of(bench, judged, matrix.zernike * (prepared.wavelength * NM_PER_MM))


def _at_rest(
    bench: SystemBench, judged: Judged, prepared: PreparedSystem, zernike: Array, count: int
) -> Array:
    """Return the numbers (c,) whose length a measure is, at rest."""
    if judged.variable in ("wfe_rms", "zernike"):
        return _terms_of(bench, judged, zernike * (prepared.wavelength * NM_PER_MM))
    return np.zeros(count)


def _terms_of(bench: SystemBench, judged: Judged, zernike: Array) -> Array:
    """Return those of annular coefficients (..., J) that a measure is made of."""
    if judged.variable != "zernike":
        return zernike[..., 3:]
    if bench.study.wavefront.basis == "circular":
        flat = zernike.reshape(-1, zernike.shape[-1])
        flat = known_transformed(flat, bench.system.pupil.obscuration, 0.0)
        zernike = flat.reshape(zernike.shape)
    return zernike[..., [judged.chosen["noll"]]]


def _traced(
    bench: SystemBench, judged: Judged, labels: Sequence[Label], cases: Sequence[Array], device: Device
) -> Array:
    """Return a measure of cases, motions (n, k), by full traces; NaN where light is lost."""
    motions = [(np.zeros(len(rows)), _motion(rows, labels)) for rows in cases]
    found = []
    for numbers, trouble in measured_cases(bench, motions, device, Stopwatch()):
        if trouble:
            found.append(np.nan)
            continue
        values = numbers[judged.variable]
        if judged.variable in ("los_mm", "centroid_mm"):
            values = values[..., [judged.chosen["axis"]]] if "axis" in judged.chosen else values
            found.append(float(np.sqrt(np.mean(np.sum(values**2, axis=-1)))))
        else:
            values = values[..., judged.chosen["noll"]] if judged.variable == "zernike" else values
            found.append(float(np.sqrt(np.mean(values**2))))
    return np.array(found)
