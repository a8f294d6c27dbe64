"""Media with a gradient in .zmx files: the surfaces Gradient 1, 2, 3 and 5.

Their parameters are the largest step, the index at the vertex (of Gradient 2: its square) and coefficients.
With r² = x² + y² about the vertex of the surface that begins the medium:

- Gradient 1 (GRINSUR1): n = n0 + nr2 r² + nr1 r
- Gradient 2 (GRINSUR2): n² = n0 + nr2 r² + nr4 r⁴ + ... + nr12 r¹²
- Gradient 3 (GRINSUR3): n = n0 + nr2 r² + nr4 r⁴ + nr6 r⁶ + nz1 z + nz2 z² + nz3 z³
- Gradient 5 (GRINSUR5): n = n0 + nr2 r² + nr4 r⁴ + nz1 z + nz2 z² + nz3 z³ + nz4 z⁴, and two tilts
- Gradient 9 (GRINSUR9): a step, two tilts, and a material by name, n = n0 (1 - A r² / 2) with
  n0 = B + C / w² and A = (K0 + K1 / w² + K2 / w⁴)² of the wavelength in µm; its maker gives these numbers

`GradientIndex` holds n² as a sum of powers of r² and of z, so a medium that varies along and across, whose
square mixes both, is refused. The step is chosen anew: it says how another program works.
"""

from dataclasses import dataclass

import numpy as np

from wavequake.errors import UserError
from wavequake.optics.media.glasses import Medium, constant
from wavequake.optics.media.gradients import SELFOC, GradientIndex, default_step
from wavequake.optics.shapes.shapes import Conic
from wavequake.optics.systems.system import Surface
from wavequake.optics.zemax.rows import Row, fail, require_no_numbers, written

NAME = "gradient"
ROD = "GRINSUR9"


@dataclass(frozen=True)
class _Form:
    """Which parameters hold the powers r², r⁴, ... and z, z², ...; all others must be zero."""

    radial: range
    axial: range
    squared: bool = False


GRADIENTS = {
    "GRINSUR1": _Form(range(3, 4), range(0)),
    "GRINSUR2": _Form(range(3, 9), range(0), squared=True),
    "GRINSUR3": _Form(range(3, 6), range(6, 9)),
    "GRINSUR5": _Form(range(3, 5), range(5, 9)),
}


def gradient(row: Row, scale: float) -> Medium | GradientIndex:
    """Return the medium that a gradient surface begins; `scale` is mm per unit of the file."""
    form, given = GRADIENTS[row.type], row.table("PARM")
    known = (1, 2, *form.radial, *form.axial)
    require_no_numbers(row, "PARM", {k: value for k, value in given.items() if k not in known})
    base = given.get(2, 0.0)
    if not base > 0.0:
        fail(row.line, f"{row.label} begins a medium of the index n0 = {base:g} (parameter 2), not positive")
    across = _trimmed([given.get(k, 0.0) * scale ** (-2 * power) for power, k in enumerate(form.radial, 1)])
    along = _trimmed([given.get(k, 0.0) * scale**-power for power, k in enumerate(form.axial, 1)])
    if across and along:
        fail(
            row.line,
            f"{row.label} begins a medium whose index varies along and across the axis; one of both is "
            "supported",
        )
    if not (across or along):
        return constant(base**0.5 if form.squared else base)
    if form.squared:
        return GradientIndex(NAME, constant(base**0.5), across)
    radial, axial = (_squared(base, numbers) for numbers in (across, along))
    return GradientIndex(NAME, constant(base), radial, axial)


def rod(row: Row, medium: Medium, scale: float) -> GradientIndex:
    """Return the medium that a surface GRINSUR9 begins, of a material with the formula "selfoc".

    Raises
    ------
    UserError
        If the glass is no such material, the surface is tilted, or lengths of the file are not mm.
    """
    require_no_numbers(row, "PARM", {k: value for k, value in row.table("PARM").items() if k != 1})
    if medium.formula != SELFOC:
        fail(row.line, f"{row.label} begins a rod of {medium.name}, which is a glass without a gradient")
    if scale != 1.0:
        fail(row.line, f"{row.label} begins a rod, whose numbers are those of a file in mm")
    return GradientIndex(medium.name, medium)


