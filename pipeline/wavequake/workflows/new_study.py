"""Begin a study of one's own: a commented study file of what a name, lens file or model holds."""

import json
import re
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from wavequake.campaign.schema import Study
from wavequake.errors import UserError
from wavequake.mechanics.importers.mesh import read_mesh
from wavequake.mechanics.importers.model import MESHES, READERS
from wavequake.optics.catalog.names import optical_system, system_names
from wavequake.optics.lens_archive import LENS_FILES
from wavequake.optics.media.gradients import medium_index
from wavequake.optics.rays.aiming import point_name
from wavequake.optics.systems.paraxial import paraxial
from wavequake.optics.systems.system import OpticalSystem, wavelength_of
from wavequake.optics.zemax.read import read_zmx
from wavequake.workflows.sensitivity_source import TELESCOPES
from wavequake.workflows.study import bundled_studies, load_study, near_matches

_MODELS = (*READERS, ".mtx")
_MOUNTS, _SURFACE = r"INTERF|MOUNT|SUPPORT|BASE|FIX", r"SURF|OPTIC|FRONT|MIRROR|TOP"
_LARGEST_IN_METERS = 100.0  # a mesh that is larger is taken to be in mm
_OPTICAL = 1.01
_UNKNOWN = "NAME OF A NODE SET"


def new_study(source: str, target: Path | None = None) -> tuple[Path, str]:
    """Write a study file; return its absolute path, and what has to be edited before it runs ("": nothing).

    Parameters
    ----------
    source : str
        Name of a bundled study (a copy with its comments), system or telescope, a lens file (.zmx), or a file
        of a finite-element model, whose mesh lies beside it.
    target : Path, optional
        By default ``NAME.toml`` in the current folder.

    Raises
    ------
    UserError
        If there is no such thing, it cannot be read, or the target exists.
    """
    path = (target or Path(f"{_name(source)}.toml")).resolve()
    if path.exists():
        raise UserError(f"{path} exists; name another file with --output, or remove it.")
    text = _text(source, path.parent)
    try:
        path.write_text(text, encoding="utf-8")
        _require_surface(load_study(path))
    except OSError as error:
        raise UserError(f"{path} cannot be written: {error.strerror or error}.") from None
    except UserError as error:
        return path, str(error)
    return path, ""


def _require_surface(study: Study) -> None:
    """Raise UserError if the surface of an imported mirror is none that a run takes, as a flat one."""
    # Slow to import, and of no use to lenses.
    from wavequake.workflows.mirrors.model_store import kept_model
    from wavequake.workflows.mirrors.optics import surface_of
    from wavequake.workflows.mirrors.study import AnyMirrorStudy

    if isinstance(study, AnyMirrorStudy) and study.model.content is not None:
        model = kept_model(study.model.content)
        nodes = model.nodes[model.surface_nodes] * 1e3  # mm
        surface_of(study, study.models[0], nodes, model.surface_weights)


def _name(source: str) -> str:
    return re.sub(r"[^A-Za-z0-9._-]+", "-", Path(source).stem).strip("-._") or "study"


def _text(source: str, folder: Path) -> str:
    suffix = Path(source).suffix.lower()
    if source in bundled_studies():
        text = bundled_studies()[source].read_text(encoding="utf-8")
        return f"# A copy of the bundled study {source}; `wavequake plan` says what running it takes.\n{text}"
    if suffix in LENS_FILES:
        return _of_system(read_zmx(source), f"file = {_quoted(_from(folder, source))}", _name(source))
    if source in TELESCOPES:
        return _of_telescope(source)
    if source in system_names():
        return _of_system(optical_system(source), f"name = {_quoted(source)}", source)
    if suffix in _MODELS:
        return _of_model(Path(source), _from(folder, source))
    known = (*bundled_studies(), *system_names(), *TELESCOPES)
    raise UserError(
        f"There is nothing called {source!r} to begin a study with{near_matches(source, known)}; of your "
        f"own, give a lens file (.zmx) or a model ({', '.join(_MODELS)})."
    )


def _from(folder: Path, source: str) -> str:
    """Return the path of a file as seen from a folder, if it lies in it."""
    path = Path(source).resolve()
    return path.relative_to(folder).as_posix() if path.is_relative_to(folder) else str(path)


def _quoted(text: str) -> str:
    return json.dumps(text, ensure_ascii=False)


def _listed(names: Iterable[str]) -> str:
    return f"[{', '.join(map(_quoted, names))}]"


def glass_groups(system: OpticalSystem) -> list[list[str]]:
    """Return the surfaces of each lens or cemented group: those between which there is glass, by name."""
    wavelength, groups, inside = wavelength_of(system), list[list[str]](), False
    for surface in system.surfaces:
        if surface.action != "refract":
            continue
        glass = medium_index(surface.medium, wavelength) > _OPTICAL
        if inside:
            groups[-1].append(surface.name)
        elif glass:
            groups.append([surface.name])
        inside = glass
    return [group for group in groups if len(group) > 1]


def _labels(groups: list[list[str]]) -> list[str]:
    """Return a name for each group: what its surfaces' names begin with, such as L3 of "L3 front"."""
    starts = [{name.rpartition(" ")[0] for name in group} for group in groups]
    labels = [start.pop() if len(start) == 1 else "" for start in starts]
    if all(labels) and len(set(labels)) == len(labels) and "surface" not in labels:
        return labels
    return [f"L{number}" for number in range(1, len(groups) + 1)]


