"""What of a store is judged: a variable, or what it is at some labels, as ``deviation[controller=FF]``."""

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from wavequake.campaign.contract import Template
from wavequake.campaign.statistics.blocks import blocks
from wavequake.errors import UserError

if TYPE_CHECKING:
    import xarray as xr

Dims = tuple[str, ...]
Labels = Mapping[str, NDArray[Any]]

WORST_OF = ("field", "wavelength")  # of these the worst value counts, unless one is chosen
_OVER_TIME = ("time", "statistic")
_IMAGE = {"y", "x"}
# Labels of cases that are drawn from different distributions.
_POPULATIONS = ("disturbance", "springs", "model", "variant", "reduction")
_FORM = re.compile(r"\s*(\w+)\s*(?:\[(.*)\])?\s*")
_SHOWN = 12  # labels in a sentence


@dataclass(frozen=True)
class Judged:
    """A variable, the places along dimensions that were chosen, and the dimensions judged label by label."""

    variable: str
    chosen: Mapping[str, int]
    each: Mapping[str, tuple[str, ...]]


def judged_of_template(text: str, template: Template) -> Judged:
    """Return what `text` names in a store that is to be made; raises as :func:`judged_in`."""
    variables = {
        name: one.dims
        for name, one in template.per_case.items()
        if one.dtype.startswith("float") and not one.coordinate
    }
    labels = {name: values for name, (dims, values, _) in template.fixed.items() if dims == (name,)}
    return _judged(text, variables, labels)


def judged_in(text: str, dataset: "xr.Dataset") -> Judged:
    """Return what `text` names in a store: ``wfe_rms``, ``peak[controller=rigid]``, ``zernike[noll=4]``.

    Raises
    ------
    UserError
        If the text has another form, there is no such variable, dimension or label, or a dimension of numbers
        is not chosen from.
    """
    return _judged(text, *_stored(dataset))


def judgeable(dataset: "xr.Dataset") -> list[str]:
    """Return the variables of a store that can be judged."""
    return [*_valid(*_stored(dataset))]


def _stored(dataset: "xr.Dataset") -> tuple[dict[str, Dims], Labels]:
    variables = {
        str(name): tuple(str(dim) for dim in one.dims if dim != "case")
        for name, one in dataset.data_vars.items()
        if one.dtype.kind == "f" and "case" in one.dims
    }
    labels = {
        str(dim): dataset[dim].to_numpy() for dim in dataset.dims if dim in dataset.coords and dim != "case"
    }
    return variables, labels


def _judged(text: str, variables: Mapping[str, Dims], labels: Labels) -> Judged:
    match = _FORM.fullmatch(text)
    if not match:
        raise UserError(f"{text!r} names nothing to judge; write a variable, or variable[dimension=label].")
    valid = _valid(variables, labels)
    if match[1] not in valid:
        raise UserError(f"There is no {match[1]!r} to judge; use one of {', '.join(valid)}.")
    dims = valid[match[1]]
    among = {dim: labels[dim] for dim in dims if dim in labels and dim not in _OVER_TIME}
    chosen = _chosen(match[1], match[2], among)
    left = {dim: values for dim, values in among.items() if dim not in (*chosen, "axis", *WORST_OF)}
    for dim, values in left.items():
        if not _is_text(values):
            raise UserError(
                f"{match[1]!r} has a number for each {dim}; choose one, as "
                f"{match[1]}[{dim}={_written(values[0])}]."
            )
    return Judged(match[1], chosen, {dim: tuple(map(str, values)) for dim, values in left.items()})


def _valid(variables: Mapping[str, Dims], labels: Labels) -> dict[str, Dims]:
    free = {"axis", *_OVER_TIME, *WORST_OF}
    valid = {
        name: dims
        for name, dims in variables.items()
        if not {*dims} >= _IMAGE and all(dim in free or dim in labels for dim in dims)
    }
    if not valid:
        raise UserError("Nothing here is one number per case, instant or label, which could be judged.")
    return valid


