"""Component mode synthesis: the families of Störkle 2018, Table 2.1, built from modes and static shapes.

Each function returns the elastic part of a basis, shape (n, count); `wavequake.reduction.galerkin` adds the
rigid motions, which every basis but that of fixed-interface modes contains.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

from wavequake.errors import UserError
from wavequake.mechanics.model import Array, Integers
from wavequake.reduction.method import Method, NormalModes, Variant, register
from wavequake.reduction.structure import (
    Size,
    Structure,
    clamped,
    elastic_flexibility,
    elastic_modes,
    fixed_modes,
    held,
)

MASSLESS_HZ = 1e6
"""Frequency of shapes that stand for massless ones."""

# Of the largest residual flexibility: below is rounding.
_NO_FLEXIBILITY = 1e-12


def modal(body: Structure, count: int) -> Array:
    """Free-interface normal modes (Hou 1969, Goldman 1969)."""
    return elastic_modes(body, count)[1]


def fixed_interface(body: Structure, count: int) -> Array:
    """Modes with the interface at rest: the thesis' modalfix, good only where the interface is held."""
    held(body)
    return fixed_modes(body, count, body.interface)[1]


def constraint_modes(body: Structure, interface: Integers) -> Array:
    """Return static shapes of unit displacements of `interface`, the others of them zero, shape (n, c)."""
    key = ("constraint", *interface.tolist())
    if key not in body.cache:
        shapes = np.zeros((body.order, len(interface)))
        shapes[interface, np.arange(len(interface))] = 1.0
        body.cache[key] = shapes - clamped(body, interface)(body.stiffness @ shapes)
    modes: Array = body.cache[key]
    return modes


def elastic_constraint_modes(body: Structure) -> Array:
    """Constraint modes of the interface motions that are not rigid, shape (n, 3 k - r)."""
    held(body)
    rigid = body.rigid[body.interface]
    motions = np.linalg.qr(rigid, mode="complete")[0][:, rigid.shape[1] :]
    return body.remove_rigid(constraint_modes(body, body.interface) @ motions)


def guyan(body: Structure, count: int) -> Array:
    """Condense statically to the interface (Guyan 1965)."""
    return elastic_constraint_modes(body)[:, :count]


def craig_bampton(body: Structure, count: int) -> Array:
    """Constraint modes and fixed-interface modes (Craig and Bampton 1968)."""
    static = elastic_constraint_modes(body)
    return np.hstack([static, fixed_modes(body, count - static.shape[1], body.interface)[1]])


def attachment_modes(body: Structure) -> Array:
    """Return static shapes of unit forces at the interface, under inertia relief, shape (n, 3 k)."""
    if "attachment" not in body.cache:
        body.cache["attachment"] = elastic_flexibility(body)(body.inputs)
    modes: Array = body.cache["attachment"]
    return modes


def inertia_relief(body: Structure, count: int) -> Array:
    """Free-interface modes and inertia-relief attachment modes."""
    static = attachment_modes(body)
    shapes = elastic_modes(body, count - static.shape[1])[1]
    # Beside many modes little is left of an attachment mode: what is left is what counts.
    return np.hstack([shapes, static - shapes @ (shapes.T @ (body.mass @ static))])


def rubin(body: Structure, count: int) -> Array:
    """Free-interface modes and residual attachment modes (Rubin 1975; Martinez 1984).

    With rigid motions, Rubin's basis, that of Martinez (dual Craig-Bampton) and that of inertia relief span
    one space.
    """
    return np.hstack(_modes_and_residual(body, count)[1:])


def _modes_and_residual(body: Structure, count: int) -> tuple[Array, Array, Array]:
    """Return squared frequencies and shapes of free modes, and what they leave of the static shapes.

    The residual flexibility is the static one less that of the kept modes.
    """
    static = attachment_modes(body)
    squared, shapes = elastic_modes(body, count - static.shape[1])
    return squared, shapes, static - shapes @ (shapes[body.interface].T / squared[:, None])


