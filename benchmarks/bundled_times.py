"""What the bundled studies take, for plans that do not get so far: `workflows/times.json`.

``python -m benchmarks.bundled_times [STUDY ...]`` measures those that are named, or those that nobody
measured as they are now (a test asks for that), or all on another processor: each in a process of its own
with an empty cache, by processor time, so that other work on the machine counts little.
"""

import json
import os
import subprocess
import sys
import tempfile
import time

from benchmarks.__main__ import processor
from wavequake.workflows.planning.known_times import FILE
from wavequake.workflows.study import bundled_studies, load_study

# A clock that stands still while others work; what is prepared and what a case takes are told apart by it.
_MEASURE = """
import sys, time
time.perf_counter = time.process_time
from wavequake.workflows.planning import plan as planning
found, measure = [], planning._time_case
planning._time_case = lambda *how: found.append(measure(*how)) or found[0]
planning.plan(sys.argv[1])
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
    here, known = processor()["processor"], json.loads(path.read_text(encoding="utf-8"))
    old = known["studies"] if known["processor"] == here else {}
    now = {name: load_study(name).identity() for name in bundled_studies()}
    names = sys.argv[1:] or [name for name, identity in now.items() if identity not in old.get(name, ())]
    print(f"To be measured: {', '.join(names) or 'none'}.", flush=True)
    for name in names:
        old[name] = [*times_of(name), now[name]]
        print(f"{time.strftime('%H:%M')} {name}: {old[name][:2]}", flush=True)
        rows = ",\n".join(f"  {json.dumps(key)}: {json.dumps(old[key])}" for key in sorted(old.keys() & now))
        head = f'{{\n "processor": {json.dumps(here)},\n "studies": {{\n'
        path.write_text(f"{head}{rows}\n }}\n}}\n", encoding="utf-8")


if __name__ == "__main__":
    main()
