"""What every source of disturbance offers, and the registry of sources.

A source is a population of cases in a file of its own: its keys of a study file, what it draws for the
segments, surfaces and bodies that it addresses, and what sampling plans and budgets have to know of it.
`register` makes it known to the study files of every optics that it fits.
"""

from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, TypeVar, Union

import numpy as np
from numpy.typing import NDArray
from pydantic import (
    BaseModel,
    Field,
    GetCoreSchemaHandler,
    SerializationInfo,
    SerializerFunctionWrapHandler,
    TypeAdapter,
    model_serializer,
)
from pydantic_core import CoreSchema, core_schema

from wavequake.mechanics.disturbances.history_facts import GridHistory
from wavequake.mechanics.disturbances.layout import SegmentLayout
from wavequake.mechanics.disturbances.motion import Motion, generator
from wavequake.mechanics.disturbances.population import Population, time_axis
from wavequake.mechanics.disturbances.streams import Coordinates, Random
from wavequake.prepared import prepared
from wavequake.registry import Registry

Array = NDArray[np.float64]
Optics = Literal["segments", "surfaces"]
Names = Annotated[tuple[str, ...], Field(min_length=1, strict=False)]

Randoms = Callable[[str], Random]
"""Gives random numbers by the name of a stream: a source's own name, or ``name/element``."""

TOGETHER = 16
"""Realizations that are drawn together: those whose numbers, divided by this, are alike but for the rest."""


class Source(Population):
    """A population that draws motions; a study file names it by the default of its field ``model``.

    Attributes
    ----------
    fits : tuple of str
        "segments" for studies of segmented telescopes, "surfaces" for those of any other system.
    independent : "element" or "whole"
        Whether what one element does is drawn independently of what others do (or is not random at all).
        Of a source that moves its elements "whole", no share of one element can be told in a budget.
    stratified : bool
        Whether a sampling plan spreads its numbers evenly: not where thousands of equal weight make a
        case.
    random : bool
        Whether its cases differ.
    sight : bool
        Whether it moves nothing but the line of sight of the whole telescope, by mount or M2.
    """

    random: ClassVar[bool] = True
    sight: ClassVar[bool] = False
    fits: ClassVar[tuple[Optics, ...]] = ("segments", "surfaces")
    independent: ClassVar[Literal["element", "whole"]] = "whole"
    stratified: ClassVar[bool] = True

    @abstractmethod
    def draw(self, layout: SegmentLayout, time: Array, randoms: Randoms) -> Motion:
        """Draw one realization at the instants `time` (n,) in s, which may be any.

        What is drawn for an element depends on its stream alone, not on which others there are.
        """

    def draw_several(
        self,
        layouts: Sequence[SegmentLayout],
        time: Array,
        randoms: Sequence[Randoms],
        realizations: Sequence[int],
    ) -> list[Motion]:
        """Draw different realizations at once, of the same `TOGETHER`, each as :meth:`draw` does.

        Layouts differ in supports and plant at most. A realization has the same bits whatever is beside it.
        """
        return [self.draw(layout, time, one) for layout, one in zip(layouts, randoms, strict=True)]

    def generator(self, stream: str, segments: int, seed: int, realization: int) -> np.random.Generator:
        """Return the random numbers of one of its streams where no sampling plan gives them."""
        return generator(seed, stream, realization)

    def dimensions(self, layout: SegmentLayout) -> int:
        """Return how many random numbers a realization takes."""
        counters: dict[str, Coordinates] = {}
        self.draw(layout, time_axis_of(self), lambda name: counters.setdefault(name, Coordinates()))
        return sum(one.taken for one in counters.values())

    def elements(self, layout: SegmentLayout) -> tuple[str, ...]:
        """Return the names of the elements that it addresses one by one; none where it moves all alike.

        Raises
        ------
        UserError
            If it names one that there is not.
        """
        return layout.chosen(getattr(self, "of", ()), self.name)

    def figure_terms(self, layout: SegmentLayout) -> dict[str, int]:
        """Return up to which Noll coefficient it deforms surfaces, by their names."""
        return {}

    def figure_grids(self) -> dict[str, GridHistory]:
        """Return the grids on which it deforms surfaces, by their names."""
        return {}

    def instants_of_file(self) -> Array | None:
        """Return the instants (n,) in s of what is given over time, which a study then takes; else None."""
        return None

    def frequencies_hz(self) -> tuple[float, ...]:
        """Return the frequencies of its lines, harmonics and modes that its keys name."""
        lines = getattr(self, "lines", ())
        return tuple(line.frequency_hz for line in lines if hasattr(line, "frequency_hz"))

    def lasts_s(self) -> float:
        """Return the time in s after which nothing is known of it: of a combination that holds it, too."""
        return np.inf

    def analytic_rms(self, layout: SegmentLayout) -> tuple[float, Literal["mas", "nm"]] | None:
        """Return the rms that it has by its parameters alone, and its unit; None where there is none.

        ``mas``: radial motion of the line of sight. ``nm``: motion of the segments along their normals.
        """
        return None

    @classmethod
    def embedded(cls, entry: Mapping[str, Any], base: Path) -> dict[str, Any] | None:
        """Return the keys that take what is in the files of a study's `entry`, relative to `base`.

        None: the file goes as it is where `file_key` says.

        Raises
        ------
        UserError
            If a file cannot be read.
        """
        return None

    @classmethod
    def file_key(cls, file: str) -> tuple[str, Literal["text", "base64"]]:
        """Return the key that takes what is in the file that ``file`` names, and how."""
        return "file_csv", "text"


