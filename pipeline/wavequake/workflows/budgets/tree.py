"""A budget as a tree: groups of what moves, what each may contribute, and what its branches add up to.

A part is what one disturbance moves of one element. A group holds parts, each branch of the tree others: so
the mean square of a group is the sum of those of its branches, and twice their covariances. The first is what
is allocated for by a root of a sum of squares; the group itself is traced, with all of its parts and nothing
else, and the difference says how its branches are correlated.
"""

import fnmatch
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from wavequake.errors import UserError
from wavequake.workflows.asked_sections import BudgetGroupSection, BudgetSection
from wavequake.workflows.budgets.indices import Estimate, bootstrapped
from wavequake.workflows.budgets.kept import UNITS
from wavequake.workflows.limits import in_unit

Array = NDArray[np.float64]
Part = tuple[str, str]  # disturbance and element

SIGHT = "line of sight"  # what moves that is no element: mount, incoming light
LEFT = "in no group"


@dataclass(frozen=True)
class Branch:
    """A group: its name, that of the group around it ("" of the whole), and its parts."""

    name: str
    parent: str
    parts: frozenset[Part]


@dataclass(frozen=True)
class RolledUp:
    """What b groups contribute to a number, and what their branches do together.

    Attributes
    ----------
    rms : Estimate
        Values (b,), the first of the whole.
    apart : ndarray, shape (b,)
        Root of the sum of squares of the branches; NaN where there are none.
    correlation : Estimate
        Values (b,): mean correlation of the branches' contributions, weighted by their product: 0 makes the
        root of the sum of squares, 1 the sum; NaN where there are fewer than two.
    """

    rms: Estimate
    apart: Array
    correlation: Estimate


def branches_of(
    section: BudgetSection | None, moving: frozenset[Part], rings: Mapping[str, Sequence[str]]
) -> tuple[Branch, ...]:
    """Return the groups of a budget, each before its own branches; and what no group holds.

    Parameters
    ----------
    section : BudgetSection, optional
    moving : frozenset of (str, str)
        All parts that there are.
    rings : mapping
        Elements of named sets of them.

    Raises
    ------
    UserError
        If a group names nothing that moves, or two hold the same part.
    """
    if section is None or not section.group:
        return ()
    groups = {group.name: group for group in section.group}
    inner = {name for group in section.group for name in group.of if name in groups}
    held: dict[Part, str] = {}
    found: list[Branch] = []

    def grow(group: BudgetGroupSection, parent: str) -> frozenset[Part]:
        place = len(found)
        if all(name in groups for name in group.of):
            below = [grow(groups[name], group.name) for name in group.of]
            parts = frozenset[Part]().union(*below)
        else:
            parts = _parts_of(group, moving, rings)
            for part in sorted(parts):
                if part in held:
                    source, element = part
                    raise UserError(
                        f"budget.group: {held[part]!r} and {group.name!r} both hold {element} as "
                        f"{source!r} moves it; a part belongs to one group."
                    )
                held[part] = group.name
        found.insert(place, Branch(group.name, parent, parts))
        return parts

    for group in section.group:
        if group.name not in inner:
            grow(group, "")
    if rest := moving - held.keys():
        found.append(Branch(LEFT, "", rest))
    return tuple(found)


def _parts_of(
    group: BudgetGroupSection, moving: frozenset[Part], rings: Mapping[str, Sequence[str]]
) -> frozenset[Part]:
    """Return the parts of a group of disturbances and elements."""
    sources, elements = ({part[side] for part in moving} for side in (0, 1))
    chosen: set[Part] = set()
    for name in group.of:
        if name in sources:
            chosen |= {part for part in moving if part[0] == name}
            continue
        mine = set(rings.get(name, ())) or {
            element for element in elements if element == name or fnmatch.fnmatchcase(element, name)
        }
        parts = {part for part in moving if part[1] in mine}
        if not parts:
            known = [*sorted(sources), *rings, *sorted(elements - {SIGHT})]
            some = ", ".join(known[:16]) + (", ..." if len(known) > 16 else "")
            raise UserError(
                f"budget.group {group.name!r}: {name!r} names nothing that moves in this budget; there is "
                f"{some}."
            )
        chosen |= parts
    return frozenset(chosen)


def require_free_names(section: BudgetSection | None, taken: Sequence[str]) -> None:
    """Raise UserError if a group has the name of something else, or an allocation is none."""
    if section is None:
        return
    for group in section.group:
        if group.name in (*taken, LEFT):
            raise UserError(
                f"budget.group: {group.name!r} is the name of a disturbance, an element or of what is left; "
                "give the group another one."
            )


def allocations(
    section: BudgetSection | None, branches: Sequence[Branch], quantities: Sequence[str]
) -> Array:
    """Return what the whole and each branch may be (b + 1, q), in budgets' units; NaN if nothing is said.

    Raises
    ------
    UserError
        For what is no quantity of this budget, or no limit.
    """
    groups = {group.name: group.allocation for group in section.group} if section else {}
    whole = section.allocation if section else {}
    found = np.full((len(branches) + 1, len(quantities)), np.nan)
    for row, (name, asked) in enumerate(
        [("the whole", whole), *((branch.name, groups.get(branch.name, {})) for branch in branches)]
    ):
        for quantity, limit in asked.items():
            where = f"The allocation of {name!r}"
            if quantity not in quantities:
                raise UserError(
                    f"{where} is of {quantity!r}, which this budget does not have; it has "
                    f"{', '.join(quantities)}."
                )
            if quantity not in UNITS:
                raise UserError(f"{where} is of {quantity!r}; allocations are of {', '.join(UNITS)}.")
            found[row, quantities.index(quantity)] = in_unit(limit, UNITS[quantity], where)
    return found


def rolled_up(values: Array, rest: float, branches: Sequence[Branch]) -> RolledUp:
    """Return what the whole and its groups contribute to the rms over cases.

    Parameters
    ----------
    values : ndarray, shape (n, b + 1)
        The number in n cases: with everything, and with each of b groups alone.
    rest : float
        The number without anything.
    branches : sequence of Branch
    """
    names = ["", *(branch.name for branch in branches)]
    above = np.array([-1, *(names.index(branch.parent) for branch in branches)])
    inside = (above == np.arange(len(names))[:, None]).astype(
        np.float64
    )  # row: a group, column: its branches

    def numbers(means: Array) -> Array:
        squares = means - rest**2
        sizes = np.sqrt(np.maximum(squares, 0.0))
        apart, sums = sizes**2 @ inside.T, sizes @ inside.T
        cross = sums**2 - apart
        nothing = np.full(cross.shape, np.nan)
        known = cross > 1e-12 * np.maximum(sums**2, 1e-300)
        correlation = np.divide(squares - apart, cross, out=nothing, where=known)
        sizes[..., 0] = np.sqrt(means[..., 0])
        return np.concatenate([sizes, correlation, apart], axis=-1)

    found = bootstrapped(values**2, numbers)
    rms, correlation, apart = (
        Estimate(*(np.split(side, 3)[part] for side in (found.value, found.low, found.high)))
        for part in range(3)
    )
    total = apart.value + np.where(np.arange(len(names)) == 0, rest**2, 0.0)
    return RolledUp(rms, np.where(inside.any(axis=1), np.sqrt(total), np.nan), correlation)
