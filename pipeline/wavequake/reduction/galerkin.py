"""From a variant to its basis, and from a basis to a reduced model."""

import time
from collections.abc import Callable

import numpy as np
import scipy.linalg

from wavequake.errors import UserError
from wavequake.mechanics.model import Array, FiniteElementModel, ReducedModel
from wavequake.reduction import component_modes
from wavequake.reduction.balanced import balanced
from wavequake.reduction.intermediate import Intermediate
from wavequake.reduction.irka import irka
from wavequake.reduction.krylov import krylov
from wavequake.reduction.limits import check_size
from wavequake.reduction.names import Variant
from wavequake.reduction.pod import generated, pod
from wavequake.reduction.structure import Structure, held

_COMPONENT_MODES: dict[str, Callable[[Structure, int], Array]] = {
    "modal": component_modes.modal,
    "guyan": component_modes.guyan,
    "modalfix": component_modes.fixed_interface,
    "craigb": component_modes.craig_bampton,
    "rubin": component_modes.rubin,
    "dualcb": component_modes.rubin,
    "inertia": component_modes.inertia_relief,
    "hintz": component_modes.hintz,
    "irka": irka,
}


def basis(body: Structure, variant: Variant, snapshots: Array | None = None) -> tuple[Array, Array]:
    """Return the rigid and the elastic part of a variant's basis, shapes (n, r) and (n, order - r).

    Parameters
    ----------
    body : Structure
        Dense for irka, bt, flbt, fwbt and generated snapshots.
    variant : Variant
    snapshots : ndarray, shape (n, m), optional
        For pod; without them they are generated.

    Raises
    ------
    UserError
        If the order does not suit the method and the model.
    """
    rigid = body.rigid if variant.method != "modalfix" else body.rigid[:, :0]
    order, method = variant.order, variant.method
    if method == "guyan" and order is None:
        held(body)
        order = len(body.interface)
    check_size(body.size, variant, snapshots is not None)
    count = None if order is None else order - rigid.shape[1]
    if method == "krylov":
        return rigid, krylov(body, count, variant.points, variant.moments)
    if count is None:
        raise UserError(f"The variant {variant} has no order.")
    if method in ("bt", "flbt", "fwbt"):
        return rigid, balanced(body, count, variant.bands)
    if method == "pod":
        frequency = variant.points[0].real if variant.points else None
        return rigid, pod(body, count, generated(body, frequency) if snapshots is None else snapshots)
    return rigid, _COMPONENT_MODES[method](body, count)


def project(body: Structure, variant: Variant, rigid: Array, elastic: Array) -> tuple[Array, Array]:
    """Return squared frequencies and mass-orthonormal shapes of the model in the span of a basis.

    Parameters
    ----------
    rigid : ndarray, shape (n, r)
        Mass-orthonormal; their squared frequencies are exactly 0.
    elastic : ndarray, shape (n, m)
        Linearly independent, also of `rigid`.
    """
    if rigid.shape[1]:
        elastic = body.remove_rigid(elastic)
    weighted = body.mass @ elastic
    scale = 1.0 / np.sqrt(np.einsum("ij,ij->j", elastic, weighted))
    elastic, weighted = elastic * scale, weighted * scale
    stiffness = elastic.T @ (body.stiffness @ elastic)
    try:
        squared, turn = scipy.linalg.eigh(stiffness, elastic.T @ weighted, check_finite=False)
    except scipy.linalg.LinAlgError:
        raise UserError(
            f"The basis of {variant} of the model {body.name} is linearly dependent; choose a lower order."
        ) from None
    zeros = np.zeros(rigid.shape[1])
    return np.concatenate([zeros, np.maximum(squared, 0.0)]), np.hstack([rigid, elastic @ turn])


def _macneal(body: Structure, variant: Variant) -> tuple[Array, Array]:
    """Return squared frequencies and shapes of a model that is no projection, as `project`."""
    check_size(body.size, variant)
    rigid = body.rigid.shape[1]
    if variant.order is None:
        raise UserError(f"The variant {variant} has no order.")
    squared, shapes = component_modes.macneal(body, variant.order - rigid)
    return np.concatenate([np.zeros(rigid), squared]), np.hstack([body.rigid, shapes])


def reduced(
    body: Structure,
    variant: Variant,
    model: FiniteElementModel | Intermediate,
    surface: Callable[[Array], Array],
    snapshots: Array | None = None,
) -> ReducedModel:
    """Return the reduced model of a variant, in modal coordinates: unit mass, diagonal stiffness and damping.

    Parameters
    ----------
    body : Structure
    variant : Variant
    model : FiniteElementModel or Intermediate
        Gives nodes and surface.
    surface : callable
        Picks the optical rows (3 p, r) of shapes (n, r).
    snapshots : ndarray, shape (n, m), optional
    """
    start = time.perf_counter()
    if variant.method == "macneal":
        squared, shapes = _macneal(body, variant)
    else:
        squared, shapes = project(body, variant, *basis(body, variant, snapshots))
    rates = body.damping.mass + body.damping.stiffness * squared
    name = variant if variant.order is not None else _with_order(variant, len(squared))
    return ReducedModel(
        name=str(name),
        method=variant.method,
        mass=np.eye(len(squared)),
        stiffness=np.diag(squared),
        damping_matrix=np.diag(rates),
        inputs=np.ascontiguousarray(shapes[body.interface].T),
        surface=surface(shapes),
        nodes=model.nodes,
        interfaces=model.interfaces,
        surface_nodes=model.surface_nodes,
        surface_weights=model.surface_weights,
        seconds=time.perf_counter() - start,
    )


def _with_order(variant: Variant, order: int) -> Variant:
    return Variant(variant.method, order, variant.points, variant.moments, variant.bands)
