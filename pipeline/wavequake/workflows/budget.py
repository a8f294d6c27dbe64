"""Which disturbance, and which ring of segments, contributes what: a budget of a segment-disturbance study.

Every case is traced with all disturbances, with each of them switched off, and with each of them drawn again
while the others stay. All share their random numbers, so that differences stand out from the scatter.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, cast

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from wavequake.errors import UserError
from wavequake.kernels.devices import choose_device
from wavequake.mechanics.common_history import CommonHistory
from wavequake.mechanics.disturbances import (
    Combine,
    SingleDisturbance,
    draw,
    parts,
    stream_of,
    time_axis,
)
from wavequake.mechanics.edge_sensors import EdgeSensorNoise
from wavequake.mechanics.layout import SegmentLayout
from wavequake.mechanics.motion import Motion, add
from wavequake.mechanics.segment_history import SegmentHistory
from wavequake.mechanics.segment_wind import SegmentWind
from wavequake.mechanics.static_random import StaticRandom
from wavequake.workflows.bench import Bench, bench_of
from wavequake.workflows.contract import DONE
from wavequake.workflows.indices import Estimate, removed_shares, variance_shares
from wavequake.workflows.provenance import collect
from wavequake.workflows.schema import Study
from wavequake.workflows.segment_disturbance import CaseDraw, trace_draws
from wavequake.workflows.segment_study import SegmentStudy
from wavequake.workflows.sensitivity import read_dataset, write_dataset
from wavequake.workflows.store import BUDGET, MANIFEST, read_manifest, refuse_foreign, refuse_other
from wavequake.workflows.study import study_with

if TYPE_CHECKING:
    import xarray as xr

Array = NDArray[np.float64]
Progress = Callable[[int, int, int], None]

SCHEMA = 1
QUANTITIES = {"wfe_rms_raw": "nm", "wfe_rms": "nm", "los": "mas"}
FEWEST = 16  # cases below which an interval says nothing
_AGAIN = "~again"  # no disturbance's name can end so
_AT_ONCE = 64  # draws that are in memory together
# Their segments are drawn independently of each other, so that a ring of them is a factor, too.
_RING_BY_RING = (StaticRandom, CommonHistory)
_TOGETHER = (SegmentHistory, SegmentWind, EdgeSensorNoise)


@dataclass(frozen=True)
class Factors:
    """Sources of a sum of disturbances, and rings of segments: (S,) number of each segment's ring, from 1."""

    sources: tuple[SingleDisturbance, ...]
    rings: NDArray[np.int64]

    @property
    def ring_numbers(self) -> list[int]:
        """Rings that there are; none where all segments are in one."""
        found: list[int] = np.unique(self.rings).tolist()
        return found if len(found) > 1 else []


def rings_of(layout: SegmentLayout) -> NDArray[np.int64]:
    """Return the ring of every segment (S,): its distance from the axis over the distance of neighbors.

    Rounded, from 1 for the innermost ring that there is; a mirror of one piece is one ring.
    """
    centers = layout.centers_m[:, :2]
    if len(centers) < 2:
        return np.ones(len(centers), dtype=np.int64)
    apart = np.linalg.norm(centers[:, None] - centers, axis=2)
    pitch = np.median(np.where(apart > 0.0, apart, np.inf).min(axis=1))
    number = np.rint(np.linalg.norm(centers, axis=1) / pitch).astype(np.int64)
    return np.unique(number, return_inverse=True)[1].astype(np.int64) + 1


def summed(study: SegmentStudy, name: str | None) -> Combine:
    """Return the sum of disturbances that a budget is made of: a combination of the study, or of all.

    Raises
    ------
    UserError
        If there is no combination `name`, or several to choose from.
    """
    combined = [entry for entry in study.disturbance if isinstance(entry, Combine)]
    if name is not None:
        found = [entry for entry in combined if entry.name == name]
        names = ", ".join(entry.name for entry in combined) or "none"
        if not found:
            raise UserError(f"There is no combination {name!r} in this study; there is {names}.")
        return found[0]
    if len(combined) > 1:
        names = ", ".join(entry.name for entry in combined)
        raise UserError(f"This study has several combinations; choose one with --of: {names}.")
    if combined:
        return combined[0]
    singles = study.disturbance
    return Combine.model_construct(
        model="combine",
        name="all",
        of=tuple(entry.name for entry in singles),
        duration_s=max(entry.duration_s for entry in singles),
        instants=max(entry.instants for entry in singles),
        share=1,
    )


