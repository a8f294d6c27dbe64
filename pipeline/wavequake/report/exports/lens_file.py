"""One case of a store as a lens file, or one for each segment, so that another program can trace it."""

from pathlib import Path

from wavequake.errors import UserError
from wavequake.optics.systems.freeze import frozen
from wavequake.optics.zemax.export import write_zmx
from wavequake.report.exports.case_states import disturbed, segments_at, telescopes


def export_case(
    store: Path, path: Path, case: int, instant: int = 0, overwrite: bool = False, under: str = ""
) -> tuple[Path, ...]:
    """Write the system of a case at an instant to .zmx files: moved, deformed, its light turned.

    NAME.zmx, or of a segmented telescope ``NAME-SEGMENT.zmx`` for each segment. ``under`` says under which
    controller or excitation, where a case has several. Return the files.

    Raises
    ------
    UserError
        If there is no such case or instant, the store's workflow has no optical system of surfaces, a file
        exists and shall not be overwritten, or the format cannot hold the system: the message names what.
    """
    if telescopes(store):
        parts = segments_at(store, case, instant, under)
        files = {path.with_name(f"{path.stem}-{name}{path.suffix}"): one for name, one in parts.items()}
    else:
        files = {path: frozen(*disturbed(store, case, under), instant)}
    for file in files:
        if file.exists() and not overwrite:
            raise UserError(f"{file} exists already; choose another name or give --overwrite.")
    return tuple(write_zmx(system, file).resolve() for file, system in files.items())
