"""Whether what a user gives is of the kind that a function takes; if not, one sentence says what would be."""

import operator
from collections.abc import Sequence
from dataclasses import fields, is_dataclass
from numbers import Integral, Real
from types import NoneType, UnionType
from typing import Any, Literal, Union, cast, get_args, get_origin, get_type_hints

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wavequake.errors import UserError
from wavequake.prepared import prepared

Array = NDArray[np.float64]

_TO_LARGEST = "a number of 1.8e308 at most"
_WORDS = {float: "a number", int: "a whole number", str: "text", bool: "True or False", NoneType: "None"}


def number(value: Any, what: str) -> float:
    """Return a number, which may be NaN or infinite; UserError for anything else."""
    if _is_number(value):
        if _fits_a_float(value):
            return float(value)
        raise UserError(f"{what} is {_shown(value)}; it must be {_TO_LARGEST}")
    raise UserError(f"{what} is {_shown(value)}; it must be a number")


def whole(value: Any, what: str) -> int:
    """Return an integer, UserError for anything else."""
    if not isinstance(value, bool) and isinstance(value, Integral):
        return operator.index(value)
    raise UserError(f"{what} is {_shown(value)}; it must be a whole number")


def array(values: ArrayLike, what: str) -> Array:
    """Return an array of numbers; UserError if the values are none, masked, or rows of different lengths."""
    if type(values) is np.ndarray and values.dtype == np.float64:
        return values
    if _is_masked(values):
        raise UserError(f"{what} must be a plain array, not a masked one, whose mask would be lost")
    try:
        found = np.asarray(values)
        # Whole numbers beyond 64 bits are numbers, too, but objects to NumPy.
        if found.dtype.kind in "fiu" or (found.dtype.kind == "O" and all(map(_is_number, found.flat))):
            with np.errstate(over="raise"):  # of long doubles
                return np.asarray(found, dtype=np.float64)
    except ValueError:  # rows of different lengths
        pass
    except (OverflowError, FloatingPointError):
        raise UserError(f"{what} are {_shown(values)}; each must be {_TO_LARGEST}") from None
    raise UserError(f"{what} must be an array of numbers, not {_shown(values)}")


def alike(what: str, *columns: ArrayLike) -> tuple[Array, ...]:
    """Return arrays of numbers (N,), UserError unless all have the same N."""
    found = tuple(array(one, what) for one in columns)
    if any(one.ndim != 1 or one.shape != found[0].shape for one in found):
        shapes = ", ".join(str(one.shape) for one in found)
        raise UserError(f"{what} have the shapes {shapes}; each must be (N,)")
    return found


@np.errstate(over="ignore", invalid="ignore")
def all_within(values: Array, limit: float) -> bool:
    """Tell whether all numbers are at most this large; what is not a number is not."""
    flat = np.asarray(values, dtype=np.float64).ravel()
    # The sum of squares takes one pass, and suffices nearly always.
    return bool(flat @ flat < limit * limit or (np.abs(flat) <= limit).all())


def require_kind(value: Any, kind: Any, what: str, hint: str = "") -> None:
    """Raise UserError unless the value is of a class, or of one of a union; `hint` ends the sentence."""
    if not isinstance(value, kind):
        raise UserError(f"{what} is {_shown(value)}; it must be {_words(kind)}{hint}")


def require_fields(record: Any, what: str) -> None:
    """Raise UserError unless all fields of a dataclass, and of those in it, are of their declared kinds."""
    found = _wrong(record, type(record))
    if found is not None:
        path, value, words = found
        raise UserError(f"{what}: {path.removeprefix('.')} is {_shown(value)}; it must be {words}")


@prepared(maxsize=None)
def _hints(kind: Any) -> dict[str, Any]:
    return {entry.name: hint for entry in fields(kind) for hint in [get_type_hints(kind)[entry.name]]}