def variants(
    population: Combine, factors: Factors, layout: SegmentLayout, seed: int, realization: int
) -> list[Motion]:
    """Return the motions of one case: of all factors, of all drawn again, without each, with each redrawn."""
    time = time_axis(population)

    def drawn(part: SingleDisturbance) -> Motion:
        return draw(part, layout, time, stream_of(part, len(layout), seed, realization))

    still = _scaled(add([drawn(part) for part in factors.sources[:1]]), 0.0)
    one = [drawn(part) for part in factors.sources]
    other = [drawn(part.model_copy(update={"name": part.name + _AGAIN})) for part in factors.sources]

    def total(motions: Sequence[Motion]) -> Motion:
        return add([still, *motions])

    indices = range(len(one))
    without = [total([one[k] for k in indices if k != i]) for i in indices]
    redrawn = [total([other[k] if k == i else one[k] for k in indices]) for i in indices]
    for ring in factors.ring_numbers:
        mine = factors.rings == ring
        without.append(_with_segments(total(one), still, mine))
        ringwise = [
            _with_segments(first, second, mine) if isinstance(part, _RING_BY_RING) else first
            for part, first, second in zip(factors.sources, one, other, strict=True)
        ]
        redrawn.append(total(ringwise))
    return [total(one), total(other), *without, *redrawn]


def _scaled(motion: Motion, factor: float) -> Motion:
    return Motion(
        motion.segment_motion * factor,
        motion.segment_figure * factor,
        motion.mount * factor,
        motion.m2 * factor,
    )


def _with_segments(motion: Motion, other: Motion, mine: NDArray[np.bool_]) -> Motion:
    """Return a motion in which some segments move as in another."""
    motion, other = add([motion, _scaled(other, 0.0)]), add([other, _scaled(motion, 0.0)])
    return replace(
        motion,
        segment_motion=np.where(mine[:, None], other.segment_motion, motion.segment_motion),
        segment_figure=np.where(mine[:, None], other.segment_figure, motion.segment_figure),
    )


def evaluate(bench: Bench, population: Combine, motions: Sequence[Motion], device: str) -> Array:
    """Return the QUANTITIES (rms over the instants) of motions (B, 3); NaN where one cannot be traced."""
    time, found = time_axis(population), []
    for first in range(0, len(motions), _AT_ONCE):
        draws = [CaseDraw(population, 0, time, motion) for motion in motions[first : first + _AT_ONCE]]
        result = trace_draws(bench.text, draws, device)
        squares = [
            np.sum(result.arrays[name][:, : len(time)].reshape(len(draws), len(time), -1) ** 2, axis=2)
            for name in QUANTITIES
        ]
        values = np.sqrt(np.mean(squares, axis=2)).T
        found.append(np.where((result.status == DONE)[:, None], values, np.nan))
    return np.concatenate(found)


