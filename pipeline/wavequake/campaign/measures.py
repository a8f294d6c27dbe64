"""Measures: one record for each number that a study gives, from which everything else about it follows.

Templates of stores, tables, goals, exports, comparisons and plain reports read these records. A study kind
made of them (`wavequake.campaign.measured`) writes nothing else down about its numbers.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from operator import itemgetter
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from wavequake.campaign.contract import Fixed, Template, Variable
from wavequake.errors import UserError

TIME = "time"
OverTime = Literal["rms", "mean", "max", "last"]


@dataclass(frozen=True)
class Measure:
    """A number, or an array of numbers, of every case.

    Attributes
    ----------
    name : str
        Its name in stores.
    units : str
        "1" for a pure number.
    long_name : str
        What it is and how it is defined, in one phrase: reports and stores quote it.
    dims : tuple of str
        Its dimensions after ``case``; their sizes and labels are the kind's axes.
    value : callable
        From what the kind computes of some cases to the measure's array (case, ...) of them. A measure over
        time may have fewer instants than the longest case has; the others are NaN.
    over_time : {"rms", "mean", "max", "last"}
        How tables and goals make one number of a case from its instants.
    dtype : str
    coordinate : bool
        Whether it labels other arrays, as the time of each instant does.
    measured : bool
        Whether a stopwatch gave it, so that it differs from run to run.
    unknown : int
        So many first entries along the last dimension are no numbers by intent.
    attrs : mapping
        Further attributes of the stored array.
    """

    name: str
    units: str
    long_name: str
    dims: tuple[str, ...]
    value: Callable[[Any], NDArray[Any]]
    over_time: OverTime = "rms"
    dtype: str = "float64"
    coordinate: bool = False
    measured: bool = False
    unknown: int = 0
    attrs: Mapping[str, str] = field(default_factory=dict)


def stored(name: str, units: str, long_name: str, dims: tuple[str, ...] = (), **more: Any) -> Measure:
    """Return the measure that is found under its name in what a kind computes; `more` as in `Measure`."""
    return Measure(name, units, long_name, dims, itemgetter(name), **more)


@dataclass(frozen=True)
class Axis:
    """The labels of a dimension, or with a number its size alone.

    Attributes
    ----------
    labels : sequence or int
        Labels, which stores keep, or how many entries the dimension has.
    long_name, units : str
    """

    labels: Sequence[Any] | NDArray[Any] | int
    long_name: str = ""
    units: str = ""

    def __len__(self) -> int:
        """Return the size of the dimension."""
        return self.labels if isinstance(self.labels, int) else len(self.labels)


def template_of(
    measures: Iterable[Measure], axes: Mapping[str, Axis], fixed: Mapping[str, Fixed] | None = None
) -> Template:
    """Return what a store of some measures holds.

    Raises
    ------
    UserError
        If two measures have one name, or a measure has a dimension that is no axis, a name, type or way over
        time that stores cannot hold; if an axis has no entries.
    """
    per_case: dict[str, Variable] = {}
    for dim, axis in axes.items():
        if not isinstance(axis, Axis) or (axis.labels if isinstance(axis.labels, int) else len(axis)) < 1:
            raise UserError(f"The axis {dim!r} must be an Axis of one entry or more, not {axis!r}.")
    for measure in measures:
        _check(measure)
        if measure.name in per_case:
            raise UserError(f"Two measures are called {measure.name!r}; each needs a name of its own.")
        unknown = [dim for dim in measure.dims if dim not in axes]
        if unknown:
            raise UserError(
                f"The measure {measure.name!r} has the dimension {unknown[0]!r}, which is none of the axes: "
                f"{', '.join(axes) or 'there are none'}."
            )
        per_case[measure.name] = Variable(
            measure.dims,
            tuple(len(axes[dim]) for dim in measure.dims),
            {
                "units": measure.units,
                "long_name": measure.long_name,
                **({"over_time": measure.over_time} if TIME in measure.dims else {}),
                **measure.attrs,
            },
            measure.dtype,
            measure.coordinate,
            measure.measured,
            measure.unknown,
        )
    labels: dict[str, Fixed] = {
        name: ((name,), _labels(axis), {"long_name": axis.long_name, **_unit(axis)})
        for name, axis in axes.items()
        if not isinstance(axis.labels, int)
    }
    for name, one in (fixed or {}).items():
        if not isinstance(one, tuple) or len(one) != 3 or len(one[0]) != np.ndim(one[1]):
            raise UserError(f"fixed has no (dims, values, attributes) called {name!r}: {one!r}.")
    return Template(per_case, {**labels, **(fixed or {})})


def _check(measure: Measure) -> None:
    if not isinstance(measure, Measure):
        raise UserError(f"{measure!r} is no measure; Measure(...) makes one.")
    where = f"The measure {measure.name!r}"
    if not isinstance(measure.name, str) or not measure.name.isidentifier():
        raise UserError(f"{where} needs a name of letters, digits and '_' that does not begin with a digit.")
    try:
        numbers = np.dtype(measure.dtype).kind in "fiub"
    except TypeError:
        numbers = False
    if not numbers:
        raise UserError(f"{where} has the dtype {measure.dtype!r}; it must be one of numbers, as 'float64'.")
    if measure.over_time not in get_args(OverTime):
        known = ", ".join(map(repr, get_args(OverTime)))
        raise UserError(f"{where} has over_time={measure.over_time!r}; it must be one of {known}.")


def _labels(axis: Axis) -> NDArray[Any]:
    labels = np.asarray(axis.labels)
    return labels.astype(object) if labels.dtype.kind == "U" else labels


def _unit(axis: Axis) -> dict[str, str]:
    return {"units": axis.units} if axis.units else {}


def evaluate(measure: Measure, result: Any, cases: int, shape: tuple[int, ...]) -> NDArray[Any]:
    """Return a measure's array (cases, *shape); instants beyond those that it has are NaN.

    Raises
    ------
    ValueError
        If what the measure gives has another shape, or is no number where numbers belong.
    """
    values = np.asarray(measure.value(result))
    if not np.can_cast(values.dtype, measure.dtype, "same_kind"):
        raise ValueError(f"the measure {measure.name!r} has values of {values.dtype}, not {measure.dtype}")
    if values.shape == (cases, *shape):
        return values.astype(measure.dtype, copy=False)
    short = tuple(
        size if dim != TIME else found
        for dim, size, found in zip(measure.dims, shape, values.shape[1:], strict=False)
    )
    if (
        values.shape != (cases, *short)
        or len(short) != len(shape)
        or any(mine > whole for mine, whole in zip(short, shape, strict=True))
    ):
        raise ValueError(
            f"the measure {measure.name!r} has the shape {values.shape}; it must be {(cases, *shape)} "
            f"({', '.join(('case', *measure.dims))})"
        )
    whole = np.full((cases, *shape), np.nan if np.dtype(measure.dtype).kind == "f" else 0, measure.dtype)
    whole[tuple(slice(0, size) for size in values.shape)] = values
    return whole