_PLAIN = (float, int, str)  # whose values are right whatever they are: a bool is none of them


def _wrong(value: Any, kind: Any) -> tuple[str, Any, str] | None:
    """Return where in a value there is what, and what would be right; None if all is."""
    if type(value) is kind and kind in _PLAIN:
        return None
    kind, origin, entries = _meant(kind)
    if origin in (Union, UnionType):
        if type(value) in entries and is_dataclass(value):
            return _wrong(value, type(value))
        return ("", value, _words(kind)) if all(_wrong(value, one) for one in entries) else None
    if isinstance(kind, type) and (is_dataclass(kind) or (is_dataclass(value) and isinstance(value, kind))):
        if not isinstance(value, kind):
            return "", value, _words(kind)
        parts = [
            (f".{name}", getattr(value, name), hint) for name, hint in _hints(cast(Any, type(value))).items()
        ]
    elif origin is tuple:
        if isinstance(value, np.ndarray) and value.ndim == 1 and value.dtype.kind in "fiu":
            value = value.tolist()
        if isinstance(value, str) or not isinstance(value, Sequence):
            return "", value, _words(kind)
        entries = entries[:1] * len(value) if entries[1:] == (...,) else entries
        if len(value) != len(entries):
            return "", value, _words(kind)
        parts = [(f"[{i}]", value[i], entry) for i, entry in enumerate(entries)]
    else:
        return None if _fits(value, kind, origin) else ("", value, _words(kind))
    for name, one, entry in parts:
        found = _wrong(one, entry)
        if found is not None:
            return name + found[0], *found[1:]
    return None


@prepared(maxsize=512)
def _meant(kind: Any) -> tuple[Any, Any, tuple[Any, ...]]:
    """Return what an alias stands for (NDArray of NumPy 2.5 is one), its origin and its arguments."""
    kind = getattr(kind, "__value__", kind)
    return kind, get_origin(kind), get_args(kind)


def _fits(value: Any, kind: Any, origin: Any) -> bool:
    if kind is float:
        return _is_number(value) and _fits_a_float(value)
    if kind is int:
        return not isinstance(value, bool) and isinstance(value, Integral)
    if origin is Literal:  # who uses it says which words there are
        return isinstance(value, str)
    if origin is np.ndarray:
        return isinstance(value, np.ndarray) and value.dtype.kind in "fiu"
    return kind is Any or isinstance(value, kind)


def _is_number(value: Any) -> bool:
    return isinstance(value, Real) and not isinstance(value, bool)


def _fits_a_float(value: Any) -> bool:
    """Return whether a number becomes no infinite one as a float; 10**400 is none."""
    try:
        return abs(float(value)) < np.inf or not abs(value) < np.inf
    except OverflowError:
        return False


def _is_masked(values: Any) -> bool:
    """Return whether an array, or one in lists, is masked."""
    return isinstance(values, np.ma.MaskedArray) or (
        isinstance(values, list | tuple) and any(map(_is_masked, values))
    )


def _words(kind: Any) -> str:
    kind = _meant(kind)[0]
    origin, entries = get_origin(kind), get_args(kind)
    if origin in (Union, UnionType):
        return " or ".join(dict.fromkeys(map(_words, entries)))
    if origin is Literal:
        return "text"
    if origin is tuple:
        many = entries[1:] == (...,)
        return f"a tuple, each entry {_words(entries[0])}" if many else f"a tuple of {len(entries)} numbers"
    if origin is np.ndarray:
        return "a NumPy array of numbers"
    return _WORDS.get(kind) or _article(kind.__name__)


def _article(name: str) -> str:
    return f"{'an' if name[0] in 'AEIOU' else 'a'} {name}"


def _shown(value: Any) -> str:
    try:
        text = " ".join(repr(value).split())
    except ValueError:  # whole numbers of more than 4300 digits are not written
        return "too long to be written"
    return text if len(text) <= 60 else text[:57] + "..."
