"""How the cost of a case grows with the work: a table of processor times, and a figure for docs/.

``python -m benchmarks.growth [FIGURE]``: one thread, best of three, after what a process does once; ten
million cases take five minutes, once. Workers beyond this machine are simulated: every chunk costs a worker
its seconds, and client and scheduler theirs.
"""

import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table
from threadpoolctl import threadpool_limits

from benchmarks import scale
from wavequake.campaign.contract import StudyKind
from wavequake.campaign.engine.driver import run_campaign
from wavequake.kernels.device.devices import choose_device
from wavequake.mechanics.mirrors.models import CircularMirror, circular_mirror
from wavequake.mechanics.vibration.eigen import eigenmodes
from wavequake.workflows.segments import disturbance as workflow
from wavequake.workflows.segments.study import SegmentStudy
from wavequake.workflows.study import load_study

BUSY = "busy"
"""Unit of simulated workers: the share of their time in which they compute."""
# Of a chunk, s of processor time of one worker: short ones, and those that the engine chooses.
CHUNK_SECONDS = (1.0, 10.0, 60.0)
_CHUNK = 10_000  # cases
_SHAKE = {"name": "shake", "model": "line-of-sight"}


def hexagons(rings: int) -> str:
    """Return the polygons of a primary mirror of 30 m of so many rings of hexagons about a hole, as CSV."""
    side = 14.0 / ((rings + 0.5) * np.sqrt(3.0))
    corners = side * np.exp(1j * np.pi / 3.0 * np.arange(6)) * 0.995
    lines = ["id," + ",".join(f"x{k}_m,y{k}_m" for k in range(1, 7))]
    for a in range(-rings, rings + 1):
        for b in range(max(-rings, -a - rings), min(rings, rings - a) + 1):
            if a or b:
                middle = side * complex(1.5 * a, np.sqrt(3.0) * (b + 0.5 * a))
                places = (f"{one.real:.9f},{one.imag:.9f}" for one in middle + corners)
                lines.append(f"{a}/{b}," + ",".join(places))
    return "\n".join(lines) + "\n"


def study_of(**sections: object) -> SegmentStudy:
    """Return tmt-segments without images, of wind shake, changed as given."""
    record = load_study("tmt-segments").model_dump(mode="json")
    record |= {"imaging": {"enabled": False}, "disturbance": [_SHAKE], **sections}
    return SegmentStudy.model_validate(record)


def best(work: Callable[[], object], calls: int = 3) -> float:
    """Return the least processor time of calls, s, after one that does not count; of one call alone, its."""
    spent = []
    for _ in range(calls + (calls > 1)):
        start = time.process_time()
        work()
        spent.append(time.process_time() - start)
    return min(spent[1:] or spent)


def of_cases(study: SegmentStudy, cases: int) -> float:
    """Return the processor time of so many cases, s; of many, chunk by chunk as a campaign, once."""
    text, device = study.identity_text(), choose_device("auto").name

    def work() -> None:
        for first in range(0, cases, _CHUNK):
            workflow.KIND.compute(text, np.arange(first, min(first + _CHUNK, cases)) + 1000, device)

    return best(work, 3 if cases <= _CHUNK else 1)


def segmented_by_rings(rings: int) -> SegmentStudy:
    """Return a study of a paraboloid of hexagons that is imaged at its focus."""
    image = {"name": "image", "radius_mm": None, "distance_mm": 30_000.0}
    telescope = {"name": "custom", "primary_radius_mm": -60_000.0, "primary_conic": -1.0, "surfaces": [image]}
    return study_of(
        telescope=telescope | {"polygons_csv": hexagons(rings)},
        optics={"rays_per_segment": 6},
        disturbance=[_SHAKE],
    )


def sweeps() -> Iterator[tuple[str, str, list[float], Callable[[float], float]]]:
    """Yield what grows, the unit of its cost, its values and what measures the seconds at one of them."""
    million = load_study("tmt-million")
    yield "cases of the modal model", "s", [10**k for k in range(3, 8)], lambda n: of_cases(million, int(n))
    yield (
        "instants of wind shake, 492 segments",
        "s per case",
        [16, 64, 256, 1024],
        lambda n: of_cases(study_of(disturbance=[{**_SHAKE, "instants": int(n)}]), 1),
    )
    yield (
        "segments (6 rays each, 16 instants)",
        "s per case",
        [18, 126, 546, 1260, 5166],
        lambda n: of_cases(segmented_by_rings(round((np.sqrt(12.0 * n + 9.0) - 3.0) / 6.0)), 1),
    )
    yield (
        "rays per segment",
        "s per case",
        [6, 18, 36, 72],
        lambda n: of_cases(study_of(optics={"rays_per_segment": int(n)}), 2),
    )
    yield (
        "Zernike terms",
        "s per case",
        [11, 45, 105, 231],
        lambda n: of_cases(study_of(wavefront={"zernike_terms": int(n)}), 2),
    )
    mirrors = {circular_mirror(CircularMirror(core=n)).order: n for n in (2, 4, 8, 12)}
    yield (
        "degrees of freedom, 40 modes",
        "s",
        list(mirrors),
        lambda order: best(lambda: eigenmodes(circular_mirror(CircularMirror(core=mirrors[int(order)])), 40)),
    )


