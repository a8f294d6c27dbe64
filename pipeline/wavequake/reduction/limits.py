"""Which orders suit a method and a model: known before anything is computed."""

from wavequake.errors import UserError
from wavequake.reduction.method import METHODS, Method, NormalModes, Variant
from wavequake.reduction.structure import Size


def check_size(size: Size, variant: Variant, method: Method | None = None) -> None:
    """Refuse a variant whose order or method does not suit a model.

    Parameters
    ----------
    size : Size
    variant : Variant
    method : Method, optional
        In place of the one that the variant names.

    Raises
    ------
    UserError
    """
    method = method or METHODS.entries()[variant.method]
    method.check(size, variant)
    order = variant.order
    if order is None:
        return
    if order > size.freedoms:
        raise UserError(
            f"The order of {variant} is above the {size.freedoms} degrees of freedom of the model "
            f"{size.name}."
        )
    rigid = size.rigid if method.rigid else 0
    if order <= rigid:
        raise UserError(
            f"The order of {variant} must be above {rigid}, the number of rigid motions of the model "
            f"{size.name}, which are always kept."
        )
    if method.order is not None and order != method.order(size):
        raise UserError(
            f"The method {method.name} gives the model {size.name} exactly the order {method.order(size)}, "
            f"not that of {variant}; for other orders choose craigb."
        )
    if method.modes is not None:
        _check_modes(size, variant, method.modes)


def _check_modes(size: Size, variant: Variant, modes: NormalModes) -> None:
    static = modes.static(size)
    count = (variant.order or static) - static
    if count < 0:
        raise UserError(
            f"The order of {variant} is below the {static} rigid motions and {modes.kind} modes that the "
            f"interface of the model {size.name} needs."
        )
    clamped = None if modes.at_rest is None else modes.at_rest(size)
    available = size.freedoms - (size.rigid if clamped is None else clamped)
    if count > available:
        kind = "elastic ones" if clamped is None else f"with {clamped} coordinates clamped"
        raise UserError(
            f"{variant} asks for {count} modes of the model {size.name}, which has only {available} {kind}."
        )
    if not size.dense and 2 * count >= available:
        raise UserError(
            f"{variant} asks for {count} modes, too many for the {size.freedoms} degrees of freedom of the "
            f"model {size.name}; ask for fewer than half of them."
        )
