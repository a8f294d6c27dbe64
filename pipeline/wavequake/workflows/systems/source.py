"""An optical system wherever it comes from: a bundled one, a Zemax lens file, a study."""

from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from wavequake.errors import UserError
from wavequake.optics.catalog.names import optical_system, system_names
from wavequake.optics.lens_archive import LENS_FILES
from wavequake.optics.media.agf import read_agf
from wavequake.optics.media.glasses import Medium, refractive_index
from wavequake.optics.segments.parent import parent_system
from wavequake.optics.systems.file import build
from wavequake.optics.systems.info import info
from wavequake.optics.systems.system import OpticalSystem
from wavequake.optics.zemax.codev import read_seq
from wavequake.optics.zemax.lens_file import LensFileError
from wavequake.optics.zemax.read import read_zmx
from wavequake.workflows.overrides import split_overrides
from wavequake.workflows.segments.bench import bench_of
from wavequake.workflows.segments.study import SegmentStudy, segment_text
from wavequake.workflows.sensitivity_source import TELESCOPES, sensitivity_study
from wavequake.workflows.study import bundled_studies, load_study, near_matches
from wavequake.workflows.systems.study import SystemStudy

MM_PER_NM = 1e-6
_D_LINE = 587.5618 * MM_PER_NM


def load_system(
    source: str | Path,
    overrides: Mapping[str, Any] | Iterable[str] = (),
    glasses: Mapping[str, Medium] | None = None,
) -> OpticalSystem:
    """Return an optical system by the name of a bundled one or a telescope, a lens file, or a study.

    Parameters
    ----------
    source : str or Path
        ``double-gauss``, ``tmt-18``, ``lens.zmx``, ``my/study.toml`` or the name of a bundled study; a
        bundled system goes before a study of the same name. A segmented telescope is that with an M1 in one
        piece.
    overrides : mapping or iterable of ``"section.key=value"``
        Of a study or a telescope that is no bundled system, as `wavequake.load_study` takes them; of a lens
        file with several configurations ``configuration=2``.
    glasses : mapping of str to Medium, optional
        The user's glasses for a lens file, as `wavequake.optics.media.agf.read_agf` returns them.

    Raises
    ------
    UserError
        If there is no such thing, it cannot be read, or its workflow has no optical system.

    Examples
    --------
    >>> load_system("euv")
    <OpticalSystem euv: 7 surfaces, 3 fields, 1 wavelength>
    """
    if not isinstance(source, str | Path):
        raise UserError(f"An optical system is loaded by name or path, not by {type(source).__name__}.")
    name, keys = str(source), dict(split_overrides(overrides))
    is_file, is_system = name.lower().endswith((*LENS_FILES, ".seq")), name in system_names()
    is_study = name in bundled_studies() or name.endswith(".toml") or Path(name).is_file()
    if is_file or (is_system and not (keys and is_study)):
        configuration = keys.pop("configuration", None) if is_file else None
        if keys:
            raise UserError(f"{name} is no study, so it has no keys to set, such as {next(iter(keys))!r}.")
        if not is_file:
            return optical_system(name)
        if configuration is not None and not (isinstance(configuration, int) and configuration > 0):
            raise UserError(f"The configuration of {name} is {configuration!r}; it must be a number from 1.")
        return (
            read_seq(name, glasses, configuration)
            if name.lower().endswith(".seq")
            else read_zmx(name, glasses, configuration)
        )
    is_telescope = name in TELESCOPES
    if not (is_study or is_telescope):
        raise UserError(
            f"There is no optical system {name!r}{near_matches(name, _names())}; a system of your own is a "
            ".zmx or .toml file."
        )
    study = sensitivity_study(name, keys) if is_telescope else load_study(source, keys)
    if isinstance(study, SystemStudy):
        return build(study.system)
    if isinstance(study, SegmentStudy):
        bench = bench_of(segment_text(study.identity_text()))
        wavelength = study.optics.wavelength_nm * MM_PER_NM
        return replace(
            parent_system(bench.system),
            fields=bench.field[None, :],
            wavelengths=np.array([wavelength]),
            note="; ".join(filter(None, (bench.system.note, bench.stopped.words()))),
        )
    raise UserError(f"The workflow {study.study.workflow} of {name} has no optical system to describe.")


def described(source: str, overrides: Iterable[str], catalogue: Path | None = None) -> str:
    """Return what `wavequake.info` says of a system, with the glasses of the user's `catalogue`.

    Raises
    ------
    UserError
        As `load_system`; of a lens file that cannot be traced it shows what could be read.
    """
    suffix = Path(source).suffix.lower()
    if suffix == ".agf" or (suffix == ".dat" and _holds_rods(Path(source))):
        return _glasses(Path(source))
    if suffix not in ("", ".toml", ".seq", *LENS_FILES):
        from wavequake.mechanics.nodal.describe import FILES, describe  # spares lenses its 0.1 s

        if suffix in FILES:
            return describe(Path(source))
    try:
        return info(load_system(source, overrides, read_agf(catalogue) if catalogue else None))
    except LensFileError as error:
        held = f"{error.details}\n\nWhat the file holds, in its own unit:\n{error.read}"
        raise UserError(error, held.lstrip("\n")) from None


def _holds_rods(file: Path) -> bool:
    """Tell whether a file holds materials of rods, and not what finite-element programs write."""
    try:
        return bool(read_agf(file))
    except UserError:
        return False


def _glasses(catalogue: Path) -> str:
    """Return the glasses of a catalogue with their indices at the d line, where they have one there."""
    found = read_agf(catalogue)
    lines = [f"{catalogue.name}: glasses with their indices at 587.56 nm"]
    for name, medium in found.items():
        try:
            lines.append(f"  {name:<16} {refractive_index(medium, _D_LINE):.6f}")
        except UserError:  # of the infrared
            lines.append(f"  {name}")
    return "\n".join(lines)


def _names() -> tuple[str, ...]:
    """Return all bundled names that `load_system` takes."""
    studies = (name for name in bundled_studies() if isinstance(load_study(name), SystemStudy | SegmentStudy))
    return tuple(dict.fromkeys((*system_names(), *TELESCOPES, *studies)))
