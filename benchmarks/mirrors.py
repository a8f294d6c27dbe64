"""From a vibrating mirror to its wavefront: every instant traced, modal sensitivities, and the naive way.

The circular mirror of Störkle 2018, Section 4.3, `craigb36` at 300 Hz: 200 instants of 500 rays, 231
Zernike terms (Table 4.1: 22 s by the standard method, 15 s by the modal one). What the polynomials
leave is traced with them as a grid. The naive way forms the normal equations of every instant anew
and traces it alone; it is timed at a few instants and extrapolated. Then 2000 surface fits: by normal
equations, by one factorization, and by modes. One thread of BLAS; medians.
"""

import time
from collections.abc import Callable
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table
from threadpoolctl import threadpool_limits

from wavequake.kernels.devices import choose_device
from wavequake.mechanics.excitations import drive_of
from wavequake.mechanics.modal import modal_model
from wavequake.mechanics.response import displacements, respond
from wavequake.optics.surface_fit import apply, heights
from wavequake.workflows.mirror_bench import bench_of, time_of, variant_of
from wavequake.workflows.mirror_optics import Optics, displacements_mm
from wavequake.workflows.mirror_residual import left_by, residual_of
from wavequake.workflows.mirror_trace import (
    MODAL,
    STANDARD,
    Clock,
    modal_method,
    standard_method,
    trace_figures,
)
from wavequake.workflows.study import load_study

REPEATS = 9
NAIVE = 5


def median(function: Callable[[], Any]) -> float:
    """Return the median time of some calls in s, after one that is not timed."""
    function()
    found = []
    for _ in range(REPEATS):
        start = time.perf_counter()
        function()
        found.append(time.perf_counter() - start)
    return float(np.median(found))


def normal_equations(optics: Optics, moved: np.ndarray) -> np.ndarray:
    """Return the figure of one instant (1, p, 3) by Eq. 4.10 as it is printed."""
    above = heights(optics.surface, moved, linear=False)[0]
    weighted = optics.surface.basis.T * optics.surface.weights
    return np.linalg.solve(weighted @ optics.surface.basis, weighted @ above)[None]


def main() -> None:
    """Print the time of each method and of its stages."""
    device = choose_device("auto")
    study = load_study("mirror-trace", {"model.shapes": ["circular"]})
    with threadpool_limits(1):
        bench = bench_of(study.identity_text(), "circular")
        optics, model, instants = bench.optics, variant_of(bench, "craigb36"), time_of(study)
        drive = drive_of(study.excitation[1], 3, instants, 0)
        response = respond(modal_model(model, drive.prescribed), [drive], instants)
        moved = displacements_mm(displacements(response, model.surface)[0])

        def one_by_one() -> None:
            for instant in range(NAIVE):
                figure = normal_equations(optics, moved[instant : instant + 1])
                trace_figures(optics, figure, None, device, Clock())

        rest = residual_of(optics, left_by(optics, model), device)
        standard = median(lambda: standard_method(optics, model.surface, response, device, Clock(), rest))
        smooth = median(lambda: standard_method(optics, model.surface, response, device, Clock()))
        modal = median(lambda: modal_method(optics, model.surface, response, Clock(), rest))
        naive = median(one_by_one) * len(instants) / NAIVE
        many = np.concatenate([moved] * 10)
        fits = median(lambda: apply(optics.surface, many))
        each = median(lambda: normal_equations(optics, moved[:1])) * len(many)
        modes = apply(optics.surface, displacements_mm((model.surface @ response.modes).T))
        amplitudes = np.concatenate([response.coordinates[0]] * 10)
        by_modes = median(lambda: amplitudes @ modes)
        clock = Clock()
        standard_method(optics, model.surface, response, device, clock, rest)
        modal_method(optics, model.surface, response, clock, rest)
    table = Table("", "ms", "ratio to standard", title=f"200 instants x 500 rays, {device.name}")
    ways = (
        ("standard", standard),
        ("standard, Zernikes alone", smooth),
        ("modal", modal),
        ("naive, Zernikes alone", naive),
    )
    for name, seconds in ways:
        table.add_row(name, f"{1e3 * seconds:.1f}", f"{seconds / standard:.2f}")
    for stage in (*STANDARD, *MODAL):
        table.add_row(f"  {stage}", f"{1e3 * clock.seconds[stage]:.2f}", "")
    table.add_row(f"{len(many)} surface fits", f"{1e3 * fits:.1f}", "")
    table.add_row("  by modes", f"{1e3 * by_modes:.1f}", "")
    table.add_row("  normal equations each time", f"{1e3 * each:.0f}", f"{each / fits:.0f} x the fit")
    Console().print(table)


if __name__ == "__main__":
    main()
