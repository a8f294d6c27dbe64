"""Which orders suit a method and a model: known before anything is computed."""

from typing import NamedTuple

from wavequake.errors import UserError
from wavequake.mechanics.model import RayleighDamping
from wavequake.reduction.names import Variant

# Below this order dense algebra is faster than sparse.
DENSE = 600
_CONSTRAINT, _ATTACHMENT = ("craigb", "guyan"), ("rubin", "macneal", "dualcb", "inertia")
_GRAMIANS = ("bt", "flbt", "fwbt", "irka", "pod")


class Size(NamedTuple):
    """What of a model limits its variants.

    ``freedoms`` degrees of freedom, ``interface`` interface directions (3 k), ``rigid`` motions (0 to 6);
    ``dense`` where all modes are at hand.
    """

    name: str
    freedoms: int
    interface: int
    rigid: int
    damping: RayleighDamping
    dense: bool


def check_size(size: Size, variant: Variant, snapshots: bool = False) -> None:
    """Refuse a variant whose order or method does not suit a model.

    Parameters
    ----------
    size : Size
    variant : Variant
    snapshots : bool
        Whether pod is given some, so that none have to be generated.

    Raises
    ------
    UserError
    """
    method, order = variant.method, variant.order
    if method in _GRAMIANS and not snapshots and size.damping.mass == 0 == size.damping.stiffness:
        raise UserError(
            f"{variant}: balanced truncation, IRKA and POD need positive damping of every elastic mode, and "
            f"the model {size.name} has none; set its Rayleigh damping, or choose craigb, rubin or krylov."
        )
    if method == "macneal" and size.damping.stiffness == 0:
        raise UserError(
            f"{variant}: shapes without mass ring when they are struck, unless the damping has a part "
            f"proportional to the stiffness, and that of the model {size.name} has none; choose rubin."
        )
    if order is None:
        return
    if order > size.freedoms:
        raise UserError(
            f"The order of {variant} is above the {size.freedoms} degrees of freedom of the model "
            f"{size.name}."
        )
    rigid = 0 if method == "modalfix" else size.rigid
    if order <= rigid:
        raise UserError(
            f"The order of {variant} must be above {rigid}, the number of rigid motions of the model "
            f"{size.name}, which are always kept."
        )
    if method == "guyan" and order != size.interface:
        raise UserError(
            f"Static condensation of the model {size.name} to its interface has exactly the order "
            f"{size.interface}, not that of {variant}; for other orders choose craigb."
        )
    static = _static(size, method)
    if order < static:
        kind = "constraint" if method in _CONSTRAINT else "attachment"
        raise UserError(
            f"The order of {variant} is below the {static} rigid motions and {kind} modes that the interface "
            f"of the model {size.name} needs."
        )
    _check_modes(size, variant, order - static)


def _static(size: Size, method: str) -> int:
    """Columns beside normal modes, rigid motions included."""
    if method in _CONSTRAINT or method == "hintz":
        return size.interface
    if method in _ATTACHMENT:
        return size.rigid + size.interface
    return size.rigid if method == "modal" else 0


def _check_modes(size: Size, variant: Variant, count: int) -> None:
    method = variant.method
    if method in ("modal", *_ATTACHMENT):
        available, kind = size.freedoms - size.rigid, "elastic ones"
    elif method in ("craigb", "modalfix"):
        available, kind = size.freedoms - size.interface, f"with {size.interface} coordinates clamped"
    elif method == "hintz":
        available, kind = size.freedoms - size.rigid, f"with {size.rigid} coordinates clamped"
    else:
        return
    if count > available:
        raise UserError(
            f"{variant} asks for {count} modes of the model {size.name}, which has only {available} {kind}."
        )
    if not size.dense and 2 * count >= available:
        raise UserError(
            f"{variant} asks for {count} modes, too many for the {size.freedoms} degrees of freedom of the "
            f"model {size.name}; ask for fewer than half of them."
        )
