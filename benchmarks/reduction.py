"""How fast models are reduced and evaluated, and how that compares with pyMOR and with the naive way.

The circular mirror of Störkle 2018, Section 4.3 (7083 degrees of freedom); processor time of one
thread. A sweep of 150 variants is reduced from one intermediate model and evaluated at 131
frequencies. The naive way, one sparse factorization per frequency, is timed at three frequencies
and extrapolated to 1000. pyMOR gets the same elastic modal model for balanced truncation, and the
same full matrices for its transfer function at one frequency; it is left out where it is not
installed.
"""

import time
from collections.abc import Callable
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table
from threadpoolctl import threadpool_limits

from wavequake.mechanics.mirrors.models import circular_mirror
from wavequake.mechanics.model import FiniteElementModel
from wavequake.reduction.intermediate import Intermediate, dense_structure, intermediate
from wavequake.reduction.methods.balanced import oscillators
from wavequake.reduction.metrics import eps_mor, full_receptance, receptance, relative_errors
from wavequake.reduction.reduce import reduce
from wavequake.reduction.two_stage import reduce_variants, reference, spot_check

CHECKS = np.array([103.0, 431.0, 1111.0])
SWEEP = np.linspace(1.0, 1200.0, 131)
FINE = np.linspace(1.0, 1200.0, 1000)
REPEATS = 5


def timed(function: Callable[[], Any]) -> tuple[float, Any]:
    """Return the time in s that the thread computed, and the result."""
    start = time.process_time()
    result = function()
    return time.process_time() - start, result


def median(function: Callable[[], Any]) -> float:
    return float(np.median([timed(function)[0] for _ in range(REPEATS)]))


def sweep_names() -> list[str]:
    """Names of 150 variants: 60 of Krylov with random points, and all the other families."""
    random = np.random.default_rng(0)
    triples = [np.sort(random.choice(np.arange(50, 1150, 10), 3, replace=False)) for _ in range(60)]
    names = ["krylov108({},{},{})".format(*triple) for triple in triples]
    names += [f"{method}{order}" for method in ("craigb", "rubin", "modal") for order in range(18, 108, 5)]
    names += [f"flbt{order}({band})" for order in range(36, 72, 2) for band in ("0-400", "0-1200")]
    return names


def pymor_model(stage: Intermediate) -> Any:
    """Return the elastic modal model in pyMOR, in units of the lowest frequency, and that frequency."""
    from pymor.models.iosys import SecondOrderModel

    squared, dampings, inputs = oscillators(dense_structure(stage))
    unit = float(np.sqrt(squared[0]))
    model = SecondOrderModel.from_matrices(
        np.eye(len(squared)), np.diag(dampings / unit), np.diag(squared / unit**2), inputs, Cp=inputs.T
    )
    return model, unit


def compare_with_pymor(table: Table, model: FiniteElementModel, stage: Intermediate) -> None:
    try:
        from pymor.core.logger import set_log_levels
        from pymor.models.iosys import SecondOrderModel
        from pymor.reductors.sobt import SOBTpvReductor
    except ImportError:
        table.add_row("pyMOR", "not installed", "")
        return
    set_log_levels({"pymor": "ERROR"})
    peer, unit = pymor_model(stage)
    rigid = reference(stage).inputs[:6]
    omega = 2 * np.pi * SWEEP
    wanted = receptance(reference(stage), SWEEP)
    seconds, small = timed(lambda: SOBTpvReductor(peer).reduce(30))
    response, elastic = timed(lambda: small.transfer_function.freq_resp(omega / unit) / unit**2)
    error = eps_mor(wanted, elastic - (rigid.T @ rigid) / (omega**2)[:, None, None])
    ours = reduce_variants(stage, ["bt36"], optics=False)[0]
    fresh = median(lambda: reduce_variants(stage, ["bt36"], optics=False))
    mine = median(lambda: receptance(ours, SWEEP))
    table.add_row(
        "balanced truncation, 6 + 30 of the modal model",
        f"{fresh * 1e3:.0f} ms",
        f"pyMOR {seconds * 1e3:.0f} ms",
    )
    table.add_row(
        "  its largest error",
        f"{eps_mor(wanted, receptance(ours, SWEEP)).max():.1e}",
        f"pyMOR {error.max():.1e}",
    )
    table.add_row("  131 frequencies of it", f"{mine * 1e3:.2f} ms", f"pyMOR {response * 1e3:.1f} ms")
    inputs = model.inputs
    full = SecondOrderModel.from_matrices(
        model.mass.tocsc(),
        model.damping_matrix.tocsc(),
        model.stiffness.tocsc(),
        inputs.toarray(),
        Cp=inputs.toarray().T,
    )
    theirs, _ = timed(lambda: full.transfer_function.eval_tf(2j * np.pi * 431.0))
    own, _ = timed(lambda: full_receptance(model, [431.0]))
    table.add_row("one frequency of the full model", f"{own:.2f} s", f"pyMOR {theirs:.2f} s")


def main() -> None:
    with threadpool_limits(1):
        Console().print(measure())


def measure() -> Table:
    model = circular_mirror()
    seconds, stage = timed(lambda: intermediate(model))
    table = Table(
        "what", "Wavequake", "the other way", title=f"{model.name}, {model.order} degrees of freedom"
    )
    table.add_row(f"intermediate model of order {stage.order}", f"{seconds:.1f} s", "")
    naive, errors = timed(lambda: spot_check(model, [reference(stage)], CHECKS))
    table.add_row("  its error at three other frequencies", f"{errors.max():.1e}", "")
    names = sweep_names()
    wanted = receptance(reference(stage), SWEEP)
    reducing, variants = timed(lambda: reduce_variants(stage, names, optics=False))
    evaluating, _ = timed(lambda: relative_errors(wanted, variants, SWEEP))
    each = (reducing + evaluating) / len(names)
    table.add_row(f"{len(names)} variants with errors", f"{each * 1e3:.1f} ms each, {1 / each:.0f} /s", "")
    optics, _ = timed(lambda: reduce_variants(stage, names))
    table.add_row("  with optical nodes", f"{optics / len(names) * 1e3:.1f} ms each", "")
    direct, _ = timed(lambda: reduce(circular_mirror(), "krylov108(200,450,700)"))
    table.add_row(
        "krylov108(200,450,700)", _seconds(stage, "krylov108(200,450,700)"), f"directly {direct:.2f} s"
    )
    big = variants[0]
    fine = median(lambda: receptance(big, FINE))
    table.add_row(
        f"1000 frequencies, 9 x 9, order {big.order}",
        f"{fine * 1e3:.1f} ms",
        f"one factorization each: {naive / len(CHECKS) * len(FINE):.0f} s (extrapolated from {len(CHECKS)})",
    )
    compare_with_pymor(table, model, stage)
    return table


def _seconds(stage: Intermediate, variant: str) -> str:
    return f"{median(lambda: reduce_variants(stage, [variant], optics=False)) * 1e3:.0f} ms"


if __name__ == "__main__":
    main()
