"""Cases of ``segment-disturbance`` by the modal model: matrix products instead of rays, and proof of it.

A random sample of the cases is traced in full besides, and the model's error is stored with them; a case
whose motion is too large for the model is traced in full instead. Both depend on nothing but the case.
"""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from wavequake.campaign.contract import DONE, ChunkResult, unknown_arrays
from wavequake.campaign.stopwatch import Stopwatch
from wavequake.chain.sampling import slots
from wavequake.kernels.device.devices import choose_device
from wavequake.kernels.device.opencl import Device
from wavequake.kernels.device.tiles import TILE, padded
from wavequake.mechanics.disturbances.registry import Disturbance, Motion, instants_of, time_axis
from wavequake.mechanics.disturbances.source import TOGETHER
from wavequake.mechanics.disturbances.sources.common_history import (
    CommonHistory,
    amplitudes,
    amplitudes_of_run,
    history,
)
from wavequake.mechanics.disturbances.sources.static_random import StaticRandom
from wavequake.optics.segments import modal
from wavequake.optics.segments.modal import Forms, ModalModel
from wavequake.optics.wavefronts.quality import meets_marechal
from wavequake.workflows.segments.bench import MAS_PER_RAD, MM_PER_M, Bench, bench_of, in_basis
from wavequake.workflows.segments.draws import draw_realization, draw_realizations, sampling_plan
from wavequake.workflows.segments.model import knows, model_of, motion_rows
from wavequake.workflows.segments.template import ERRORS, template

Array = NDArray[np.float64]
Cases = NDArray[np.int64]
Trace = Callable[[str, Cases, str], ChunkResult]

MODAL, CERTIFIED, TRACED = range(3)
ALWAYS_CERTIFIED = 100  # that many first cases: cases are independent draws, so they are a random sample, too

_ROWS = 64  # cases of one matrix product
_INSTANTS, _TRACED_AT_ONCE = 5120, 32  # instants, or cases, that are in memory together
_NM_PER_MM = 1e6


@dataclass(frozen=True)
class _Found:
    """What C cases of n instants came to.

    ``forms`` (C, n, ...); ``sizes`` (C, D + 4) largest motions; ``piston`` (C, n) rms over the segments of
    their displacement along the normal in nm; ``known`` (C,) whether the model knows all that moves.
    """

    forms: Forms
    sizes: Array
    piston: Array
    known: NDArray[np.bool_]


