"""The algorithm of the sequential kernel for one telescope, one ray at a time, in numba."""

import math
from collections.abc import Callable
from typing import Any


def numba_tracer(degree: int) -> Callable[..., Any] | None:
    """Return a function (elements, poses, coefficients, radius, position, direction, out), or None."""
    try:
        import numba
    except ImportError:
        return None

    @numba.njit(inline="always", error_model="numpy")
    def conic_step(x, y, z, u, v, w, c, k1):  # type: ignore[no-untyped-def]
        f = c * (x * x + y * y + k1 * z * z) - 2.0 * z
        b = c * (x * u + y * v + k1 * z * w) - w
        a = c * (u * u + v * v + k1 * w * w)
        r = math.sqrt(b * b - a * f)
        if w < 0.0:
            r = -r
        return -(b + r) / a if b * r > 0.0 else f / (r - b)

    @numba.njit(inline="always", error_model="numpy")
    def turned(p, x, y, z):  # type: ignore[no-untyped-def]
        return (
            p[0] * x + p[1] * y + p[2] * z,
            p[3] * x + p[4] * y + p[5] * z,
            p[6] * x + p[7] * y + p[8] * z,
        )

    @numba.njit(parallel=True, error_model="numpy")
    def trace(conics, poses, coefficients, radius, position, direction, path, out_x, out_y):  # type: ignore[no-untyped-def]
        scale = 1.0 / radius
        for n in numba.prange(position.shape[1]):
            u, v, w = direction
            x, y, z = position[0, n], position[1, n], position[2, n]
            c, k1 = conics[0]
            way = conic_step(x, y, z, u, v, w, c, k1)
            x, y, z = x + way * u, y + way * v, z + way * w
            s, t = x * scale, y * scale
            height, slope_s, slope_t = coefficients[degree * (degree + 1) // 2], 0.0, 0.0
            for i in range(degree - 1, -1, -1):
                order = degree
                inner, inner_t = coefficients[order * (order + 1) // 2 + degree - i], 0.0
                for j in range(degree - i - 1, -1, -1):
                    inner_t = inner_t * t + inner
                    inner = inner * t + coefficients[(i + j) * (i + j + 1) // 2 + j]
                slope_s = slope_s * s + height
                slope_t = slope_t * s + inner_t
                height = height * s + inner
            a, b = slope_s * scale, slope_t * scale
            q = z - height
            h = 1.0 - c * k1 * q
            inverse = -0.5 / ((c * x + h * a) * u + (c * y + h * b) * v - h * w)
            step = (c * (x * x + y * y + k1 * q * q) - 2.0 * q) * inverse
            x, y, z = x + step * u, y + step * v, z + step * w
            q = z - height - (a * u + b * v) * step
            h = 1.0 - c * k1 * q
            nx, ny, nz = c * x + h * a, c * y + h * b, -h
            last = (c * (x * x + y * y + k1 * q * q) - 2.0 * q) * inverse
            x, y, z = x + last * u, y + last * v, z + last * w
            total = way + step + last
            twice, square = -2.0 * (nx * u + ny * v + nz * w), nx * nx + ny * ny + nz * nz
            u, v, w = square * u + twice * nx, square * v + twice * ny, square * w + twice * nz
            length = square
            x, y, z = x + poses[1, 9], y + poses[1, 10], z + poses[1, 11]
            c, k1 = conics[1]
            way = conic_step(x, y, z, u, v, w, c, k1)
            x, y, z = x + way * u, y + way * v, z + way * w
            total += way * length
            nx, ny, nz = c * x, c * y, c * k1 * z - 1.0
            twice, square = -2.0 * (nx * u + ny * v + nz * w), nx * nx + ny * ny + nz * nz
            u, v, w = square * u + twice * nx, square * v + twice * ny, square * w + twice * nz
            length *= square
            for surface in (2, 3):
                pose = poses[surface]
                u, v, w = turned(pose, u, v, w)
                x, y, z = turned(pose, x, y, z)
                x, y, z = x + pose[9], y + pose[10], z + pose[11]
                way = -z / w
                x, y, z = x + way * u, y + way * v, 0.0
                total += way * length
                w = -w if surface == 2 else w
            path[n], out_x[n], out_y[n] = total, x, y

    return trace  # type: ignore[no-any-return]
