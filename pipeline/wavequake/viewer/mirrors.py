"""Vibrating mirrors, the reference beside a reduced model: their modes, and what excitations do to them."""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from wavequake.campaign.contract import DONE
from wavequake.campaign.store.store import Manifest, open_store
from wavequake.drawing.solid import MOUNT, model_scene
from wavequake.errors import UserError
from wavequake.mechanics.model import ReducedModel
from wavequake.reduction.metrics import pseudo_frequencies, surface_modes
from wavequake.viewer.film import Array, Stage, Take, principal
from wavequake.workflows.mirrors import mirror_mor, mirror_trace
from wavequake.workflows.mirrors.mirror_bench import any_study_of, bench_of, over_time, time_of, variant_of
from wavequake.workflows.mirrors.mirror_study import FULL, AnyMirrorStudy, MirrorStudy, TraceStudy

_MODES = 12
_PERIOD = 40  # instants of a mode
_MOST_INSTANTS = 200
_GAP = 1.15  # between both mirrors, of a width
_MOST_CASES = 6
_EXACT = 2e-5
_LEFT, _RIGHT = "#9cc4e4", "#b9d7b0"


def film_of(
    store: Path, manifest: Manifest, chosen: Sequence[int], tell: Callable[[str], None]
) -> tuple[tuple[Stage, ...], tuple[Take, ...]]:
    """Return a stage for every variant, and its modes and excitations."""
    study = any_study_of(manifest.study)
    every = mirror_trace.cases_of(study) if isinstance(study, TraceStudy) else _cases(study)
    status = open_store(store)["status"].to_numpy()
    cases = list(chosen) or _spread(
        [k for k, (_, variant) in enumerate(every) if status[k] == DONE and variant != FULL]
    )
    stages, takes = list[Stage](), list[Take]()
    with threadpool_limits(1):
        for case in cases:
            name, variant = every[case]
            bench = bench_of(manifest.study, name)
            whole = variant_of(bench, study.reduction.reference if isinstance(study, MirrorStudy) else FULL)
            reduced = variant_of(bench, variant)
            label = f"case {case}, {name} {variant}"
            takes += _modes(whole, reduced, label, len(stages))
            takes += _excited(study, whole, reduced, label, len(stages))
            stages.append(_side_by_side(whole, reduced, name, variant))
            tell(label)
    return tuple(stages), tuple(takes)


def _spread(cases: list[int]) -> list[int]:
    """Return some of the cases, evenly chosen."""
    if not cases:
        raise UserError("No case of the store is done yet; there is nothing to view.")
    return cases[:: -(-len(cases) // _MOST_CASES)]


def _cases(study: AnyMirrorStudy) -> list[tuple[str, str]]:
    if not isinstance(study, MirrorStudy):
        raise TypeError(f"{type(study).__name__} has no variants")
    return mirror_mor.cases_of(study)


def _side_by_side(whole: ReducedModel, reduced: ReducedModel, name: str, variant: str) -> Stage:
    scene = model_scene(whole)
    skin, count = scene.skins[0], len(scene.skins[0].points)
    shift = np.array([_GAP * np.ptp(skin.points[:, 0]), 0.0, 0.0])
    edge = np.array([0.0, 1.1 * skin.points[:, 1].min(), 0.0])
    names = (f"{name}, reference: order {whole.order}", f"{variant}: order {reduced.order}")
    crosses = [
        (MOUNT, point + by + size * line)
        for by in (0.0 * shift, shift)
        for point in scene.dots
        for size in (0.02 * shift[0],)
        for line in (np.array([[-1.0, 0, 0], [1, 0, 0]]), np.array([[0.0, -1, 0], [0, 1, 0]]))
    ]
    return Stage(
        np.concatenate([skin.points, skin.points + shift]),
        np.concatenate([skin.faces, skin.faces + count]),
        np.repeat([0, 1], count),
        (_LEFT,) * len(skin.faces) + (_RIGHT,) * len(skin.faces),
        names,
        np.stack([0.0 * shift, shift]),
        np.broadcast_to(np.eye(3), (2, 3, 3)),
        tuple(crosses),
        ((names[0], edge), (names[1], shift + edge)),
    )


def _modes(whole: ReducedModel, reduced: ReducedModel, label: str, stage: int) -> list[Take]:
    """Return the elastic modes of both by rising frequency, over one period of the reference's."""
    both = [(pseudo_frequencies(model), surface_modes(model)) for model in (whole, reduced)]
    elastic = [np.flatnonzero(frequencies > 0.0)[:_MODES] for frequencies, _ in both]
    takes = []
    for number, places in enumerate(zip(*elastic, strict=False), start=1):
        shapes, hertz = [], []
        for place, (frequencies, modes) in zip(places, both, strict=True):
            shape = modes[:, place]
            shapes.append(shape / np.abs(shape).max())
            hertz.append(float(frequencies[place]))
        sign = -1.0 if shapes[0] @ shapes[1] < 0.0 else 1.0
        moved = np.concatenate([shapes[0].reshape(-1, 3), sign * shapes[1].reshape(-1, 3)])
        phase = 2.0 * np.pi * np.arange(_PERIOD) / _PERIOD
        takes.append(
            Take(
                f"{label}: mode {number}, {hertz[0]:.4g} and {hertz[1]:.4g} Hz",
                np.arange(_PERIOD) / _PERIOD / hertz[0],
                note="Left the reference, right the reduced model, each scaled to a largest motion of 1 m.",
                stage=stage,
                shapes=moved[None],
                weights=np.sin(phase)[:, None],
            )
        )
    return takes


def _excited(
    study: AnyMirrorStudy, whole: ReducedModel, reduced: ReducedModel, label: str, stage: int
) -> list[Take]:
    """Return the response of both to every excitation, and how far apart they are."""
    moved = [over_time(study, model, model.surface)[0] for model in (whole, reduced)]  # type: ignore[arg-type]
    time = time_of(study)
    step = -(-len(time) // _MOST_INSTANTS)
    takes = []
    for number, excitation in enumerate(study.excitation):
        left, right = (one[number, ::step].reshape(len(time[::step]), -1, 3) for one in moved)
        shapes, weights = principal(np.concatenate([left, right], axis=1), _EXACT)
        rms = [_rms(left), _rms(right), _rms(right - left)]
        takes.append(
            Take(
                f"{label}: excited by {excitation.name}",
                time[::step],
                note="Left the reference, right the reduced model; both share one scale.",
                stage=stage,
                shapes=shapes,
                weights=weights,
                series={
                    "displacement along z, rms (reference, reduced)": ("um", 1e6 * np.stack(rms[:2], axis=1)),
                    "difference, rms": ("um", 1e6 * rms[2][:, None]),
                },
            )
        )
    return takes


def _rms(moved: Array) -> Array:
    return np.asarray(np.sqrt(np.mean(moved[..., 2] ** 2, axis=1)))
