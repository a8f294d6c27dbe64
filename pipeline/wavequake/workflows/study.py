"""Study files: TOML in, one validated frozen record out, with an identity.

The identity is everything that determines one case's numbers. How many cases there are, where they are stored
and what runs them is not part of it. Files that a study names (polygons, spectra) are read when the study is
loaded and become part of the effective study, so a store never depends on a file that may change.
"""

import difflib
import hashlib
import json
import tomllib
from collections.abc import Iterable, Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal, get_args

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator

from wavequake.errors import UserError
from wavequake.files import folder
from wavequake.mechanics.disturbances import Disturbance
from wavequake.optics.polygon_table import read_polygons


class Section(BaseModel):
    """A table of a study file: frozen, strict, unknown keys are errors."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)


class StudySection(Section):
    """What the study is called and which workflow runs it."""

    name: str = Field(min_length=1, pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$")
    workflow: Literal["segment-disturbance"]
    title: str = ""
    seed: int = Field(default=20180701, ge=0, lt=2**63)


class SurfaceSection(Section):
    """One surface of a custom telescope after M1 (the last one is the image plane)."""

    name: str
    radius_mm: float | None = Field(
        default=None, description="None is a plane; positive if the center lies on +z"
    )
    conic: float = 0.0
    distance_mm: float = Field(description="along the light from the previous surface", gt=0)
    tilt_deg: float = Field(default=0.0, gt=-90, lt=90, description="of a fold mirror about its y axis")


class TelescopeSection(Section):
    """Which telescope, and what may be changed of it."""

    name: Literal["tmt", "tmt-18", "tmt-thesis", "jwst", "custom"]
    side_mm: float | None = Field(default=None, gt=0, description="tmt-18: side length of the hexagons")
    gap_mm: float | None = Field(default=None, ge=0, description="tmt, tmt-18: gap between the segments")
    polygons: str | None = Field(
        default=None, exclude=True, description="custom: CSV file of polygons (read when the study is loaded)"
    )
    polygons_csv: str | None = Field(default=None, description="custom: the text of that file")
    primary_radius_mm: float | None = Field(
        default=None, lt=0, description="custom: radius of M1, concave < 0"
    )
    primary_conic: float = -1.0
    surfaces: tuple[SurfaceSection, ...] = Field(default=(), strict=False)

    @model_validator(mode="after")
    def _keys_fit_the_telescope(self) -> "TelescopeSection":
        owners = {
            "side_mm": ("tmt-18",),
            "gap_mm": ("tmt", "tmt-18"),
            "polygons": ("custom",),
            "polygons_csv": ("custom",),
            "primary_radius_mm": ("custom",),
            "surfaces": ("custom",),
        }
        for key, names in owners.items():
            if getattr(self, key) not in (None, ()) and self.name not in names:
                raise ValueError(f"{key} belongs to the telescope {' or '.join(names)}, not to {self.name}")
        if self.name == "custom":
            for key in ("primary_radius_mm", "surfaces"):
                if getattr(self, key) in (None, ()):
                    raise ValueError(f"a custom telescope needs {key}")
            if self.polygons is None and self.polygons_csv is None:
                raise ValueError("a custom telescope needs polygons, a CSV file")
        return self


class OpticsSection(Section):
    """Light and rays."""

    wavelength_nm: float = Field(default=550.0, gt=0, le=1e6)
    sampling: Literal["segments", "sunflower"] = "segments"
    rays_per_segment: Literal[6, 18, 36, 72] = Field(
        default=18,
        description="of a hexagon, six triangles: 18 for piston and tilt; "
        "36 for figures j <= 6, 72 for higher ones and for few, large segments",
    )
    rays: int = Field(default=2000, ge=10, le=2_000_000, description="sunflower: rays over the annulus")
    field_arcmin: tuple[float, float] = Field(
        default=(0.0, 0.0), strict=False, description="of the star; the image plane stays, not refocused"
    )


class WavefrontSection(Section):
    """What is fitted to the optical path differences."""

    zernike_terms: int = Field(default=45, ge=4, le=231)


class ImagingSection(Section):
    """The exposure of each case: mean of its instants' point spread functions."""

    pixels: int = Field(default=64, ge=8, le=512, multiple_of=2)
    sampling: float = Field(default=0.25, gt=0, le=0.5, description="pixel in lambda/D")
    moments: Literal["auto", 1, 6, 15] = Field(
        default="auto", description="1: piston, 6/15: tip and tilt to 2nd/4th order"
    )


