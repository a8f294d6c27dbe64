"""Motions and figures over time that were computed or measured elsewhere, as a disturbance of a study."""

from dataclasses import replace
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from wavequake.errors import UserError
from wavequake.mechanics.disturbances.history_arrays import read_arrays
from wavequake.mechanics.disturbances.history_facts import (
    COLUMNS,
    MOST_INSTANTS,
    ElementHistory,
    GridHistory,
)
from wavequake.mechanics.disturbances.history_table import read_table
from wavequake.mechanics.disturbances.layout import SegmentLayout
from wavequake.mechanics.disturbances.motion import Motion, still
from wavequake.mechanics.disturbances.source import Randoms, Source, register

Array = NDArray[np.float64]

# Instants this much of the longest time apart are one: a program's rounding.
_SAME = 1e-9


@register
class SurfaceHistory(Source):
    """Given motion and figures of surfaces and bodies over time, the same in every case.

    The instants are those of the file, so `instants` and `duration_s` are left out.
    """

    independent: ClassVar = "element"

    model: Literal["surface-history"] = "surface-history"
    instants: int = Field(default=16, ge=1, le=MOST_INSTANTS, description="left out: the rows of the file")
    file: str | None = Field(
        default=None,
        exclude=True,
        description="required: CSV of time_s and columns SURFACE.dx_um, .dy_um, .dz_um, .rx_urad, .ry_urad, "
        ".rz_urad, SURFACE.zN_nm (Noll coefficient N of its figure) and line_of_sight.x_mas, .y_mas, for any "
        "surface, body or segment; or an .npz of arrays of these names, and of SURFACE.grid_nm (instants, "
        "rows, columns) with SURFACE.grid_spacing_mm (read when the study is loaded)",
    )
    file_csv: str | None = Field(default=None, description="the text of that file")
    file_npz: str | None = Field(default=None, description="that file in base64")

    @model_validator(mode="before")
    @classmethod
    def _instants_are_the_rows(cls, given: Any) -> Any:
        if not isinstance(given, dict):
            return given
        table, arrays = given.get("file_csv"), given.get("file_npz")
        if not isinstance(table if arrays is None else arrays, str) or None not in (table, arrays):
            raise ValueError(f"a history needs one file, a CSV of time_s and columns such as {COLUMNS}")
        try:
            time = _read(table, arrays).time
        except UserError as error:
            raise ValueError(f"the history {given.get('file') or 'of the study'}: {error}") from None
        return given | own_axis(time, given, f"the history has {len(time)} rows")

    @property
    def of(self) -> tuple[str, ...]:
        """Names of the surfaces, bodies and segments that move or deform."""
        return history_of(self).names

    def draw(self, layout: SegmentLayout, time: Array, randoms: Randoms) -> Motion:
        """Return what is given."""
        self.elements(layout)  # the names are known
        found = history_of(self)
        heights = {name: one.heights for name, one in found.grid.items()}
        motion = still(len(time), len(layout), rigid=found.rigid, figure=found.figure, grid=heights)
        return replace(motion, mount=found.sight)

    def instants_of_file(self) -> Array:
        """Return those of the file."""
        return history_of(self).time

    def figure_terms(self, layout: SegmentLayout) -> dict[str, int]:
        """Return how many coefficients are given, by surface."""
        return {name: form.shape[1] for name, form in history_of(self).figure.items()}

    def figure_grids(self) -> dict[str, GridHistory]:
        """Return the grids that are given, by surface."""
        return history_of(self).grid

    @classmethod
    def file_key(cls, file: str) -> tuple[str, Literal["text", "base64"]]:
        """Return where tables and arrays go."""
        return ("file_npz", "base64") if file.lower().endswith(".npz") else ("file_csv", "text")


def own_axis(time: Array, given: dict[str, Any], what: str) -> dict[str, Any]:
    """Return `instants` and `duration_s` of what has the instants `time`.

    Raises
    ------
    ValueError
        If others are given.
    """
    own = {"instants": len(time), "duration_s": float(time[-1]) if time[-1] > 0.0 else 0.1}
    other = next((key for key, value in own.items() if given.get(key, value) != value), None)
    if other is not None:
        raise ValueError(f"{what}, which are its instants: leave {other} = {given[other]} out")
    return own


def history_of(parameters: SurfaceHistory) -> ElementHistory:
    """Return what a history holds."""
    return _read(parameters.file_csv, parameters.file_npz)


def _read(table: str | None, arrays: str | None) -> ElementHistory:
    return read_arrays(arrays) if arrays is not None else read_table(table or "")


def same_instants(one: Array, other: Array) -> bool:
    """Return whether two time axes are the same but for rounding."""
    return one.shape == other.shape and bool(np.all(np.abs(one - other) <= _SAME * np.abs(one).max()))
