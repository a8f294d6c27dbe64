"""One case of a store as a lens file, so that another program can trace it."""

from pathlib import Path

from wavequake.campaign.store.store import read_manifest
from wavequake.errors import UserError
from wavequake.optics.systems.freeze import frozen
from wavequake.optics.systems.system import OpticalSystem, SystemStates
from wavequake.optics.zemax.export import write_zmx
from wavequake.workflows.systems.bench import system_bench, system_states
from wavequake.workflows.systems.draws import draw

_WORKFLOWS = ("system-disturbance",)


def export_case(store: Path, path: Path, case: int, instant: int = 0, overwrite: bool = False) -> Path:
    """Write the system of a case at an instant to a .zmx file: moved, deformed, its light turned.

    Raises
    ------
    UserError
        If there is no such case or instant, the store's workflow has no optical system of surfaces, the file
        exists and shall not be overwritten, or the format cannot hold the system: the message names what.
    """
    system, states = disturbed(store, case)
    if path.exists() and not overwrite:
        raise UserError(f"{path} exists already; choose another name or give --overwrite.")
    return write_zmx(frozen(system, states, instant), path).resolve()


def disturbed(store: Path, case: int) -> tuple[OpticalSystem, SystemStates]:
    """Return the system of a store and how it moves and deforms in a case; raises as `export_case`."""
    manifest = read_manifest(store)
    if manifest.workflow not in _WORKFLOWS:
        raise UserError(
            f"{store} holds the workflow {manifest.workflow}; lens files are made of {', '.join(_WORKFLOWS)}."
        )
    if case not in range(manifest.cases):
        raise UserError(f"{store} has cases 0 to {manifest.cases - 1}; there is no case {case}.")
    bench = system_bench(manifest.study)
    _, motion = draw(bench, case)
    return bench.system, system_states(bench, motion)
