"""Which cases a viewer shows where none is asked for."""

import numpy as np
import xarray as xr

from wavequake.campaign.contract import DONE
from wavequake.errors import UserError
from wavequake.viewer.film import Array

MOST_VARIANTS = 6
_NOTHING = "No case of the store is done yet; there is nothing to view."


def worst_cases(dataset: xr.Dataset, badness: Array) -> list[int]:
    """Return the ids of the finished case of each disturbance with the largest of the numbers (case,).

    Raises
    ------
    UserError
        If no case is done.
    """
    done = dataset["status"].to_numpy() == DONE
    size = np.where(done, np.nan_to_num(badness, nan=-np.inf), -np.inf)
    names, ids = dataset["disturbance"].to_numpy(), dataset["case"].to_numpy()
    found = []
    for name in dict.fromkeys(names.tolist()):
        mine = np.flatnonzero((names == name) & done)
        found += [int(ids[mine[np.argmax(size[mine])]])] if len(mine) else []
    if not found:
        raise UserError(_NOTHING)
    return found


def some_cases(dataset: xr.Dataset, allowed: list[int], most: int = MOST_VARIANTS) -> list[int]:
    """Return at most so many of the allowed cases that are done, evenly chosen; a store may have fewer cases.

    Raises
    ------
    UserError
        If none of them is done.
    """
    status = dataset["status"].to_numpy()
    done = [case for case in allowed if case < len(status) and status[case] == DONE]
    if not done:
        raise UserError(_NOTHING)
    return done[:: -(-len(done) // most)]
