"""Datasets that are written and read whole, with digests: sensitivities, budgets."""

import os
import shutil
import uuid
from pathlib import Path
from typing import TYPE_CHECKING, Any

from wavequake.campaign.store import arrays
from wavequake.campaign.store.folder import write_errors_explained
from wavequake.campaign.store.journal import digest, flush
from wavequake.campaign.store.objects import ObjectPath, location
from wavequake.errors import StoreDamageError, UserError

if TYPE_CHECKING:
    import xarray as xr

# Dimensions, values and attributes of an array.
Labelled = tuple[tuple[str, ...], Any, dict[str, str]]


def write_dataset(made: "xr.Dataset", target: Path) -> None:
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


def read_dataset(target: Path, expected: int) -> "xr.Dataset":
    """Read what :func:`write_dataset` wrote with the attribute ``schema``.

    Raises
    ------
    UserError
        If it is of another schema than `expected`.
    StoreDamageError
        If it cannot be read.
    """
    import xarray as xr

    try:
        with arrays.damage_explained(target):
            found: xr.Dataset = xr.open_zarr(target, chunks=None, consolidated=False).load()
            schema, written = found.attrs["schema"], found.attrs.pop("digests")
        # A file that is missing or empty reads as fill values without any error.
        if schema == expected and written != _digests(found):
            raise StoreDamageError(f"{target} is damaged: its numbers are not those that were written.")
    except StoreDamageError as error:
        raise StoreDamageError(f"{error} Delete it and repeat the command.") from None
    if schema != expected:
        raise UserError(f"{target} has schema {schema}; this version of Wavequake reads schema {expected}.")
    ordered: xr.Dataset = found[sorted(map(str, found.data_vars))]
    return ordered


def _digests(values: "xr.Dataset") -> dict[str, str]:
    return {
        str(name): digest(variable.values)
        for name, variable in sorted(values.variables.items(), key=lambda pair: str(pair[0]))
    }
