"""Reduced models of the user's own in studies of mirrors."""

import base64

import numpy as np
from numpy.typing import NDArray

from wavequake.errors import UserError
from wavequake.reduction.names import parse
from wavequake.reduction.own import OWN
from wavequake.user_files import read_npz
from wavequake.workflows.mirrors.study import FULL, AnyMirrorStudy

Array = NDArray[np.float64]

_MOST_BYTES = 500_000_000


def own_arrays(text: str, name: str) -> dict[str, Array]:
    """Return the arrays of an own model's file in base64.

    Raises
    ------
    UserError
        If it is no ``.npz`` file of arrays.
    """
    try:
        return dict(read_npz(base64.b64decode(text, validate=True), _MOST_BYTES))
    except (UserError, ValueError) as error:
        raise UserError(f"The file of the reduced model {name!r} cannot be read: {error}") from None


def method_of(study: AnyMirrorStudy, variant: str) -> str:
    """Return by which method a variant is made."""
    if variant == FULL:
        return FULL
    return OWN if variant in study.reduction.own_files else parse(variant).method
