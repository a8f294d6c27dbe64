"""Datasets that are written and read whole, with digests: sensitivities, budgets.

Between disk and xarray they are :class:`Arrays`: loading xarray takes longer than some commands that need no
more than numbers and their labels.
"""

import os
import shutil
import uuid
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from wavequake.campaign.store import arrays
from wavequake.campaign.store.folder import write_errors_explained
from wavequake.campaign.store.journal import digest, flush
from wavequake.campaign.store.objects import ObjectPath, location
from wavequake.errors import StoreDamageError, UserError

if TYPE_CHECKING:
    import xarray as xr


class Labelled(NamedTuple):
    """Dimensions, values and attributes of an array."""

    dims: tuple[str, ...]
    values: Any
    attrs: Mapping[str, Any]


@dataclass(frozen=True)
class Arrays:
    """Labelled arrays by name, those of coordinates among them, and the attributes of the whole."""

    variables: Mapping[str, Labelled]
    attrs: dict[str, Any]

    def __getitem__(self, name: str) -> Labelled:
        """Return an array by its name."""
        return self.variables[name]

    def __contains__(self, name: str) -> bool:
        """Say whether there is an array of a name."""
        return name in self.variables

    def dataset(self) -> "xr.Dataset":
        """Return the same as xarray's, variables in the order of their names."""
        import xarray as xr

        return xr.Dataset({name: self[name] for name in sorted(self.variables)}, attrs=self.attrs)


def write_dataset(made: "Arrays | xr.Dataset", target: Path) -> None:
    """Write a dataset to `target`, or nothing."""
    if isinstance(location(target), ObjectPath):
        raise UserError(f"{location(target)} would be in object storage: give the folder of a store.")
    partial = target.with_name(f"{target.name}.partial-{uuid.uuid4().hex}")
    with write_errors_explained(target.parent):
        target.parent.mkdir(parents=True, exist_ok=True)
        try:
            attrs = {str(key): value for key, value in made.attrs.items()}
            group = arrays.create_group(partial, {**attrs, "digests": _digests(made)})
            for name, variable in made.variables.items():
                dims = tuple(map(str, variable.dims))
                arrays.create_fixed(group, str(name), dims, variable.values, variable.attrs)
            arrays.consolidate(partial)
            if target.exists():  # of the same study, but with other figure terms
                shutil.rmtree(target)
            try:
                os.replace(partial, target)
            except OSError:
                if not target.exists():
                    raise  # otherwise another process wrote the same numbers meanwhile
            flush(target.parent)
        finally:
            shutil.rmtree(partial, ignore_errors=True)


def read_dataset(target: Path, expected: int, absent: str = "") -> "xr.Dataset":
    """Read what :func:`write_dataset` wrote, as :func:`read_arrays` does."""
    return read_arrays(target, expected, absent).dataset()


def read_arrays(target: Path, expected: int, absent: str = "") -> Arrays:
    """Read what :func:`write_dataset` wrote with the attribute ``schema``.

    Raises
    ------
    UserError
        If it is of another schema than `expected`; or not there, and `absent` says what to do then.
    StoreDamageError
        If it cannot be read.
    """
    if absent and not target.exists():
        raise UserError(absent)
    try:
        with arrays.damage_explained(target):
            found = _read(target)
            schema, written = found.attrs["schema"], found.attrs.pop("digests")
        # A file that is missing or empty reads as fill values without any error.
        if schema == expected and written != _digests(found):
            raise StoreDamageError(f"{target} is damaged: its numbers are not those that were written.")
    except StoreDamageError as error:
        raise StoreDamageError(f"{error} Delete it and repeat the command.") from None
    if schema != expected:
        raise UserError(f"{target} has schema {schema}; this version of Wavequake reads schema {expected}.")
    return found


def _read(target: Path) -> Arrays:
    group = arrays.open_group(target, read_only=True)
    variables = {}
    with arrays.missing_reads_as_fill():
        for name, array in group.arrays():
            values = np.asarray(array[...])
            texts = values.dtype.kind in "OUT"
            dims = tuple(map(str, getattr(array.metadata, "dimension_names", None) or ()))
            variables[name] = Labelled(dims, values.astype(object) if texts else values, dict(array.attrs))
    return Arrays(variables, dict(group.attrs))


def _digests(values: "Arrays | xr.Dataset") -> dict[str, str]:
    variables: Mapping[Any, Any] = values.variables
    return {str(name): digest(variables[name].values) for name in sorted(variables, key=str)}
