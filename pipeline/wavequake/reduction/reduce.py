"""Reduce a finite-element model by one method."""

from collections.abc import Callable
from functools import partial

from wavequake.errors import UserError
from wavequake.mechanics.model import Array, FiniteElementModel, ReducedModel
from wavequake.prepared import preparing
from wavequake.reduction.galerkin import reduced
from wavequake.reduction.intermediate import Intermediate, dense_structure, intermediate
from wavequake.reduction.method import METHODS, Variant
from wavequake.reduction.names import parse
from wavequake.reduction.own import OWN, Given, own_model
from wavequake.reduction.structure import structure

Keep = Callable[[float, Callable[[], Intermediate]], Intermediate]


def reduce(
    model: FiniteElementModel,
    method: str | Variant | Given,
    order: int | None = None,
    *,
    snapshots: Array | None = None,
) -> ReducedModel:
    """Reduce a finite-element model, directly.

    Factorizations and modes are kept with the model and shared by later calls. IRKA, balanced truncation and
    POD from generated snapshots work on all elastic modes of a small model, and on the intermediate model of
    a large one (built for bands of 1200 Hz, or as high as the variant's own).

    A body of threefold symmetry has pairs of modes of equal frequency. A method that truncates modes between
    the two keeps the one that moves the interface's first coordinates most: prefer orders that keep both.

    Parameters
    ----------
    model : FiniteElementModel
    method : str, Variant, array_like, mapping or pyMOR model
        A name such as ``craigb36`` or ``krylov108(200,450,700)``, or a bare method such as ``rubin``; or what
        somebody else has made of the model, as `wavequake.reduction.own.own_model` takes it.
    order : int, optional
        For a bare method.
    snapshots : ndarray, shape (n, m), optional
        Displacements in m, for pod.

    Raises
    ------
    UserError
        If the method is unknown, the order does not suit it or the model, or a matrix is singular.

    Examples
    --------
    >>> reduce(model, "craigb36").order  # doctest: +SKIP
    36
    """
    if not isinstance(model, FiniteElementModel):
        raise UserError(f"Only a finite-element model can be reduced, not a {type(model).__name__}.")
    if not isinstance(method, str | Variant):
        return own_model(model, method, OWN)
    variant = parse(method, order) if isinstance(method, str) else method
    chosen = METHODS.entries()[variant.method]
    if snapshots is not None:
        if chosen.of_snapshots is None:
            raise UserError(f"Snapshots are for pod, not for {variant}.")
        chosen = chosen.of_snapshots(snapshots)
    body = structure(model)
    if needs_intermediate(model, variant):
        stage = shared_intermediate(model, variant)
        return reduced(dense_structure(stage), variant, stage, lambda shapes: stage.surface @ shapes)
    rows = model.surface
    return reduced(body, variant, model, lambda shapes: rows @ shapes, chosen)


@preparing()
def shared_intermediate(
    model: FiniteElementModel, variant: Variant, keep: Keep | None = None
) -> Intermediate:
    """Return the intermediate model that methods of dense matrices reduce; all variants of a model share it.

    Parameters
    ----------
    model : FiniteElementModel
        Large enough to need one.
    variant : Variant
    keep : callable, optional
        Given the highest frequency, Hz, and what builds it, returns it: from disk, for instance.
    """
    cache = structure(model).cache
    highest = max(
        [1200.0] + [high for _, high, _ in variant.bands] + [abs(point) for point in variant.points]
    )
    key = ("intermediate", highest)
    if key not in cache:
        build = partial(intermediate, model, highest=highest)
        cache[key] = build() if keep is None else keep(highest, build)
    stage: Intermediate = cache[key]
    return stage


def needs_intermediate(model: FiniteElementModel, variant: Variant) -> bool:
    """Return whether a variant is made from the intermediate model: of a large model by a dense method."""
    return METHODS.entries()[variant.method].dense and not structure(model).is_dense
