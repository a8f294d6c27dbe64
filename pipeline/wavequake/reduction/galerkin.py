"""From a variant to its basis, and from a basis to a reduced model."""

import time
from collections.abc import Callable

import numpy as np
import scipy  # its parts load when first used

from wavequake.errors import UserError
from wavequake.mechanics.model import Array, FiniteElementModel, ReducedModel
from wavequake.reduction.intermediate import Intermediate
from wavequake.reduction.limits import check_size
from wavequake.reduction.method import METHODS, Method, Variant
from wavequake.reduction.structure import Structure


def basis(body: Structure, variant: Variant, method: Method) -> tuple[Array, Array]:
    """Return the rigid and the elastic part of a variant's basis, shapes (n, r) and (n, order - r).

    Raises
    ------
    UserError
        If the order does not suit the method and the model.
    """
    rigid = body.rigid if method.rigid else body.rigid[:, :0]
    return rigid, method.basis(body, variant, _count(body, variant, method))


def _count(body: Structure, variant: Variant, method: Method) -> int:
    """Elastic columns; all that there may be where the arguments decide."""
    check_size(body.size, variant, method)
    order = method.order(body.size) if method.order else variant.order or body.order
    return order - (body.rigid.shape[1] if method.rigid else 0)


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


def reduced(
    body: Structure,
    variant: Variant,
    model: FiniteElementModel | Intermediate,
    surface: Callable[[Array], Array],
    method: Method | None = None,
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
    method : Method, optional
        In place of the one that the variant names.
    """
    start = time.perf_counter()
    method = method or METHODS.entries()[variant.method]
    if method.spectrum is None:
        squared, shapes = project(body, variant, *basis(body, variant, method))
    else:
        squared, shapes = method.spectrum(body, variant, _count(body, variant, method))
        squared = np.concatenate([np.zeros(body.rigid.shape[1]), squared])
        shapes = np.hstack([body.rigid, shapes])
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
        turns=model.turns,
    )


def _with_order(variant: Variant, order: int) -> Variant:
    return Variant(variant.method, order, variant.points, variant.moments, variant.bands)
