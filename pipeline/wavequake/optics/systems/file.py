"""An optical system in a study file: a bundled one by name, a lens file, or a table of surfaces.

::

    [system]
    entrance_diameter_mm = 20.0
    fields_deg = [[0.0, 0.0], [0.0, 5.0]]
    wavelengths_nm = [486.1, 587.6, 656.3]
    primary_wavelength = 2

    [[system.surface]]
    name = "front"
    radius_mm = 61.5
    glass = "N-BK7"
    stop = true
    ...

Distances run along the light from the surface before. Angles follow the right hand. A folding mirror bends
the axis on which the later surfaces stand; every other tilt and decenter moves its own surface alone.
"""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, SerializerFunctionWrapHandler, model_serializer, model_validator

from wavequake.errors import UserError
from wavequake.optics.media.glasses import Medium
from wavequake.optics.sections import MM_PER_NM, FileSection, Pair
from wavequake.optics.segments.kinematics import cardan
from wavequake.optics.systems.apodization import STRONGEST, Apodization
from wavequake.optics.systems.glass_file import GlassSection, embed_glasses, own_glasses
from wavequake.optics.systems.phase_file import effect_of
from wavequake.optics.systems.surface_file import (
    SurfaceSection,
    deformation_of,
    embed_sag,
    medium_after,
    opening_of,
    shape_of,
)
from wavequake.optics.systems.system import OpticalSystem, Pupil, Surface
from wavequake.optics.text_file import read_text
from wavequake.optics.zemax.read import parse_zmx, read_zmx

Array = NDArray[np.float64]

_PUPILS = {
    "entrance_diameter_mm": "entrance_diameter",
    "f_number": "f_number",
    "object_na": "object_na",
    "image_na": "image_na",
    "stop_radius_mm": "stop",
}
_FIELDS = {"fields_deg": 1.0, "fields_arcmin": 1.0 / 60.0, "fields_mm": None}
Pairs = tuple[Pair, ...] | None


