"""Reduced models of elastic segments as cases: how far each is from the same draw with the full model."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from wavequake.campaign.contract import DONE, ChunkResult
from wavequake.campaign.measures import Measure, stored
from wavequake.workflows.mirrors.compared_models import ERRORS, model_errors, rms_of
from wavequake.workflows.mirrors.study import FULL
from wavequake.workflows.segments.bench import Bench, benches_of, in_basis
from wavequake.workflows.segments.launches import CaseDraw
from wavequake.workflows.segments.study import SegmentStudy


def error_measures(study: SegmentStudy, places: tuple[str, ...]) -> Iterator[Measure]:
    """Yield the errors of a case, by place."""
    for name, (unit, words) in ERRORS.items():
        if study.imaging.enabled or name != "model_error_image":
            yield stored(name, unit or "mas", f"difference to the draw with the full model: {words}", places)


def judged(bench: Bench, draws: list[CaseDraw], found: ChunkResult, count: int) -> ChunkResult:
    """Return the first cases, so many, of what was found of draws, with the errors of their models.

    Among the draws is every realization with the full model. A case whose full model failed has no errors.
    """
    arrays = {name: array[:count] for name, array in found.arrays.items()}
    places = arrays["wfe_rms"].shape[2:]
    fulls = {
        (one.population.name, one.realization): row for row, one in enumerate(draws) if one.model == FULL
    }
    rest = [in_basis(each, each.static.zernike[0]) * each.wavelength_nm for each in benches_of(bench.text)]
    still = np.reshape(rest, (*places, -1))
    for measure in error_measures(bench.study, ()):
        arrays[measure.name] = np.full((count, *places), np.nan)
    for row, one in enumerate(draws[:count]):
        whole = fulls[one.population.name, one.realization]
        if found.status[row] != DONE or found.status[whole] != DONE:
            continue
        known = slice(0, len(one.time))
        own, full = (
            {name: found.arrays[name][at] for name in ("zernike", "los", "exposure") if name in found.arrays}
            for at in (row, whole)
        )
        bent, away = (own[name][known] - full[name][known] for name in ("zernike", "los"))
        moved = full["zernike"][known] - still
        sizes = rms_of(moved[..., 3:]), rms_of(full["los"][known])
        for name, values in model_errors(bent[..., 3:], away, sizes, own, full).items():
            arrays[name][row] = values
    return replace(found, arrays=arrays, status=found.status[:count], messages=found.messages[:count])
