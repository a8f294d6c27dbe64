"""The cases of a store as a grid: a dimension for each label that tells them apart."""

from typing import TYPE_CHECKING

import numpy as np

from wavequake.errors import UserError

if TYPE_CHECKING:
    import xarray as xr


def unstack(dataset: "xr.Dataset", *labels: str) -> "xr.Dataset":
    """Return a dataset whose cases are a grid: ``ds.peak.sel(disturbance="wind", thickness_m=0.02)``.

    Parameters
    ----------
    dataset : xarray.Dataset
        Of :func:`wavequake.open_store`.
    labels : str, optional
        Labels of cases (coordinates along ``case``), or numbers that each case has one of, such as ``order``,
        that become dimensions; together they name every case once. By default the last labels, swept keys
        first, that do and of which none can be left out.

    Returns
    -------
    xarray.Dataset
        What no case is at stays NaN. Labels that are no dimension are variables. Every dimension has a
        coordinate, from 0 where the store has none.

    Raises
    ------
    UserError
        If a label is unknown, or several cases have the same labels.

    Examples
    --------
    >>> grid = unstack(open_store("runs/thickness"))       # doctest: +SKIP
    >>> grid.eps_opt.sel(variant="craigb36").plot(x="thickness_m")  # doctest: +SKIP
    """
    known = [str(name) for name in dataset.coords if dataset[name].dims == ("case",) and name != "case"]
    numbers = [name for name in labels if name in dataset.data_vars and dataset[name].dims == ("case",)]
    for name in labels:
        if name not in (*known, *numbers):
            raise UserError(f"{name!r} is no label of cases; there are {', '.join(known)}.")
    dataset = dataset.set_coords(numbers)
    chosen = list(labels) or _needed(dataset, known)
    if len(_rows(dataset, chosen)) < dataset.sizes["case"]:
        raise UserError(
            f"Several cases have the same {' and '.join(chosen)}; give more labels of {', '.join(known)}."
        )
    texts = [name for name in dataset.variables if dataset[name].dims == ("case",) and _text(dataset[name])]
    # Indices of pandas take no texts of variable length, nor do gaps of the grid.
    dataset = dataset.assign({name: ("case", dataset[name].to_numpy().astype(object)) for name in texts})
    others = [name for name in known if name not in chosen]
    labelled = dataset.drop_vars("case", errors="ignore").reset_coords(others)
    grid: xr.Dataset = labelled.set_index(case=chosen).unstack("case")
    bare = {name: np.arange(size) for name, size in grid.sizes.items() if name not in grid.coords}
    return grid.assign_coords(bare)


def _needed(dataset: "xr.Dataset", known: list[str]) -> list[str]:
    chosen = [name for name in known if len(_rows(dataset, [name])) > 1]
    for name in list(chosen):
        fewer = [one for one in chosen if one != name]
        if fewer and len(_rows(dataset, fewer)) == dataset.sizes["case"]:
            chosen = fewer
    return chosen or known[:1]


def _text(label: "xr.DataArray") -> bool:
    return label.dtype.kind not in "biuf"


def _rows(dataset: "xr.Dataset", names: list[str]) -> set[tuple[str, ...]]:
    return set(zip(*(map(str, dataset[name].to_numpy().tolist()) for name in names), strict=True))
