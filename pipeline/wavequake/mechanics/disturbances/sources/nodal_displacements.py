"""Displacements of a surface's nodes that another program computed, as a disturbance of a study."""

import base64
import binascii
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from wavequake.errors import UserError
from wavequake.mechanics.disturbances.history_facts import MOST_INSTANTS, MOST_NUMBERS, MOST_TEXT
from wavequake.mechanics.disturbances.layout import Moved, SegmentLayout
from wavequake.mechanics.disturbances.motion import Motion, still
from wavequake.mechanics.disturbances.source import Optics, Randoms, Source, register
from wavequake.mechanics.disturbances.sources.element_history import own_axis
from wavequake.mechanics.nodal.results import FORMATS, NodalResults, read_results
from wavequake.mechanics.nodal.tables import COLUMNS, from_arrays, packed
from wavequake.mechanics.nodal.temperatures import thermal_displacements
from wavequake.mechanics.nodal.thermal import Thermal, thermal_of
from wavequake.prepared import prepared
from wavequake.user_files import read_npz

Array = NDArray[np.float64]


@register
class NodalDisplacements(Source):
    """Given displacements of a surface's nodes, over time or of one load case, the same in every case.

    The best rigid motion of the nodes moves the surface, and polynomials (and a grid, if asked for) are
    fitted to the rest. The instants of results over time are those of the file, so `instants` and
    `duration_s` are left out; a load case stays for all instants.
    """

    random: ClassVar[bool] = False
    independent: ClassVar = "element"
    fits: ClassVar[tuple[Optics, ...]] = ("surfaces",)

    model: Literal["nodal-displacements"] = "nodal-displacements"
    instants: int = Field(
        default=1,
        ge=1,
        le=MOST_INSTANTS,
        description="at which a load case stands still; of results over time left out",
    )
    surface: str = Field(description="whose nodes they are")
    file: str | None = Field(
        default=None,
        exclude=True,
        description=f"required: {FORMATS}; columns of a CSV are {COLUMNS}; an .npz holds nodes_mm (p, 3), "
        "displacements_um (n, p, 3) or temperatures_c (n, p), and perhaps time_s (n,) (read when the study "
        "is loaded)",
    )
    unit: str | None = Field(
        default=None, exclude=True, description="of length, where the file does not say it: mm, m, in, ..."
    )
    mesh: str | None = Field(
        default=None, exclude=True, description="deck with the nodes, where the file has none (.op2)"
    )
    file_npz: str | None = Field(default=None, description="what was read of the file, in base64")
    frame: Literal["surface", "system"] = Field(
        default="surface",
        description="axes of coordinates and displacements: those of the surface, from its vertex, or of the "
        "system",
    )
    off_mm: float | None = Field(
        default=None,
        gt=0,
        description="nodes that lie farther from the surface are left out; default: all must lie on it, to "
        "1 % of its radius",
    )
    thermal: Thermal | None = Field(
        default=None,
        exclude=True,
        description="the file holds temperatures: what they do to the body whose elements the mesh has",
    )
    load_case: int | None = Field(default=None, description="number of the one to take, where there are more")
    terms: int = Field(default=28, ge=3, le=231, description="Noll coefficients of the figure")
    grid: int = Field(
        default=0,
        ge=0,
        le=513,
        description="points along the sides of a grid for what the coefficients leave; 0: it is left out",
    )
    scale: float = Field(default=1.0, description="what the displacements are multiplied by")

    @model_validator(mode="before")
    @classmethod
    def _instants_are_the_steps(cls, given: Any) -> Any:
        if not isinstance(given, dict):
            return given
        text = given.get("file_npz")
        if not isinstance(text, str):
            raise ValueError(f"displacements of nodes need a file: {FORMATS}")
        try:
            results = read_embedded(text)
        except UserError as error:
            raise ValueError(f"the file {given.get('file') or 'of the study'}: {error}") from None
        if results.kind != "time":
            return given
        what = f"the file has {len(results.values)} instants"
        return given | own_axis(results.values, given, what)

    @model_validator(mode="after")
    def _one_load_case(self) -> Self:
        results = self.results
        if results.kind == "time":
            if self.load_case is not None:
                raise ValueError("load_case belongs to a file of load cases; this one has instants")
        elif len(results.values) > 1 or self.load_case is not None:
            known = [int(number) for number in results.values]
            if self.load_case not in known:
                some = ", ".join(map(str, known[:12])) + (", ..." if len(known) > 12 else "")
                raise ValueError(f"load_case must say which of the load cases {some} of the file is taken")
        if self.grid and self.grid < 4:
            raise ValueError("a grid has at least 4 points along a side")
        return self

    @property
    def of(self) -> tuple[str, ...]:
        """The surface, once."""
        return (self.surface,)

    @property
    def results(self) -> NodalResults:
        """What the file holds, SI units."""
        return read_embedded(self.file_npz or "")

    def displacements(self) -> Array:
        """Return those that are taken (n, p, 3), m; of a load case n = 1."""
        found = self.results
        chosen = found.motions
        if found.kind != "time" and self.load_case is not None:
            chosen = chosen[found.values == self.load_case]
        return np.asarray(chosen * self.scale)

    def draw(self, layout: SegmentLayout, time: Array, randoms: Randoms) -> Motion:
        """Return what was fitted to the nodes."""
        self.elements(layout)
        given = layout.moved.get(self.name)
        if given is None:
            raise UserError(
                f"The disturbance {self.name!r} is fitted to a surface, which this study has no means for; "
                "take the workflow system-disturbance."
            )
        if self.instants_of_file() is None:
            given = _repeated(given, len(time))
        grid = {} if given.grid is None else {self.surface: given.grid}
        return still(
            len(time),
            len(layout),
            rigid={self.surface: given.rigid},
            figure={self.surface: given.figure},
            grid=grid,
        )

    def instants_of_file(self) -> Array | None:
        """Return those of results over time."""
        found = self.results
        return found.values if found.kind == "time" else None

    def figure_terms(self, layout: SegmentLayout) -> dict[str, int]:
        """Return how many coefficients are fitted."""
        return {self.surface: self.terms}

    @classmethod
    def embedded(cls, entry: Mapping[str, Any], base: Path) -> dict[str, Any] | None:
        """Return what a file holds, as the arrays that a study keeps."""
        unit, mesh = (entry.get(key) if isinstance(entry.get(key), str) else None for key in ("unit", "mesh"))
        deck = base / mesh if mesh else None
        if entry.get("thermal") is None:
            found = read_results(base / entry["file"], unit, deck)
        else:
            found = thermal_displacements(base / entry["file"], unit, deck, thermal_of(entry["thermal"]))
        if found.motions.size > MOST_NUMBERS:
            raise UserError(
                f"{len(found.values)} steps of {len(found.labels)} nodes are {found.motions.size} numbers; "
                f"{MOST_NUMBERS} are possible: leave out nodes or steps"
            )
        text = base64.b64encode(
            packed(found.kind == "time", found.values, found.points, found.motions[..., :3], found.note)
        ).decode()
        if len(text) > MOST_TEXT:
            raise UserError(
                f"its displacements take {len(text) / 1e6:.0f} MB as text, {MOST_TEXT / 1e6:.0f} MB are "
                "possible: leave out nodes or steps"
            )
        return {"file_npz": text}


def _repeated(moved: Moved, instants: int) -> Moved:
    def times(values: Array) -> Array:
        return np.repeat(values, instants, axis=0)

    grid = None if moved.grid is None else times(moved.grid)
    return replace(moved, rigid=times(moved.rigid), figure=times(moved.figure), grid=grid)


@prepared(maxsize=4)
def read_embedded(text: str) -> NodalResults:
    """Return the results that a study keeps, from the base64 text of an .npz file.

    Raises
    ------
    UserError
        If it is no such file.
    """
    try:
        arrays = read_npz(base64.b64decode(text, validate=True), 9.0 * MOST_NUMBERS)
    except binascii.Error as error:
        raise UserError(f"it is no .npz file ({error})") from None
    written = from_arrays(arrays, "the file")
    motions = np.stack([step.values for step in written.steps])
    assert written.labels is not None
    assert written.points is not None
    kind = written.steps[0].kind
    values = np.array([step.value if kind == "time" else step.number for step in written.steps], dtype=float)
    return NodalResults(kind, values, written.labels, written.points, motions, written.note)
