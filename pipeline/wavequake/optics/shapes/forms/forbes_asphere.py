"""Forbes' aspheres: departures from a conic along its normal (Qbfs) or along the axis (Qcon).

They are sums of polynomials of which the slopes (Qbfs) or the heights (Qcon) are orthogonal.

Source: G. W. Forbes, "Shape specification for axially symmetric optical surfaces", Opt. Express 15, 5218
(2007), and "Robust, efficient computational methods for axially symmetric optical aspheres", Opt. Express 18,
19700 (2010).
"""

from dataclasses import dataclass
from typing import Any, Literal, Self

import numpy as np
from pydantic import Field, model_validator
from scipy.special import eval_jacobi

from wavequake.errors import UserError
from wavequake.kernels.trace.sequence import Form
from wavequake.optics.sections import FileSection
from wavequake.optics.shapes.heights import require_finite
from wavequake.optics.shapes.shape import SMALLEST_RADIUS, Array, Packed, SagAndSlopes, Shape, register
from wavequake.optics.zemax.rows import Row, fail, require_no_numbers, written

MAX_TERMS = 100
Kind = Literal["bfs", "con"]


class ForbesKeys(FileSection):
    """Keys of a study file."""

    qbfs_mm: tuple[float, ...] = Field(
        default=(), strict=False, max_length=MAX_TERMS, description="over the normalization radius"
    )
    qcon_mm: tuple[float, ...] = Field(
        default=(), strict=False, max_length=MAX_TERMS, description="over the normalization radius"
    )

    @model_validator(mode="after")
    def _one_kind(self) -> Self:
        if bool(self.qbfs_mm) == bool(self.qcon_mm):
            raise ValueError("give qbfs_mm or qcon_mm")
        return self


@register
@dataclass(frozen=True)
class ForbesAsphere(Shape):
    """A conic plus u^4 sum a_m Qcon_m(u^2), or plus u^2 (1 - u^2) / cos sum a_m Qbfs_m(u^2).

    u is the distance from the axis over ``normalization_radius``, the cosine that of the conic's slope (a
    sphere's in Forbes' papers; lens files have conics as well).
    """

    radius: float
    conic: float
    coefficients: tuple[float, ...]
    normalization_radius: float
    kind: Kind = "con"

    keys = ForbesKeys
    zemax = "QED_TYPE"

    def over_conic(self, x: Array, y: Array) -> SagAndSlopes:
        """Return the departure and its slopes by explicit recurrences of the polynomials."""
        square, norm = x**2 + y**2, self.normalization_radius**2
        w = square / norm
        value, rise = _sum(self.kind, self.coefficients, w)
        if self.kind == "con":
            height, by_w = w**2 * value, 2.0 * w * value + w**2 * rise
        else:
            bent = norm / self.radius**2 * np.array([self.conic, 1.0 + self.conic])
            with np.errstate(invalid="ignore", divide="ignore"):
                lean = np.sqrt((1.0 - bent[0] * w) / (1.0 - bent[1] * w))  # 1 / cos
                height = w * (1.0 - w) * value * lean
                by_w = ((1.0 - 2.0 * w) * value + w * (1.0 - w) * rise) * lean
                by_w = by_w + 0.5 * height * (bent[1] / (1.0 - bent[1] * w) - bent[0] / (1.0 - bent[0] * w))
        return height, by_w * 2.0 * x / norm, by_w * 2.0 * y / norm

    def packed(self) -> Packed:
        """Return the sum by Chebyshev polynomials, which takes one recurrence for both kinds."""
        if not self.coefficients:
            return Packed()
        series = np.polynomial.Chebyshev.interpolate(
            lambda w: _sum(self.kind, self.coefficients, w)[0], len(self.coefficients) - 1, [0.0, 1.0]
        )
        norm = 1.0 / self.normalization_radius**2
        if self.kind == "con":
            return Packed(form=Form("qcon", (norm, *series.coef.tolist())))
        squares = self.conic / self.radius**2, (1.0 + self.conic) / self.radius**2
        return Packed(form=Form("qbfs", (norm, *squares, *series.coef.tolist())))

    def require(self) -> None:
        """Raise UserError unless the numbers are finite and the normalization radius is positive."""
        require_finite(self, self.coefficients)
        if not SMALLEST_RADIUS <= self.normalization_radius < np.inf:
            raise UserError(
                f"the normalization radius of a {type(self).__name__} is {self.normalization_radius}; it "
                f"must be {SMALLEST_RADIUS:g} mm at least"
            )

    def added_curvature(self) -> float:
        """Return that of the departure from the best-fit sphere; that from a conic has none."""
        if self.kind == "con" or not self.coefficients:
            return 0.0
        return 2.0 * float(_sum("bfs", self.coefficients, np.zeros(1))[0][0]) / self.normalization_radius**2

    def words(self) -> str:
        """Return its name and its kind."""
        return f"{type(self).__name__} (Q{self.kind})"

    @classmethod
    def from_keys(cls, keys: Any, radius: float, conic: float, norm: float) -> Self:
        """Return the shape of a study file."""
        if np.isnan(norm):
            raise UserError("qbfs_mm and qcon_mm need normalization_radius_mm or semi_diameter_mm")
        if keys.qbfs_mm:
            return cls(radius, conic, keys.qbfs_mm, norm, "bfs")
        return cls(radius, conic, keys.qcon_mm, norm, "con")

    @classmethod
    def from_zemax(cls, row: Row, scale: float, radius: float, conic: float) -> Self:
        """Return the shape of a row of the type QED_TYPE: kind, number of terms, radius, terms."""
        require_no_numbers(row, "PARM", row.table("PARM"))
        data = row.table("XDAT")
        kind, count, norm = (data.get(k, 0.0) for k in (1, 2, 3))
        if kind not in (0.0, 1.0) or count != int(count) or not 0 <= count <= MAX_TERMS or not norm > 0.0:
            fail(
                row.line,
                f"{row.label} needs its kind (XDAT 1: 0 or 1), a number of terms up to {MAX_TERMS} (XDAT 2) "
                "and a positive normalization radius (XDAT 3)",
            )
        terms = tuple(data.get(4 + k, 0.0) * scale for k in range(int(count)))
        return cls(radius, conic, terms, norm * scale, "con" if kind else "bfs")

    def zemax_lines(self, where: str) -> list[str]:
        """Return kind, number of terms, radius and terms as extra data."""
        kind = float(self.kind == "con")
        numbers = [kind, float(len(self.coefficients)), self.normalization_radius, *self.coefficients]
        return [f"XDAT {k} {written(value)} 0 0" for k, value in enumerate(numbers, start=1)]


