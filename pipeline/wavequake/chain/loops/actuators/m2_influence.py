"""A deformable M2 with actuators behind it, by their influence functions."""

import re
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from wavequake.chain.loops.actuators.m2_figure import MM_PER_NM
from wavequake.chain.loops.block import Actuator, register
from wavequake.chain.loops.light import Light
from wavequake.errors import UserError
from wavequake.mechanics.disturbances.history_table import read_columns
from wavequake.optics.polynomials.zernike import MOST_TERMS, annular_zernike
from wavequake.optics.rays.pupils import sunflower
from wavequake.optics.segments.telescope import M2
from wavequake.optics.systems.system import States
from wavequake.prepared import prepared

Array = NDArray[np.float64]
_KEY, _COLUMNS = "actuator", "z2, z3, ... (Noll coefficients of the surface, nm per nm of command)"
# Points per fitted term.
_POINTS = 20


@register
class InfluencedM2(Actuator):
    """Actuators behind M2: what each does to its surface, as Zernike terms over the beam's footprint.

    Without a file they stand on a square grid and their influence is Gaussian: 1 where an actuator is,
    `coupling` where its neighbour is (Hardy 1998, Adaptive Optics for Astronomical Telescopes, section 6.3).
    """

    model: Literal["m2-influence"] = "m2-influence"
    across: int = Field(default=9, ge=2, le=64, description="actuators across the footprint, without a file")
    coupling: float = Field(default=0.15, gt=0, lt=1, description="what an actuator's neighbour moves by")
    terms: int = Field(
        default=105, ge=3, le=MOST_TERMS, description="Noll terms by which surfaces are described"
    )
    file: str | None = Field(
        default=None,
        exclude=True,
        description=f"CSV of {_KEY} (its number, rising) and {_COLUMNS}; read when the study is loaded",
    )
    file_csv: str | None = Field(default=None, description="the text of that file")

    @model_validator(mode="after")
    def _file_can_be_read(self) -> "InfluencedM2":
        if self.file is not None and self.file_csv is None:
            raise ValueError(f"the file of the actuator {self.name!r} was not read")
        if self.file_csv is not None:
            try:
                last = _read(self.file_csv)[1].shape[1]
            except UserError as error:
                raise ValueError(f"the table {self.file or 'of the study'}: {error}") from None
            if last > self.terms:
                raise ValueError(
                    f"the table has terms up to z{last}, beyond terms = {self.terms} of {self.name!r}"
                )
        return self

    @property
    def mirror_terms(self) -> int:
        """Noll terms by which it deforms M2."""
        return self.terms

    def channels(self, light: Light) -> tuple[str, ...]:
        """Return the numbers of a file's actuators, or rows and columns as r3c4."""
        if self.file_csv is not None:
            return _read(self.file_csv)[0]
        rows, columns = _grid(self.across)[2:]
        return tuple(f"r{row}c{column}" for row, column in zip(rows, columns, strict=True))

    def surfaces(self) -> Array:
        """Return the Noll coefficients of the surface per command, (p, terms)."""
        if self.file_csv is None:
            return _gaussian(self.across, self.coupling, self.terms)
        given = _read(self.file_csv)[1]
        return np.pad(given, ((0, 0), (0, self.terms - given.shape[1])))

    def put(self, light: Light, states: States, positions: Array) -> None:
        """Add positions to the figure of M2."""
        figure = states.deformations[M2]
        assert figure is not None
        figure[: len(positions), : self.terms] += positions @ self.surfaces() * MM_PER_NM


def _grid(across: int) -> tuple[Array, Array, NDArray[np.int64], NDArray[np.int64]]:
    """Return x and y of the actuators within half a pitch of the footprint, their rows and columns."""
    pitch = 2.0 / (across - 1)
    rows, columns = (one.ravel() for one in np.indices((across, across)))
    x, y = columns * pitch - 1.0, rows * pitch - 1.0
    kept = np.hypot(x, y) <= 1.0 + 0.5 * pitch
    return x[kept], y[kept], rows[kept], columns[kept]


@prepared(maxsize=4)
def _gaussian(across: int, coupling: float, terms: int) -> Array:
    """Return the terms that are nearest to Gaussian influence functions over the footprint, (p, terms)."""
    x, y, *_ = _grid(across)
    at = sunflower(0.0, 1.0, _POINTS * terms)
    distance = (at.x[:, None] - x) ** 2 + (at.y[:, None] - y) ** 2
    heights = coupling ** (distance / (2.0 / (across - 1)) ** 2)
    return np.ascontiguousarray(np.linalg.lstsq(annular_zernike(at.x, at.y, terms), heights, rcond=None)[0].T)


@prepared(maxsize=4)
def _read(text: str) -> tuple[tuple[str, ...], Array]:
    """Return the numbers of actuators and the Noll coefficients of their surfaces, (p, terms).

    Raises
    ------
    UserError
        If the table cannot be read.
    """
    names, values = read_columns(text, _KEY, _COLUMNS, _require_terms)
    terms = [int(name[1:]) for name in names]
    found = np.zeros((len(values), max(terms)))
    found[:, np.array(terms) - 1] = values[:, 1:]
    return tuple(f"{one:g}" for one in values[:, 0]), found


def _require_terms(names: list[str]) -> None:
    for name in names:
        if not (re.fullmatch(r"z[1-9][0-9]{0,3}", name) and int(name[1:]) <= MOST_TERMS):
            raise UserError(f"the column {name!r} is no term; write {_COLUMNS}.")
    if twice := next((name for name in names if names.count(name) > 1), None):
        raise UserError(f"the column {twice!r} is there twice.")
