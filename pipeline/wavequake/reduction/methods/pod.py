"""Proper orthogonal decomposition (Sirovich 1987): the directions that snapshots of a motion use most."""

import numpy as np
from numpy.typing import NDArray

from wavequake.errors import UserError
from wavequake.mechanics.model import Array
from wavequake.reduction.directions import turn_equal
from wavequake.reduction.method import Method, Variant, register
from wavequake.reduction.methods.balanced import check_damping, oscillators
from wavequake.reduction.structure import Structure, elastic_modes

# Instants of generated snapshots, and how long they last in periods of the lowest elastic mode.
_INSTANTS = 400
_PERIODS = 8.0


def pod(body: Structure, count: int, snapshots: Array) -> Array:
    """Return the elastic part of the strongest directions of snapshots, in the norm of the mass, (n, count).

    Parameters
    ----------
    body : Structure
    count : int
    snapshots : ndarray, shape (n, m)
        Displacements in m, one instant per column.

    Raises
    ------
    UserError
        If the snapshots do not fit the model, are not finite, or span fewer directions than `count`.
    """
    if (
        snapshots.ndim != 2
        or snapshots.shape[0] != body.order
        or not snapshots.size
        or not np.isfinite(snapshots).all()
    ):
        raise UserError(
            f"Snapshots of the model {body.name} must be finite and have {body.order} rows, one per degree "
            f"of freedom; these have the shape {snapshots.shape}."
        )
    elastic = body.remove_rigid(snapshots)
    energies, turn = np.linalg.eigh(elastic.T @ (body.mass @ elastic))
    known = int((energies > 1e-14 * energies[-1]).sum()) if energies[-1] > 0 else 0
    if count > known:
        raise UserError(
            f"The {snapshots.shape[1]} snapshots of the model {body.name} span {known} elastic directions, "
            f"fewer than the {count} wanted; give more snapshots or a lower order."
        )
    energies, turn = energies[::-1][:known], turn[:, ::-1][:, :known]
    basis = elastic @ (turn / np.sqrt(energies))
    return turn_equal(energies, basis, basis[body.interface])[:, :count]


def generated(body: Structure, frequency: float | None) -> Array:
    """Return the weighted principal directions of responses to all interface forces, shape (n, modes).

    They stand for 400 instants over eight periods of the lowest elastic mode, and span the same.

    Parameters
    ----------
    body : Structure
        Dense.
    frequency : float or None
        Sine force in Hz that starts suddenly from rest; None for impulses.
    """
    squared, dampings, inputs = oscillators(body)
    lowest = np.sqrt(squared[0])
    instants = np.arange(1, _INSTANTS + 1) * (2 * np.pi * _PERIODS / lowest / _INSTANTS)
    if frequency is None:
        response = _impulse(squared, dampings, instants)
    else:
        response = _sine(squared, dampings, instants, 2 * np.pi * frequency)
    shapes = elastic_modes(body, len(squared))[1]
    modal = response[:, :, None] * inputs[:, None, :]
    energies, turn = np.linalg.eigh(np.einsum("itp,jtp->ij", modal, modal, optimize=True))
    snapshots: Array = shapes @ (turn * np.sqrt(np.maximum(energies, 0.0)))
    return snapshots


def _poles(squared: Array, dampings: Array) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
    half = dampings / 2
    swing: NDArray[np.complex128] = np.sqrt((half**2 - squared).astype(complex))
    swing = np.where(np.abs(swing) < 1e-4 * half, 1e-4 * half, swing)
    return (-half + swing)[:, None], (-half - swing)[:, None]


def _impulse(squared: Array, dampings: Array, instants: Array) -> Array:
    first, second = _poles(squared, dampings)
    response: Array = ((np.exp(first * instants) - np.exp(second * instants)) / (first - second)).real
    return response


def _sine(squared: Array, dampings: Array, instants: Array, omega: float) -> Array:
    """Response from rest to sin(omega t): the imaginary part of that to exp(i omega t), by residues."""
    first, second = _poles(squared, dampings)
    drive = 1j * omega
    forced = np.exp(drive * instants) / ((drive - first) * (drive - second))
    # Real input: residues of omega / (s^2 + omega^2) / ((s - p1)(s - p2)) at the oscillator's poles.
    free = [
        omega / (pole**2 + omega**2) * np.exp(pole * instants) / (pole - other)
        for pole, other in ((first, second), (second, first))
    ]
    response: Array = forced.imag + (free[0] + free[1]).real
    return response


def _basis(body: Structure, variant: Variant, count: int) -> Array:
    return pod(body, count, generated(body, variant.points[0].real if variant.points else None))


def _of_snapshots(snapshots: Array) -> Method:
    return Method("pod", lambda body, _, count: pod(body, count, snapshots), arguments="frequency")


register(
    Method(
        "pod",
        _basis,
        arguments="frequency",
        dense=True,
        check=check_damping,
        of_snapshots=_of_snapshots,
    )
)
