"""Spare processes without Dask from loading it: xarray asks of most arrays whether they are Dask's."""

import sys


def spare_dask() -> None:
    """Have xarray answer by itself that nothing is of Dask as long as Dask is not loaded.

    It would load Dask to ask, a tenth of a second of every report. Nothing else changes.
    """
    from xarray.namedarray import utils

    asked = utils.is_dask_collection
    if asked.__module__ == __name__:
        return

    def is_dask_collection(x: object) -> bool:
        return "dask.base" in sys.modules and asked(x)

    utils.is_dask_collection = is_dask_collection  # type: ignore[assignment]
