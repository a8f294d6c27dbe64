"""Budgets that stores keep."""

from pathlib import Path
from typing import TYPE_CHECKING

from wavequake.campaign.store.store import BUDGET
from wavequake.campaign.store.whole import read_dataset
from wavequake.errors import UserError

if TYPE_CHECKING:
    import xarray as xr

SCHEMA = 1
UNITS = {"wfe_rms_raw": "nm", "wfe_rms": "nm", "los": "mas", "wfe_change": "nm", "image_motion": "µm"}


def open_budget(path: Path | str) -> "xr.Dataset":
    """Read the budget that the folder of a store keeps.

    Raises
    ------
    UserError
        If it keeps none, or one of another version of Wavequake.
    StoreDamageError
        If it cannot be read.
    """
    target = Path(path) / BUDGET
    if not target.exists():
        raise UserError(f"There is no budget at {target}; wavequake budget STUDY computes it.")
    return read_dataset(target, SCHEMA)
