"""From a vibrating mirror to its wavefront: every instant traced, modal sensitivities, and the naive way.

The mirrors of Störkle 2018, Section 4.3, at 300 Hz: 200 instants of 500 rays, 231 Zernike terms on the
circle, 105 on the ring (Table 4.1, `craigb36`: 22 s by the standard method, 15 s by the modal one). What
the polynomials leave is traced with them as a grid. The naive way forms the normal equations of every
instant anew and traces it alone; it is timed at a few instants and extrapolated. Then 2000 surface fits with
the undeformed surface at the displaced x and y (Eq. 4.7 to 4.11; 10 ms are demanded): by normal equations, by
one factorization of all displaced nodes, and by patterns of the motion, which is what the standard method
does; beside them their linear part by modes. One thread of BLAS; minima of many runs in turn.
"""

import time
from collections.abc import Callable
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table
from threadpoolctl import threadpool_limits

from wavequake.campaign.stopwatch import Stopwatch
from wavequake.kernels.device.devices import choose_device
from wavequake.mechanics.model import ReducedModel
from wavequake.mechanics.vibration.excitations import drive_of
from wavequake.mechanics.vibration.modal import modal_model
from wavequake.mechanics.vibration.response import Response, displacements, respond
from wavequake.optics.shapes.fit import apply, heights
from wavequake.optics.shapes.motion_fit import figures, motion_fit
from wavequake.workflows.mirrors.bench import bench_of, variant_of
from wavequake.workflows.mirrors.optics import Optics, displacements_mm
from wavequake.workflows.mirrors.residual import coordinates_of, left_by, residual_of
from wavequake.workflows.mirrors.study import TraceStudy
from wavequake.workflows.mirrors.trace import (
    MODAL,
    STANDARD,
    modal_method,
    standard_method,
    trace_figures,
)
from wavequake.workflows.study import load_study

REPEATS = 25
NAIVE = 5
VARIANTS = ("craigb18", "craigb36", "krylov108(200,450,700)")
WORDS = {
    "smooth": "standard, Zernikes alone",
    "naive": "naive, Zernikes alone",
    "residual": "residual grids of coordinates, traced",
    "coordinates": "fits of coordinates",
    "patterns": "2000 surface fits (10 ms demanded)",
    "fits": "2000 fits, all nodes displaced",
    "by_modes": "2000 fits, linear, by modes",
    "each_time": "2000 fits, normal equations each time",
}


def best(**functions: Callable[[Stopwatch], Any]) -> dict[str, dict[str, float]]:
    """Return the least seconds of each function, called in turn, as a whole ("") and of its stages."""
    found: dict[str, dict[str, float]] = {name: {} for name in functions}
    for _ in range(REPEATS):
        for name, function in functions.items():
            clock, start = Stopwatch(), time.perf_counter()
            function(clock)
            clock.seconds[""] = time.perf_counter() - start
            known = found[name]
            found[name] = {key: min(value, known.get(key, value)) for key, value in clock.seconds.items()}
    return found


def shaken(study: TraceStudy, model: ReducedModel, instants: np.ndarray) -> Response:
    """Return how a model moves under the second excitation of a study."""
    drive = drive_of(study.excitation[1], 3, instants, 0)
    return respond(modal_model(model, drive.prescribed), [drive], instants)


def normal_equations(optics: Optics, moved: np.ndarray) -> np.ndarray:
    """Return the figure of one instant (1, p, 3) by Eq. 4.10 as it is printed."""
    above = heights(optics.surface, moved, linear=False)[0]
    weighted = optics.surface.basis.T * optics.surface.weights
    return np.linalg.solve(weighted @ optics.surface.basis, weighted @ above)[None]


def measured(shape: str, variant: str) -> dict[str, dict[str, float]]:
    """Return the seconds of each way, as `best`, for one reduced model of a mirror."""
    device = choose_device("auto")
    study = load_study("mirror-trace", {"model.shapes": [shape]})
    bench = bench_of(study.identity_text(), shape)
    optics, model, instants = bench.optics, variant_of(bench, variant), study.time.seconds
    response = shaken(study, model, instants)
    coordinates = coordinates_of(response)
    moved = displacements_mm(displacements(response, model.surface)[0])
    motion = motion_fit(optics.surface, displacements_mm(model.surface.T))
    rest = residual_of(optics, left_by(optics, model), device)
    modes = apply(optics.surface, displacements_mm((model.surface @ response.modes).T))
    longer = shaken(study, model, np.arange(2000) * instants[1])
    sums, many = coordinates_of(longer), displacements_mm(displacements(longer, model.surface)[0])

    def one_by_one(_: Stopwatch) -> None:
        for instant in range(NAIVE):
            figure = normal_equations(optics, moved[instant : instant + 1])
            trace_figures(optics, figure, coordinates, device, Stopwatch())

    found = best(
        standard=lambda clock: standard_method(optics, motion, coordinates, device, clock, rest),
        smooth=lambda clock: standard_method(optics, motion, coordinates, device, clock),
        modal=lambda clock: modal_method(optics, model.surface, response, clock, rest),
        naive=one_by_one,
        residual=lambda _: residual_of(optics, left_by(optics, model), device),
        coordinates=lambda _: motion_fit(optics.surface, displacements_mm(model.surface.T)),
        patterns=lambda _: figures(motion, sums),
        fits=lambda _: apply(optics.surface, many, linear=False),
        by_modes=lambda _: longer.coordinates[0] @ modes,
        each_time=lambda _: normal_equations(optics, moved[:1]),
    )
    found["naive"][""] *= len(instants) / NAIVE
    found["each_time"][""] *= len(many)
    found["sensitivities"] = {"": optics.seconds}
    truth = apply(optics.surface, many, linear=False)
    apart = np.abs(figures(motion, sums) - truth).max() / np.abs(truth).max()
    found["apart"] = {"": apart}
    return found


def main() -> None:
    """Print the time of each method and of its stages, ms."""
    cases = [(shape, variant) for shape in ("circular", "annular") for variant in VARIANTS]
    with threadpool_limits(1):
        columns = [measured(*case) for case in cases]
    heads = (f"{shape} {variant.split('(')[0]}" for shape, variant in cases)
    table = Table("ms", *heads, title=f"200 instants x 500 rays, {choose_device('auto').name}", box=None)
    rows = [("standard", stage) for stage in ("", *STANDARD)] + [("smooth", ""), ("smooth", "ray trace")]
    rows += [("modal", stage) for stage in ("", *MODAL)]
    rows += [(name, "") for name in ("naive", "sensitivities", "residual", "coordinates")]
    rows += [(name, "") for name in ("patterns", "fits", "by_modes", "each_time")]
    for name, stage in rows:
        words = f"{WORDS.get(name, name)}: {stage}" if stage else WORDS.get(name, name)
        table.add_row(words, *(f"{1e3 * found[name][stage]:.2f}" for found in columns))
    console = Console()
    console.print(table)
    apart = max(found["apart"][""] for found in columns)
    console.print(f"Surface fits by patterns and by all nodes displaced differ by {apart:.0e} at most.")


if __name__ == "__main__":
    main()
