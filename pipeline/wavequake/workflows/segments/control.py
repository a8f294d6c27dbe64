"""Numbers of cases by the modal model alone: the cheap partner of traced cases."""

import numpy as np
from numpy.typing import NDArray

from wavequake.campaign.contract import DONE, ChunkResult, unknown_arrays
from wavequake.campaign.schema import Study
from wavequake.errors import UserError
from wavequake.workflows.segments.modal import modal_cases
from wavequake.workflows.segments.study import WHOLE, SegmentStudy, without_images
from wavequake.workflows.segments.template import template
from wavequake.workflows.study import study_with

Array = NDArray[np.float64]

MEASURES = ("wfe_rms_raw", "wfe_rms", "los", "centroid")
_ANY = 1e9  # nm: a partner need not be good, only the same for all cases
_MODAL = {
    "optics.light": "modal",
    "optics.modal_tolerance_nm": _ANY,
    "optics.modal_sample": 0.0,
    **WHOLE,
}


def modal_partner(study: Study) -> SegmentStudy:
    """Return the study of the modal model that stands beside traced cases.

    Raises
    ------
    UserError
        If the study is none that the modal model can stand for.
    """
    if not isinstance(study, SegmentStudy) or study.study.workflow != "segment-disturbance":
        raise UserError(
            "The modal model is a partner of traced segment-disturbance studies, not of "
            f"{study.study.workflow}."
        )
    if study.optics.light == "modal":
        raise UserError("This study is by the modal model already: take more cases.")
    study.require_one_place("The modal model is")
    if study.rare is not None:
        raise UserError("Cases near a limit have no means of their own; take wavequake rare.")
    partner = study_with(without_images(study), _MODAL)
    assert isinstance(partner, SegmentStudy)
    return partner


def modal_numbers(partner: SegmentStudy, cases: NDArray[np.int64], device: str) -> dict[str, Array]:
    """Return the MEASURES (case,) of cases of a modal partner: rms over instants, of vectors the length's.

    Zero where the model does not know what moves.
    """
    result = modal_cases(partner.identity_text(), cases, device, _untraced)
    found = {}
    for name in MEASURES:
        squares = result.arrays[name] ** 2
        squares = squares.sum(axis=2) if squares.ndim == 3 else squares
        known = np.isfinite(squares)
        total = np.where(known, squares, 0.0).sum(axis=1) / np.maximum(known.sum(axis=1), 1)
        found[name] = np.sqrt(total)
    return found


def _untraced(study_text: str, cases: NDArray[np.int64], device: str) -> ChunkResult:
    """Return cases without a number in the place of traces, which nobody needs here."""
    numbers = {name: one for name, one in template(study_text).per_case.items() if one.dtype != "int8"}
    arrays = unknown_arrays(numbers, len(cases))
    status = np.full(len(cases), DONE, dtype=np.int8)
    return ChunkResult(arrays, status, ("",) * len(cases))
