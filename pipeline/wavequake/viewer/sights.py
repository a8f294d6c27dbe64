"""A line of sight that wind and lines shake, without a controller and with each one: histories alone."""

from collections.abc import Callable, Sequence

import numpy as np
import xarray as xr
from threadpoolctl import threadpool_limits

from wavequake.campaign.schema import study_from_identity
from wavequake.campaign.stopwatch import Stopwatch
from wavequake.campaign.store.store import Manifest
from wavequake.viewer.chosen import some_cases
from wavequake.viewer.film import NO_BODIES, Stage, Take
from wavequake.workflows.loops.tip_tilt import bench_of, run_of
from wavequake.workflows.loops.tip_tilt_study import TipTiltStudy

_MOST_FRAMES = 400


def film_of(
    dataset: xr.Dataset, manifest: Manifest, chosen: Sequence[int], tell: Callable[[str], None]
) -> tuple[tuple[Stage, ...], tuple[Take, ...]]:
    """Return no bodies, and of each loop the chosen cases or the first one over its first frames."""
    bench, takes = bench_of(study_from_identity(TipTiltStudy, manifest.study)), list[Take]()
    with threadpool_limits(1):
        for case in list(chosen) or some_cases(dataset, list(range(min(manifest.cases, len(bench.loops))))):
            loop = bench.loops[case % len(bench.loops)]
            moved, left = (
                one[:_MOST_FRAMES, None] for one in run_of(bench, loop, case // len(bench.loops), Stopwatch())
            )
            name = f"{loop.name}, {loop.rate_hz:g} Hz"
            takes.append(
                Take(
                    f"case {case}: {name}",
                    np.arange(1, len(moved) + 1) / loop.rate_hz,
                    note=f"Means over frames along the motion, the first {len(moved)} after settling.",
                    series={
                        "without (blue), with the controller (orange)": ("mas", np.hstack([moved, left])),
                        "what the controller leaves": ("mas", left),
                    },
                    case=case,
                    of=name,
                )
            )
            tell(takes[-1].label)
    return (NO_BODIES,), tuple(takes)