def budget(
    study: Study,
    cases: int,
    of: str | None = None,
    progress: Progress | None = None,
) -> "xr.Dataset":
    """Return what each source and each ring of segments contributes, with 95 % confidence intervals.

    Parameters
    ----------
    study : Study
        Of the workflow segment-disturbance.
    cases : int
        Realizations; each is traced 2 + 2 (sources + rings) times.
    of : str, optional
        The combination to take apart; by default the study's only one, or else the sum of its disturbances.

    Raises
    ------
    UserError
        If the study is another kind of study, has several combinations, or most cases cannot be traced.
    """
    if not isinstance(study, SegmentStudy) or study.study.workflow != "segment-disturbance":
        raise UserError(f"A budget is of segment-disturbance studies, not of {study.study.workflow}.")
    if cases < FEWEST:
        raise UserError(f"A budget of {cases} cases says nothing; take at least {FEWEST}.")
    population = summed(study, of)
    traced = cast(SegmentStudy, study_with(study, _TRACED))
    bench = bench_of(traced.identity_text())
    device = choose_device(study.campaign.device)
    factors = Factors(tuple(parts(study.disturbance, population)), rings_of(bench.layout))
    count = 2 + 2 * (len(factors.sources) + len(factors.ring_numbers))
    group, values = max(1, _AT_ONCE // count), []
    with threadpool_limits(1):
        for first in range(0, cases, group):
            if progress:
                progress(first, cases, 0)
            motions = [
                motion
                for realization in range(first, min(first + group, cases))
                for motion in variants(population, factors, bench.layout, study.study.seed, realization)
            ]
            values.append(evaluate(bench, population, motions, device.name))
        rest = evaluate(bench, population, [_scaled(motions[0], 0.0)], device.name)[0]
    if progress:
        progress(cases, cases, 0)
    attrs = {
        "title": "Budget of disturbances",
        "schema": SCHEMA,
        "study": study.identity_text(),
        "study_sha256": study.identity(),
        "population": population.name,
        "cases": cases,
        "device": f"{device.name} ({device.kind})",
        **collect(device),
    }
    return _dataset(np.concatenate(values).reshape(cases, count, -1), rest, factors, attrs)


_TRACED = {
    "imaging.enabled": False,
    "optics.method": "standard",
    "store.reduce": "none",
    "store.every": 1,
    "store.keep": [],
    "campaign.sampling": "random",
    "campaign.until": None,
}


def _dataset(values: Array, rest: Array, factors: Factors, attrs: dict[str, object]) -> "xr.Dataset":
    """Return the budget of values (case, 2 + 2 k, quantity) and those at rest (quantity,)."""
    import xarray as xr

    good: NDArray[np.bool_] = np.asarray(np.isfinite(values).all(axis=(1, 2)))
    if good.sum() < FEWEST:
        raise UserError(
            f"{len(good) - good.sum()} of {len(good)} cases cannot be traced with every disturbance on and "
            f"off, and {FEWEST} are needed; lower the disturbances or raise --cases."
        )
    kept = values[good]
    names = [part.name for part in factors.sources] + [f"ring {ring}" for ring in factors.ring_numbers]
    count = len(names)
    sets: dict[str, Callable[[Array], Estimate]] = {
        "share": lambda v: removed_shares(v[:, 0], v[:, 2 : 2 + count]),
        "first": lambda v: variance_shares(v[:, 0], v[:, 1], v[:, 2 + count :]).first,
        "total": lambda v: variance_shares(v[:, 0], v[:, 1], v[:, 2 + count :]).total,
    }
    words = {
        "share": "share of the mean square that goes when the factor is switched off",
        "first": "first-order Sobol index: share of the variance over cases by the factor alone",
        "total": "total Sobol index: share of the variance over cases by the factor and its interactions",
    }
    known = np.array(
        [True] * len(factors.sources)
        + [not any(isinstance(part, _TOGETHER) for part in factors.sources)] * len(factors.ring_numbers)
    )
    variables: dict[str, object] = {}
    for key, estimate in sets.items():
        each: list[Estimate] = [estimate(kept[..., q]) for q in range(len(QUANTITIES))]
        for suffix, attribute in (("", "value"), ("_low", "low"), ("_high", "high")):
            numbers = np.stack([getattr(one, attribute) for one in each], axis=1)
            if key != "share":
                numbers = np.where(known[:, None], numbers, np.nan)
            bound = {"": "", "_low": ", lower bound (95 %)", "_high": ", upper bound (95 %)"}[suffix]
            variables[f"{key}{suffix}"] = (
                ("factor", "quantity"),
                numbers,
                {"units": "1", "long_name": words[key] + bound},
            )
    rms = np.sqrt(np.mean(kept**2, axis=0))
    mixed = {"units": "nm, nm, mas"}
    variables["rms"] = (("quantity",), rms[0], {**mixed, "long_name": "rms over cases and instants"})
    variables["rms_without"] = (
        ("factor", "quantity"),
        rms[2 : 2 + count],
        {**mixed, "long_name": "rms over cases and instants with the factor switched off"},
    )
    variables["rms_rest"] = (
        ("quantity",),
        rest,
        {**mixed, "long_name": "rms of what no factor causes: the telescope at rest"},
    )
    variables["value"] = (
        ("case", "variant", "quantity"),
        values,
        {**mixed, "long_name": "rms over the instants of a case; NaN: cannot be traced"},
    )
    coordinates = {
        "factor": np.array(names, dtype=object),
        "kind": (
            ("factor",),
            np.array(["source"] * len(factors.sources) + ["ring"] * len(factors.ring_numbers), dtype=object),
        ),
        "quantity": np.array(list(QUANTITIES), dtype=object),
        "variant": np.array(
            [
                "all",
                "all again",
                *(f"without {name}" for name in names),
                *(f"{name} again" for name in names),
            ],
            dtype=object,
        ),
        "case": np.arange(len(values)),
        "segments": (("factor",), _sizes(factors)),
    }
    found: xr.Dataset = xr.Dataset(variables, coordinates, {**attrs, "cases_used": int(good.sum())})
    return found


def _sizes(factors: Factors) -> NDArray[np.int64]:
    rings = [int(np.count_nonzero(factors.rings == ring)) for ring in factors.ring_numbers]
    return np.array([len(factors.rings)] * len(factors.sources) + rings, dtype=np.int64)


def stored_budget(
    study: Study, path: Path, cases: int, of: str | None = None, progress: Progress | None = None
) -> tuple["xr.Dataset", bool]:
    """Return the budget that the folder of a store keeps, or compute and keep it; and whether it was there.

    Raises as :func:`budget` and :func:`open_budget`, and UserError where the folder is something else.
    """
    path = Path(path)
    target = path / BUDGET
    refuse_foreign(path)
    if (path / MANIFEST).exists():
        manifest = read_manifest(path)
        refuse_other(path, manifest, study.study.workflow, study.identity_text(), manifest.device_kind)
    if target.exists():
        found = open_budget(path)
        wanted = of or found.attrs["population"]
        if (found.attrs["study_sha256"], found.attrs["cases"], found.attrs["population"]) == (
            study.identity(),
            cases,
            wanted,
        ):
            return found, True
    made = budget(study, cases, of, progress)
    write_dataset(made, target)
    return made, False


def open_budget(path: Path | str) -> "xr.Dataset":
    """Read the budget that the folder of a store keeps.

    Raises
    ------
    UserError
        If it keeps none, or one of another version of Wavequake.
    StoreDamageError
        If it cannot be read.
    """
    target = Path(path) / BUDGET
    if not target.exists():
        raise UserError(f"There is no budget at {target}; wavequake budget STUDY computes it.")
    return read_dataset(target, SCHEMA)
