"""Draw whatever there is to see: a system, telescope, model or study, by name, file or object."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from wavequake.campaign.schema import Study
from wavequake.drawing.aperture import telescope_figure
from wavequake.drawing.model import model_figure
from wavequake.drawing.section import section_figure
from wavequake.drawing.solid import Scene, model_scene, stretched, system_scene
from wavequake.drawing.still import still_figure
from wavequake.drawing.style import Drawing
from wavequake.errors import UserError
from wavequake.mechanics.model import FiniteElementModel, Model, ReducedModel, shifts
from wavequake.optics.catalog.names import optical_system, system_names
from wavequake.optics.lens_archive import LENS_FILES
from wavequake.optics.segments.catalog import telescope
from wavequake.optics.segments.parent import parent_system
from wavequake.optics.systems.file import build
from wavequake.optics.systems.info import info
from wavequake.optics.systems.system import OpticalSystem
from wavequake.optics.zemax.read import read_zmx
from wavequake.workflows.overrides import split_overrides
from wavequake.workflows.sensitivity_source import TELESCOPES
from wavequake.workflows.study import bundled_studies, load_study, near_matches

_ARCMIN = np.pi / 180.0 / 60.0
_MM_PER_NM = 1e-6


@dataclass(frozen=True)
class Seen:
    """What is drawn: a system, a telescope with the system of one piece that it stands for, or models."""

    system: OpticalSystem | None = None
    telescope: OpticalSystem | None = None
    models: tuple[Model, ...] = ()


def draw(
    what: Any,
    overrides: Mapping[str, Any] | Iterable[str] = (),
    *,
    solid: bool = False,
    rays: int = 7,
) -> Drawing:
    """Draw an optical system with its rays, a segmented mirror with its names, or a finite-element mirror.

    Parameters
    ----------
    what : str, Path or object
        Name of a bundled system, telescope or study, path of a lens file or study, or an `OpticalSystem`,
        `Study`, `FiniteElementModel` or `ReducedModel`.
    overrides : mapping or iterable of ``"section.key=value"``
        Of a study, as `wavequake.load_study` takes them.
    solid : bool
        In three dimensions, rather than to scale in the plane of the fields and folds.
    rays : int
        Of each field of an optical system.

    Returns
    -------
    Drawing
        A matplotlib figure that shows itself in a notebook; ``savefig`` writes it.

    Raises
    ------
    UserError
        If there is no such thing, or it has nothing to be drawn.

    Examples
    --------
    >>> draw("double-gauss").savefig("double-gauss.svg")  # doctest: +SKIP
    """
    if not 2 <= rays <= 1000:
        raise UserError(f"A field is drawn with 2 to 1000 rays, not {rays}.")
    seen = look(what, overrides)
    if solid:
        return still_figure(scene_of(seen))
    if seen.models:
        return model_figure(seen.models)
    if seen.telescope is not None:
        return telescope_figure(seen.telescope, seen.system)
    return section_figure(_system(seen), rays=rays)


def scene_of(seen: Seen) -> Scene:
    """Return what is seen in three dimensions; of several models the first."""
    if seen.models:
        return model_scene(seen.models[0])
    scene, times = stretched(system_scene(_system(seen), seen.telescope))
    return (
        scene
        if times == 1.0
        else replace(scene, name=f"{scene.name}, drawn {times:g} times as wide as it is")
    )


def _system(seen: Seen) -> OpticalSystem:
    if seen.system is None:
        raise ValueError("there is neither a system nor a model")
    return seen.system


def look(what: Any, overrides: Mapping[str, Any] | Iterable[str] = ()) -> Seen:
    """Return what there is to be drawn of something; arguments as `draw`."""
    if isinstance(what, str | Path):
        return _named(str(what), dict(split_overrides(overrides)))
    if dict(split_overrides(overrides)):
        raise UserError("Overrides belong to a study by name or path; change the object itself.")
    if isinstance(what, OpticalSystem):
        return Seen(what) if what.segmented is None else Seen(parent_system(what), what)
    if isinstance(what, FiniteElementModel | ReducedModel):
        return Seen(models=(what,))
    if isinstance(what, Study):
        return _of_study(what)
    raise UserError(
        f"A {type(what).__name__} cannot be drawn; give a name, a path, a system, telescope, model or study."
    )


def described_study(what: str, overrides: Iterable[str] = ()) -> str | None:
    """Return what a study is about that has no optical system of its own: its models, or whose light it is.

    None for everything else, of which `wavequake.workflows.systems.source.described` tells.
    """
    taken = what in (*system_names(), *TELESCOPES) or what.lower().endswith((*LENS_FILES, ".seq"))
    if taken or not (what in bundled_studies() or what.endswith(".toml")):
        return None
    study = load_study(what, overrides)
    kinds = {one.__name__ for one in type(study).__mro__}
    if kinds & {"SystemStudy", "SegmentStudy"}:
        return None
    try:
        seen = _of_study(study)
    except UserError:  # a study of numbers alone
        return None
    if seen.models:
        return "\n".join(map(_words_of, seen.models))
    return info(_system(seen))


def _words_of(model: Model) -> str:
    size = " x ".join(f"{length:.4g}" for length in np.ptp(model.nodes, axis=0))
    return (
        f"{model.name}: {model.order} degrees of freedom of {len(model.nodes)} nodes, {size} m\n"
        f"  optical surface of {len(model.surface_nodes)} nodes, {len(shifts(model))} mounts"
    )


def _named(name: str, keys: dict[str, Any]) -> Seen:
    if name.lower().endswith(LENS_FILES) and not keys:
        return Seen(read_zmx(name))
    is_study = name in bundled_studies() or name.endswith(".toml") or Path(name).is_file()
    if name in TELESCOPES and not (is_study and keys):
        segmented = telescope(name)
        system = optical_system(name) if name in system_names() else parent_system(segmented)
        return Seen(system, segmented)
    if name in system_names() and not (keys and is_study):
        if keys:
            raise UserError(f"{name} is no study, so it has no keys to set, such as {next(iter(keys))!r}.")
        return Seen(optical_system(name))
    if not is_study:
        known = (*bundled_studies(), *system_names(), *TELESCOPES)
        raise UserError(
            f"There is nothing called {name!r} to draw{near_matches(name, known)}; of your own: a .zmx lens "
            "file, or a .toml study, in which a [model] names the files of a finite-element model."
        )
    return _of_study(load_study(name, keys))


def _of_study(study: Study) -> Seen:
    # By the names of its classes: to load every kind takes longer than to draw one.
    kinds = {one.__name__ for one in type(study).__mro__}
    made_of: Any = study
    if "SystemStudy" in kinds:
        return Seen(build(made_of.system))
    if "AnyMirrorStudy" in kinds:
        from wavequake.workflows.mirrors.bench import build_model

        names = ("file",) if made_of.model.content is not None else made_of.model.shapes
        return Seen(models=tuple(build_model(made_of, name) for name in names))
    if "ControllerStudy" in kinds:
        from wavequake.workflows.loops import controller_bench

        return Seen(models=(controller_bench.build_model(made_of),))
    if kinds & {"SegmentStudy", "SegmentMorStudy"}:
        from wavequake.workflows.segments.bench import build_telescope

        segmented = build_telescope(made_of)
        points = getattr(made_of.optics, "fields_arcmin", None) or (made_of.optics.field_arcmin,)
        wavelengths = np.array([made_of.optics.wavelength_nm * _MM_PER_NM])
        return Seen(
            replace(parent_system(segmented), fields=np.array(points) * _ARCMIN, wavelengths=wavelengths),
            segmented,
        )
    if "SegmentControlStudy" in kinds:
        return _named(made_of.mirror.telescope, {})
    if kinds & {"LensStudy", "PassiveStudy"}:
        return Seen(optical_system("six-lens"))  # it has the sensitivities of the bench
    raise UserError(f"The workflow {study.study.workflow} of {study.study.name} has nothing to be drawn.")
