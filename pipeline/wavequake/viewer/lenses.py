"""The bench of six lenses after a blow: lenses and stage move, and the image under each controller."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import xarray as xr
from threadpoolctl import threadpool_limits

from wavequake.campaign.store.store import Manifest
from wavequake.control.bench import COMPENSATOR, SENSITIVITIES, Bench, bench_modes, fitted_bench
from wavequake.control.plant import swing
from wavequake.drawing.solid import stretched, system_scene
from wavequake.optics.catalog.names import optical_system
from wavequake.viewer.chosen import some_cases
from wavequake.viewer.film import Array, Stage, Take, stage_of
from wavequake.workflows.kinds import study_of
from wavequake.workflows.lens import experiment as lens_experiment
from wavequake.workflows.lens import passive as lens_passive

_MOST_INSTANTS = 400
_MOST_CASES = 2
_PERIOD = 40  # instants of a mode
_ACROSS = 1  # lenses swing along y: across the axis, in the section that is drawn
_STEP = 1e-3


def film_of(
    dataset: xr.Dataset, manifest: Manifest, chosen: Sequence[int], tell: Callable[[str], None]
) -> tuple[tuple[Stage, ...], tuple[Take, ...]]:
    """Return the objective, and of each case what the lenses do after the blow, and their modes."""
    scene, times = stretched(system_scene(optical_system("six-lens")))
    stage, drawn = stage_of(scene), f"The objective is drawn {times:g} times as wide as it is."
    takes_of = _of_search if manifest.workflow == lens_passive.KIND.name else _of_plant
    takes = list[Take]()
    with threadpool_limits(1):
        for case in list(chosen) or some_cases(dataset, list(range(dataset.sizes["case"])), _MOST_CASES):
            label, found = takes_of(manifest.study, stage, dataset.sel(case=case), case)
            takes += [
                replace(take, label=f"{label}: {take.label}", note=f"{take.note} {drawn}", case=case)
                for take in found
            ]
            tell(label)
    return (stage,), tuple(takes)


def _of_plant(text: str, stage: Stage, stored: xr.Dataset, case: int) -> tuple[str, list[Take]]:
    """Return a plant of lens-experiment: its lenses swing alike under all controllers, lens 5 does not."""
    study = study_of(text)
    springs, realization = lens_experiment.case_of(study, case)
    plant = lens_experiment.plant_of(study, springs, realization)
    friction = lens_experiment.errors_of(study).friction
    late, time = np.array([plant.late]), stored["time"].to_numpy()
    lenses = lens_positions(plant.bench, plant.blows[1], time, friction=friction, late=late)
    takes = []
    for controller in map(str, stored["controller"].to_numpy()):
        one = stored.sel(controller=controller)
        moved = lenses.copy()
        moved[:, COMPENSATOR] = 1e-3 * one["stage_position"].to_numpy()
        image = 1e-3 * one["image"].to_numpy()
        takes.append(_take(stage, controller, time, moved, image))
    return f"case {case}, {springs} springs", [*takes, *_modes(stage, plant.bench)]


def _of_search(text: str, stage: Stage, stored: xr.Dataset, case: int) -> tuple[str, list[Take]]:
    """Return the bench that a search of lens-passive found, and the present one, after the same blow."""
    present, time = fitted_bench(active=False), np.arange(0.0, 3.0, 5.0 * _STEP)
    parts = {name: stored[name].to_numpy() for name in lens_passive.PARAMETERS}
    found = replace(present, **parts)  # type: ignore[arg-type]
    takes = []
    for name, bench in (("bench that was found", found), ("present bench", present)):
        lenses = lens_positions(bench, 1.0, time)
        takes.append(_take(stage, name, time, lenses, lenses @ np.array(SENSITIVITIES)))
    return f"case {case}", [*takes, *_modes(stage, found)]


def lens_positions(
    bench: Bench, blow: float, time: Array, friction: float = 0.0, late: Array | None = None
) -> Array:
    """Return the positions (T, 6) of the lenses after a blow, m; 0 of the one that a stage carries."""
    end = float(time[-1])
    runs = swing(
        [bench], np.array([blow]), friction=friction, duration=end, step=_STEP, late=late, keep_lenses=True
    )
    if runs.lenses is None:
        raise ValueError("swing kept no lenses")
    lenses = np.zeros((len(time), len(SENSITIVITIES)))
    lenses[:, bench.lenses] = runs.lenses[0].T[np.rint(time / _STEP).astype(np.int64)]
    return lenses


def _take(stage: Stage, name: str, time: Array, lenses: Array, image: Array) -> Take:
    step = -(-len(time) // _MOST_INSTANTS)
    lenses, image = lenses[::step], image[::step]
    note = "Lenses and image are drawn across the axis, with one exaggeration."
    return Take(
        name,
        time[::step],
        note=note + (f" One instant in {step} is shown." if step > 1 else ""),
        poses=_poses(stage, lenses, image),
        series={
            "image displacement": ("mm", 1e3 * image[:, None]),
            "lens 4 and lens 5": ("mm", 1e3 * lenses[:, 3:5]),
        },
        of=name,
    )


def _poses(stage: Stage, lenses: Array, image: Array) -> Array:
    """Return the motion of every surface, (T, B, 6), by lens or image."""
    poses = np.zeros((len(image), len(stage.names), 6))
    for number, name in enumerate(stage.names):
        poses[:, number, _ACROSS] = image if name == "image" else lenses[:, int(name[1]) - 1]
    return poses


def _modes(stage: Stage, bench: Bench) -> list[Take]:
    """Return the modes of a bench by rising frequency, each with a largest motion of 1 mm of a lens."""
    modes, takes = bench_modes(bench), []
    phase = np.cos(2.0 * np.pi * np.arange(_PERIOD) / _PERIOD)
    for number, place in enumerate(np.argsort(modes.omega), start=1):
        lenses = np.zeros(len(SENSITIVITIES))
        lenses[bench.lenses] = modes.shapes[: len(bench.lenses), place]
        lenses *= 1e-3 / (np.abs(lenses).max() or 1.0)
        hertz = float(modes.omega[place]) / (2.0 * np.pi)
        moved = phase[:, None] * lenses
        takes.append(
            Take(
                f"mode {number}, {hertz:.3g} Hz",
                np.arange(_PERIOD) / _PERIOD / hertz,
                note="Scaled to 1 mm of the lens that moves most.",
                poses=_poses(stage, moved, moved @ np.array(SENSITIVITIES)),
                of=f"mode {number}",
            )
        )
    return takes
