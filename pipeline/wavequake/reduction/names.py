"""Names of variants: ``craigb36``, ``krylov108(200,450,700)``, ``flbt42(0-1200)``.

A name is a method, an order, and for some methods arguments in brackets. Of component modes there are modal
(free-interface modes), modalfix (fixed-interface modes, the thesis' "Guyan"), guyan (static condensation),
craigb, rubin, macneal, dualcb (Martinez), inertia and hintz; then krylov, irka, bt (balanced truncation; flbt
in frequency bands, fwbt with weights) and pod.

- ``krylov36(150)``: expansion points in Hz. A real point f lies on the imaginary axis, s0 = 2 pi i f; a
  complex one a+bj is s0 = 2 pi (b + i a), so that ``150j`` is the real s0 = 2 pi 150.
  ``krylov(200*3,450*1)`` chooses the number of block moments of each point instead of the order.
- ``flbt42(0-1200)``: bands in Hz; ``fwbt42(0-400*1,400-1200*0.1)`` gives each band a weight.
- ``pod36`` takes impulse responses, ``pod36(100)`` responses to a sudden sine of 100 Hz.
"""

import difflib
import math
import re

from wavequake.errors import UserError
from wavequake.reduction.method import METHODS, Variant

__all__ = ["Variant", "orders_of", "parse"]

_EXAMPLES = {
    "points": "krylov36(150) or krylov(200*3,450*1)",
    "bands": "flbt42(0-1200) or fwbt42(0-400*1,400-1200*0.1)",
    "frequency": "pod36(100)",
    "": "craigb36",
}
# Far above any structure; squares of it stay finite.
_HIGHEST_HZ = 1e9
_NAME = re.compile(r"([a-z]+)(\d*)(?:\(([^()]*)\))?")
_RANGE = re.compile(r"\{(\d+):(\d+):(\d+)\}")
_MOST_ORDERS = 10_000
_NUMBER = r"\d+(?:\.\d*)?(?:e[+-]?\d+)?"
_BAND = re.compile(rf"({_NUMBER})-({_NUMBER})(?:\*({_NUMBER}))?")


def parse(name: str, order: int | None = None) -> Variant:
    """Return what a name says.

    Parameters
    ----------
    name : str
    order : int, optional
        Order of a name that has none, e.g. ``parse("craigb", 36)``.

    Raises
    ------
    UserError
        If the method is unknown (names the nearest one), or order or arguments are missing or make no sense.
    """
    match = _NAME.fullmatch(name.strip().lower().replace(" ", ""))
    if match is None:
        raise UserError(f"{name!r} is no name of a reduction; an example is {_EXAMPLES['points']}.")
    method, digits, inside = match.groups()
    known = METHODS.entries()
    if method not in known:
        near = difflib.get_close_matches(method, known, n=1, cutoff=0.0)[0]
        raise UserError(f"There is no reduction method {method!r} ({name!r}); the nearest one is {near!r}.")
    if digits and order is not None and int(digits) != order:
        raise UserError(f"The name {name!r} and the order {order} contradict each other; give one of them.")
    order = int(digits) if digits else order
    kind = known[method].arguments
    if (inside is None) != (kind == "" or (kind == "frequency" and inside is None)):
        wanted = "takes no arguments" if kind == "" else f"needs its {kind} in Hz"
        raise UserError(f"{name!r}: the method {method} {wanted}; an example is {_EXAMPLES[kind]}.")
    items = (inside or "").split(",") if inside is not None else []
    points, moments = _points(name, items) if kind in ("points", "frequency") else ((), ())
    bands = tuple(_band(name, item) for item in items) if kind == "bands" else ()
    if kind == "frequency" and (len(points) > 1 or moments or any(p.imag or p.real <= 0 for p in points)):
        raise UserError(f"{name!r}: the method {method} takes one positive frequency.")
    if order is None and not (known[method].order or moments):
        raise UserError(f"{name!r} has no order; an example is {_EXAMPLES[kind]}.")
    if order == 0:
        raise UserError(f"{name!r}: the order must be at least 1.")
    return Variant(method, order, points, moments, bands)


def orders_of(name: str) -> list[str]:
    """Return the names that a range stands for: ``craigb{18:54:18}`` is craigb18, craigb36 and craigb54.

    The range is first, last and step, the last one included where a step meets it. A name without a range
    stands for itself.

    Raises
    ------
    UserError
        If the range is empty, endless or malformed.
    """
    found = _RANGE.search(name)
    if not found:
        if "{" in name or "}" in name:
            raise UserError(f"{name!r}: a range of orders is {{first:last:step}}, as craigb{{18:108:18}}.")
        return [name]
    first, last, step = map(int, found.groups())
    if step < 1 or last < first or (last - first) // step >= _MOST_ORDERS:
        raise UserError(f"{name!r}: the range must rise from first to last in at most {_MOST_ORDERS} steps.")
    return [_RANGE.sub(str(order), name, count=1) for order in range(first, last + 1, step)]


def _points(name: str, items: list[str]) -> tuple[tuple[complex, ...], tuple[int, ...]]:
    points, moments = [], []
    for item in items:
        text, star, count = item.partition("*")
        try:
            point = complex(text)
            moments += [int(count)] if star else []
        except ValueError:
            raise UserError(
                f"{name!r}: {item!r} is no frequency; an example is {_EXAMPLES['points']}."
            ) from None
        if not (abs(point) <= _HIGHEST_HZ and point.real >= 0 and point.imag >= 0):
            raise UserError(
                f"{name!r}: the expansion point {item!r} must be finite and not negative, and at most "
                f"{_HIGHEST_HZ:g} Hz."
            )
        points.append(point)
    if len(set(points)) < len(points):
        raise UserError(f"{name!r} has an expansion point twice; ask for more moments instead.")
    if moments and (len(moments) < len(points) or min(moments) < 1):
        raise UserError(f"{name!r}: give every expansion point a number of moments of at least 1, or none.")
    return tuple(points), tuple(moments)


def _band(name: str, item: str) -> tuple[float, float, float]:
    match = _BAND.fullmatch(item)
    if match is None:
        raise UserError(f"{name!r}: {item!r} is no band; an example is {_EXAMPLES['bands']}.")
    low, high, weight = float(match[1]), float(match[2]), float(match[3] or 1.0)
    if not (low < high <= _HIGHEST_HZ and 0.0 < weight < math.inf):
        raise UserError(
            f"{name!r}: the band {item!r} must rise, to {_HIGHEST_HZ:g} Hz at most, and have a "
            "positive weight."
        )
    return low, high, weight