class CampaignSection(Section):
    """How much of the study to run, and on which device; not part of its identity."""

    cases: int = Field(default=1000, ge=1, le=100_000_000)
    device: str = Field(default="auto", min_length=1)


class StoreSection(Section):
    """Where the results go; not part of the identity, but for what is kept."""

    path: str | None = None
    chunk_cases: int = Field(default=20, ge=1, le=100_000, description="K: cases per task and per shard")
    keep: tuple[Literal["segment_motion"], ...] = Field(default=(), strict=False)


class Study(Section):
    """A validated study file."""

    study: StudySection
    telescope: TelescopeSection
    disturbance: tuple[Disturbance, ...] = Field(min_length=1, strict=False)
    optics: OpticsSection = OpticsSection()
    wavefront: WavefrontSection = WavefrontSection()
    imaging: ImagingSection = ImagingSection()
    campaign: CampaignSection = CampaignSection()
    store: StoreSection = StoreSection()

    @field_validator("disturbance")
    @classmethod
    def _names_are_unique(cls, value: tuple[Any, ...]) -> tuple[Any, ...]:
        names = [entry.name for entry in value]
        for name in names:
            if names.count(name) > 1:
                raise ValueError(f"two disturbances are called {name!r}; each needs a name of its own")
        for entry in value:
            parts = getattr(entry, "of", ())
            if len(set(parts)) < len(parts):
                raise ValueError(f"{entry.name!r} combines a disturbance with itself; name each one once")
            for part in parts:
                if part not in names or part == entry.name:
                    raise ValueError(
                        f"{entry.name!r} combines {part!r}, which is not another disturbance of this study"
                    )
        if not any(entry.share for entry in value):
            raise ValueError("every disturbance has share 0, so there is nothing to run")
        return value

    def identity_text(self) -> str:
        """Return the canonical JSON text of all that determines one case's numbers (and of what is kept)."""
        record = self.model_dump(mode="json", exclude={"campaign": True, "store": {"path", "chunk_cases"}})
        record["study"].pop("title")
        return json.dumps(record, sort_keys=True, separators=(",", ":"))

    def identity(self) -> str:
        """Return the SHA-256 of :meth:`identity_text` in hexadecimal."""
        return hashlib.sha256(self.identity_text().encode()).hexdigest()

    def default_store(self) -> Path:
        """Return the folder that results go to when the study names none: another study never lands in it."""
        return Path("runs") / f"{self.study.name}-{self.identity()[:8]}"


@lru_cache(maxsize=16)
def study_from_identity(text: str) -> Study:
    """Rebuild a study from its identity text, as workers do."""
    return Study.model_validate_json(text, strict=False)


def bundled_studies() -> dict[str, Path]:
    """Return the study files that come with Wavequake, by name."""
    return {path.stem: path for path in sorted(folder("workflows").glob("*.toml"))}


