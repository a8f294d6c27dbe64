"""What one reduced model of a mirror takes: errors and frequencies alone, with time responses, with images.

``python -m benchmarks.variants``: medians of processor time over the variants of `mirror-mor`, circular
mirror, one thread of BLAS, after what a process does once.
"""

import time
from collections import defaultdict
from statistics import median

from rich.console import Console
from threadpoolctl import threadpool_limits

from benchmarks._processor import slowness
from benchmarks._verdict import Row, verdict
from wavequake.kernels.device.devices import choose_device
from wavequake.reduction.metrics import eps_mor, eps_of, pseudo_frequencies, receptance
from wavequake.workflows.mirrors import mor as mirror_mor
from wavequake.workflows.mirrors.bench import (
    answers_of,
    bench_of,
    over_time,
    study_of,
    variant_of,
)
from wavequake.workflows.mirrors.optics import figure_rows, optical_rows
from wavequake.workflows.mirrors.shapes import node_row
from wavequake.workflows.study import load_study

DEMANDS = {
    "errors, order and frequencies": (20.0, 10.0),
    "with time responses": (40.0, 25.0),
    "with images": (100.0, 50.0),
}


def main() -> None:
    text = load_study("mirror-mor").identity_text()
    study = study_of(text)
    spent: dict[str, list[float]] = defaultdict(list)
    device = choose_device("auto")
    with threadpool_limits(1):
        bench, answers = bench_of(text, "circular"), answers_of(text, "circular")
        frequencies, optics = study.reduction.hertz, bench.optics
        mirror_mor.exposures(study, optics, answers.aberrations, device)
        for name in study.reduction.variants:
            marks = [time.process_time()]
            reduced = variant_of(bench, name)
            rows = optical_rows(optics, reduced)
            eps_mor(answers.mechanical, receptance(reduced, frequencies))
            eps_of(answers.optical, reduced, frequencies, rows[3:])
            pseudo_frequencies(reduced)
            marks.append(time.process_time())
            aberrations, *_ = over_time(study, reduced, rows, node_row(reduced), figure_rows(optics, reduced))
            marks.append(time.process_time())
            mirror_mor.exposures(study, optics, aberrations, device)
            marks.append(time.process_time())
            for part, end in zip(DEMANDS, marks[1:], strict=True):
                spent[part].append(1e3 * (end - marks[0]))
    slower = slowness()
    print(f"libraries alone take {slower:.2f} times as long as on the Zen 4 that met what is demanded")
    Console(width=120).print(
        verdict(
            Row(f"a variant: {part}, CPU", median(spent[part]), *demands, False, "ms", slower=slower)
            for part, demands in DEMANDS.items()
        )
    )


if __name__ == "__main__":
    main()
