"""What of a study may be computed finer, and how: rays, terms, full traces, models of higher order."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, get_args

import numpy as np

from wavequake.campaign.schema import Study
from wavequake.optics.polynomials.zernike import MOST_TERMS
from wavequake.reduction.names import parse
from wavequake.workflows.sweep import SweepStudy, base_study

RAYS, TERMS, LINEAR, REDUCTION = "rays", "terms", "linearisation", "reduction"
_FULL = "full"


@dataclass(frozen=True)
class Refinement:
    """Steps of one origin of errors, from coarse to fine.

    Attributes
    ----------
    origin : str
    key : str
        Of the study, which the steps change.
    counts : tuple of float
        How fine each step is; infinite of a step that counts as exact.
    steps : tuple of mapping
        Keys of the study that each step changes.
    base : int
        The step that is the study's own.
    """

    origin: str
    key: str
    counts: tuple[float, ...]
    steps: tuple[Mapping[str, Any], ...]
    base: int = 0


def refinements(study: Study) -> Iterator[Refinement]:
    """Yield the refinements of a study of any kind, by the keys that it has and does not sweep."""
    if isinstance(study, SweepStudy):
        swept = {one.key for one in study.sweep}
        for refined in refinements(base_study(study)):
            if not swept & {key for step in refined.steps for key in step}:
                yield refined
        return
    optics = getattr(study, "optics", None)
    rays = _rays(optics)
    if rays is not None:
        key, counts, base = rays
        yield Refinement(RAYS, key, counts, tuple({key: count} for count in counts), base)
    home = next((name for name in ("wavefront", "optics") if _terms(study, name) is not None), None)
    if home is not None and (count := _terms(study, home)) < MOST_TERMS:  # type: ignore[operator]
        finer = {rays[0]: rays[1][-1]} if rays is not None else {}
        more = min(2 * count, MOST_TERMS)  # type: ignore[operator]
        key = f"{home}.zernike_terms"
        yield Refinement(TERMS, key, (count, more), tuple({key: one, **finer} for one in (count, more)))  # type: ignore[arg-type]
    if getattr(optics, "light", None) == "modal":
        yield Refinement(LINEAR, "optics.light", (1.0, 2.0), ({}, {"optics.light": "traced"}))
    if models := _models(study):
        yield _order(models)


def _models(study: Study) -> dict[str, str]:
    """Return the reduced models that a study takes, and compares with no others, by their keys."""
    segment = getattr(study, "segment", None)
    found = {"segment.reduced": getattr(segment, "reduced", _FULL)}
    if getattr(study, "reduction", None) is None:
        for body in getattr(study, "body", ()):
            for kind in ("mirror", "imported"):
                model = getattr(getattr(body, kind, None), "reduced", _FULL)
                found[f"body.{body.name}.{kind}.reduced"] = model
    return {key: model for key, model in found.items() if model != _FULL}


def _order(models: Mapping[str, str]) -> Refinement:
    """Return the steps of reduced models: as they are, of twice their orders, and not reduced."""
    parsed = {key: parse(model) for key, model in models.items()}
    doubled = {key: str(replace(one, order=2 * one.order)) for key, one in parsed.items() if one.order}
    steps = [dict(models), dict.fromkeys(models, _FULL)]
    counts = [1.0, np.inf]
    if len(doubled) == len(models):
        steps.insert(1, doubled)
        counts.insert(1, 2.0)
    return Refinement(REDUCTION, next(iter(models)), tuple(counts), tuple(steps))


def _rays(optics: Any) -> tuple[str, tuple[int, ...], int] | None:
    """Return the key of a number of rays, three numbers of them, and which of them is the study's."""
    if getattr(optics, "sampling", None) == "segments" and hasattr(optics, "rays_per_segment"):
        field = type(optics).model_fields["rays_per_segment"]
        choices = sorted(get_args(field.annotation))
        place = choices.index(optics.rays_per_segment)
        first = max(min(place, len(choices) - 3), 0)
        return "optics.rays_per_segment", tuple(choices[first : first + 3]), place - first
    rays = getattr(optics, "rays", None)
    if not isinstance(rays, int):
        return None
    return "optics.rays", (rays, 2 * rays, 4 * rays), 0


def _terms(study: Study, home: str) -> int | None:
    count = getattr(getattr(study, home, None), "zernike_terms", None)
    return count if isinstance(count, int) else None
