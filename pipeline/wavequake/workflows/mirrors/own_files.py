"""Files of reduced models of the user's own, read when a study is loaded and kept in it as text."""

import base64
import io
from pathlib import Path

import numpy as np
import scipy  # its parts load when first used

from wavequake.campaign.schema import base64_of
from wavequake.errors import UserError
from wavequake.user_files import read_bytes


def own_file(path: Path, key: str) -> str:
    """Return a file of an own model in base64: an ``.npz`` as it is, a Matrix Market file as its basis.

    Raises
    ------
    UserError
        If it cannot be read, or is neither.
    """
    if path.suffix.lower() == ".npz":
        return base64_of(path, key)
    if path.suffix.lower() != ".mtx":
        raise UserError(f"{key}: {path.name} must be an .npz file, or an .mtx file of a basis.")
    try:
        matrix = scipy.io.mmread(io.BytesIO(read_bytes(path)), spmatrix=False)
        dense = np.asarray(matrix.toarray() if hasattr(matrix, "toarray") else matrix, dtype=np.float64)
    except UserError as error:
        raise UserError(f"{key}: the file {error}") from None
    except (ValueError, TypeError, OverflowError) as error:
        raise UserError(
            f"{key}: {path.name} is no complete Matrix Market file of real numbers: {error}"
        ) from None
    packed = io.BytesIO()
    np.savez(packed, basis=dense)
    return base64.b64encode(packed.getvalue()).decode()