class SegmentSource(Source):
    """A source that moves all segments of a telescope, or some of them."""

    fits: ClassVar[tuple[Optics, ...]] = ("segments",)

    segments: tuple[str, ...] = Field(
        default=(),
        strict=False,
        description="names of those that move, or patterns such as A*, as they do without it; default: all",
    )

    @model_serializer(mode="wrap")
    def _all_are_not_named(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        record: dict[str, Any] = handler(self)
        if not self.segments:
            record.pop("segments", None)
        return record

    def moving(self, layout: SegmentLayout) -> NDArray[np.bool_] | None:
        """Return which segments (S,) move; None: all do.

        Raises
        ------
        UserError
            If it names one that there is not.
        """
        if not self.segments:
            return None
        chosen = layout.chosen(self.segments, self.name)
        return np.array([name in chosen for name in layout.names])


def require_length(source: Source, case: Population) -> None:
    """Raise ValueError if a case, of a source or of what it is a part of, lasts longer than its file."""
    known = source.lasts_s()
    if case.duration_s > known * (1.0 + 1e-9):
        raise ValueError(
            f"the loads of {source.name!r} end at {known:.6g} s, but cases of {case.name!r} "
            f"last {case.duration_s:g} s; give a longer file, or duration_s = {known:.6g}"
        )


def time_axis_of(source: Source) -> Array:
    """Return the instants of a source: those of its file, or else of its time axis."""
    own = source.instants_of_file()
    return time_axis(source) if own is None else own


Kind = TypeVar("Kind", bound=type[Source])
SOURCES: Registry[type[Source]] = Registry(
    "disturbance",
    "wavequake.mechanics.disturbances.sources",
    "wavequake.sources",
    lambda source: str(source.model_fields["model"].default),
)


def register(source: Kind) -> Kind:
    """Make a source known to study files; a decorator of its class.

    Raises
    ------
    UserError
        If another source has its name.
    """
    SOURCES.add(source)
    return source


class AnySource:
    """Annotates a field of a study that takes any registered source that fits an optics, or a sum of them."""

    def __init__(self, optics: Optics, combined: type[Population]) -> None:
        self._optics, self._combined = optics, combined

    def models(self) -> tuple[type[Population], ...]:
        """Return the models among which the key ``model`` chooses."""
        found = sorted(SOURCES.entries().items())  # whatever was imported first
        return (*(source for _, source in found if self._optics in source.fits), self._combined)

    def __get_pydantic_core_schema__(self, kind: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        """Choose the model when a study is read: more may have been registered by then."""
        dumped = core_schema.plain_serializer_function_ser_schema(_dumped, info_arg=True)
        return core_schema.no_info_plain_validator_function(self._validated, serialization=dumped)

    def _validated(self, given: Any) -> Any:
        return _adapter(self.models()).validate_python(given)


@prepared(maxsize=16)
def _adapter(models: tuple[type[Population], ...]) -> TypeAdapter[Any]:
    choice: Any = Annotated[Union[models], Field(discriminator="model")]  # noqa: UP007
    return TypeAdapter(choice)


def _dumped(value: BaseModel, info: SerializationInfo) -> dict[str, Any]:
    return value.model_dump(mode=info.mode, exclude_defaults=info.exclude_defaults)
