"""Loads on bodies that were measured or computed: forces, moments and motions of the floor over time."""

from typing import Any, ClassVar, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from wavequake.errors import UserError
from wavequake.mechanics.assembly.answers import require_floor
from wavequake.mechanics.assembly.bodies import GROUND
from wavequake.mechanics.assembly.forced import forced
from wavequake.mechanics.assembly.plant import Plant
from wavequake.mechanics.disturbances.history_arrays import read_numbers, require_finite, require_instants
from wavequake.mechanics.disturbances.history_table import read_columns
from wavequake.mechanics.disturbances.plant_source import PlantSource
from wavequake.mechanics.disturbances.source import register, require_length
from wavequake.mechanics.disturbances.streams import Random
from wavequake.prepared import prepared

Array = NDArray[np.float64]

_LOADS = ("fx_n", "fy_n", "fz_n", "mx_n_m", "my_n_m", "mz_n_m")
_FLOOR = ("dx_um", "dy_um", "dz_um", "rx_urad", "ry_urad", "rz_urad")
_MICRO = 1e-6
COLUMNS = "BODY.NODE.fx_n, .fy_n, .fz_n, .mx_n_m, .my_n_m, .mz_n_m or ground.dx_um to .rz_urad"


@register
class LoadHistory(PlantSource):
    """Given forces at nodes and motions of the floor, joined by straight lines, the same in every case.

    All is at rest before the first row. Cases have instants of their own, which need not be those of rows.
    """

    random: ClassVar[bool] = False

    model: Literal["load-history"] = "load-history"
    file: str | None = Field(
        default=None,
        exclude=True,
        description="required: CSV of time_s and columns BODY.NODE.fx_n, .fy_n, .fz_n, .mx_n_m, .my_n_m, "
        ".mz_n_m (a rigid body needs no node) and ground.dx_um, .dy_um, .dz_um, .rx_urad, .ry_urad, "
        ".rz_urad, in the axes of the system; or an .npz of arrays of these names (read when the study is "
        "loaded)",
    )
    file_csv: str | None = Field(default=None, description="the text of that file")
    file_npz: str | None = Field(default=None, description="that file in base64")

    @model_validator(mode="before")
    @classmethod
    def _can_be_read(cls, given: Any) -> Any:
        if not isinstance(given, dict):
            return given
        table, arrays = given.get("file_csv"), given.get("file_npz")
        if not isinstance(table if arrays is None else arrays, str) or None not in (table, arrays):
            raise ValueError(f"a load-history needs one file, a CSV of time_s and columns such as {COLUMNS}")
        try:
            _read(table, arrays)
        except UserError as error:
            raise ValueError(f"the loads {given.get('file') or 'of the study'}: {error}") from None
        return given

    @model_validator(mode="after")
    def _lasts_long_enough(self) -> Self:
        require_length(self, self)
        return self

    def lasts_s(self) -> float:
        """Return the time of the last row."""
        return float(_read(self.file_csv, self.file_npz)[1][-1, 0])

    def answer(self, plant: Plant, time: Array, random: Random) -> Array:
        """Return the response from rest."""
        names, values = _read(self.file_csv, self.file_npz)
        loads = np.zeros((len(values), plant.modal.inputs.shape[1]))
        for name, column in zip(names, values[:, 1:].T, strict=True):
            where, _, kind = name.rpartition(".")
            if kind in _FLOOR:
                require_floor(plant, f"the disturbance {self.name!r}")
                loads[:, _FLOOR.index(kind)] = column * _MICRO
            else:
                axis = _LOADS.index(kind)
                loads[:, self.place(plant, where, "force" if axis < 3 else "moment").start + axis % 3] = (
                    column
                )
        return forced(plant, values[:, 0], loads, time)

    @classmethod
    def file_key(cls, file: str) -> tuple[str, Literal["text", "base64"]]:
        """Return where tables and arrays go."""
        return ("file_npz", "base64") if file.lower().endswith(".npz") else ("file_csv", "text")


@prepared(maxsize=4)
def _read(table: str | None, arrays: str | None) -> tuple[list[str], Array]:
    """Return the names of the columns beside time_s, and the rows (k, 1 + columns), time_s first."""
    if arrays is None:
        return read_columns(table or "", "time_s", COLUMNS, _require_known)
    found = read_numbers(arrays)
    time = found.pop("time_s", np.zeros(0))
    require_instants(time)
    names = list(found)
    _require_known(names)
    for name, one in found.items():
        if one.shape != time.shape:
            raise UserError(f"{name!r} has the shape {one.shape}, but time_s has {time.shape}.")
        require_finite(name, one)
    return names, np.column_stack([time, *found.values()])


def _require_known(names: list[str]) -> None:
    for name in names:
        where, _, kind = name.rpartition(".")
        if not where or kind not in (_FLOOR if where == GROUND else _LOADS):
            raise UserError(f"the column {name!r} is no load; write {COLUMNS}.")
        if names.count(name) > 1:
            raise UserError(f"there are two columns {name!r}; keep one of them.")
    if not names:
        raise UserError(f"there is nothing beside time_s that acts; add {COLUMNS}.")
