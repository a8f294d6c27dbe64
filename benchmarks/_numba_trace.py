"""The algorithm of the sequential kernel in numba: two conics, the first bent by monomials, and two planes.

The loop is straight-line code for a degree, without branches, and what rays share is read before it: LLVM
makes vectors of it, which takes a sixth of the time of loops over coefficients. As the kernel does, it turns
rays into the frames of surfaces that are turned, and says which are lost, where and why; rays that need
Newton's iteration, of which there are none here, would take it in a second loop.
"""

from collections.abc import Callable, Iterator, Sequence
from typing import Any


def numba_tracer(degree: int, rotates: Sequence[bool]) -> Callable[..., Any] | None:
    """Return a function whose arguments are those of the text, or None without numba.

    ``rotates`` tells which of the four surfaces turn against the one before.
    """
    try:
        import numba
    except ImportError:
        return None
    names: dict[str, Any] = {}
    exec("\n".join(_lines(degree, rotates)), names)
    return numba.njit(parallel=True, error_model="numpy")(names["trace"])  # type: ignore[no-any-return]


def _lines(degree: int, rotates: Sequence[bool]) -> Iterator[str]:
    yield "from math import nan, sqrt"
    yield "from numba import prange"
    given = "conics, poses, coefficients, scale, limit, reach, position, direction"
    yield f"def trace({given}, path, out_x, out_y, status, surface):"
    for i in (0, 1):
        yield f"    c{i}, k{i} = conics[{i}, 0], conics[{i}, 0] * conics[{i}, 1]"
    for i in range(4):
        yield from (f"    p{i}_{j} = poses[{i}, {j}]" for j in range(12))
    yield from (f"    a{i} = coefficients[{i}]" for i in range((degree + 1) * (degree + 2) // 2))
    yield "    u, v, w = direction"
    yield f"    u0, v0, w0 = {_turned(0, rotates)}"
    yield "    for n in prange(position.shape[1]):"
    yield from (f"        {line}" for line in _ray(degree, rotates))


def _ray(degree: int, rotates: Sequence[bool]) -> Iterator[str]:
    yield "x, y, z = position[0, n], position[1, n], position[2, n]"
    yield f"x, y, z = {_moved(0, rotates)}"
    yield "u, v, w = u0, v0, w0"
    yield from _to_conic(0)
    yield "total = way"
    yield "beyond = k0 * z - 1.0"
    yield from _heights(degree)
    yield "q = z - height"
    yield "h = 1.0 - k0 * q"
    yield "climb = w - lean_x * u - lean_y * v"
    yield "inverse = 0.5 / (h * climb - c0 * (x * u + y * v))"
    yield "step = (c0 * (x * x + y * y) - (1.0 + h) * q) * inverse"
    yield "x, y = x + step * u, y + step * v"
    yield "q = q + step * climb"
    yield "h = 1.0 - k0 * q"
    yield "square = x * x + y * y"
    yield "last = (c0 * square - (1.0 + h) * q) * inverse"
    yield "lateral = (u * u + v * v) * (step * step)"
    yield "x, y = x + last * u, y + last * v"
    yield "h = h - k0 * climb * last"
    yield "nx, ny, nz = c0 * x + h * lean_x, c0 * y + h * lean_y, -h"
    yield "step = step + last"
    yield "z = z + step * w"
    yield "total = total + step"
    yield "near = (lateral <= limit) & (square <= reach) & (beyond <= 0.0)"
    yield "loss = 0.0 if near & (nz < 0.0) & ((nx * u + ny * v + nz * w) * w < 0.0) else 2043.0"
    yield from _reflect()
    yield "length = norm"
    yield f"u, v, w = {_turned(1, rotates)}"
    yield f"x, y, z = {_moved(1, rotates)}"
    yield from _to_conic(1)
    yield "total = total + way * length"
    yield "nx, ny, nz = c1 * x, c1 * y, k1 * z - 1.0"
    yield "miss = 0.0 if nz + (way - way) < 0.0 else 2036.0"
    yield "loss = miss if miss > loss else loss"
    yield from _reflect()
    yield "length = length * norm"
    for i in (2, 3):
        yield f"u, v, w = {_turned(i, rotates)}"
        yield f"x, y, z = {_moved(i, rotates)}"
        yield "way = -z / w"
        yield "x, y, z = x + way * u, y + way * v, z + way * w"
        yield "total = total + way * length"
        yield f"miss = 0.0 if way - way == 0.0 else {8 * (255 - i) + 4}.0"
        yield "loss = miss if miss > loss else loss"
        yield "w = -w"
    yield "path[n] = nan if loss > 0.0 else total"
    yield "out_x[n] = nan if loss > 0.0 else x"
    yield "out_y[n] = nan if loss > 0.0 else y"
    yield "code = int(loss)"
    yield "status[n] = (0x24130 >> 4 * (code & 7)) & 15"
    yield "surface[n] = -1 - (code >> 3)"


def _row(surface: int, row: int, *point: str) -> str:
    return " + ".join(f"p{surface}_{3 * row + k} * {name}" for k, name in enumerate(point))


def _turned(surface: int, rotates: Sequence[bool]) -> str:
    if not rotates[surface]:
        return "u, v, w"
    return ", ".join(_row(surface, row, "u", "v", "w") for row in range(3))


def _moved(surface: int, rotates: Sequence[bool]) -> str:
    places = [_row(surface, row, "x", "y", "z") if rotates[surface] else "xyz"[row] for row in range(3)]
    return ", ".join(f"p{surface}_{9 + row} + {place}" for row, place in enumerate(places))


def _to_conic(surface: int) -> Iterator[str]:
    c, k = f"c{surface}", f"k{surface}"
    yield f"high = {k} * z"
    yield f"f = {c} * (x * x + y * y) + (high - 2.0) * z"
    yield f"b = {c} * (x * u + y * v) + (high - 1.0) * w"
    yield f"a = {c} * (u * u + v * v) + {k} * (w * w)"
    yield "r = sqrt(b * b - a * f)"
    yield "r = -r if w < 0.0 else r"
    yield "cancels = b * r > 0.0"
    yield "way = (-(b + r) if cancels else f) / (a if cancels else r - b)"
    yield "x, y, z = x + way * u, y + way * v, z + way * w"


def _heights(degree: int) -> Iterator[str]:
    """Horner's scheme in s, of coefficients by Horner's scheme in t, with both slopes."""
    yield "s, t = x * scale, y * scale"
    for i in range(degree, -1, -1):
        order = degree - i
        place = [(i + j) * (i + j + 1) // 2 + j for j in range(order + 1)]
        yield f"inner, inner_t = a{place[order]}, 0.0"
        for j in range(order - 1, -1, -1):
            yield "inner_t = inner_t * t + inner"
            yield f"inner = inner * t + a{place[j]}"
        if i == degree:
            yield "height, slope_s, slope_t = inner, 0.0, 0.0"
        else:
            yield "slope_s = slope_s * s + height"
            yield "slope_t = slope_t * s + inner_t"
            yield "height = height * s + inner"
    yield "lean_x, lean_y = slope_s * scale, slope_t * scale"


def _reflect() -> Iterator[str]:
    yield "twice, norm = -2.0 * (nx * u + ny * v + nz * w), nx * nx + ny * ny + nz * nz"
    yield "u, v, w = norm * u + twice * nx, norm * v + twice * ny, norm * w + twice * nz"
