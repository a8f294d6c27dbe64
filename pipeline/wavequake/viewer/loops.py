"""Reduced models for controllers: their modes beside those of the full model."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import xarray as xr

from wavequake.campaign.schema import study_from_identity
from wavequake.campaign.store.store import Manifest
from wavequake.reduction.reduce import reduce
from wavequake.viewer.chosen import some_cases
from wavequake.viewer.film import Stage, Take
from wavequake.viewer.mirrors import mode_takes, modes_of, side_by_side
from wavequake.workflows.loops.controller_bench import bench_of
from wavequake.workflows.loops.controller_mor import bench_frequencies
from wavequake.workflows.loops.controller_study import ControllerStudy


def film_of(
    dataset: xr.Dataset, manifest: Manifest, chosen: Sequence[int], tell: Callable[[str], None]
) -> tuple[tuple[Stage, ...], tuple[Take, ...]]:
    """Return a stage for every reduced model, with its modes; cases that differ in the effort share them."""
    bench = bench_of(study_from_identity(ControllerStudy, manifest.study))
    names = list(map(str, dataset["variant"].to_numpy()))
    first = list({name: case for case, name in reversed(list(enumerate(names)))}.values())
    whole = bench_frequencies(bench), bench.shapes
    stages, takes = list[Stage](), list[Take]()
    for case in list(chosen) or some_cases(dataset, sorted(first)):
        model, label = reduce(bench.full(), names[case]), f"case {case}, {names[case]}"
        takes += [
            replace(take, label=f"{label}: {take.label}", case=case, stage=len(stages))
            for take in mode_takes(whole, modes_of(model))
        ]
        stages.append(side_by_side(bench.full(), model, bench.study.model.shape, names[case]))
        tell(label)
    return tuple(stages), tuple(takes)
