"""Run the benchmarks of this folder, and say which demands are met on this processor.

``python -m benchmarks [NAME ...] [--json FILE]`` runs all of them or some, each in a process of its own: one
that fails is a row with its reason. ``python -m benchmarks --compare A.json B.json`` shows what changed.
"""

import argparse
import json
import os
import pkgutil
import platform
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from datetime import date
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

import benchmarks
from benchmarks._verdict import ROWS, Row, table
from wavequake.kernels.device.devices import list_devices

_UNCHANGED = 0.1  # rows that differ by less than this share are alike: machines are not quieter
_ASKED_FOR = ("measured", "viewer", "bundled_times")  # tests, which `make test` runs, pages, a file of ours
_FIRST = ("main_job", "modal", "variants")  # what is demanded in seconds, before an hour of work warms up


def processor() -> dict[str, Any]:
    """Return what the figures depend on: processor, its CPUs, and OpenCL devices with their vectors."""
    lines = Path("/proc/cpuinfo").read_text().splitlines() if Path("/proc/cpuinfo").exists() else []
    facts = dict(line.split(":", 1) for line in lines if ":" in line)
    facts = {key.strip(): value.strip() for key, value in facts.items()}
    flags = facts.get("flags", "").split()
    wide = next((bits for flag, bits in (("avx512f", 512), ("avx2", 256)) if flag in flags), 128)
    kernels = [f"{one.name}, {one.vector_width} lanes" for one in list_devices() if one.kind != "numpy"]
    return {
        "processor": facts.get("model name", platform.processor()),
        "vectors": f"{wide} bits",
        "cpus": len(os.sched_getaffinity(0)),
        "devices": kernels,
        "date": date.today().isoformat(),
    }


def collect(names: Sequence[str]) -> list[dict[str, Any]]:
    """Run benchmarks one after the other; return their rows, and of one that fails why."""
    rows = []
    for name in names:
        print(f"== {name} ==", flush=True)
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "rows"
            ran = subprocess.run(
                [sys.executable, "-m", f"benchmarks.{name}"],
                env=os.environ | {ROWS: str(file)},
                stderr=subprocess.PIPE,
                text=True,
                check=False,
            )
            lines = file.read_text(encoding="utf-8").splitlines() if file.exists() else []
        sys.stderr.write(ran.stderr)
        rows += [{"benchmark": name, **json.loads(line)} for line in lines]
        if ran.returncode:
            why = (ran.stderr.strip().splitlines() or [f"exit code {ran.returncode}"])[-1]
            rows.append({"benchmark": name, **Row("all of it", None, 0.0, 0.0, reason=why)._asdict()})
    return rows


def shown(found: Mapping[str, Any]) -> Table:
    """Return the verdicts of a file as a table."""
    rows = [Row(**{key: value for key, value in one.items() if key != "benchmark"}) for one in found["rows"]]
    return table(rows, [one["benchmark"] for one in found["rows"]])


def compared(before: Mapping[str, Any], after: Mapping[str, Any]) -> Table:
    """Return the rows of two files side by side; changes of more than a tenth have a word."""
    old, new = ({(one["benchmark"], one["name"]): one for one in file["rows"]} for file in (before, after))
    columns = Table("", "", "before", "after", "after / before", "", box=None)
    for key in dict.fromkeys([*old, *new]):
        values = [(file.get(key) or {}).get("value") for file in (old, new)]
        first, second = values
        if first is None or second is None:
            ratio = ""
            word = (
                "gone" if second is None and first is not None else "new" if second is not None else "skipped"
            )
        else:
            change = second / first if first else float("inf")
            ratio = f"{change:.2f}"
            better = (change > 1.0) == new[key]["least"]
            word = "" if abs(change - 1.0) < _UNCHANGED else "better" if better else "worse"
        columns.add_row(*key, *("-" if one is None else f"{one:.3g}" for one in values), ratio, word)
    return columns


def main() -> None:
    """Run, collect and show."""
    known = [one.name for one in pkgutil.iter_modules(benchmarks.__path__) if not one.name.startswith("_")]
    every = [*_FIRST, *(name for name in known if name not in (*_FIRST, *_ASKED_FOR))]
    parser = argparse.ArgumentParser(prog="python -m benchmarks")
    parser.add_argument("names", nargs="*", metavar="NAME", help=", ".join(known))
    parser.add_argument("--json", type=Path, default=Path("runs/benchmarks.json"), metavar="FILE")
    parser.add_argument("--compare", type=Path, nargs=2, metavar=("A.json", "B.json"))
    asked = parser.parse_args()
    console = Console(width=150)
    if asked.compare:
        files = [json.loads(file.read_text(encoding="utf-8")) for file in asked.compare]
        for name, one in zip(("before", "after"), files, strict=True):
            console.print(f"{name}: {one['processor']}, {one['cpus']} CPUs, {one['date']}")
        console.print(compared(*files))
        return
    if unknown := sorted(set(asked.names) - set(known)):
        parser.error(f"there is no benchmark {unknown[0]}; there are {', '.join(known)}")
    found = {**processor(), "rows": collect(asked.names or every)}
    asked.json.parent.mkdir(parents=True, exist_ok=True)
    asked.json.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    console.print(f"{found['processor']}, vectors of {found['vectors']}, {found['cpus']} CPUs")
    for device in found["devices"]:
        console.print(device)
    console.print(shown(found))
    console.print(f"written: {asked.json}")


if __name__ == "__main__":
    main()
