"""What a reduced model is worth: transfer matrices, errors, mode shapes, pseudo-eigenfrequencies."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy  # its parts load when first used
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import csc_array

from wavequake.errors import UserError
from wavequake.mechanics.model import Array, FiniteElementModel, ReducedModel, force_columns
from wavequake.mechanics.vibration.factors import factorize

Complex = NDArray[np.complex128]

# Below this, squares of norms agree in too many digits: their difference is good to 1e-7 above.
_CANCELLED = 1e-4
_TOGETHER = 16  # frequencies whose differences are summed while the caches hold them


@dataclass(frozen=True, eq=False)
class ModalForm:
    """A reduced model in its undamped modes, q'' + D q' + diag(squared) q = inputs f.

    Attributes
    ----------
    squared : ndarray, shape (r,)
        Squared angular pseudo-eigenfrequencies, rad^2/s^2, rising.
    damping : ndarray, shape (r, r)
        1/s; diagonal if the damping is proportional.
    inputs : ndarray, shape (r, 3 k)
        Forces; moments are left out, so that norms have one unit.
    modes : ndarray, shape (r, r)
        Mass-normalized modes in the coordinates of the model.
    """

    squared: Array
    damping: Array
    inputs: Array
    modes: Array


def modal_form(model: ReducedModel) -> ModalForm:
    """Return the undamped modes of a reduced model; at no cost if it is in its modes already.

    Raises
    ------
    UserError
        If the mass matrix is not positive definite.
    """
    squared = np.diag(model.stiffness)
    unit = np.eye(model.order)
    if (np.diff(squared) >= 0).all() and (model.mass == unit).all() and _is_diagonal(model.stiffness):
        return ModalForm(squared, model.damping_matrix, _forces(model), unit)
    try:
        squared, modes = scipy.linalg.eigh(model.stiffness, model.mass)
    except scipy.linalg.LinAlgError:
        raise UserError(
            f"The mass matrix of {model.name} is singular; it must be positive definite."
        ) from None
    return ModalForm(squared, modes.T @ model.damping_matrix @ modes, modes.T @ _forces(model), modes)


def _forces(model: ReducedModel) -> Array:
    return model.inputs[:, force_columns(model)] if len(model.turns) else model.inputs


def _is_diagonal(matrix: Array) -> bool:
    return bool(np.count_nonzero(matrix) == np.count_nonzero(np.diag(matrix)))


def pseudo_frequencies(model: ReducedModel) -> Array:
    """Return the eigenfrequencies of a reduced model in Hz, shape (r,), rising; the last is the largest."""
    frequencies: Array = np.sqrt(np.maximum(modal_form(model).squared, 0.0)) / (2 * np.pi)
    return frequencies


def receptance(model: ReducedModel, frequencies: ArrayLike, rows: Array | None = None) -> Complex:
    """Return the displacements per unit force over frequency, m/N.

    Proportional damping keeps the undamped modes, and all frequencies are one product of the resonances
    (f, r) with the modal contributions (r, entries); a symmetric matrix has only 3 k (3 k + 1) / 2 of them.

    Parameters
    ----------
    model : ReducedModel
    frequencies : array_like, shape (f,)
        Hz; positive for a body that is free to move.
    rows : ndarray, shape (o, r), optional
        Outputs, e.g. ``model.surface``; the interface displacements by default.

    Returns
    -------
    ndarray, shape (f, o or 3 k, 3 k)

    Raises
    ------
    UserError
        If a frequency is negative, not finite, or 0 with a rigid mode.
    """
    form = modal_form(model)
    omega = _angular(frequencies)
    if (omega == 0).any() and not form.squared[0] > 0:
        raise UserError(f"The model {model.name} is free to move: its response at 0 Hz is infinite.")
    if not _is_proportional(form):
        return _coupled(form, omega, form.inputs.T if rows is None else rows @ form.modes)
    resonances = _resonances(form, omega)
    count = form.inputs.shape[1]
    if rows is not None:
        products = (rows @ form.modes).T[:, :, None] * form.inputs[:, None, :]
        return _times_real(resonances, products.reshape(len(form.squared), -1)).reshape(len(omega), -1, count)
    first, second = np.triu_indices(count)
    entries = _times_real(resonances, form.inputs[:, first] * form.inputs[:, second])
    place = np.zeros((count, count), dtype=np.int64)
    place[first, second] = place[second, first] = np.arange(len(first))
    return entries[:, place.ravel()].reshape(len(omega), count, count)


def acceleration(model: ReducedModel, frequencies: ArrayLike, rows: Array | None = None) -> Complex:
    """Return accelerations per unit force over frequency, m/s^2/N; arguments as `receptance`."""
    return -(_angular(frequencies)[:, None, None] ** 2) * receptance(model, frequencies, rows)


def _angular(frequencies: ArrayLike) -> Array:
    values = np.atleast_1d(np.asarray(frequencies, dtype=float))
    if values.ndim != 1 or not len(values) or not (np.isfinite(values) & (values >= 0)).all():
        raise UserError("Frequencies must be finite, not negative, and at least one.")
    omega: Array = 2 * np.pi * values
    return omega


def _is_proportional(form: ModalForm) -> bool:
    off = form.damping - np.diag(np.diag(form.damping))
    return bool(np.abs(off).max(initial=0.0) <= 1e-9 * np.abs(form.damping).max(initial=0.0))


def _times_real(left: NDArray[Any], right: Array) -> Complex:
    """Complex times real by one real product: real and imaginary part are neighbours in memory."""
    count = len(left)
    parts = np.concatenate([left.real, left.imag]) @ right
    return parts[:count] + 1j * parts[count:]


def _coupled(form: ModalForm, omega: Array, rows: Array) -> Complex:
    """Damping that couples the modes: one solution per frequency."""
    dynamic = 1j * omega[:, None, None] * form.damping
    diagonal = np.arange(len(form.squared))
    dynamic[:, diagonal, diagonal] += form.squared - omega[:, None] ** 2
    result: Complex = rows @ np.linalg.solve(dynamic, form.inputs[None].astype(complex))
    return result


def full_receptance(
    model: FiniteElementModel, frequencies: ArrayLike, progress: Callable[[int], None] | None = None
) -> Complex:
    """Return the interface receptance of the full model, shape (f, 3 k, 3 k): one factorization each.

    Parameters
    ----------
    model : FiniteElementModel
    frequencies : array_like, shape (f,)
        Hz, positive.
    progress : callable, optional
        Called with the number of frequencies done.
    """
    omega = _angular(frequencies)
    inputs = model.inputs.toarray()[:, force_columns(model)]
    damping = model.damping_matrix
    result = np.zeros((len(omega), inputs.shape[1], inputs.shape[1]), dtype=complex)
    for place, value in enumerate(omega):
        dynamic = csc_array(model.stiffness + 1j * value * damping - value**2 * model.mass)
        result[place] = inputs.T @ factorize(dynamic).solve(inputs.astype(complex))
        if progress is not None:
            progress(place + 1)
    return result


def frobenius(transfer: Complex) -> Array:
    """Return the Frobenius norm of transfer matrices (f, o, i), shape (f,)."""
    return np.sqrt(_squares(transfer))


def _squares(transfer: Complex) -> Array:
    """Return the sums of squares of matrices (f, o, i); `np.linalg.norm` makes two copies before."""
    flat = np.ascontiguousarray(transfer, dtype=np.complex128).reshape(len(transfer), -1).view(np.float64)
    return np.asarray(np.einsum("fe,fe->f", flat, flat))


def eps_mor(reference: Complex, reduced: Complex) -> Array:
    """Return the relative error of a reduced model over frequency, Störkle 2018, Eq. 2.10.

    Parameters
    ----------
    reference, reduced : ndarray, shape (f, o, i)
        Transfer matrices; acceleration and receptance give the same error.

    Returns
    -------
    ndarray, shape (f,)
    """
    if reference.shape != reduced.shape:
        raise UserError(
            f"Transfer matrices of the shapes {reference.shape} and {reduced.shape} cannot be compared; use "
            "the same frequencies, interface nodes and outputs."
        )
    parts = (slice(first, first + _TOGETHER) for first in range(0, len(reference), _TOGETHER))
    apart = [_squares(reference[part] - reduced[part]) for part in parts]  # what the caches hold
    error: Array = np.sqrt(np.concatenate([np.zeros(0), *apart])) / frobenius(reference)
    return error


@dataclass(frozen=True, eq=False)
class Residues:
    """A reference whose many variants are compared output by output: what `eps_of` needs of it.

    Attributes
    ----------
    transfer : ndarray, shape (f, o, 3 k)
        Its receptance.
    resonances : ndarray, shape (f, r)
        1 / (squared - omega^2 + i omega damping) of its modes; none if damping couples them.
    rows : ndarray, shape (o, r)
        Outputs per mode.
    inputs : ndarray, shape (r, 3 k)
    norms : ndarray, shape (f,)
        Of its transfer matrices.
    """

    transfer: Complex
    resonances: Complex | None
    rows: Array
    inputs: Array
    norms: Array


def residues(model: ReducedModel, frequencies: ArrayLike, rows: Array) -> Residues:
    """Prepare a reference for `eps_of`; arguments and errors as of `receptance`."""
    transfer, form = receptance(model, frequencies, rows), modal_form(model)
    resonances = _resonances(form, _angular(frequencies)) if _is_proportional(form) else None
    return Residues(transfer, resonances, rows @ form.modes, form.inputs, frobenius(transfer))


def eps_of(
    reference: Residues, model: ReducedModel, frequencies: ArrayLike, rows: Array
) -> tuple[Array, Array]:
    """Return the norm of a model's transfer matrices, and `eps_mor` against a reference, each (f,).

    A transfer matrix is a sum of modes, H = sum d_a c_a b_a^T, so that inner products of two of them are
    those of few resonances: <H, G> = d^H [(C^T C') o (B B'^T)] d'. Where an error is too small to be the
    difference of such products, it is that of the matrices themselves.

    Parameters
    ----------
    reference : Residues
        At the same frequencies.
    model, frequencies, rows
        As for `receptance`.
    """
    form = modal_form(model)
    if reference.resonances is None or not _is_proportional(form):
        transfer = receptance(model, frequencies, rows)
        return frobenius(transfer), eps_mor(reference.transfer, transfer)
    own, columns = _resonances(form, _angular(frequencies)), rows @ form.modes
    whole = _inner(own, own, (columns.T @ columns) * (form.inputs @ form.inputs.T))
    products = (reference.rows.T @ columns) * (reference.inputs @ form.inputs.T)
    both = _inner(reference.resonances, own, products)
    apart = np.maximum(reference.norms**2 + whole - 2.0 * both, 0.0)
    error = np.sqrt(apart) / reference.norms
    small = np.flatnonzero(~(error > _CANCELLED))
    if len(small):
        exact = receptance(model, np.atleast_1d(frequencies)[small], rows)
        error[small] = eps_mor(reference.transfer[small], exact)
    return np.sqrt(whole), error


def _inner(first: Complex, second: Complex, products: Array) -> Array:
    """Return the real part of first^H products second at each frequency."""
    turned = _times_real(first, products)
    total: Array = (turned.real * second.real + turned.imag * second.imag).sum(axis=1)
    return total


def _resonances(form: ModalForm, omega: Array) -> Complex:
    rates = np.diag(form.damping)
    return np.asarray(1.0 / (form.squared - omega[:, None] ** 2 + 1j * omega[:, None] * rates))


def surface_modes(model: ReducedModel) -> Array:
    """Return the mode shapes at the optical nodes, shape (3 p, r), mass-normalized."""
    shapes: Array = model.surface @ modal_form(model).modes
    return shapes


def interface_modes(model: ReducedModel) -> Array:
    """Return the mode shapes at the interface nodes, shape (3 k, r), mass-normalized."""
    return modal_form(model).inputs.T


def mac(first: Array, second: Array, weights: Array | csc_array | None = None) -> Array:
    """Return the modal assurance criterion of each shape of one model with each of another (Allemang 1982).

    Parameters
    ----------
    first, second : ndarray, shapes (n, a) and (n, b)
        Mode shapes at the same places.
    weights : ndarray or csc_array, shape (n, n), optional
        For instance the mass matrix.

    Returns
    -------
    ndarray, shape (a, b)
        From 0 to 1; 0 for a shape that is zero.
    """
    if len(first) != len(second):
        raise UserError(f"Mode shapes at {len(first)} and {len(second)} places cannot be compared.")
    weighted, other = (first, second) if weights is None else (weights @ first, weights @ second)
    energies = np.einsum("ij,ij->j", first, weighted)[:, None] * np.einsum("ij,ij->j", second, other)
    criterion: Array = (weighted.T @ second) ** 2 / np.where(energies > 0, energies, 1.0)
    return criterion


def participation(model: ReducedModel) -> Array:
    """Return how strongly unit forces drive each mode, and it them: shape (r, 3 k), in kg^(-1/2).

    Products of two columns are the residues of the transfer function between the two.
    """
    return modal_form(model).inputs


def relative_errors(reference: Complex, variants: Sequence[ReducedModel], frequencies: ArrayLike) -> Array:
    """Return `eps_mor` of many variants against one reference, shape (variants, f)."""
    return np.array([eps_mor(reference, receptance(variant, frequencies)) for variant in variants])
