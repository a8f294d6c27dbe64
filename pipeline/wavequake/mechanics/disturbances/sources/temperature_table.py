"""Motions and figures that depend on temperature: a table of them, and how the temperature goes."""

from typing import Annotated, Any, ClassVar, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from wavequake.errors import UserError
from wavequake.mechanics.disturbances.history_facts import (
    COLUMNS,
    ElementHistory,
    history_from,
    place_of,
    require_distinct,
)
from wavequake.mechanics.disturbances.history_table import read_columns
from wavequake.mechanics.disturbances.layout import SegmentLayout
from wavequake.mechanics.disturbances.motion import Motion, still
from wavequake.mechanics.disturbances.source import Randoms, Source, register
from wavequake.prepared import prepared

Array = NDArray[np.float64]
Celsius = Annotated[float, Field(ge=-273.15, le=5000)]
_KEY = "temperature_c"


@register
class TemperatureTable(Source):
    """Motions and figures by a table over temperature, less those at which all was aligned.

    The temperature goes evenly from the first one to the second in its own ``duration_s``, where it stays in
    a longer combination, with an offset that is the same in all of a case; the table is linear between rows.
    """

    stratified: ClassVar[bool] = False

    model: Literal["temperature-table"] = "temperature-table"
    temperature_c: Annotated[tuple[Celsius, Celsius], Field(strict=False)] = Field(
        description="of the first and the last instant"
    )
    aligned_c: Celsius = Field(description="temperature at which the optics are as designed")
    spread_c: float = Field(
        default=0.0, ge=0, le=1000, description="largest offset of a case; uniform between minus and plus it"
    )
    file: str | None = Field(
        default=None,
        exclude=True,
        description="required: CSV of temperature_c and columns SURFACE.dx_um, .dy_um, .dz_um, .rx_urad, "
        ".ry_urad, .rz_urad and SURFACE.zN_nm, as a surface-history has (read when the study is loaded)",
    )
    file_csv: str = Field(description="the text of that file")

    @model_validator(mode="before")
    @classmethod
    def _can_be_read(cls, given: Any) -> Any:
        if not isinstance(given, dict):
            return given
        if not isinstance(given.get("file_csv"), str):
            raise ValueError(
                f"a temperature-table needs its file, a CSV of {_KEY} and columns such as {COLUMNS}"
            )
        try:
            _read(given["file_csv"])
        except UserError as error:
            raise ValueError(f"the table {given.get('file') or 'of the study'}: {error}") from None
        return given

    @model_validator(mode="after")
    def _stays_in_the_table(self) -> Self:
        known = _read(self.file_csv).time
        low, high = min(self.temperature_c) - self.spread_c, max(self.temperature_c) + self.spread_c
        for wanted in (low, high, self.aligned_c):
            if not known[0] <= wanted <= known[-1]:
                raise ValueError(
                    f"the table of {self.name!r} goes from {known[0]:g} to {known[-1]:g} degrees Celsius, "
                    f"but {wanted:g} is asked for; add rows"
                )
        return self

    @property
    def of(self) -> tuple[str, ...]:
        """Names of the surfaces, bodies and segments that move or deform."""
        return _read(self.file_csv).names

    def draw(self, layout: SegmentLayout, time: Array, randoms: Randoms) -> Motion:
        """Draw one realization."""
        self.elements(layout)  # the names are known
        table = _read(self.file_csv)
        offset = self.spread_c * (2.0 * float(randoms(self.name).random(1)[0]) - 1.0)
        first, last = self.temperature_c
        step = self.duration_s / self.instants
        share = np.clip((time - step) / max(self.duration_s - step, step), 0.0, 1.0)
        at = first + (last - first) * share + offset

        def less(values: Array) -> Array:
            both = np.append(at, self.aligned_c)
            found = np.stack([np.interp(both, table.time, column) for column in values.T], axis=1)
            return np.asarray(found[:-1] - found[-1])

        rigid = {name: less(values) for name, values in table.rigid.items()}
        figure = {name: less(values) for name, values in table.figure.items()}
        return still(len(time), len(layout), rigid=rigid, figure=figure)

    def figure_terms(self, layout: SegmentLayout) -> dict[str, int]:
        """Return how many coefficients the table has, by surface."""
        return {name: form.shape[1] for name, form in _read(self.file_csv).figure.items()}


@prepared(maxsize=4)
def _read(text: str) -> ElementHistory:
    """Return what a table holds, with temperatures in the place of instants."""
    names, values = read_columns(text, _KEY, COLUMNS, _require_known)
    return history_from(values[:, 0].copy(), [place_of(name) for name in names], values[:, 1:], {})


def _require_known(names: list[str]) -> None:
    places = [place_of(name) for name in names]
    if any(kind == "sight" for _, kind, _ in places):
        raise UserError(f"light does not turn with temperature; write {COLUMNS}.")
    require_distinct(names, places)
