"""Motions in which some elements move alone, or as in another draw: surfaces and bodies, which have names."""

from collections.abc import Set
from dataclasses import replace
from typing import Any, TypeVar

from wavequake.mechanics.disturbances.element_motion import ElementMotion
from wavequake.mechanics.disturbances.motion import Motion
from wavequake.workflows.budgets.tree import Part

Moved = TypeVar("Moved", Motion, ElementMotion)

_NAMED = ("rigid", "figure", "grid")


def with_element(motion: Moved, other: Moved, element: str) -> Moved:
    """Return a motion in which one surface or body moves and deforms as in another."""
    found: dict[str, Any] = {}
    for key in _NAMED:
        mine, theirs = getattr(motion, key), getattr(other, key)
        others = {name: values for name, values in mine.items() if name != element}
        found[key] = others | {name: values for name, values in theirs.items() if name == element}
    return replace(motion, **found)


def only_elements(motion: Moved, mine: Set[str]) -> Moved:
    """Return a motion in which of all surfaces and bodies some move and deform alone."""
    found: dict[str, Any] = {
        key: {name: values for name, values in getattr(motion, key).items() if name in mine} for key in _NAMED
    }
    return replace(motion, **found)


def moving_elements(source: str, motion: Motion | ElementMotion) -> set[Part]:
    """Return which surfaces and bodies a disturbance moves or deforms."""
    return {(source, name) for key in _NAMED for name, values in getattr(motion, key).items() if values.any()}
