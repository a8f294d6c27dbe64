"""Reduced models that somebody else has made: a basis, matrices, or a second-order model of pyMOR."""

import time
from collections.abc import Mapping
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wavequake.errors import UserError
from wavequake.mechanics.model import Array, FiniteElementModel, ReducedModel
from wavequake.reduction.intermediate import Intermediate
from wavequake.reduction.structure import structure

OWN = "own"
"""The method of such a model."""

# Names of the arrays, and those that textbooks give them.
_NAMES = {"mass": "M", "stiffness": "K", "damping": "D", "inputs": "B", "surface": "C"}
# Columns of a basis are dependent where the smallest eigenvalue of their scaled mass is below it.
_DEPENDENT = 1e-13
_SYMMETRIC = 1e-8


@runtime_checkable
class SecondOrderModel(Protocol):
    """What pyMOR's ``SecondOrderModel`` offers."""

    def to_matrices(self) -> tuple[Any, ...]:
        """Return M, E, K, B, Cp, Cv and D."""


Given = ArrayLike | Mapping[str, Any] | SecondOrderModel


def own_model(model: FiniteElementModel | Intermediate, given: Given, name: str) -> ReducedModel:
    """Return a reduced model of a body from what somebody else has made of it.

    Parameters
    ----------
    model : FiniteElementModel or Intermediate
        The body; a basis needs the full model.
    given : array_like, mapping or SecondOrderModel
        A basis (n, r), whose rows are the model's degrees of freedom; or arrays ``mass``, ``stiffness``, and
        perhaps ``damping`` (r, r; without it the body's Rayleigh damping), ``inputs`` (r, 3 k; forces in N at
        the interface nodes, x, y and z of each) and ``surface`` (3 p, r; displacements in m of the optical
        nodes, likewise), which may be called M, K, D, B and C; a mapping may hold a ``basis``, too. Or a
        second-order model of pyMOR with these inputs and outputs.
    name : str
        What to call it.

    Raises
    ------
    UserError
        If arrays are missing, have other shapes or numbers that are not finite, matrices are not symmetric,
        the mass is not positive definite, or the columns of a basis are dependent.
    """
    start = time.perf_counter()
    arrays = _arrays(given, name)
    if "basis" in arrays:
        if not isinstance(model, FiniteElementModel):
            raise UserError(f"The reduced model {name!r} is a basis, which needs the full model.")
        arrays = _projected(model, arrays["basis"], name)
    order = len(arrays["mass"]) if arrays["mass"].ndim else 0
    inputs, outputs = 3 * len(model.interfaces), 3 * len(model.surface_nodes)
    shapes = {"mass": (order, order), "stiffness": (order, order), "damping": (order, order)}
    shapes |= {"inputs": (order, inputs), "surface": (outputs, order)}
    for key, shape in shapes.items():
        if key == "damping" and key not in arrays:
            rayleigh = model.damping
            arrays[key] = rayleigh.mass * arrays["mass"] + rayleigh.stiffness * arrays["stiffness"]
        if arrays[key].shape != shape or not order:
            raise UserError(
                f"{key} of the reduced model {name!r} has the shape {arrays[key].shape}; with {order} "
                f"coordinates, {inputs // 3} interface and {outputs // 3} optical nodes it must be {shape}."
            )
    for key in ("mass", "stiffness", "damping"):
        apart = np.abs(arrays[key] - arrays[key].T).max()
        if apart > _SYMMETRIC * np.abs(arrays[key]).max(initial=1e-300):
            raise UserError(f"{key} of the reduced model {name!r} is not symmetric.")
        arrays[key] = 0.5 * (arrays[key] + arrays[key].T)
    if not np.linalg.eigvalsh(arrays["mass"])[0] > 0.0:
        raise UserError(f"The mass of the reduced model {name!r} is not positive definite.")
    return ReducedModel(
        name=name,
        method=OWN,
        mass=arrays["mass"],
        stiffness=arrays["stiffness"],
        damping_matrix=arrays["damping"],
        inputs=arrays["inputs"],
        surface=arrays["surface"],
        nodes=model.nodes,
        interfaces=model.interfaces,
        surface_nodes=model.surface_nodes,
        surface_weights=model.surface_weights,
        seconds=time.perf_counter() - start,
        turns=model.turns,
    )


def _arrays(given: Any, name: str) -> dict[str, Array]:
    """Return the named arrays of what is given, checked one by one."""
    if isinstance(given, Mapping):
        letters = {letter: key for key, letter in _NAMES.items()}
        found = {letters.get(str(key), str(key)): values for key, values in given.items()}
        unknown = next((key for key in found if key not in (*_NAMES, "basis")), None)
        if unknown is not None:
            raise UserError(
                f"The reduced model {name!r} holds {unknown!r}; it takes basis, or {', '.join(_NAMES)}."
            )
        missing = [key for key in ("mass", "stiffness", "inputs", "surface") if key not in found]
        if "basis" not in found and missing:
            raise UserError(f"The reduced model {name!r} has no {missing[0]}; give it, or a basis.")
    elif isinstance(given, SecondOrderModel):
        mass, damping, stiffness, inputs, outputs, velocities, *_ = given.to_matrices()
        if velocities is not None and abs(velocities).max() > 0.0:
            raise UserError(f"The reduced model {name!r} has outputs of velocities; give displacements.")
        found = {"mass": mass, "stiffness": stiffness, "inputs": inputs, "surface": outputs}
        found |= {} if damping is None else {"damping": damping}
    else:
        found = {"basis": given}
    return {key: _real(values, key, name) for key, values in found.items()}


def _real(values: Any, key: str, name: str) -> Array:
    dense = values.toarray() if hasattr(values, "toarray") else values
    try:
        array: NDArray[Any] = np.array(dense, dtype=np.float64)
    except (TypeError, ValueError):
        raise UserError(f"{key} of the reduced model {name!r} is no array of real numbers.") from None
    if array.ndim != 2 or not np.isfinite(array).all():
        raise UserError(f"{key} of the reduced model {name!r} must be a matrix of finite numbers.")
    return array


def _projected(model: FiniteElementModel, basis: Array, name: str) -> dict[str, Array]:
    """Return the matrices of a model in the span of a basis, of unit masses."""
    if basis.shape[0] != model.order or not 0 < basis.shape[1] <= model.order:
        raise UserError(
            f"The basis of the reduced model {name!r} has the shape {basis.shape}; its rows must be the "
            f"{model.order} degrees of freedom of {model.name}."
        )
    size = np.sqrt(np.einsum("ij,ij->j", basis, model.mass @ basis))
    if not (size > 0.0).all():
        raise UserError(f"A column of the basis of the reduced model {name!r} moves nothing that has mass.")
    shapes = basis / size
    squared, turn = np.linalg.eigh(shapes.T @ (model.mass @ shapes))
    if squared[0] < _DEPENDENT * squared[-1]:
        raise UserError(f"The columns of the basis of the reduced model {name!r} are linearly dependent.")
    shapes = shapes @ (turn / np.sqrt(squared))
    rows = structure(model).interface
    stiffness = shapes.T @ (model.stiffness @ shapes)
    return {
        "mass": np.eye(len(squared)),
        "stiffness": 0.5 * (stiffness + stiffness.T),
        "inputs": np.ascontiguousarray(shapes[rows].T),
        "surface": np.asarray(model.surface @ shapes),
    }
