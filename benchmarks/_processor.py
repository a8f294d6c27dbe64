"""How slow this processor is: libraries alone, no code of ours, beside one that met the demands."""

import os
import sys
from statistics import median

from benchmarks._whole import spent

_WORDS = "typer, rich.table, rich.progress"
_STUDY = f"{_WORDS}, pydantic, numpy, scipy.sparse, scipy.linalg"
_NUMBERS = f"{_STUDY}, xarray, zarr, pyopencl"
LIBRARIES = {
    "run again": _STUDY,
    "report": f"{_NUMBERS}, scipy.special, jinja2, matplotlib.figure, matplotlib.backends.backend_svg",
    "status": f"{_WORDS}, pydantic, numpy",
    "sensitivity": f"{_STUDY}, zarr, pyopencl",
}
"""What commands that are answers rather than computations cannot do without."""
MET = {"run again": 0.437, "report": 1.198, "status": 0.190}
"""Their CPU-s on the Zen 4 of docs/measured/epyc.json, which met what is demanded."""
_DEVICES = "[one.get_devices() for one in pyopencl.get_platforms()]"


def loading(name: str) -> float:
    """Return the processor time of loading libraries as we do: garbage is looked for seldom."""
    devices = _DEVICES if "pyopencl" in LIBRARIES[name] else ""
    code = f"import gc; gc.set_threshold(50_000); import {LIBRARIES[name]}; {devices}; gc.freeze()"
    return spent([sys.executable, "-c", code.replace("; ;", ";")], dict(os.environ)).cpu


def slowness(rounds: int = 5) -> float:
    """Return how many times as long as there libraries take now, by the median of some rounds."""
    return slower_by({name: median(loading(name) for _ in range(rounds)) for name in MET})


def slower_by(took: dict[str, float]) -> float:
    """Return how many times as long as there libraries took, by the median of all."""
    return median(took[name] / seconds for name, seconds in MET.items())
