"""Bodies of numbers: own matrices and tables of modes, in .npz files. SI units but for places in mm."""

import base64
import binascii
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import scipy  # its parts load when first used

from wavequake.errors import UserError
from wavequake.mechanics.model import Array, ReducedModel
from wavequake.user_files import read_npz

_MOST_BYTES = 2**28
_M_PER_MM = 1e-3
_AXES = {"names": (1,), "frequencies_hz": (1,), "damping_ratios": (0, 1), "shapes": (3,)}  # of all others 2


@dataclass(frozen=True)
class Given:
    """A model that arrays give.

    ``nodes`` and ``turns`` say which interface of the model is the displacement and the rotation of a node,
    ``points`` where it is, m, and ``motions`` the rows (6, n) of nodes that turn.
    """

    model: ReducedModel
    nodes: Mapping[str, int]
    turns: Mapping[str, int]
    points: Mapping[str, Array]
    motions: Mapping[str, Array]


def from_matrices(name: str, text: str) -> Given:
    """Return the model of the matrices in the base64 text of an .npz file.

    It holds mass, stiffness and perhaps damping (n, n), nodes_mm (k, 3), inputs (n, 3 k), and perhaps turns
    (n, 3 k) and names (k,).

    Raises
    ------
    UserError
        If an array is missing, has another shape, is not finite, or a matrix is not symmetric.
    """
    found = _arrays(name, text, ("mass", "stiffness", "nodes_mm", "inputs"), ("damping", "turns", "names"))
    count, nodes = len(found["mass"]), len(found["nodes_mm"])
    damping = found.get("damping", np.zeros((count, count)))
    for label, matrix in (("mass", found["mass"]), ("stiffness", found["stiffness"]), ("damping", damping)):
        _require_shape(name, label, matrix, (count, count))
        if np.abs(matrix - matrix.T).max() > 1e-9 * np.abs(matrix).max():
            raise UserError(f"the array {label!r} of the body {name!r} is not symmetric")
    for label in ("inputs", "turns"):
        if label in found:
            _require_shape(name, label, found[label], (count, 3 * nodes))
    return _given(
        name, found, found["mass"], found["stiffness"], damping, found["inputs"], found.get("turns")
    )


def from_modes(name: str, text: str) -> Given:
    """Return the model of a table of modes in the base64 text of an .npz file; unit modal masses.

    It holds frequencies_hz (r,), damping_ratios (r,) or one number, nodes_mm (k, 3), shapes (r, k, 3 or 6),
    and perhaps names (k,).

    Raises
    ------
    UserError
        If an array is missing, has another shape, is not finite, or a frequency or damping is negative.
    """
    needed = ("frequencies_hz", "damping_ratios", "nodes_mm", "shapes")
    found = _arrays(name, text, needed, ("names",))
    frequencies, shapes = found["frequencies_hz"], found["shapes"]
    count, nodes = len(frequencies), len(found["nodes_mm"])
    _require_shape(name, "frequencies_hz", frequencies, (count,))
    each = 6 if shapes.ndim == 3 and shapes.shape[2] == 6 else 3
    _require_shape(name, "shapes", shapes, (count, nodes, each))
    ratios = found["damping_ratios"]
    if ratios.ndim:
        _require_shape(name, "damping_ratios", ratios, (count,))
    ratios = np.broadcast_to(ratios, (count,))
    if (frequencies < 0.0).any() or (ratios < 0.0).any():
        raise UserError(f"the modes of the body {name!r} have a frequency or damping below 0")
    omega = 2.0 * np.pi * frequencies
    turns = shapes[:, :, 3:].reshape(count, -1) if each == 6 else None
    return _given(
        name,
        found,
        np.eye(count),
        np.diag(omega**2),
        np.diag(2.0 * ratios * omega),
        shapes[:, :, :3].reshape(count, -1),
        turns,
    )


def _given(
    name: str,
    found: Mapping[str, Array],
    mass: Array,
    stiffness: Array,
    damping: Array,
    inputs: Array,
    turns: Array | None,
) -> Given:
    points = found["nodes_mm"] * _M_PER_MM
    _require_shape(name, "nodes_mm", points, (len(points), 3))
    names = [str(one) for one in found.get("names", np.arange(1, len(points) + 1))]
    if len(set(names)) < len(points) or len(names) != len(points):
        raise UserError(f"the names of the body {name!r} must be {len(points)} different ones")
    groups = np.vstack([points, points]) if turns is not None else points
    try:
        scipy.linalg.cholesky(mass)
    except scipy.linalg.LinAlgError:
        raise UserError(f"the mass of the body {name!r} is not positive definite") from None
    model = ReducedModel(
        name=name,
        method="arrays",
        mass=mass,
        stiffness=stiffness,
        damping_matrix=damping,
        inputs=inputs if turns is None else np.hstack([inputs, turns]),
        surface=np.zeros((0, len(mass))),
        nodes=groups,
        interfaces=np.arange(len(groups)),
        surface_nodes=np.zeros(0, dtype=np.int64),
        surface_weights=np.zeros(0),
        seconds=0.0,
    )
    where = {one: index for index, one in enumerate(names)}
    turning = {one: index + len(points) for one, index in where.items()} if turns is not None else {}
    motions = {
        one: np.vstack([model.inputs.T[3 * where[one] :][:3], model.inputs.T[3 * group :][:3]])
        for one, group in turning.items()
    }
    return Given(model, where, turning, dict(zip(names, points, strict=True)), motions)


def _arrays(name: str, text: str, needed: tuple[str, ...], optional: tuple[str, ...]) -> dict[str, Array]:
    try:
        found = read_npz(base64.b64decode(text, validate=True), _MOST_BYTES)
    except (binascii.Error, UserError) as error:
        raise UserError(f"the file of the body {name!r} is no .npz file of arrays: {error}") from None
    for label in needed:
        if label not in found:
            raise UserError(
                f"the file of the body {name!r} lacks the array {label!r}; it needs {', '.join(needed)}"
            )
    for label in found:
        if label not in (*needed, *optional):
            raise UserError(
                f"the file of the body {name!r} holds {label!r}, which means nothing; it takes "
                f"{', '.join((*needed, *optional))}"
            )
    for label, values in found.items():
        if label != "names" and (values.dtype.kind not in "fiu" or not np.isfinite(values).all()):
            raise UserError(f"the array {label!r} of the body {name!r} holds what is no finite number")
        axes = _AXES.get(label, (2,))
        if values.ndim not in axes:
            raise UserError(
                f"the array {label!r} of the body {name!r} has {values.ndim} axes; it must have "
                f"{' or '.join(map(str, axes))}"
            )
    return {
        label: values if label == "names" else np.array(values, dtype=np.float64)
        for label, values in found.items()
    }


def _require_shape(name: str, label: str, values: Array, shape: tuple[int, ...]) -> None:
    if values.shape != shape:
        raise UserError(
            f"the array {label!r} of the body {name!r} has the shape {values.shape}; it must be {shape}"
        )