def seconds_per_chunk(chunks: int = 300) -> float:
    """Return what client and scheduler take per chunk of one worker's, s of processor time."""
    kind = StudyKind("nothing", scale.template, scale.case_table, scale.compute)
    with tempfile.TemporaryDirectory() as folder:
        begun = time.process_time()
        run_campaign(
            *(kind, '{"study":{}}', Path(folder) / "store"),
            **{"cases": chunks, "chunk": 1, "device": "numpy", "on": "local", "workers": 1},
            progress=lambda *_: None,
        )
        return (time.process_time() - begun) / chunks


def busy(workers: int, chunk: float, served: float) -> float:
    """Return the share of their time in which workers compute, if one process serves all their chunks.

    Workers ask for the next chunk when one is done and wait their turn: a closed queue of one server, whose
    waits follow from those of one worker less (mean value analysis).
    """
    queue = 0.0
    for count in range(1, workers + 1):
        answer = served * (1.0 + queue)
        rate = count / (chunk + answer)
        queue = rate * answer
    return rate * chunk / workers


def slope(values: list[float], costs: list[float]) -> float:
    """Return the power with which a cost grows at the end of its row."""
    return float(np.log(costs[-1] / costs[-2]) / np.log(values[-1] / values[-2]))


def main(figure: str = "") -> None:
    """Measure, print, and draw where a file is given."""
    table = Table("", "", "from", "to", "cost", "power at the end", box=None)
    rows = []
    with threadpool_limits(1):
        for name, unit, values, cost in sweeps():
            costs = [cost(value) for value in values]
            rows.append((name, unit, values, costs))
            words = " ".join(f"{one:.3g}" for one in costs)
            power = f"{slope(values, costs):.2f}"
            table.add_row(name, unit, f"{values[0]:g}", f"{values[-1]:g}", words, power)
    served = seconds_per_chunk()
    counts = [1, 2, 10, 100, 1000]
    for chunk in CHUNK_SECONDS:
        shares = [busy(count, chunk, served) for count in counts]
        rows.append((f"workers, chunks of {chunk:g} s", BUSY, counts, shares))
        words = " ".join(f"{one:.1%}" for one in shares)
        table.add_row(f"workers, chunks of {chunk:g} s", BUSY, "1", "1000", words, "")
    console = Console(width=150)
    console.print(table)
    print(f"client and scheduler take {served * 1e3:.1f} ms per chunk: they serve {1 / served:.0f} a second")
    if figure:
        draw(rows, Path(figure))


def _label(value: float) -> str:
    """Return a number as a tick has room for it."""
    if value >= 1000 and np.log10(value) % 1.0 == 0.0:
        return f"$10^{np.log10(value):.0f}$"
    return f"{value:g}" if value < 1000 else f"{value / 1000:.2g}k"


def draw(rows: list[tuple[str, str, list[float], list[float]]], file: Path) -> None:
    """Draw what was measured, one panel each, dotted what is proportional, and the simulated workers."""
    import matplotlib.pyplot as plt

    measured = [row for row in rows if row[1] != BUSY]
    drawn, panels = plt.subplots(2, 4, figsize=(11.0, 5.0), layout="constrained")
    for panel, (name, unit, values, costs) in zip(panels.flat, measured, strict=False):
        panel.loglog(values, costs, "o-", color="#0b5fa5", markersize=4)
        panel.loglog(values, np.array(values) * costs[-1] / values[-1], ":", color="0.6")
        panel.minorticks_off()
        panel.set_xticks(values, [_label(value) for value in values])
        panel.set(xlabel=name, ylabel=f"CPU {unit}")
    panel = panels.flat[len(measured)]
    for name, _, counts, shares in (row for row in rows if row[1] == BUSY):
        panel.semilogx(
            counts, 100.0 * np.array(shares), "o-", markersize=4, label=name.removeprefix("workers, ")
        )
    panel.set(xlabel="workers (simulated)", ylabel="% busy", ylim=(0, 105))
    panel.legend(fontsize=8)
    for panel in panels.flat[len(measured) + 1 :]:
        panel.set_visible(False)
    for panel in panels.flat:
        panel.xaxis.label.set_size(8)
        panel.tick_params(labelsize=7)
    drawn.savefig(file, dpi=90)


if __name__ == "__main__":
    main(*sys.argv[1:])
