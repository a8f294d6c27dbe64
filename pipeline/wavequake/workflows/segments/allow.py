"""What a disturbance of a segmented telescope moves, for allowances: the modal model, and full traces."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from wavequake.campaign.contract import DONE
from wavequake.campaign.statistics.judged import Judged, judged_of_template
from wavequake.errors import UserError
from wavequake.kernels.device.devices import choose_device
from wavequake.mechanics.disturbances.motion import Motion, still
from wavequake.mechanics.disturbances.registry import draw_case, instants_of
from wavequake.optics.derivatives.central import DOFS
from wavequake.optics.segments.modal import COMMON, RIGID, ModalModel
from wavequake.workflows.movable import Movable
from wavequake.workflows.segments.bench import MM_PER_M, Bench, bench_of
from wavequake.workflows.segments.disturbance import trace_draws
from wavequake.workflows.segments.launches import CaseDraw
from wavequake.workflows.segments.model import model_of, motion_rows
from wavequake.workflows.segments.rare import MEASURES, form_of_motions, segment_motions
from wavequake.workflows.segments.study import SegmentStudy
from wavequake.workflows.segments.template import template

Array = NDArray[np.float64]

_RIGID_FIGURES = {0: DOFS.index("dz"), 1: DOFS.index("ry"), 2: DOFS.index("rx")}
_NOTHING = 1e-12  # share of the largest square that counts as none
_ROUNDING = 1e-16  # the same of what a case moves: elastic bodies turn by rounding errors


def segment_movable(study: SegmentStudy, measure: str) -> Movable:
    """Return what the only disturbance with a share of a study moves; raises UserError."""
    text = study.identity_text()
    bench, model = bench_of(text), model_of(text, "numpy")
    judged = judged_of_template(measure, template(text))
    if judged.variable not in MEASURES:
        raise UserError(f"{judged.variable!r} has no allowances; use one of {', '.join(MEASURES)}.")
    population = next(entry for entry in study.disturbance if entry.share)
    segments, seed = len(bench.layout), study.study.seed
    time = instants_of(study.disturbance, population)

    def drawn(realization: int) -> Array:
        motion = draw_case(study.disturbance, population, bench.layout, seed, realization, time=time)
        return motion_rows(bench, model, motion, len(time))

    with threadpool_limits(1):
        form = form_of_motions(bench, model, judged)
        size = np.abs(drawn(0)).max(axis=0)
    costs = np.diag(form.square)
    idle = costs <= _NOTHING * costs[size > 0.0].max(initial=0.0)
    worth = size**2 * costs
    moved = (size > 0.0) & (idle | (worth > _ROUNDING * worth.max(initial=0.0)))
    moved &= ~_twice(model.dofs, moved, segments)
    turns = np.array([RIGID > dof >= 3 for dof in model.dofs], dtype=bool)
    each = np.indices((len(model.dofs), segments)).reshape(2, -1).T
    return Movable(
        name=population.name,
        elements=bench.layout.names,
        axes=tuple(DOFS[dof] if dof < RIGID else f"figure {dof - RIGID + 1}" for dof in model.dofs),
        place=each,
        metric=np.where(turns, 1.0, 1.0 / MM_PER_M)[each[:, 0]],
        form=form,
        moved=moved,
        idle=idle,
        lasting=np.array([dof >= RIGID for dof in model.dofs], dtype=bool)[each[:, 0]],
        time=time,
        seed=seed,
        unit=str(template(text).per_case[judged.variable].attrs["units"]),
        gaussian=lambda: segment_motions(bench, model, population),
        drawn=drawn,
        traced=lambda cases: _traced(bench, model, judged, cases),
    )


def _twice(dofs: Sequence[int], moved: NDArray[np.bool_], segments: int) -> NDArray[np.bool_]:
    """Return which columns are piston and tilts of figures of segments that move so as rigid bodies, too.

    Both do the same to light: as allowances they would be two of one thing.
    """
    each = moved[: len(dofs) * segments].reshape(len(dofs), segments)
    found = np.zeros_like(each)
    for row, dof in enumerate(dofs):
        rigid = _RIGID_FIGURES.get(dof - RIGID)
        if rigid in dofs:
            found[row] = each[dofs.index(rigid)]
    return np.append(found.ravel(), np.zeros(len(moved) - found.size, dtype=bool))


def _traced(bench: Bench, model: ModalModel, judged: Judged, cases: Sequence[Array]) -> Array:
    """Return the measure of cases, motions (n, D S + 4), by full traces; NaN where that fails."""
    population = next(entry for entry in bench.study.disturbance if entry.share)
    time = instants_of(bench.study.disturbance, population)
    draws = [
        CaseDraw(population, case, time[: len(rows)], _motion(bench, model, rows))
        for case, rows in enumerate(cases)
    ]
    result = trace_draws(bench.text, draws, choose_device(bench.study.campaign.device).name)
    values, places = result.arrays[judged.variable][:, : len(cases[0])], judged.chosen
    if "axis" in places:
        values = values[..., places["axis"]]
    elif judged.variable in ("los", "centroid"):
        values = np.linalg.norm(values, axis=2)
    elif "noll" in places:
        values = values[..., places["noll"]]
    return np.where(result.status == DONE, np.sqrt(np.mean(values**2, axis=1)), np.nan)


def _motion(bench: Bench, model: ModalModel, rows: Array) -> Motion:
    """Return the motion of rows (n, D S + 4) in mm and rad, as `motion_rows` gives them."""
    count, segments = len(rows), len(bench.layout)
    terms = max((dof - RIGID + 1 for dof in model.dofs), default=0)
    motion = still(count, segments, max(terms, 0))
    local = rows[:, :-COMMON].reshape(count, len(model.dofs), segments)
    figure = np.zeros((count, *motion.segment_figure.shape))
    for column, dof in enumerate(model.dofs):
        if dof < RIGID:
            motion.segment_motion[:, :, dof] = local[:, column] / (MM_PER_M if dof < 3 else 1.0)
        else:
            figure[:, :, dof - RIGID] = local[:, column] / MM_PER_M
    motion = replace(motion, segment_figure=figure if np.ptp(figure, axis=0).any() else figure[0])
    motion.mount[:] = rows[:, -2:]
    if rows[:, -COMMON:-2].any():
        motion.m2[:] = rows[:, -COMMON:-2] @ np.linalg.inv(bench.m2_tilt.T)
    return motion
