"""Sweeps: many variants from one intermediate model, checked against the full model.

Variants that the intermediate model does not cover are reduced directly.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from wavequake.errors import UserError
from wavequake.mechanics.model import Array, FiniteElementModel, ReducedModel
from wavequake.reduction.galerkin import reduced
from wavequake.reduction.intermediate import Intermediate, dense_structure
from wavequake.reduction.limits import check_size
from wavequake.reduction.method import METHODS, Variant
from wavequake.reduction.metrics import full_receptance, relative_errors
from wavequake.reduction.names import parse
from wavequake.reduction.reduce import reduce
from wavequake.reduction.structure import DENSE, Size, Structure


def reference(model: Intermediate) -> ReducedModel:
    """Return the whole intermediate model as a reduced model: what a sweep is compared with."""
    whole = Variant("modal", model.order)
    return reduced(dense_structure(model), whole, model, lambda shapes: model.surface @ shapes)


def covers(model: Intermediate, variant: Variant) -> bool:
    """Whether a variant of the intermediate model stands for that of the full model.

    Modes must be among those that the basis holds, expansion points and bands inside its band, and other
    orders not above two thirds of its order.
    """
    if model.order == model.full_order:
        return True
    size, order = _size(model), variant.order or 0
    modes = METHODS.entries()[variant.method].modes
    if modes is not None:
        return order - modes.static(size) <= int(modes.covered * model.modes)
    if variant.moments:
        order = size.rigid + size.interface * sum(variant.moments)
    highest = max([abs(point) for point in variant.points] + [high for _, high, _ in variant.bands] + [0.0])
    return bool(highest <= model.highest and 3 * order <= 2 * model.order)


def check_variants(model: Intermediate, variants: Sequence[str | Variant]) -> None:
    """Refuse what cannot be reduced, before anything is; orders are those of the full model.

    Raises
    ------
    UserError
        If an order does not suit the method and the model, or the method needs damping that is not there.
    """
    size = _size(model)
    for name in variants:
        check_size(size, parse(name) if isinstance(name, str) else name)


def _size(model: Intermediate) -> Size:
    """Of the full model."""
    interface, rigid = 3 * len(model.interfaces), model.rigid.shape[1]
    dense = model.full_order <= DENSE
    return Size(model.name, model.full_order, interface, rigid, model.damping, dense)


def reduce_variants(
    model: Intermediate,
    variants: Sequence[str | Variant],
    full: FiniteElementModel | None = None,
    *,
    optics: bool = True,
) -> list[ReducedModel]:
    """Return the reduced models of many variants.

    Parameters
    ----------
    model : Intermediate
    variants : sequence of str or Variant
    full : FiniteElementModel, optional
        Reduces those variants directly that the intermediate model does not cover (`covers`).
    optics : bool
        False leaves out the optical nodes, which cost more than all the rest where only interfaces matter.

    Raises
    ------
    UserError
        If a variant is not covered and the full model is not given, or does not suit the model.
    """
    if not optics:
        model = replace(
            model,
            surface=model.surface[:0],
            surface_nodes=model.surface_nodes[:0],
            surface_weights=np.zeros(0),
        )
    body = dense_structure(model)
    chosen = [parse(name) if isinstance(name, str) else name for name in variants]
    return [_reduce_one(model, body, variant, full) for variant in chosen]


def _reduce_one(
    model: Intermediate, body: Structure, variant: Variant, full: FiniteElementModel | None
) -> ReducedModel:
    if covers(model, variant):
        return reduced(body, variant, model, lambda shapes: model.surface @ shapes)
    if full is None:
        raise UserError(
            f"The variant {variant} is outside what the intermediate model of {model.name} covers "
            f"({model.modes} modes, {model.highest:g} Hz, order {model.order}); give the full model too."
        )
    return reduce(full, variant)


def spot_check(model: FiniteElementModel, variants: Sequence[ReducedModel], frequencies: ArrayLike) -> Array:
    """Return errors (Störkle 2018, Eq. 2.10) of variants against full-size solutions, shape (variants, f).

    Choose frequencies on which no basis was built. Below about 10 Hz the full-size solution of a free body is
    itself good to some 1e-7 only, for its dynamic stiffness is almost singular there.

    Parameters
    ----------
    model : FiniteElementModel
    variants : sequence of ReducedModel
        For instance the `reference` of a sweep and some of its variants.
    frequencies : array_like, shape (f,)
        Hz; each costs one sparse factorization.
    """
    return relative_errors(full_receptance(model, frequencies), variants, frequencies)