def _trimmed(numbers: list[float]) -> tuple[float, ...]:
    """Return numbers up to the last that is not zero."""
    count = max((k for k, number in enumerate(numbers, start=1) if number), default=0)
    return tuple(numbers[:count])


def _squared(base: float, numbers: tuple[float, ...]) -> tuple[float, ...]:
    """Return what the square of base + numbers[0] t + numbers[1] t² + ... adds to that of base."""
    whole = np.array([base, *numbers])
    return tuple(np.convolve(whole, whole)[1:].tolist())


def gradient_lines(surface: Surface, medium: GradientIndex, begins: Surface, wavelength: float) -> list[str]:
    """Return type and parameters of a surface with a gradient behind it.

    Parameters
    ----------
    surface : Surface
    medium : GradientIndex
    begins : Surface
        Where the medium begins: the surface itself, or one before it.
    wavelength : float
        mm; the step is chosen for it.

    Raises
    ------
    UserError
        If the format has no such medium.
    """
    if surface.action == "reflect":
        raise UserError(
            f"The mirror {surface.name} stands in {medium.name}, whose index varies: a lens file cannot "
            "hold that."
        )
    if not isinstance(surface.shape, Conic):
        raise UserError(
            f"{surface.name} has {medium.name} behind it, whose index varies: in a lens file that needs a "
            "plane, a sphere or a conic."
        )
    _require_same_axis(surface, medium, begins)
    if medium.base.formula != "constant":
        raise UserError(
            f"The medium {medium.name} behind {surface.name} has a gradient and dispersion, of which a lens "
            "file holds one."
        )
    kind, base, numbers = _form(surface.name, medium)
    step = default_step(medium, wavelength) if medium.step is None else medium.step
    values = [(1, step), (2, base), *((k, numbers[k]) for k in sorted(numbers))]
    return [f"TYPE {kind}", *(f"PARM {k} {written(value)}" for k, value in values)]


def _require_same_axis(surface: Surface, medium: GradientIndex, begins: Surface) -> None:
    """Refuse a surface about whose vertex, where a file starts the medium anew, it varies otherwise."""
    away = begins.rotation.T @ (surface.position - begins.position)
    turned = begins.rotation.T @ surface.rotation[:, 2]
    along = medium.axial and surface is not begins
    if along or np.hypot(*away[:2]) > 1e-9 or np.hypot(*turned[:2]) > 1e-12:
        raise UserError(
            f"{surface.name} stands in {medium.name}, whose index varies about {begins.name}: a lens file "
            "takes it as varying about each surface."
        )


def _form(name: str, medium: GradientIndex) -> tuple[str, float, dict[int, float]]:
    """Return the type, its second parameter and the others that are not zero."""
    base = medium.base.coefficients[0]
    radial, axial = _trimmed(list(medium.radial)), _trimmed(list(medium.axial))
    places = GRADIENTS["GRINSUR2"].radial
    if not axial and len(radial) <= len(places):
        return "GRINSUR2", base**2, dict(zip(places, radial, strict=False))
    places = GRADIENTS["GRINSUR3"].axial
    root = None if radial else _root(base, axial, len(places))
    if root is not None:
        return "GRINSUR3", base, dict(zip(places, root, strict=True))
    raise UserError(
        f"The index of {medium.name} behind {name} is neither n² = n0² + a r² + ... + f r¹² nor "
        "n = n0 + a z + b z² + c z³, which a lens file can hold."
    )


def _root(base: float, axial: tuple[float, ...], count: int) -> tuple[float, ...] | None:
    """Return the polynomial that adds to base, if its square is what is given; None if there is none."""
    wanted = np.zeros(max(len(axial), 2 * count))
    wanted[: len(axial)] = axial
    root: list[float] = []
    for k in range(count):
        mixed = sum(root[i] * root[k - 1 - i] for i in range(k))
        root.append((float(wanted[k]) - mixed) / (2.0 * base))
    away = wanted - np.pad(_squared(base, tuple(root)), (0, len(wanted) - 2 * count))
    powers = np.arange(1, len(wanted) + 1)
    length = 1.0 / ((np.abs(wanted) / base**2) ** (1.0 / powers)).max()  # on which the index changes
    return tuple(root) if (np.abs(away) * length**powers <= 1e-14 * base**2).all() else None
