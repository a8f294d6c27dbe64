"""Stores of several places (field points, wavelengths) as pages take them: a population for each."""

import itertools
import re

import numpy as np
import xarray as xr

from wavequake.workflows.mirrors.study import FULL

_DIMS = ("field", "wavelength")
_AT = re.compile(r"(.*) at (?:\([^()]*\) arcmin(?:, [0-9.e+]+ nm)?|[0-9.e+]+ nm)")


def place_names(dataset: xr.Dataset) -> list[str]:
    """Return what `by_field` adds to the names of disturbances, by place; one empty word without places."""
    names = [
        [one if isinstance(one, str) else f"{one:g} nm" for one in dataset[dim].to_numpy().tolist()]
        for dim in _DIMS
        if dim in dataset.dims
    ]
    return [f" at {', '.join(one)}" for one in itertools.product(*names)] if names else [""]


def by_field(dataset: xr.Dataset) -> xr.Dataset:
    """Return a store with its cases once for each place, which the disturbance's name says then.

    Numbers of these places themselves are left out. A store without them stays as it is. Of models of
    segments that are compared, the full one tells what a disturbance does.
    """
    if "reduction" in dataset.coords:
        dataset = dataset.isel(case=np.flatnonzero(dataset["reduction"].to_numpy() == FULL))
    places = [dim for dim in _DIMS if dim in dataset.dims]
    if not places:
        return dataset
    apart = [
        name
        for name, one in dataset.variables.items()
        if "case" not in one.dims and set(places) & set(one.dims)
    ]
    names = [str(name) for name in dataset["disturbance"].to_numpy()]
    bare = dataset.drop_vars(apart)
    each = itertools.product(*(range(dataset.sizes[dim]) for dim in places))
    parts = [
        bare.isel(dict(zip(places, place, strict=True))).assign_coords(
            disturbance=("case", np.array([name + words for name in names], dtype=object))
        )
        for place, words in zip(each, place_names(dataset), strict=True)
    ]
    found = xr.concat(
        parts, "case", data_vars="minimal", coords="minimal", compat="override", join="override"
    )
    # All places of a disturbance stand together, in the order of the disturbances.
    order = {name: place for place, name in reversed(list(enumerate(names)))}
    rank = np.argsort(np.tile([order[name] for name in names], len(parts)), kind="stable")
    return found.isel(case=rank)


def base_name(population: str) -> str:
    """Return the disturbance of a population of `by_field`."""
    match = _AT.fullmatch(population)
    return match[1] if match else population


def of_population(dataset: xr.Dataset, population: str) -> xr.Dataset:
    """Return the cases of a population, of which each stands in it once."""
    return dataset.isel(case=np.flatnonzero(dataset["disturbance"].to_numpy() == population))