def _of_system(system: OpticalSystem, said: str, name: str) -> str:
    names = [surface.name for surface in system.surfaces]
    groups = glass_groups(system) if len(set(names)) == len(names) else []
    labels = _labels(groups)
    mirrors = [one.name for one in system.surfaces if one.action == "reflect" and names.count(one.name) == 1]
    moving = [*labels, *mirrors]
    data = paraxial(system)
    bodies = "".join(
        f"[[body]]\nname = {_quoted(label)}\nsurfaces = {_listed(group)}\n\n"
        for label, group in zip(labels, groups, strict=True)
    )
    fields = "; ".join(point_name(system, point) for point in system.fields)
    stop = system.surfaces[system.stop].name
    waves = ", ".join(f"{1e6 * wavelength:.6g}" for wavelength in system.wavelengths)
    every = f"of = {_listed(moving)}" if moving else f"of = {_listed(names[:1])}  # name what moves"
    return f"""# A study of {system.name}, begun by `wavequake new`. Found:
#   focal length {data.focal_length:.6g} mm, f-number {data.f_number:.4g}, stop {stop}
#   {len(system.surfaces)} surfaces: {", ".join(names)}
#   {len(system.fields)} fields: {fields}
#   wavelengths (nm): {waves}
# `wavequake draw` shows it, `wavequake plan` says what running it takes, docs/study.md has all keys.
[study]
name = {_quoted(name)}
workflow = "system-disturbance"
title = {_quoted(f"{system.name}: elements out of place and shaken")}

[system]
{said}

# What moves as one piece: surfaces between which there is glass, cemented ones together. Check this.
{bodies}# What assembly leaves behind, rms of each element about each axis. Sizes are examples: set your own.
[[disturbance]]
name = "assembly"
model = "surface-random"
{every}
rms = {{ dx_um = 1.0, dy_um = 1.0, dz_um = 1.0, rx_urad = 10.0, ry_urad = 10.0 }}

# Lines of a vibration spectrum: frequency and amplitude.
[[disturbance]]
name = "vibration"
model = "surface-vibration"
{every}
duration_s = 0.05  # long enough for some periods; instants close enough for twice their frequency
instants = 32
lines = [{{ frequency_hz = 120.0, amplitude = {{ dx_um = 0.5, dy_um = 0.5, rx_urad = 5.0, ry_urad = 5.0 }} }}]

[campaign]
cases = 100
"""


_IN_SPACE = ("jwst",)
_WIND = """# Gusts on the segments.
[[disturbance]]
name = "wind"
model = "segment-wind"
mean_speed_m_s = 0.3

"""


def _of_telescope(name: str) -> str:
    wind = "" if name in _IN_SPACE else _WIND
    return f"""# A study of the telescope {name}, begun by `wavequake new`; docs/study.md has all keys.
[study]
name = {_quoted(name)}
workflow = "segment-disturbance"
title = {_quoted(f"{name}: segments out of place, {'wind, ' if wind else ''}pointing")}

[telescope]
name = {_quoted(name)}

# What alignment leaves behind, rms of each segment. Sizes are examples: set your own.
[[disturbance]]
name = "alignment"
model = "static-random"
piston_nm = 20.0

{wind}# Motion of the line of sight.
[[disturbance]]
name = "pointing"
model = "line-of-sight"

[optics]
wavelength_nm = 550.0

[campaign]
cases = 100
"""


def _of_model(file: Path, said: str) -> str:
    """Return a study of a finite-element model: its node sets and the likely units of its mesh."""
    if not file.is_file():
        raise UserError(f"There is no file {file}; give the matrices of a model.")
    meshes = [path for path in map(file.with_suffix, MESHES) if path.is_file()]
    found, sets, units = "no mesh beside it", dict[str, int](), "m,kg,s,N"
    if meshes:
        mesh = read_mesh(meshes[0])
        sets = {name: len(nodes) for name, nodes in mesh.sets.items()}
        size = float(np.ptp(mesh.points, axis=0).max())
        units = "mm,t,s,N" if size > _LARGEST_IN_METERS else "m,kg,s,N"
        found = f"{len(mesh.points)} nodes in {meshes[0].name}, {size:.4g} across in its unit of length"
    chosen = {"interfaces": _guess(sets, _MOUNTS), "surface": _guess(sets, _SURFACE)}
    listed = "\n".join(f"#   {name}: {count} nodes" for name, count in sets.items()) or "#   none"
    return f"""# A study of the finite-element model {file.name}, begun by `wavequake new`. Found:
#   {found}
# Node sets:
{listed}
# `wavequake plan` says what to check of the model; docs/finite-elements.md has all keys of [model].
[study]
name = {_quoted(_name(file.name))}
workflow = "mirror-mor"
title = {_quoted(f"Which reduced model of {file.stem} is good enough?")}

[model]
file = {_quoted(said)}
units = {_quoted(units)}  # A GUESS by the size of the mesh: check it, as all results depend on it.
interfaces = {_quoted(chosen["interfaces"])}  # the nodes that carry forces{_marked(chosen["interfaces"])}
surface = {_quoted(chosen["surface"])}  # the nodes of the optical surface{_marked(chosen["surface"])}

# A flat optical surface has no focus. If yours is, uncomment both lines: which parabola it stands for.
# [optics]
# focal_length_m = 1.0

[reduction]
variants = ["craigb36", "rubin36", "krylov36(150)"]
last_hz = 1200.0

# 10 um of all mounts at 100 Hz; an example.
[[excitation]]
name = "sine100"
kind = "sinusoid"
frequency_hz = 100.0
"""


def _guess(sets: dict[str, int], words: str) -> str:
    """Return the smallest set whose name has one of the words, or else a name to be replaced."""
    fitting = [name for name in sets if re.search(words, name, flags=re.IGNORECASE)]
    return min(fitting, key=lambda name: sets[name]) if fitting else _UNKNOWN


def _marked(chosen: str) -> str:
    return ": TO BE SET, no node set is named like one" if chosen == _UNKNOWN else ""
