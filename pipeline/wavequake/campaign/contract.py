"""What the engine asks of a study kind: a few functions and three small records."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wavequake.campaign.plugins import loaded_plugins
from wavequake.campaign.schema import Study

TODO, DONE, RAISED, CRASHED, TIMED_OUT, DIVERGED = range(6)
STATUS_MEANINGS = "todo done raised crashed timed_out diverged"


@dataclass(frozen=True)
class Variable:
    """A stored array: ``dims`` after the leading ``case``, their sizes, dtype, attributes (units, long_name).

    A ``coordinate`` labels other arrays (the time of each instant); the rest is data. What is ``measured``
    with a stopwatch differs from run to run. The first ``unknown`` entries along the last of ``dims`` are no
    numbers by intent (slopes do not know piston).
    """

    dims: tuple[str, ...]
    shape: tuple[int, ...]
    attrs: Mapping[str, str]
    dtype: str = "float64"
    coordinate: bool = False
    measured: bool = False
    unknown: int = 0


# Of an array that does not depend on the case: dimensions, values, attributes.
Fixed = tuple[tuple[str, ...], NDArray[Any], Mapping[str, str]]


@dataclass(frozen=True)
class Template:
    """What a store holds: arrays per case, and coordinates and arrays that do not depend on the case.

    ``working_bytes`` is the memory of each case while it is computed, where that is more than what is stored.
    """

    per_case: Mapping[str, Variable]
    fixed: Mapping[str, Fixed] = field(default_factory=dict)
    working_bytes: int = 0


@dataclass(frozen=True)
class ChunkResult:
    """The numbers of some cases: an array (case, ...) per variable, a status and a message per case.

    ``timings`` in s by name ("trace", "psf") go to the journal with the engine's own.
    """

    arrays: Mapping[str, NDArray[Any]]
    status: NDArray[np.int8]
    messages: tuple[str, ...]
    timings: Mapping[str, float] = field(default_factory=dict)


def unknown_arrays(variables: Mapping[str, Variable], cases: int) -> dict[str, NDArray[Any]]:
    """Return arrays (case, ...) of which nothing is known: NaN, or 0 where they are of whole numbers."""
    blank = {name: np.nan if np.dtype(one.dtype).kind in "fc" else 0 for name, one in variables.items()}
    return {name: np.full((cases, *one.shape), blank[name], one.dtype) for name, one in variables.items()}


def no_description(study: str) -> dict[str, str]:
    """Add nothing to the plan."""
    return {}


def no_work(study: str, cases: int) -> dict[str, tuple[float, str]]:
    """Return no amounts of work."""
    return {}


def no_notices(study: str) -> Iterator[str]:
    """Have nothing to say."""
    return iter(())


def no_check(study: str) -> None:
    """Find nothing wrong."""


def no_pictures(study: str, dataset: Any) -> Iterator["Drawn"]:
    """Draw nothing."""
    return iter(())


@dataclass(frozen=True)
class Drawn:
    """A picture of a study kind: a matplotlib figure that nobody has saved, with a title and a caption."""

    title: str
    caption: str
    figure: Any


@dataclass(frozen=True)
class StudyKind:
    """A kind of study as module-level functions (so that Dask sends them by reference).

    ``model`` describes its study files. ``study`` is the canonical JSON text of the effective study without
    what does not belong to its identity; a kind may cache on it. ``case_table(study, first, last)`` gives the
    coordinates of cases first <= id < last, each array of length last - first (str, int or float).
    ``compute(study, cases, device)`` is a pure function of the study and the case ids: a case's bits depend
    on nothing else. It marks a case that fails for a known reason in ``status``; an exception means that the
    engine tries the chunk's cases one by one; a UserError ends the run. ``describe`` adds lines to the plan;
    ``work(study, cases)`` says how much of what a kind of work in the timings has processed, e.g.
    {"trace": (1e9, "ray-surfaces")}; ``check`` raises UserError for a study that no case of can succeed,
    before a store is made; ``notices`` yields what the user should read before, such as doubtful units.
    ``compared`` are the coordinates of cases that plain reports tell apart, ``compared_of(study)`` where they
    depend on the study; ``pictures(study, dataset)`` are added to them.

    Most kinds are written as measures: :func:`wavequake.campaign.measured.study_kind`.
    """

    name: str
    template: Callable[[str], Template]
    case_table: Callable[[str, int, int], dict[str, NDArray[Any]]]
    compute: Callable[[str, NDArray[np.int64], str], ChunkResult]
    describe: Callable[[str], dict[str, str]] = no_description
    work: Callable[[str, int], dict[str, tuple[float, str]]] = no_work
    check: Callable[[str], None] = no_check
    notices: Callable[[str], Iterator[str]] = no_notices
    model: type[Study] = Study
    compared: tuple[str, ...] = ("disturbance",)
    pictures: Callable[[str, Any], Iterator[Drawn]] = no_pictures
    compared_of: Callable[[str], tuple[str, ...]] | None = None

    def __reduce__(self) -> tuple[Any, ...]:
        """Travel with the plug-ins of this process: where a kind arrives, they are loaded before it is."""
        return _arrived, (loaded_plugins(), *(getattr(self, one.name) for one in fields(self)))


def _arrived(plugins: object, *values: Any) -> StudyKind:
    return StudyKind(*values)
