"""Fixed-interface modes of a mirror whose mounts move: elastic coordinates on a moving rigid base.

Modes with the interface at rest cannot follow a motion of the mounts. In multibody dynamics they ride on the
rigid motion of the body's frame (Störkle 2018, Eq. 2.11), and its inertia excites them: that is right as long
as the mounts move as one rigid body (Section 4.5.1, "modalfix36").
"""

from dataclasses import replace

import numpy as np

from wavequake.errors import UserError
from wavequake.mechanics.model import Array, FiniteElementModel, ReducedModel
from wavequake.mechanics.vibration.drive import Drive, Harmonic
from wavequake.reduction.galerkin import project, reduced
from wavequake.reduction.intermediate import Intermediate, dense_structure
from wavequake.reduction.methods.component_modes import fixed_interface
from wavequake.reduction.names import Variant
from wavequake.reduction.structure import structure

CLAMPED = "modalfix"
_APART = 1e-9  # what of a motion of the mounts may be no rigid motion: rounding


def on_moving_base(model: FiniteElementModel | Intermediate, variant: Variant) -> ReducedModel:
    """Return the rigid motions of a model and so many fixed-interface modes, in modal coordinates.

    Raises
    ------
    UserError
        If the order does not suit the model.
    """
    body = dense_structure(model) if isinstance(model, Intermediate) else structure(model)
    clamped = reduced(body, variant, model, lambda shapes: model.surface @ shapes)
    squared, shapes = project(body, variant, body.rigid, fixed_interface(body, clamped.order))
    return replace(
        clamped,
        mass=np.eye(len(squared)),
        stiffness=np.diag(squared),
        damping_matrix=np.diag(body.damping.mass + body.damping.stiffness * squared),
        inputs=np.ascontiguousarray(shapes[body.interface].T),
        surface=np.asarray(model.surface @ shapes),
    )


def driven(model: ReducedModel, drive: Drive, name: str) -> tuple[ReducedModel, Drive]:
    """Return a model and its drive; where the mounts can only move rigidly, in terms of those motions.

    Parameters
    ----------
    model : ReducedModel
    drive : Drive
        Of all interface directions.
    name : str
        Of the excitation, for messages.

    Raises
    ------
    UserError
        If the drive moves mounts against each other that the model holds together.
    """
    if model.method != CLAMPED or not drive.prescribed.all():
        return model, drive
    left, sizes, _ = np.linalg.svd(model.inputs.T, full_matrices=False)
    motions = left[:, sizes > _APART * sizes[0]]
    patterns = [part for one in drive.harmonics for part in (one.cosine, one.sine)]
    moved = np.vstack([*patterns, *([] if drive.samples is None else [drive.samples])])
    if np.abs(moved - moved @ motions @ motions.T).max() > _APART * np.abs(moved).max():
        raise UserError(
            f"{model.name} holds the mounts together, and the excitation {name!r} moves them against each "
            f"other; let it act at all interfaces alike, or choose a variant such as craigb{model.order}"
        )
    return replace(model, inputs=model.inputs @ motions), Drive(
        np.ones(motions.shape[1], dtype=bool),
        tuple(_seen(one, motions) for one in drive.harmonics),
        samples=None if drive.samples is None else drive.samples @ motions,
    )


def _seen(harmonic: Harmonic, motions: Array) -> Harmonic:
    return replace(harmonic, cosine=harmonic.cosine @ motions, sine=harmonic.sine @ motions)
