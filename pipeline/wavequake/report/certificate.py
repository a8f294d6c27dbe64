"""How good the modal model was in a store: its errors in the cases that were traced besides."""

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from wavequake.campaign.contract import DONE
from wavequake.report.statistics import quantile
from wavequake.report.table import number
from wavequake.words import counted
from wavequake.workflows.segments.modal import CERTIFIED, TRACED

Array = NDArray[np.float64]

ERRORS = {
    "wfe_rms_raw": "WFE on glass",
    "wfe_rms": "WFE j ≥ 4",
    "zernike": "Zernike coefficients",
    "los": "LOS",
    "los_mm": "LOS",
    "centroid": "centroid",
    "centroid_mm": "centroid",
    "peak": "peak of exposures",
}
"""What is measured of the model, in words."""


def certificate(tolerance_nm: float, dataset: xr.Dataset) -> list[str]:
    """Say how large the errors of the modal model are; nothing where none is known."""
    if "traced" not in dataset:
        return []
    done = dataset["status"].to_numpy() == DONE
    traced = dataset["traced"].to_numpy()[done]
    if not len(traced):
        return []
    certified, beyond = (int(np.count_nonzero(traced == code)) for code in (CERTIFIED, TRACED))
    parts = []
    for name, values in modal_errors(dataset, done).items():
        unit = dataset[f"modal_error_{name}"].attrs["units"]
        levels = [number(quantile(values, p).value, 2) for p in (0.5, 0.95, 1.0)]
        parts.append(f"{ERRORS[name]} {', '.join(levels)}" + f" {unit}" * (unit != "1"))
    modal = len(traced) - beyond
    limit = f"beyond its range (second order above {tolerance_nm:g} nm)"
    if not modal:
        return [f"Modal model: every case is {limit}; all numbers are those of full traces."]
    which = f"of which {certified}" if certified < modal else "all of which"
    words = [
        f"Modal model: {counted(modal, 'case')}, {which} were traced in full to measure its "
        f"error; {f'the numbers of {beyond} more,' if beyond else 'none is'} {limit}"
        + (", are those of full traces." if beyond else ".")
    ]
    if parts:
        words.append(f"Largest error of a case (P50, P95, largest over cases): {'; '.join(parts)}.")
        raw = modal_errors(dataset, done)["wfe_rms_raw"]
        wrong = int(np.count_nonzero(raw > tolerance_nm))
        if wrong:
            words.append(
                f"WARNING: the error of {wrong} of {len(raw)} traced cases is above the tolerance; use "
                "optics.light = 'traced', or a smaller optics.modal_tolerance_nm."
            )
    return words


def modal_errors(dataset: xr.Dataset, done: NDArray[np.bool_]) -> dict[str, Array]:
    """Return the finite errors of finished cases by name."""
    found = {
        name: dataset[f"modal_error_{name}"].to_numpy()[done]
        for name in ERRORS
        if f"modal_error_{name}" in dataset
    }
    finite = {name: values[np.isfinite(values)] for name, values in found.items()}
    return {name: values for name, values in finite.items() if len(values)}
