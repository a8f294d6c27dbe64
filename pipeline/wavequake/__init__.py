"""What does vibration do to the image, and which model, mirror or controller is good enough.

>>> import wavequake as wq
>>> ds = wq.run("tmt-segments", cases=100)            # doctest: +SKIP
>>> ds = wq.open_store("runs/tmt-segments-1a2b3c4d")  # doctest: +SKIP
>>> print(wq.info(wq.load_system("double-gauss")))    # doctest: +SKIP
>>> wq.draw("euv").savefig("euv.svg")                 # doctest: +SKIP
"""

import sys
import time
from importlib import import_module
from typing import TYPE_CHECKING, Any

from wavequake.errors import StoreDamageError, UserError

if TYPE_CHECKING:
    from wavequake import plot
    from wavequake.campaign.schema import Study
    from wavequake.campaign.store.grid import unstack
    from wavequake.campaign.store.store import open_store
    from wavequake.doors.decisions import (
        allow,
        budget,
        plan_accuracy,
        plan_budget,
        rare,
        sharpen,
        store_errors,
    )
    from wavequake.doors.firmware import build_firmware, flash_firmware, try_firmware
    from wavequake.doors.models import load_model, loop, plant, respond
    from wavequake.doors.stores import devices, info, new, profile, rank, rerun, retry, status
    from wavequake.doors.studies import (
        compare,
        export,
        margins,
        report,
        run,
        studies,
        tail,
        verify,
    )
    from wavequake.doors.telemetry import agreement, identify
    from wavequake.drawing.draw import draw
    from wavequake.optics.light import trace
    from wavequake.optics.segments.catalog import telescope
    from wavequake.optics.systems.kinematics import rest_states
    from wavequake.optics.zemax.export import write_zmx
    from wavequake.reduction.reduce import reduce
    from wavequake.viewer.animate import animate
    from wavequake.viewer.pictures import write_drawing
    from wavequake.viewer.view import view
    from wavequake.workflows.migrate import migrate
    from wavequake.workflows.planning.plan import plan
    from wavequake.workflows.sensitivity import sensitivity
    from wavequake.workflows.study import load_study
    from wavequake.workflows.systems.source import load_system
    from wavequake.workflows.zernike_arrays import convert_zernike

__version__ = "0.4.0"
BEGUN = time.monotonic()  # libraries load from here on
__all__ = [
    "StoreDamageError",
    "Study",
    "UserError",
    "agreement",
    "allow",
    "animate",
    "budget",
    "build_firmware",
    "compare",
    "convert_zernike",
    "devices",
    "draw",
    "export",
    "flash_firmware",
    "identify",
    "info",
    "load_model",
    "load_study",
    "load_system",
    "loop",
    "margins",
    "migrate",
    "new",
    "open_store",
    "plan",
    "plan_accuracy",
    "plan_budget",
    "plant",
    "plot",
    "profile",
    "rank",
    "rare",
    "reduce",
    "report",
    "rerun",
    "respond",
    "rest_states",
    "retry",
    "run",
    "sensitivity",
    "sharpen",
    "status",
    "store_errors",
    "studies",
    "tail",
    "telescope",
    "trace",
    "try_firmware",
    "unstack",
    "verify",
    "view",
    "write_drawing",
    "write_zmx",
]

# Heavy modules are imported when a name is first used, so that `import wavequake` and `wavequake --version`
# stay quick.
_HOMES = {
    "Study": "wavequake.campaign.schema",
    "agreement": "wavequake.doors.telemetry",
    "allow": "wavequake.doors.decisions",
    "animate": "wavequake.viewer.animate",
    "budget": "wavequake.doors.decisions",
    "build_firmware": "wavequake.doors.firmware",
    "compare": "wavequake.doors.studies",
    "convert_zernike": "wavequake.workflows.zernike_arrays",
    "devices": "wavequake.doors.stores",
    "draw": "wavequake.drawing.draw",
    "export": "wavequake.doors.studies",
    "flash_firmware": "wavequake.doors.firmware",
    "identify": "wavequake.doors.telemetry",
    "info": "wavequake.doors.stores",
    "load_model": "wavequake.doors.models",
    "load_study": "wavequake.workflows.study",
    "load_system": "wavequake.workflows.systems.source",
    "loop": "wavequake.doors.models",
    "margins": "wavequake.doors.studies",
    "migrate": "wavequake.workflows.migrate",
    "new": "wavequake.doors.stores",
    "open_store": "wavequake.campaign.store.store",
    "plan": "wavequake.workflows.planning.plan",
    "plan_accuracy": "wavequake.doors.decisions",
    "plan_budget": "wavequake.doors.decisions",
    "plant": "wavequake.doors.models",
    "profile": "wavequake.doors.stores",
    "rank": "wavequake.doors.stores",
    "rare": "wavequake.doors.decisions",
    "reduce": "wavequake.reduction.reduce",
    "rerun": "wavequake.doors.stores",
    "respond": "wavequake.doors.models",
    "rest_states": "wavequake.optics.systems.kinematics",
    "retry": "wavequake.doors.stores",
    "run": "wavequake.doors.studies",
    "sensitivity": "wavequake.workflows.sensitivity",
    "sharpen": "wavequake.doors.decisions",
    "status": "wavequake.doors.stores",
    "store_errors": "wavequake.doors.decisions",
    "studies": "wavequake.doors.studies",
    "tail": "wavequake.doors.studies",
    "telescope": "wavequake.optics.segments.catalog",
    "trace": "wavequake.optics.light",
    "try_firmware": "wavequake.doors.firmware",
    "unstack": "wavequake.campaign.store.grid",
    "verify": "wavequake.doors.studies",
    "view": "wavequake.viewer.view",
    "write_drawing": "wavequake.viewer.pictures",
    "write_zmx": "wavequake.optics.zemax.export",
}


def __getattr__(name: str) -> Any:
    if name in ("plot", "report"):  # the package of reports can be called, as its name is that of a function
        return import_module(f"wavequake.{name}")
    if name not in _HOMES:
        raise AttributeError(f"module 'wavequake' has no attribute {name!r}")
    return getattr(import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return [*__all__, "__version__"]


if "IPython" in sys.modules:
    from wavequake import notebook

    if (_shell := notebook.shell()) is not None:
        notebook.install(_shell)