def modal_cases(study_text: str, cases: Cases, device_name: str, trace: Trace) -> ChunkResult:
    """Compute the numbers of `cases` over their instants; `trace` computes cases in full."""
    bench, clock = bench_of(study_text), Stopwatch()
    study = bench.study
    model, device = model_of(study_text, device_name), choose_device(device_name)
    numbers = {name: one for name, one in template(study_text).per_case.items() if one.dtype != "int8"}
    arrays = unknown_arrays(numbers, len(cases))
    which, realizations = slots([entry.share for entry in study.disturbance], cases)
    for index, population in enumerate(study.disturbance):
        mine = np.flatnonzero(which == index)
        at_once = max(_INSTANTS // population.instants, 1)
        for first in range(0, len(mine), at_once):
            rows = mine[first : first + at_once]
            found = _found(bench, model, population, cases[rows], realizations[rows], device, clock)
            with clock("modal"):
                _record(bench, model, arrays, rows, instants_of(study.disturbance, population), found)
    status, messages = np.full(len(cases), DONE, dtype=np.int8), [""] * len(cases)
    beyond = ~(arrays["modal_bound"] <= study.optics.modal_tolerance_nm)
    certified = sampled(study.study.seed, cases, study.optics.modal_sample) & ~beyond
    arrays["traced"] = np.where(beyond, TRACED, np.where(certified, CERTIFIED, MODAL)).astype(np.int8)
    chosen = np.flatnonzero(beyond | certified)
    for first in range(0, len(chosen), _TRACED_AT_ONCE):
        group = chosen[first : first + _TRACED_AT_ONCE]
        full = trace(study_text, cases[group], device_name)
        for name, seconds in full.timings.items():
            clock.seconds[name] = clock.seconds.get(name, 0.0) + seconds
        for k, row in enumerate(group):
            status[row], messages[row] = full.status[k], full.messages[k]
            if beyond[row]:
                for name in arrays.keys() & full.arrays.keys():
                    arrays[name][row] = full.arrays[name][k]
            else:
                _compare(arrays, row, full, k)
    return ChunkResult(arrays, status, tuple(messages), clock.seconds)


def sampled(seed: int, cases: Cases, share: float) -> NDArray[np.bool_]:
    """Return which cases are traced to measure the model's error: the first hundred and a random `share`.

    By a hash of the case (the finalizer of SplitMix64), so that a case need not know how many there are.
    """
    start = np.uint64(seed * 0x9E3779B97F4A7C15 % 2**64)
    mixed = cases.astype(np.uint64) + start
    for shift, factor in ((30, 0xBF58476D1CE4E5B9), (27, 0x94D049BB133111EB), (31, 1)):
        mixed = (mixed ^ (mixed >> np.uint64(shift))) * np.uint64(factor)
    return np.asarray((cases < ALWAYS_CERTIFIED) | ((mixed >> np.uint64(11)) * 2.0**-53 < share))


def _found(
    bench: Bench,
    model: ModalModel,
    population: Disturbance,
    cases: Cases,
    realizations: Cases,
    device: Device,
    clock: Stopwatch,
) -> _Found:
    """Draw cases of one population and return what they come to."""
    known = np.ones(len(cases), dtype=np.bool_)
    if not isinstance(population, CommonHistory | StaticRandom):
        return _moving(bench, model, population, realizations, clock)
    motions, rows = _in_tiles(model, bench, cases)
    with clock("draw"):
        if isinstance(population, CommonHistory):
            swing = history(population, time_axis(population))
            _draw_pistons(bench, model, population, motions, rows, realizations, device)
        else:
            swing, first_instant = np.ones(population.instants), population.model_copy(update={"instants": 1})
            for k, realization in enumerate(realizations.tolist()):
                one = draw_realization(bench, first_instant, realization)
                motions[rows[k]], known[k] = motion_rows(bench, model, one, 1)[0], knows(model, one)
    with clock("modal"):
        return _separable(model, motions, rows, swing, known)


def _in_tiles(model: ModalModel, bench: Bench, cases: Cases) -> tuple[Array, Cases]:
    """Return room for one motion per case, and the case's row.

    A case has the same place in its tile whatever else is computed.
    """
    tiles, of_case = np.unique(cases // _ROWS, return_inverse=True)
    motions = np.zeros((len(tiles) * _ROWS, len(model.columns)))
    return motions, of_case * _ROWS + cases % _ROWS


def _draw_pistons(
    bench: Bench,
    model: ModalModel,
    population: CommonHistory,
    motions: Array,
    rows: Cases,
    realizations: Cases,
    device: Device,
) -> None:
    """Draw the amplitudes of consecutive realizations at once."""
    if 2 not in model.dofs:  # no amplitude at all
        return
    segments = len(bench.layout)
    first = model.dofs.index(2) * segments
    chosen = population.moving(bench.layout)
    moving = MM_PER_M * (1.0 if chosen is None else chosen.astype(np.float64))
    plan = sampling_plan(bench.text)
    if plan.method != "random":
        for row, realization in zip(rows, realizations.tolist(), strict=True):
            point = plan.of(realization)(population.name)
            assert point is not None  # never left out of a plan
            motions[row, first : first + segments] = amplitudes(population, segments, point) * moving
        return
    for run in np.split(np.arange(len(rows)), np.flatnonzero(np.diff(realizations) != 1) + 1):
        begin = int(realizations[run[0]])
        drawn = amplitudes_of_run(population, segments, bench.study.study.seed, begin, len(run), device)
        here = rows[run]
        if here[-1] - here[0] == len(here) - 1:  # a tile after the other
            np.multiply(drawn, moving, out=motions[here[0] : here[-1] + 1, first : first + segments])
        else:
            motions[here, first : first + segments] = drawn * moving


def _separable(
    model: ModalModel, motions: Array, rows: Cases, swing: Array, known: NDArray[np.bool_]
) -> _Found:
    """Return cases of one motion each that follows a common history: products once per case."""
    whole = modal.forms(model, motions, _ROWS)
    found = modal.scaled(Forms(whole.linear[rows], whole.quadratic[rows]), swing)
    sizes = modal.amplitudes(model, motions)[rows] * np.abs(swing).max()
    return _Found(found, sizes, _piston(model, motions)[rows, None] * np.abs(swing), known)


def _moving(
    bench: Bench, model: ModalModel, population: Disturbance, realizations: Cases, clock: Stopwatch
) -> _Found:
    """Draw cases that move in any way over their instants."""
    parts: list[_Found] = []
    drawn = draw_realizations(bench, population, realizations.tolist())
    while True:
        with clock("draw"):
            motions = list(islice(drawn, TOGETHER))
        if not motions:
            return _joined(parts)
        with clock("modal"):
            parts.append(_by_instants(bench, model, motions))


def _by_instants(bench: Bench, model: ModalModel, drawn: list[Motion]) -> _Found:
    """Return cases instant by instant, each in tiles of its own."""
    count = len(drawn[0].mount)
    motions = np.concatenate([motion_rows(bench, model, motion, padded(count)) for motion in drawn])

    def of_cases(values: Array) -> Array:
        return values.reshape(len(drawn), -1, *values.shape[1:])

    found = modal.forms(model, motions, TILE)
    return _Found(
        Forms(of_cases(found.linear)[:, :count], of_cases(found.quadratic)[:, :count]),
        of_cases(modal.amplitudes(model, motions)).max(axis=1),
        of_cases(_piston(model, motions))[:, :count],
        np.array([knows(model, motion) for motion in drawn]),
    )


def _joined(parts: list[_Found]) -> _Found:
    return _Found(
        Forms(
            np.concatenate([part.forms.linear for part in parts]),
            np.concatenate([part.forms.quadratic for part in parts]),
        ),
        *(np.concatenate([getattr(part, name) for part in parts]) for name in ("sizes", "piston", "known")),
    )


def _piston(model: ModalModel, motions: Array) -> Array:
    """Return the rms over the segments (B,) of their displacement along the normal, nm."""
    if 2 not in model.dofs:
        return np.zeros(len(motions))
    segments = model.square.shape[2]
    first = model.dofs.index(2) * segments
    along: Array = np.sqrt(np.mean(motions[:, first : first + segments] ** 2, axis=1))
    return along * _NM_PER_MM


def _record(
    bench: Bench, model: ModalModel, arrays: dict[str, Array], rows: Cases, time: Array, found: _Found
) -> None:
    """Write cases of n instants to their rows of the arrays."""
    wavefront = modal.wavefronts(model, found.forms)
    to_nm = bench.study.optics.wavelength_nm
    to_mas = MAS_PER_RAD / bench.first_order.focal_length
    series = {
        "time_s": np.broadcast_to(time, (len(rows), len(time))),
        "wfe_rms": wavefront.rms * to_nm,
        "wfe_rms_raw": wavefront.rms_raw * to_nm,
        "zernike": in_basis(bench, wavefront.zernike) * to_nm,
        "los": wavefront.los * to_mas,
        "centroid": wavefront.centroid * to_mas,
        "segment_piston_rms": found.piston,
    }
    for name, values in series.items():
        arrays[name][rows, : len(time)] = values
    arrays["marechal"][rows] = np.mean(meets_marechal(wavefront.rms_flat), axis=1)
    bound = modal.error_bound(model, found.sizes) * to_nm
    arrays["modal_bound"][rows] = np.where(found.known, bound, np.inf)


def _compare(arrays: dict[str, Array], row: int, full: ChunkResult, k: int) -> None:
    """Store the model's largest errors in case `row`, which is case `k` of a full trace."""
    for name in ERRORS:
        error = np.abs(arrays[name][row] - full.arrays[name][k])
        if name in ("los", "centroid"):
            error = np.linalg.norm(error, axis=1)
        arrays[f"modal_error_{name}"][row] = np.nanmax(error) if np.isfinite(error).any() else np.nan