class SystemSection(FileSection):
    """The optical system of a study. What is given beside ``name`` or ``file`` replaces what that says."""

    alternatives: ClassVar = (tuple(_PUPILS), tuple(_FIELDS))  # an override of one replaces the others

    name: str | None = Field(default=None, description="of a bundled system; of this one if it has surfaces")
    file: str | None = Field(
        default=None, exclude=True, description="a Zemax lens file (read when the study is loaded)"
    )
    file_text: str | None = Field(default=None, description="the text of that file")
    configuration: int | None = Field(
        default=None, ge=1, description="of that file; default: the one in which it was saved"
    )
    surface: tuple[SurfaceSection, ...] = Field(default=(), strict=False)
    glass: dict[str, GlassSection] = Field(default={}, description="glasses of your own, by name")
    glass_file: str | None = Field(
        default=None, exclude=True, description="a catalogue of glasses, .agf (read when the study is loaded)"
    )
    entrance_diameter_mm: float | None = Field(
        default=None, gt=0, description="of the entrance pupil; one of the keys that say how wide the beam is"
    )
    f_number: float | None = Field(default=None, gt=0, description="paraxial, in the image space")
    object_na: float | None = Field(
        default=None,
        gt=0,
        description="numerical aperture in the object space, in place of entrance_diameter_mm",
    )
    image_na: float | None = Field(
        default=None,
        gt=0,
        description="numerical aperture in the image space, in place of entrance_diameter_mm",
    )
    stop_radius_mm: float | None = Field(
        default=None,
        gt=0,
        description="of the aperture stop that is full of light, in place of entrance_diameter_mm",
    )
    pupil_obscuration: float | None = Field(default=None, ge=0, lt=1, description="inner over outer radius")
    pupil_apodization: Literal["uniform", "gaussian", "cosine_cubed"] | None = Field(
        default=None, description="of the light's amplitude over the pupil"
    )
    apodization_factor: float | None = Field(
        default=None, ge=0, le=STRONGEST, description="G of the Gaussian exp(-G rho^2)"
    )
    object_distance_mm: float | None = Field(default=None, description="None is infinity")
    fields_deg: Pairs = Field(
        default=None,
        strict=False,
        min_length=1,
        description="field points x, y: angles to the axis in the object space",
    )
    fields_arcmin: Pairs = Field(
        default=None,
        strict=False,
        min_length=1,
        description="field points x, y in the object space, in place of fields_deg",
    )
    fields_mm: Pairs = Field(default=None, strict=False, min_length=1, description="heights of the object")
    wavelengths_nm: tuple[float, ...] | None = Field(
        default=None,
        strict=False,
        min_length=1,
        description="of the light; default: those of the bundled system or file",
    )
    primary_wavelength: int | None = Field(default=None, ge=1, description="its place in the list, from 1")
    telecentric: bool | None = Field(default=None, description="in the object space")

    @model_serializer(mode="wrap")
    def _without_what_is_not_given(self, write: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Leave out what there is none of: stores go on from before these keys were any."""
        record: dict[str, Any] = write(self)
        for key in ("configuration", "pupil_apodization", "apodization_factor"):
            if getattr(self, key) is None:
                record.pop(key, None)
        if not self.glass:
            record.pop("glass", None)
        return record

    @model_validator(mode="after")
    def _keys_fit_each_other(self) -> "SystemSection":
        from_file = self.file is not None or self.file_text is not None
        if from_file and (self.surface or self.name is not None):
            raise ValueError("file stands alone: leave out name and surface")
        if self.configuration is not None and not from_file:
            raise ValueError("configuration is that of a lens file; give file")
        if not (from_file or self.surface or self.name is not None):
            raise ValueError("it needs the name of a bundled system, a file, or surfaces")
        pupils = [key for key in _PUPILS if getattr(self, key) is not None]
        if len(pupils) > 1 or (self.surface and not pupils):
            raise ValueError(f"it needs one of {', '.join(_PUPILS)}, not {' and '.join(pupils) or 'none'}")
        fields = [key for key in _FIELDS if getattr(self, key) is not None]
        if len(fields) > 1:
            raise ValueError(f"{' and '.join(fields)} are given; choose one")
        if (self.pupil_apodization == "gaussian") != (self.apodization_factor is not None):
            raise ValueError('apodization_factor belongs to pupil_apodization = "gaussian", which needs it')
        if self.wavelengths_nm and min(self.wavelengths_nm) <= 0:
            raise ValueError("wavelengths_nm must be positive")
        if self.surface:
            self._require_complete_surfaces()
        return self

    def _require_complete_surfaces(self) -> None:
        stops = [one.name for one in self.surface if one.stop]
        if len(stops) != 1:
            raise ValueError(f"exactly one surface is the stop; {', '.join(stops) or 'none'} has stop = true")
        names = [one.name for one in self.surface]
        twice = next((name for name in names if names.count(name) > 1), None)
        if twice is not None:
            raise ValueError(f"two surfaces are called {twice!r}; each needs a name of its own")
        image = self.surface[-1]
        if image.glass is not None:
            raise ValueError(f"the last surface, {image.name}, is the image and cannot have a glass")
        if self.wavelengths_nm is None:
            raise ValueError("a system of surfaces needs wavelengths_nm")


def embed_file(record: dict[str, Any], base: Path) -> None:
    """Add what the lens file and the sag files hold that the record of a section names, relative to `base`.

    Raises
    ------
    UserError
        If a file cannot be read or is not supported.
    """
    for surface in record.get("surface") or ():
        if isinstance(surface, dict):
            embed_sag(surface, base)
    if isinstance(record.get("file"), str):
        path = base / record["file"]
        record["file_text"] = read_text(path)
    embed_glasses(record, base)
    if isinstance(record.get("file"), str):
        try:
            glasses = {name: GlassSection(**one) for name, one in (record.get("glass") or {}).items()}
        except (TypeError, ValueError, AttributeError):
            return  # the schema says it better
        chosen = record.get("configuration")
        number = chosen if isinstance(chosen, int) else None
        parse_zmx(
            record["file_text"], str(base / record["file"]), own_glasses(glasses), number
        )  # names the file


def build(section: SystemSection) -> OpticalSystem:
    """Return the system that a section describes.

    Raises
    ------
    UserError
        If the bundled system or a glass is unknown, the lens file is not supported, or the section's parts
        do not fit each other.
    """
    glasses = own_glasses(section.glass)
    if section.file_text is not None:
        system = parse_zmx(
            section.file_text, section.file or "system.file_text", glasses, section.configuration
        )
    elif section.file is not None:
        system = read_zmx(section.file, glasses, section.configuration)
    elif section.surface:
        system = _inline(section)
    else:
        from wavequake.optics.catalog.names import optical_system

        system = optical_system(section.name or "")
    return _changed(system, section)


def _inline(section: SystemSection) -> OpticalSystem:
    return OpticalSystem(
        name=section.name or "custom",
        surfaces=_surfaces(section.surface, own_glasses(section.glass)),
        stop=next(index for index, one in enumerate(section.surface) if one.stop),
        pupil=Pupil("entrance_diameter", 1.0),  # replaced: the section is valid only with one of its own
    )


def _changed(system: OpticalSystem, section: SystemSection) -> OpticalSystem:
    """Return the system with what the section says of pupil, object, fields and wavelengths."""
    pupil = system.pupil
    for key, kind in _PUPILS.items():
        value = getattr(section, key)
        if value is not None:
            pupil = replace(pupil, kind=kind, value=value)  # type: ignore[arg-type]
    if section.pupil_obscuration is not None:
        pupil = replace(pupil, obscuration=section.pupil_obscuration)
    light = section.pupil_apodization
    if light is not None:
        falls = None if light == "uniform" else Apodization(light, section.apodization_factor or 0.0)
        pupil = replace(pupil, apodization=falls)
    waves, primary = system.wavelengths, system.primary_wavelength
    if section.wavelengths_nm is not None:
        waves, primary = np.array(section.wavelengths_nm) * MM_PER_NM, 0
    if section.primary_wavelength is not None:
        primary = section.primary_wavelength - 1
    if primary >= len(waves):
        raise UserError(
            f"system.primary_wavelength is {primary + 1}, but {system.name} has {len(waves)} wavelengths."
        )
    distance = system.object_distance
    if section.object_distance_mm is not None:
        distance = section.object_distance_mm
    fields = _fields(system, section, infinite=bool(np.isinf(distance)))
    same = len(fields) == len(system.fields) and bool((fields == system.fields).all())
    telecentric = system.telecentric if section.telecentric is None else section.telecentric
    return replace(
        system,
        pupil=pupil,
        object_distance=distance,
        fields=fields,
        vignetting=system.vignetting if same else (),
        wavelengths=waves,
        primary_wavelength=primary,
        telecentric=telecentric,
    )


def _fields(system: OpticalSystem, section: SystemSection, infinite: bool) -> Array:
    for key, degrees in _FIELDS.items():
        given = getattr(section, key)
        if given is None:
            continue
        if (degrees is not None) != infinite:
            right = "fields_deg or fields_arcmin" if infinite else "fields_mm"
            where = "infinity" if infinite else "a finite distance"
            raise UserError(f"The object of {system.name} is at {where}: give {right} instead of {key}.")
        values = np.array(given, dtype=np.float64)
        return values if degrees is None else np.deg2rad(values * degrees)
    if infinite != bool(np.isinf(system.object_distance)) and system.fields.any():
        raise UserError(
            f"The object of {system.name} is moved to or from infinity: give its fields anew, as fields_deg "
            "or fields_mm."
        )
    return system.fields


def _surfaces(sections: tuple[SurfaceSection, ...], glasses: Mapping[str, Medium]) -> tuple[Surface, ...]:
    """Place the surfaces along the light; the first one's distance moves it from the origin."""
    axis, turn, sense = np.zeros(3), np.eye(3), 1.0
    surfaces = []
    for section in sections:
        axis = axis + sense * section.distance_mm * turn[:, 2]
        rotation = turn @ cardan(np.deg2rad(section.tilt_deg))
        action, medium = medium_after(section, glasses)
        surfaces.append(
            Surface(
                section.name,
                shape_of(section),
                axis + turn[:, :2] @ np.array(section.decenter_mm),
                rotation,
                action,
                medium,
                opening_of(section),
                deformation_of(section),
                effect_of(section.phase),
            )
        )
        if action == "reflect":
            sense = -sense
        if section.fold:
            turn = _folded(turn, rotation[:, 2])
    return tuple(surfaces)


def _folded(turn: Array, normal: Array) -> Array:
    """Return the frame after a fold mirror: reflected, with z turned over so that it keeps its sense."""
    reflected: Array = turn - 2.0 * np.outer(normal, normal @ turn)
    reflected[:, 2] *= -1.0
    return reflected