def _sum(kind: Kind, coefficients: tuple[float, ...], w: Array) -> tuple[Array, Array]:
    """Return sum a_m Q_m(w) and its derivative by w."""
    value, rise = np.zeros_like(w), np.zeros_like(w)
    if kind == "con":  # Jacobi polynomials (2007, Eq. 3.9)
        for m, a in enumerate(coefficients):
            value = value + a * eval_jacobi(m, 0, 4, 2.0 * w - 1.0)
            rise = rise + (a * (m + 5) * eval_jacobi(m - 1, 1, 5, 2.0 * w - 1.0) if m else 0.0)
        return value, rise
    # P_m = f_m Q_m + g_(m-1) Q_(m-1) + h_(m-2) Q_(m-2) with P_0 = 2, P_1 = 6 - 8 w and
    # P_(m+1) = (2 - 4 w) P_m - P_(m-1) (2010, Eq. A.5 to A.16); all with their derivatives.
    p = [(2.0 + 0.0 * w, 0.0 * w), (6.0 - 8.0 * w, -8.0 + 0.0 * w)]
    f, g, h = [2.0, np.sqrt(19.0) / 2.0], [-0.5], []
    q: list[tuple[Array, Array]] = []
    for m, a in enumerate(coefficients):
        if m > 1:
            h.append(-m * (m - 1) / (2.0 * f[m - 2]))
            g.append(-(1.0 + g[m - 2] * h[m - 2]) / f[m - 1])
            f.append(float(np.sqrt(m * (m + 1) + 3.0 - g[m - 1] ** 2 - h[m - 2] ** 2)))
            (one, slope), (two, before) = p[m - 1], p[m - 2]
            p.append(((2.0 - 4.0 * w) * one - two, (2.0 - 4.0 * w) * slope - 4.0 * one - before))
        rest = [part.copy() for part in p[m]]
        for k, factors in ((m - 1, g), (m - 2, h)):
            if k >= 0:
                rest = [part - factors[k] * other for part, other in zip(rest, q[k], strict=True)]
        q.append((rest[0] / f[m], rest[1] / f[m]))
        value, rise = value + a * q[m][0], rise + a * q[m][1]
    return value, rise
