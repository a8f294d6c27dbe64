"""The modal model of a segment-disturbance study, and motions as the rows that it takes."""

import numpy as np
from numpy.typing import NDArray

from wavequake.kernels.device.devices import choose_device
from wavequake.kernels.device.tiles import TILE
from wavequake.mechanics.disturbances.registry import Motion, draw_case, instants_of
from wavequake.optics.segments.modal import COMMON, RIGID, ModalModel
from wavequake.optics.segments.modal_derivatives import modal_model
from wavequake.prepared import prepared
from wavequake.workflows.segments.bench import MM_PER_M, Bench, bench_of

Array = NDArray[np.float64]


@prepared(maxsize=2)
def model_of(study_text: str, device_name: str, others: tuple[int, ...] = ()) -> ModalModel:
    """Return the modal model of a study, for the degrees of freedom in which its disturbances move segments.

    They may be moved in `others` besides.

    Raises
    ------
    UserError
        If there are no derivatives at rest.
    """
    bench = bench_of(study_text)
    study = bench.study
    moved = set(others)
    for population in study.disturbance:
        time = instants_of(study.disturbance, population.model_copy(update={"instants": TILE}))
        motion = draw_case(study.disturbance, population, bench.layout, study.study.seed, 0, time=time)
        moved |= set(np.flatnonzero(motion.segment_motion.any(axis=(0, 1))).tolist())
        moved |= {RIGID + term for term in np.flatnonzero(_any_term(motion.segment_figure)).tolist()}
    return modal_model(bench.prepared, choose_device(device_name), tuple(sorted(moved)))


def motion_rows(bench: Bench, model: ModalModel, motion: Motion, rows: int) -> Array:
    """Return the motion of one case (rows, D S + 4) in mm and rad, padded with rest."""
    count, segments = len(motion.mount), len(bench.layout)
    found = np.zeros((rows, len(model.columns)))
    local = found[:count, :-COMMON].reshape(count, len(model.dofs), segments)
    for column, dof in enumerate(model.dofs):
        if dof < RIGID:
            local[:, column] = motion.segment_motion[:, :, dof] * (MM_PER_M if dof < 3 else 1.0)
        elif dof - RIGID < motion.segment_figure.shape[-1]:
            local[:, column] = motion.segment_figure[..., dof - RIGID] * MM_PER_M
    found[:count, :-COMMON] = local.reshape(count, -1)
    found[:count, -COMMON:-2] = motion.m2 @ bench.m2_tilt.T
    found[:count, -2:] = motion.mount
    return found


def knows(model: ModalModel, motion: Motion) -> bool:
    """Return whether the model knows all that moves."""
    rigid = [dof for dof in range(RIGID) if dof not in model.dofs]
    terms = [term for term in range(motion.segment_figure.shape[-1]) if RIGID + term not in model.dofs]
    moved = any(motion.segment_motion[..., dof].any() for dof in rigid)
    moved = moved or bool(motion.segment_figure[..., terms].any())
    named = (*motion.rigid.values(), *motion.figure.values())
    return not (moved or any(values.any() for values in named))


def _any_term(figure: Array) -> NDArray[np.bool_]:
    """Return which terms (terms,) any segment has at any instant."""
    return np.asarray(figure.any(axis=tuple(range(figure.ndim - 1))))
