"""What the bundled studies take, for plans that do not get so far: `workflows/times.json`.

``python -m benchmarks.bundled_times [STUDY ...]`` measures all or some, each in a process of its own with
an empty cache, by processor time, so that other work on the machine does not count.
"""

import json
import os
import subprocess
import sys
import tempfile
import time

from benchmarks.__main__ import processor
from wavequake.workflows.known_times import FILE
from wavequake.workflows.study import bundled_studies

# A clock that stands still while others work; what is prepared and what a case takes are told apart by it.
_MEASURE = """
import sys, time
time.perf_counter = time.process_time
from wavequake.workflows import run
found, measure = [], run._time_case
run._time_case = lambda *how: found.append(measure(*how)) or found[0]
run.plan(sys.argv[1])
each, pilot = found[0]
print(time.process_time() - each * pilot, each)
"""


def times_of(study: str) -> tuple[float, float]:
    """Return the processor time of the set-up of a process and of a case, s."""
    with tempfile.TemporaryDirectory() as cache:
        ran = subprocess.run(
            [sys.executable, "-c", _MEASURE, study],
            env=os.environ | {"XDG_CACHE_HOME": cache, "POCL_CACHE_DIR": cache},
            stdout=subprocess.PIPE,
            text=True,
            check=True,
        )
    set_up, each = map(float, ran.stdout.split()[-2:])
    return float(f"{set_up:.2g}"), float(f"{each:.2g}")


def main() -> None:
    """Measure, and write what is new into the file."""
    path = next(iter(bundled_studies().values())).parent / FILE
    old = json.loads(path.read_text(encoding="utf-8"))["studies"] if path.exists() else {}
    names = sys.argv[1:] or list(bundled_studies())
    for name in names:
        old[name] = times_of(name)
        print(f"{time.strftime('%H:%M')} {name}: {old[name]}", flush=True)
        rows = ",\n".join(f"  {json.dumps(key)}: {json.dumps(old[key])}" for key in sorted(old))
        head = f'{{\n "processor": {json.dumps(processor()["processor"])},\n "studies": {{\n'
        path.write_text(f"{head}{rows}\n }}\n}}\n", encoding="utf-8")


if __name__ == "__main__":
    main()
