"""The nominal bench and stage of a study file of the lens experiment."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from wavequake.control.bench import Bench, fitted_bench
from wavequake.control.stage import Stage
from wavequake.workflows.lens.study import LensStudy

Array = NDArray[np.float64]


def bench_of(study: LensStudy, springs: str) -> Bench:
    """Return the nominal bench of a configuration of springs."""
    section = study.bench
    given = {
        "lens_kg": section.lens_kg,
        "ring_kg": section.ring_kg,
        "couplings": section.couplings_n_m,
        "lens_springs": section.lens_springs_n_m,
        "ring_springs": section.ring_springs_n_m,
    }
    changes: dict[str, Array | float] = {
        name: np.array(values) for name, values in given.items() if values is not None
    }
    if section.housing_kg is not None:
        changes["housing_kg"] = section.housing_kg
    if section.housing_spring_n_m is not None:
        changes["housing_spring"] = section.housing_spring_n_m
    bench = fitted_bench(springs)
    if "lens_springs" in changes:
        changes["lens_springs"] = changes["lens_springs"] * bench.lens_springs / fitted_bench().lens_springs
    return replace(bench, alpha=section.alpha, beta=section.beta, **changes)  # type: ignore[arg-type]


def stage_of(study: LensStudy) -> Stage:
    """Return the stage that the controllers are designed for."""
    section = study.stage
    zeros, poles = (tuple(complex(*root) for root in roots) for roots in (section.zeros, section.poles))
    return Stage(zeros, poles, section.gain, section.delay_ms / 1e3)