def load_study(name: str | Path, overrides: Mapping[str, Any] | Iterable[str] = ()) -> Study:
    """Load a study by the name of a bundled one or by path, and apply ``key=value`` overrides.

    Parameters
    ----------
    name : str or Path
        ``tmt-segments`` or ``my/study.toml``.
    overrides : mapping or iterable of ``"section.key=value"``
        Values of text overrides are TOML values; bare words are strings. A disturbance is addressed by its
        name: ``disturbance.wind.mean_speed_m_s=8``.

    Raises
    ------
    UserError
        If the study is unknown, is no TOML, or does not fit the schema; names the file, the key and the
        nearest valid one.
    """
    path = _find(str(name))
    try:
        record = tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise UserError(f"{path} is not a TOML file: {error}.") from None
    except OSError as error:
        raise UserError(f"The study file {path} cannot be read: {error.strerror}.") from None
    pairs = overrides.items() if isinstance(overrides, Mapping) else [_split(text) for text in overrides]
    for key, value in pairs:
        _override(record, key, value)
    _read_files(record, path.parent)
    try:
        return Study.model_validate(record)
    except ValidationError as error:
        raise UserError(f"{path.name}: {describe(error, record)}") from None


def study_with(study: Study, keys: Mapping[str, Any]) -> Study:
    """Return a copy of `study` with ``section.key`` values replaced; raises as :func:`load_study`."""
    record = study.model_dump(mode="json")
    for key, value in keys.items():
        _override(record, key, value)
    try:
        return Study.model_validate(record)
    except ValidationError as error:
        raise UserError(f"{study.study.name}: {describe(error, record)}") from None


def _find(name: str) -> Path:
    bundled = bundled_studies()
    if name in bundled:
        return bundled[name]
    path = Path(name)
    if path.is_file():
        return path
    near = difflib.get_close_matches(name, bundled, n=1)
    hint = f"did you mean {near[0]!r}? " if near else ""
    raise UserError(
        f"There is no study {name!r}: {hint}Bundled studies are {', '.join(bundled)}; "
        "a study of your own is a path to a .toml file."
    )


def _split(text: str) -> tuple[str, Any]:
    key, separator, value = text.partition("=")
    if not separator or not key:
        raise UserError(
            f"{text!r} is not an override; write section.key=value, for example campaign.cases=40."
        )
    try:
        return key.strip(), tomllib.loads(f"value = {value}")["value"]
    except tomllib.TOMLDecodeError:
        return key.strip(), value


def _override(record: dict[str, Any], key: str, value: Any) -> None:
    node: Any = record
    *parents, last = key.split(".")
    if not parents:
        homes = [
            name
            for name, field in Study.model_fields.items()
            if key in getattr(field.annotation, "model_fields", ())
        ]
        hint = f"did you mean {homes[0]}.{key}?" if homes else "write section.key=value."
        raise UserError(f"The key {key!r} has no section; {hint}")
    for depth, part in enumerate(parents):
        if isinstance(node, list):
            node = _entry(node, part, ".".join(parents[:depth]))
        else:
            node = node.setdefault(part, {})
        if not isinstance(node, dict | list):
            raise UserError(
                f"The key {key!r} leads nowhere: {'.'.join(parents[: depth + 1])} is a value, not a section."
            )
    if isinstance(node, list):
        raise UserError(f"The key {key!r} names a whole entry; write {key}.key=value.")
    node[last] = value


def _entry(entries: list[Any], name: str, where: str) -> Any:
    for index, entry in enumerate(entries):
        if isinstance(entry, dict) and (entry.get("name") == name or str(index) == name):
            return entry
    names = [str(entry.get("name")) for entry in entries if isinstance(entry, dict)]
    near = difflib.get_close_matches(name, names, n=1)
    hint = f"did you mean {near[0]!r}? " if near else ""
    raise UserError(f"There is no {where} called {name!r}; {hint}There are {', '.join(names)}.")


def _read_files(record: dict[str, Any], base: Path) -> None:
    """Replace the files that a study names by their contents."""
    telescope = record.get("telescope")
    if isinstance(telescope, dict) and isinstance(telescope.get("polygons"), str):
        path = base / telescope["polygons"]
        telescope["polygons_csv"] = _text(path, "telescope.polygons")
        read_polygons(path)  # here an error can name the file
    for entry in record.get("disturbance") or ():
        if isinstance(entry, dict) and isinstance(entry.get("file"), str):
            entry["file_csv"] = _text(base / entry["file"], f"disturbance.{entry.get('name')}.file")


