"""Write the kernels of one length of Fourier transform: calls of ``kernels/fourier.cl``, stage by stage."""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from wavequake.kernels.device.program import source


def radices(length: int, width: int) -> tuple[int, ...]:
    """Return the radices of the stages, at least two of them; empty if there is a prime factor above 5.

    A stage of radix 8 needs more registers than processors have whose vectors hold 4 lanes.
    """
    powers = {}
    rest = length
    for prime in (2, 3, 5):
        powers[prime] = 0
        while rest % prime == 0:
            rest //= prime
            powers[prime] += 1
    if rest != 1 or length < 1:
        return ()
    if width <= 4:
        eights, binary = 0, [4] * (powers[2] // 2) + [2] * (powers[2] % 2)
    else:
        eights, twos = divmod(powers[2], 3)
        if twos == 1 and eights:  # 8 x 2 takes more than 4 x 4
            eights, binary = eights - 1, [4, 4]
        else:
            binary = {0: [], 1: [2], 2: [4]}[twos]
    stages = [8] * eights + binary + [5] * powers[5] + [3] * powers[3]
    return tuple(stages + [1] * (2 - len(stages)))


def row_lanes(length: int, width: int) -> int:
    """Return how many lanes the transform of a row can use: they must divide the first radix."""
    first = radices(length, width)[0]
    while first % width or length // first < width:
        width //= 2
    return width


def factors(length: int, along_rows: bool, width: int) -> NDArray[np.float64]:
    """Return what the stages multiply by, one after the other: exp(-2 pi i p r / n), r = 1.. below the radix.

    Stages have the shape (m, r, re and im), but the first along rows, whose lanes are values of p, has
    (r, re and im, m).
    """
    found, size = [], length
    for number, radix in enumerate(radices(length, width)[:-1]):
        steps = size // radix
        turns = np.outer(np.arange(steps), np.arange(1, radix)) % size / size
        waves = np.stack([np.cos(2.0 * np.pi * turns), -np.sin(2.0 * np.pi * turns)], axis=2)
        found.append((waves.transpose(1, 2, 0) if along_rows and number == 0 else waves).ravel())
        size = steps
    return np.concatenate(found)


@lru_cache(maxsize=64)
def kernel_source(length: int, along_rows: bool, width: int) -> str:
    """Return the OpenCL C of a kernel ``transform`` of many rows or columns.

    ``width`` counts the lanes of the device's vectors. Its arguments are: where to begin in the input and in
    the output (at which row, or along columns at which image), how many rows (or groups of columns) there
    are, input, factors, scale, output.
    """
    stages = radices(length, width)
    lines = [f"#define ROWS {int(along_rows)}", source("fourier.cl")]
    for radix in sorted(set(stages)):
        # Only rows' first stages need whole vectors of outputs.
        lines += [f"#define RADIX {radix}", f"#define IS_FIRST {int(radix == stages[0])}"]
        lines += [source("fourier_stage.h"), "#undef RADIX", "#undef IS_FIRST"]
    element, room = ("scalar", "(2 * IMAGINARY)") if along_rows else ("wave", "N")
    lines += [
        "__kernel void transform(const int from, const int to, const int count, __global const scalar *x,",
        "                        __global const scalar *factors, const scalar scale, __global scalar *y)",
        "{",
        "    const int number = get_global_id(1);",
        "    if (number >= count)",
        "        return;",
        "    // Addresses a multiple of 4096 bytes apart would get into each other's way.",
        f"    __local {element} even[2 * {room} + APART];",
        f"    __local {element} *odd = even + {room} + APART;",
    ]
    if along_rows:
        lines += ["    x += (size_t)(from + number) * 2 * N;", "    y += ROW(to + number);"]
    else:
        lines += [
            "    // The last group of columns overlaps the one before it.",
            "    const int column = number * W + W > OTHER ? OTHER - W : number * W;",
            "    const size_t image = get_global_id(2);",
            "    x += 2 * (from + image) * N * OTHER + COLUMN(column);",
            "    y += 2 * ((to + image) * N * OTHER + column);",
        ]
    size, stride, offset, here, there = length, 1, 0, "even", "odd"
    for number, radix in enumerate(stages):
        steps = size // radix
        if number == 0:
            lines.append(f"    first_{radix}(x, {here}, factors, {steps});")
        elif number == len(stages) - 1:
            lines.append(f"    last_{radix}({here}, y, scale, {stride});")
        else:
            lines.append(f"    middle_{radix}({here}, {there}, factors + {offset}, {steps}, {stride});")
            here, there = there, here
        offset += 2 * steps * (radix - 1)
        size, stride = steps, stride * radix
    return "\n".join([*lines, "}", ""])