def macneal(body: Structure, count: int) -> tuple[Array, Array]:
    """Free-interface modes and residual flexibility without its mass (MacNeal 1971).

    A mass matrix must be positive definite, so the residual shapes get what puts their frequencies at
    `MASSLESS_HZ`: at 1 kHz a millionth of the residual flexibility is lost. They are orthogonal to the modes.

    Returns
    -------
    squared : ndarray, shape (count,)
        rad^2/s^2.
    shapes : ndarray, shape (n, count)
        With a mass of 1 each.

    Raises
    ------
    UserError
        If the modes leave no flexibility of some interface direction.
    """
    squared, shapes, residual = _modes_and_residual(body, count)
    flexibility = residual[body.interface]
    values, turn = np.linalg.eigh((flexibility + flexibility.T) / 2.0)
    if values[0] <= _NO_FLEXIBILITY * values[-1]:
        raise UserError(
            f"The {len(squared)} elastic modes leave no residual flexibility of some interface direction of "
            f"the model {body.name}, so macneal has too high an order; choose a lower one, or modal."
        )
    fast = 2.0 * np.pi * MASSLESS_HZ
    return (
        np.concatenate([squared, np.full(len(values), fast**2)]),
        np.hstack([shapes, residual @ (turn * (fast / np.sqrt(values)))]),
    )


def hintz(body: Structure, count: int) -> Array:
    """Mixed boundary (Hintz 1975): part of the interface fixed, the rest free.

    Fixed are those six directions that hold the body determinately (3-2-1), chosen by pivoted QR of the rigid
    motions; their constraint modes are the rigid motions. The others carry attachment modes, and the normal
    modes have the six at rest and the others free.
    """
    fixed = held(body)
    loaded = ~np.isin(body.interface, fixed)
    static = clamped(body, fixed)(body.inputs[:, loaded])
    squared, shapes = fixed_modes(body, count - static.shape[1], fixed)
    residual = static - shapes @ (shapes[body.interface[loaded]].T / squared[:, None])
    return body.remove_rigid(np.hstack([shapes, residual]))


def _check_damping(size: Size, variant: Variant) -> None:
    if size.damping.stiffness == 0:
        raise UserError(
            f"{variant}: shapes without mass ring when they are struck, unless the damping has a part "
            f"proportional to the stiffness, and that of the model {size.name} has none; choose rubin."
        )


def _interface(size: Size) -> int:
    return size.interface


def _rigid(size: Size) -> int:
    return size.rigid


def _register(name: str, basis: Callable[[Structure, int], Array], modes: NormalModes, **more: Any) -> None:
    def elastic(body: Structure, _: Variant, count: int) -> Array:
        return basis(body, count)

    register(Method(name, elastic, modes=modes, **more))


_ATTACHED = NormalModes(static=lambda size: size.rigid + size.interface, kind="attachment")
_CONSTRAINED = NormalModes(static=_interface, at_rest=_interface, kind="constraint")
_register("modal", modal, NormalModes(static=_rigid))
_register("guyan", guyan, _CONSTRAINED, order=_interface)
_register("modalfix", fixed_interface, NormalModes(static=lambda _: 0, at_rest=_interface), rigid=False)
_register("craigb", craig_bampton, _CONSTRAINED)
_register("rubin", rubin, _ATTACHED)
_register(
    "macneal",
    lambda body, count: macneal(body, count)[1],
    _ATTACHED,
    check=_check_damping,
    spectrum=lambda body, _, count: macneal(body, count),
)
_register("dualcb", rubin, _ATTACHED)
_register("inertia", inertia_relief, _ATTACHED)
# Its modes hold six directions, and those of an intermediate model all or none.
_register("hintz", hintz, NormalModes(static=_interface, at_rest=_rigid, kind="attachment", covered=0.5))