def _text(path: Path, key: str) -> str:
    try:
        return path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(
            f"{key}: the file {path} cannot be read ({getattr(error, 'strerror', None) or error})."
        ) from None


def describe(error: ValidationError, record: Mapping[str, Any]) -> str:
    """Turn the first error of a validation into one sentence: where, what, what would be right."""
    found = error.errors(include_url=False)
    places = [one["loc"] for one in found]
    # A list with a bad entry is reported once more itself, as if it lacked that entry.
    errors = [one for one in found if not any(p != one["loc"] == p[: len(one["loc"])] for p in places)]
    first = errors[0]
    location = [part for part in first["loc"] if part not in _union_tags()]
    where = ".".join(_entry_name(record, location, depth) for depth in range(len(location))) or "the study"
    more = f" ({len(errors) - 1} more after this one)" if len(errors) > 1 else ""
    if first["type"] == "extra_forbidden":
        valid = _valid_keys(record, first["loc"])
        near = difflib.get_close_matches(str(location[-1]), valid, n=1, cutoff=0.3)
        hint = f"; the nearest valid key is {near[0]!r}" if near else f"; valid keys are {', '.join(valid)}"
        return f"the key {where!r} is unknown{hint}{more}."
    if first["type"] == "missing":
        return f"the key {where!r} is missing{more}."
    if first["type"] == "union_tag_invalid":
        models = ", ".join(disturbance_models())
        return f"{where}.model: there is no model {first['ctx']['tag']!r}; choose one of {models}{more}."
    if first["type"] == "too_short":
        limit = first["ctx"]
        return (
            f"{where}: it needs at least {limit['min_length']} entries, not {limit['actual_length']}{more}."
        )
    if first["type"] == "string_pattern_mismatch":
        return (
            f"{where}: {first['input']!r} must begin with a letter or a digit and go on with letters, digits,"
            f" '.', '_' and '-'{more}."
        )
    message = first["msg"].removeprefix("Value error, ")
    given = first.get("input")
    shown = (
        ""
        if isinstance(given, dict | list | tuple) or first["type"] == "value_error"
        else f" (it is {given!r})"
    )
    return f"{where}: {message[0].lower()}{message[1:].rstrip('.')}{shown}{more}."


def _union_tags() -> set[str]:
    return set(disturbance_models())


def disturbance_models() -> dict[str, type[BaseModel]]:
    """Return the parameter models of all disturbances by the name that a study file gives them."""
    union = get_args(Disturbance)[0]
    return {model.model_fields["model"].default: model for model in get_args(union)}


def _entry_name(record: Mapping[str, Any], location: list[Any], depth: int) -> str:
    part = location[depth]
    if not isinstance(part, int):
        return str(part)
    node: Any = record
    for step in location[: depth + 1]:
        try:
            node = node[step]
        except (KeyError, IndexError, TypeError):
            return str(part)
    return str(node.get("name", part)) if isinstance(node, dict) else str(part)


def _valid_keys(record: Mapping[str, Any], location: tuple[Any, ...]) -> list[str]:
    """Return the keys that would be valid where an unknown one stands."""
    if len(location) == 1:
        return list(Study.model_fields)
    if location[0] == "disturbance":
        tags = [part for part in location if part in disturbance_models()]
        return list(disturbance_models()[tags[0]].model_fields) if tags else ["name", "model"]
    if location[:2] == ("telescope", "surfaces"):
        return list(SurfaceSection.model_fields)
    annotation = Study.model_fields[str(location[0])].annotation
    return (
        list(annotation.model_fields)
        if isinstance(annotation, type) and issubclass(annotation, BaseModel)
        else []
    )
