"""Evaluations and CPU seconds of a rare event: weighted draws, splitting, OpenTURNS, plain Monte Carlo.

The event is that of `tmt-rare`: the wavefront error of 492 misaligned segments by the modal model, a
quadratic form whose probability is known exactly. All see the same function of the same numbers. The last
column is what a standard error of 10 % would take, as errors fall with the root of the evaluations.

``python -m benchmarks.rare``
"""

import time
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from wavequake.campaign.rare.certificate import estimated
from wavequake.campaign.rare.quadratic import QuadraticForm, limit_of, tilt_to
from wavequake.campaign.rare.splitting import probability
from wavequake.workflows.segments.rare import rare_cases
from wavequake.workflows.study import load_study

Array = NDArray[np.float64]
# Estimate, half of its 95 % interval, evaluations.
Found = tuple[float, float, int]


def by_draws(form: QuadraticForm, limit: float) -> Found:
    found = estimated(tilt_to(form, limit), limit, 0, 50_000)
    return found.value, (found.high - found.low) / 2.0, found.evaluations


def by_splitting(form: QuadraticForm, limit: float) -> Found:
    found = probability(form.along, len(form.slopes), limit)
    return found.value, (found.high - found.low) / 2.0, found.evaluations


def by_openturns(form: QuadraticForm, limit: float) -> Found:
    """Return what OpenTURNS' subset simulation says, with its own estimate of the scatter."""
    import openturns as ot

    ot.Log.Show(ot.Log.NONE)
    ot.RandomGenerator.SetSeed(0)
    rank, asked = len(form.slopes), []

    def values(points: object) -> list[list[float]]:
        found = form.along(np.array(points))
        asked.append(len(found))
        return found[:, None].tolist()

    model = ot.PythonFunction(rank, 1, func_sample=values)
    output = ot.CompositeRandomVector(model, ot.RandomVector(ot.Normal(rank)))
    algorithm = ot.SubsetSampling(ot.ThresholdEvent(output, ot.Greater(), limit))
    algorithm.setMaximumOuterSampling(100)
    algorithm.setBlockSize(1000)
    algorithm.run()
    result = algorithm.getResult()
    value = result.getProbabilityEstimate()
    return value, 1.96 * result.getCoefficientOfVariation() * value, sum(asked)


def main() -> None:
    form = rare_cases(load_study("tmt-rare").identity_text()).tilt.form
    ways: dict[str, Callable[[QuadraticForm, float], Found]] = {
        "weighted draws": by_draws,
        "splitting": by_splitting,
    }
    try:
        import openturns

        ways[f"OpenTURNS {openturns.__version__}, subset simulation"] = by_openturns
    except ImportError:
        print("OpenTURNS is not installed (pip install openturns): left out")
    table = Table(box=None)
    for column in ("exact", "by", "found", "±", "evaluations", "CPU s", "evaluations to 10 %"):
        table.add_column(column, justify="left" if column == "by" else "right")
    for exact in (1e-4, 1e-6, 1e-9):
        limit = limit_of(form, exact)
        for name, way in ways.items():
            start = time.process_time()
            value, half, evaluations = way(form, limit)
            seconds = time.process_time() - start
            needed = evaluations * (half / 1.96 / value / 0.1) ** 2
            table.add_row(
                f"{exact:g}",
                name,
                f"{value:.3g}",
                f"{half / value:.1%}",
                f"{evaluations:.3g}",
                f"{seconds:.2f}",
                f"{needed:.2g}",
            )
        table.add_row(f"{exact:g}", "plain Monte Carlo", "", "", "", "", f"{100.0 / exact:.2g}")
    Console(width=110).print(table)


if __name__ == "__main__":
    main()