def _chosen(variable: str, text: str | None, among: Labels) -> dict[str, int]:
    """Return the place along each dimension that ``dimension=label, ...`` chooses."""
    if text is None:
        return {}
    if not text.strip():
        last = [f"{variable}[{dim}={_written(values[0])}]" for dim, values in among.items()][-1:]
        right = f"choose one, as {last[0]}" if last else f"write {variable} alone"
        raise UserError(f"{variable}[]: there is no choice in the brackets; {right}.")
    if re.search(r"\]\s*\[", text):
        joined = re.sub(r"\]\s*\[", ", ", text)
        raise UserError(
            f"{variable}[{text}]: all choices stand in one pair of brackets; write {variable}[{joined}]."
        )
    found: dict[str, int] = {}
    for part in re.split(r",\s*(?=\w+\s*=)", text):
        dim, equals, label = (piece.strip() for piece in part.partition("="))
        if not equals or not dim or not label:
            raise UserError(f"{variable}[{text}]: {part.strip()!r} is no choice; write dimension=label.")
        if dim not in among:
            has = f"it has {', '.join(among)}" if among else "it has no labels to choose from"
            raise UserError(f"{variable}[{text}]: {variable} has no {dim!r}; {has}.")
        if dim in found:
            raise UserError(f"{variable}[{text}]: {dim} is chosen twice; give one label.")
        places = [place for place, one in enumerate(among[dim]) if _is(one, label)]
        if not places:
            raise UserError(
                f"{variable}[{text}]: there is no {dim} {label!r}; use one of {_shown(among[dim])}."
            )
        found[dim] = places[0]
    return found


def _is_text(values: NDArray[Any]) -> bool:
    return values.dtype.kind not in "biuf"


def _is(one: object, label: str) -> bool:
    """Return whether a stored label is what was written."""
    if not isinstance(one, int | float | np.number):
        return str(one) == label
    try:
        return bool(np.isclose(float(one), float(label), rtol=1e-9, atol=0.0))
    except ValueError:
        return False


def _written(one: object) -> str:
    """Return a label as it can be given: of a number enough digits for :func:`_is`."""
    return f"{one:.10g}" if isinstance(one, int | float | np.number) else str(one)


def _shown(values: Sequence[Any] | NDArray[Any]) -> str:
    words = [_written(one) for one in values]
    return ", ".join(words[:_SHOWN]) + (f", ... {words[-1]}" if len(words) > _SHOWN else "")


def selected(judged: Judged, values: "xr.DataArray") -> "Iterator[tuple[slice, dict[str, xr.DataArray]]]":
    """Yield block by block which cases, and by label their values (case, ...), in memory.

    Of a vector (``axis``) without choice they are the length. Of what was not chosen nothing is read. What is
    left of the dimensions are those over time, and fields and wavelengths.
    """
    values = values.isel(dict(judged.chosen))
    for cases in blocks([values.variable]):
        block = values.isel(case=cases).compute()
        if "axis" in block.dims:
            block = (block**2).sum("axis", skipna=False) ** 0.5
        found = {}
        for places in product(*(range(len(labels)) for labels in judged.each.values())):
            words = [labels[place] for labels, place in zip(judged.each.values(), places, strict=True)]
            found[", ".join(words)] = block.isel(dict(zip(judged.each, places, strict=True)))
        yield cases, found


def populations_of(dataset: "xr.Dataset", compared: Iterable[str] = ()) -> NDArray[np.str_]:
    """Return which population each case is drawn from, by its labels and those that its kind compares.

    Labels that tell no more cases apart than those before them are left out.
    """
    found, kinds = np.full(dataset.sizes["case"], "all cases"), 0
    for name in dict.fromkeys([*_POPULATIONS, *compared]):
        if name in dataset.variables:
            words = np.array([_written(one) for one in dataset[name].to_numpy().tolist()], dtype=str)
            longer = np.char.add(np.char.add(found, ", "), words) if kinds else words
            if (count := len(np.unique(longer))) > kinds:
                found, kinds = longer, count
    return found


def title(population: str, label: str) -> str:
    """Return the name of a population's values at a label."""
    return f"{population}, {label}" if label else population
