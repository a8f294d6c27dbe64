"""What commands of the main job take: processor time of all processes, and wall time; medians.

``python -m benchmarks.main_job [ROUNDS]``; kernels and tables are built before, in a round that does not
count. Wall times mean something on a machine that does nothing else. Of each command that is an answer rather
than a computation stands beside what an interpreter takes that loads the libraries it cannot do without, and
asks OpenCL for its devices where the command computes on one: no code of ours can be below that.
"""

import os
import sys
import tempfile
from collections import defaultdict
from pathlib import Path
from statistics import median

from rich.console import Console

from benchmarks._processor import LIBRARIES, loading, slower_by
from benchmarks._verdict import Row, verdict
from benchmarks._whole import spent, until

STUDY = "tmt-segments"
# Command -> demanded and aimed at: seconds of processor time; then by the clock, where that is asked for.
DEMANDS = {
    "run": ((20.0, 9.0), (12.0, 5.0)),
    "run again": ((2.0, 1.0), None),
    "report": ((4.0, 1.5), None),
    "plan": ((8.0, 4.0), None),
    "status": ((0.5, 0.3), None),
    "studies": ((0.5, 0.3), None),
    "--version": ((0.5, 0.3), None),
    "tab completion": ((0.5, 0.3), None),
    "sensitivity": ((1.5, 1.0), None),
    "sensitivity, no kernel built": ((5.0, 4.0), None),
}
FIRST = (3.0, 1.5)


def wavequake(*words: str) -> list[str]:
    """Return the command line that runs this installation."""
    return [sys.executable, "-m", "wavequake", *words]


def measure(folder: Path) -> dict[str, tuple[float, float]]:
    """Run every command once in an empty folder; return processor time and wall time of each."""
    store = str(folder / "store")
    commands = {
        "run": ("run", STUDY, "--store", store),
        "run again": ("run", STUDY, "--store", store),
        "report": ("report", store),
        "plan": ("plan", STUDY),
        "status": ("status", store),
        "studies": ("studies",),
        "--version": ("--version",),
        "sensitivity": ("sensitivity", "tmt-thesis", "--store", str(folder / "warm")),
    }
    found = {name: tuple(spent(wavequake(*words))) for name, words in commands.items()}
    asked = {"_WAVEQUAKE_COMPLETE": "complete_bash", "COMP_WORDS": "wavequake run tmt", "COMP_CWORD": "2"}
    script = str(Path(sys.executable).with_name("wavequake"))
    found["tab completion"] = tuple(spent([script, "run"], os.environ | asked))
    found |= {_alone(name): (loading(name), 0.0) for name in LIBRARIES}
    cold = os.environ | {"POCL_CACHE_DIR": str(folder / "kernels"), "XDG_CACHE_HOME": str(folder / "cache")}
    words = wavequake("sensitivity", "tmt-thesis", "--store", str(folder / "cold"))
    found["sensitivity, no kernel built"] = tuple(spent(words, cold))
    few, journal = folder / "few", folder / "few" / "done"
    command = wavequake("run", STUDY, "campaign.cases=4", "store.chunk_cases=1", "--store", str(few))
    found["first case"] = (0.0, until(command, lambda: any(journal.glob("*.jsonl")), folder))
    return found  # type: ignore[return-value]


def _alone(name: str) -> str:
    return f"{name}: its libraries alone"


def main(rounds: int = 5) -> None:
    """Print the medians of all rounds beside what is demanded."""
    found: dict[str, list[tuple[float, float]]] = defaultdict(list)
    for index in range(rounds + 1):
        with tempfile.TemporaryDirectory() as folder:
            for name, pair in measure(Path(folder)).items():
                if index:
                    found[name].append(pair)
    alone = {name: median(value for value, _ in found[_alone(name)]) for name in LIBRARIES}
    rows = []
    for name, (processor, clock) in DEMANDS.items():
        cpu, wall = (median(values) for values in zip(*found[name], strict=True))
        rows.append(Row(f"{name}, CPU", cpu, *processor, least=False, unit="s"))
        if clock:
            rows.append(Row(f"{name}, wall", wall, *clock, least=False, unit="s"))
        if name in LIBRARIES:
            rows.append(Row(f"{_alone(name)}, CPU", alone[name], *processor, least=False, unit="s"))
    first = median(wall for _, wall in found["first case"])
    rows.append(Row("first case done, wall", first, *FIRST, least=False, unit="s"))
    slower = slower_by(alone)
    print(f"libraries alone take {slower:.2f} times as long as on the Zen 4 that met what is demanded")
    Console(width=120).print(verdict(row._replace(slower=slower) for row in rows))


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
