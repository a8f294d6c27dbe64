"""Budgets that stores keep."""

from pathlib import Path
from typing import TYPE_CHECKING

from wavequake.campaign.store.store import BUDGET
from wavequake.campaign.store.whole import read_dataset

if TYPE_CHECKING:
    import xarray as xr

SCHEMA = 1
# Of measures of which more is better a budget takes what is missing.
LOSSES = ("peak", "strehl")
UNITS = {"wfe_rms_raw": "nm", "wfe_rms": "nm", "los": "mas", "wfe_change": "nm", "image_motion": "µm"}


def unit_of(found: "xr.Dataset", quantity: str) -> str:
    """Return the unit of a quantity of a budget; budgets of before kept none."""
    return str(found["unit"].sel(quantity=quantity).item()) if "unit" in found.coords else UNITS[quantity]


def open_budget(path: Path | str) -> "xr.Dataset":
    """Read the budget that the folder of a store keeps; raises as `read_arrays`, also if it keeps none."""
    target = Path(path) / BUDGET
    absent = f"There is no budget at {target}; wavequake budget STUDY computes it."
    return read_dataset(target, SCHEMA, absent)
