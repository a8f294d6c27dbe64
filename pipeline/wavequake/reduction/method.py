"""What a method of reduction is, and the registry of those that names, studies and `reduce` know.

A method is one record in one file: a module of `wavequake.reduction.methods`, or one of another distribution
that the entry points of the group ``wavequake.methods`` name.
"""

import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from wavequake.errors import UserError
from wavequake.mechanics.model import Array
from wavequake.reduction.structure import Size, Structure
from wavequake.registry import Registry


@dataclass(frozen=True)
class Variant:
    """What a name says: a method with its order and arguments.

    Attributes
    ----------
    method : str
        Name of a registered `Method`.
    order : int or None
        Number of coordinates; None where the method fixes it (guyan, krylov with chosen moments).
    points : tuple of complex
        Expansion points (krylov) or the frequency of the sine (pod) in Hz.
    moments : tuple of int
        Block moments at each expansion point; empty if the order is shared out evenly.
    bands : tuple of (float, float, float)
        Lower and upper frequency in Hz, and weight.
    """

    method: str
    order: int | None = None
    points: tuple[complex, ...] = ()
    moments: tuple[int, ...] = ()
    bands: tuple[tuple[float, float, float], ...] = ()

    def __str__(self) -> str:
        """Return the canonical name, which `wavequake.reduction.names.parse` reads back."""
        order = "" if self.order is None else str(self.order)
        counts = self.moments or (None,) * len(self.points)
        items = [
            _print_number(point) + ("" if count is None else f"*{count}")
            for point, count in zip(self.points, counts, strict=True)
        ]
        for low, high, weight in self.bands:
            scale = "" if weight == 1.0 else f"*{weight!r}".removesuffix(".0")
            items.append(f"{_print_number(low)}-{_print_number(high)}{scale}")
        return f"{self.method}{order}" + (f"({','.join(items)})" if items else "")


def _print_number(value: complex) -> str:
    real, imaginary = (repr(part).removesuffix(".0") for part in (complex(value).real, complex(value).imag))
    if complex(value).imag == 0:
        return real
    return f"{imaginary}j" if complex(value).real == 0 else f"{real}+{imaginary}j"


@dataclass(frozen=True)
class NormalModes:
    """What limits a basis of elastic normal modes and static shapes.

    Attributes
    ----------
    static : callable
        How many columns are no elastic modes, rigid motions included, of a `Size`.
    at_rest : callable or None
        How many coordinates the modes have at rest, of a `Size`; None for modes of the free interface.
    kind : str
        What the static shapes are: "constraint" or "attachment" modes.
    covered : float
        Which part of the modes of an intermediate model stands for those of the full model.
    """

    static: Callable[[Size], int]
    at_rest: Callable[[Size], int] | None = None
    kind: str = "static"
    covered: float = 1.0


def _accept(size: Size, variant: Variant) -> None:
    """Models of every kind are welcome."""


@dataclass(frozen=True)
class Method:
    """How a reduced model is made.

    Attributes
    ----------
    name : str
        Small letters; with the order it names a variant.
    basis : callable
        ``basis(body, variant, count)`` returns ``count`` linearly independent shapes (n, count) beside the
        rigid motions; the model is projected onto both.
    arguments : "", "points", "bands" or "frequency"
        What the brackets of a name hold.
    rigid : bool
        Whether the model keeps the rigid motions, exactly.
    order : callable or None
        The only order that there is, of a `Size`.
    modes : NormalModes or None
        For bases of normal modes; others are limited by the band and order of an intermediate model.
    dense : bool
        Whether `basis` needs all elastic modes; of large models it gets the intermediate model.
    check : callable
        ``check(size, variant)`` raises a UserError where the method does not suit the model.
    spectrum : callable or None
        For what is no projection, in place of `basis`: squared angular frequencies (count,) and shapes
        (n, count) of unit mass.
    of_snapshots : callable or None
        The method that works on given displacements (n, m).
    """

    name: str
    basis: Callable[[Structure, Variant, int], Array]
    arguments: Literal["", "points", "bands", "frequency"] = ""
    rigid: bool = True
    order: Callable[[Size], int] | None = None
    modes: NormalModes | None = None
    dense: bool = False
    check: Callable[[Size, Variant], None] = _accept
    spectrum: Callable[[Structure, Variant, int], tuple[Array, Array]] | None = None
    of_snapshots: Callable[[Array], "Method"] | None = None


METHODS: Registry[Method] = Registry(
    "reduction method", "wavequake.reduction.methods", "wavequake.methods", lambda method: method.name
)


def register(method: Method) -> Method:
    """Make a method known to names, studies and `wavequake.reduction.reduce.reduce`, and return it.

    Raises
    ------
    UserError
        If its name is not of small letters, or another file's method has it.
    """
    if re.fullmatch("[a-z]+", method.name) is None:
        raise UserError(f"the name {method.name!r} of a reduction method must be of small letters, as craigb")
    before = METHODS.known().get(method.name)
    if before is not None and before.basis.__module__ != method.basis.__module__:
        raise UserError(
            f"two reduction methods are called {method.name!r}, in {before.basis.__module__} and in "
            f"{method.basis.__module__}; each needs a name of its own"
        )
    return METHODS.add(method)
