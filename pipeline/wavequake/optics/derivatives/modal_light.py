"""The modal model of any optical system: wavefronts of small motions without tracing a ray.

What is linear in the optical path difference (OPD) of the rays is one matrix product per batch of motions
(Störkle 2018, Eq. 4.21), and means of squares over the rays are lengths of vectors, so that no ray is ever
formed. Second derivatives bound what is left out.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from wavequake.errors import UserError
from wavequake.kernels.device.devices import Device
from wavequake.optics.derivatives.central import FAINT, SIGNS, central, checked_derivative
from wavequake.optics.systems.paraxial import paraxial
from wavequake.optics.systems.system import States
from wavequake.optics.wavefronts.fits import fit_with_plane
from wavequake.optics.wavefronts.record import Wavefront
from wavequake.optics.wavefronts.wavefront import PreparedSystem, line_of_sight, trace_system

Array = NDArray[np.float64]
Move = Callable[[Array], States]
"""From motions (K, D) to the states of K instants."""

_MM_PER_M = 1e3
_AT_ONCE = 64  # instants of a launch, a constant shape


class Motions(NamedTuple):
    """The motions that a model knows: how they move a system, and the steps (D,) of their differences.

    Those that are ``turns`` (D,), in rad, share a scale, and all others, in m, do.
    """

    move: Move
    steps: Array
    turns: NDArray[np.bool_]


@dataclass(frozen=True)
class ModalLight:
    """Wavefronts of a field and wavelength as they follow motions q (D,), by way of p = (1, q).

    Attributes
    ----------
    columns : ndarray, shape (1 + D, J + 6)
        J Zernike coefficients (waves), then chief ray, line of sight and centroid (mm, x and y of each).
    raw, flat, spot : ndarray, shape (m, 1 + D)
        The length of their product with p is the rms over the rays of the OPD without piston, and about its
        plane (waves), and that of the image points about their centroid (mm).
    """

    columns: Array
    raw: Array
    flat: Array
    spot: Array


def modal_light(prepared: PreparedSystem, device: Device, motions: Motions) -> ModalLight:
    """Trace the derivatives of the wavefront with respect to motions.

    Parameters
    ----------
    prepared : PreparedSystem
        With coefficients from path lengths about the chief ray (no `slopes`, no `sphere`).
    device : Device
    motions : Motions

    Raises
    ------
    UserError
        If the wavefront is not fitted as the model needs it, no ray arrives, or the derivatives with a step
        and with twice that do not agree.
    """
    if prepared.slopes is not None or prepared.sphere is not None:
        raise UserError("The modal model needs coefficients from path lengths about the chief ray.")
    count, wavelength = len(motions.steps), prepared.wavelength
    signs = np.concatenate([np.zeros((1, count)), *(sign * np.eye(count) for sign in SIGNS)])
    opd, x, y, chief = _traced(prepared, device, motions, signs)
    arrives = _arrive(opd)
    opd[:, ~arrives] = np.nan
    scale = FAINT / wavelength * np.where(motions.turns, paraxial(prepared.system).stop_radius, _MM_PER_M)
    remedy = "choose optics.light = 'traced'"
    around = opd[1:].reshape(4, count, -1).swapaxes(1, 2)
    slope = checked_derivative(around, motions.steps, "the path lengths", remedy, 0, motions.turns, scale).T
    waves = np.concatenate([opd[:1], slope])
    points = [np.concatenate([one[:1], _slopes(one, motions.steps)]) for one in (x, y)]
    toward = np.concatenate([chief[:1], _slopes(chief, motions.steps)])
    zernike, slopes = fit_with_plane(prepared.fit, waves)
    sight = line_of_sight(prepared, toward, zernike)
    weight = _normed(prepared.fit.weight, arrives)
    inside = [one[:, arrives] for one in (waves, *points)]
    centroid = np.stack([one @ weight for one in inside[1:]], axis=1)
    plane = slopes @ prepared.fit.basis[arrives, 1:3].T
    return ModalLight(
        columns=np.hstack([zernike, toward, sight, centroid]),
        raw=_root(weight, inside[0]),
        flat=_root(weight, inside[0] - plane),
        spot=_root(weight, *inside[1:]),
    )


def curvatures(prepared: PreparedSystem, device: Device, motions: Motions) -> Array:
    """Return the rms over the rays, without piston, of the second derivatives of the OPD (D, D), waves.

    By steps of twice the width, since rounding is divided by their square.
    """
    count, steps = len(motions.steps), 2.0 * motions.steps
    first, second = np.triu_indices(count, 1)
    one = np.eye(count)
    still, ahead, back = (
        _traced(prepared, device, motions, 2.0 * signs)[0] for signs in (np.zeros((1, count)), one, -one)
    )
    arrives = _arrive(np.concatenate([still, ahead, back]))
    weight = _normed(prepared.fit.weight, arrives)
    still, ahead, back = (part[:, arrives] for part in (still, ahead, back))
    bend = ahead + back - 2.0 * still
    found = np.diag(_rms(weight, bend) / steps**2)
    for begin in range(0, len(first), _AT_ONCE):
        i, j = first[begin : begin + _AT_ONCE], second[begin : begin + _AT_ONCE]
        both = one[i] + one[j]
        there, here = (_traced(prepared, device, motions, sign * both)[0][:, arrives] for sign in (2.0, -2.0))
        twist = 0.5 * _rms(weight, np.nan_to_num(there + here - bend[i] - bend[j] - 2.0 * still))
        found[i, j] = found[j, i] = twist / (steps[i] * steps[j])
    return found


def wavefronts(light: ModalLight, motions: Array) -> Wavefront:
    """Return the wavefronts of motions (T, D); peak to valley and Strehl ratio, which it does not know, NaN.

    The bits of a batch depend on the others in it: give the instants of a case together, and no more.
    """
    whole = np.hstack([np.ones((len(motions), 1)), motions])
    found = whole @ light.columns
    zernike, chief, los, centroid = np.split(found, [-6, -4, -2], axis=1)
    raw, flat, spot = (np.linalg.norm(whole @ root.T, axis=1) for root in (light.raw, light.flat, light.spot))
    unknown, none = np.full(len(motions), np.nan), np.zeros(len(motions), np.int64)
    return Wavefront(
        zernike=zernike,
        rms_raw=raw,
        rms_flat=flat,
        pv=unknown,
        chief=chief,
        los=los,
        centroid=centroid,
        spot_rms=spot,
        strehl=unknown,
        lost=none,
        vignetted=none,
    )


def error_bound(curvature: Array, motions: Array) -> float:
    """Return a bound of the rms over the rays, in waves, of what the model leaves out of motions (T, D).

    It is that of the second-order term, by the triangle inequality. Third order is to second order as that is
    to the first.
    """
    sizes = np.abs(motions)
    return float(0.5 * np.sum((sizes @ curvature) * sizes, axis=1).max(initial=0.0))


def _traced(
    prepared: PreparedSystem, device: Device, motions: Motions, signs: Array
) -> tuple[Array, Array, Array, Array]:
    """Trace motions of so many steps (K, D): OPD in waves, x, y (K, N) and chief ray (K, 2)."""
    parts = []
    for begin in range(0, len(signs), _AT_ONCE):
        some = signs[begin : begin + _AT_ONCE]
        padded = np.zeros((_AT_ONCE, signs.shape[1]))
        padded[: len(some)] = some
        opd, traced, chief = trace_system(prepared, motions.move(padded * motions.steps), device)
        parts.append([np.array(one)[: len(some)] for one in (opd, traced.x, traced.y, chief)])
    opd, x, y, chief = (np.concatenate(part) for part in zip(*parts, strict=True))
    return opd, x, y, chief


def _slopes(values: Array, steps: Array) -> Array:
    """Return central differences (D, ...) of what is there at rest and at +1, -1, +2, -2 steps of each."""
    around = values[1:].reshape(4, len(steps), -1)
    return central(around, steps[:, None])


def _normed(weight: Array, arrives: NDArray[np.bool_]) -> Array:
    if not arrives.any():
        raise UserError("no ray arrives where it has derivatives; choose optics.light = 'traced'")
    return np.asarray(weight[arrives] / weight[arrives].sum())


def _root(weight: Array, *values: Array) -> Array:
    """Return the matrix whose product with p has the length of the rms of p @ values about their mean."""
    about = [np.sqrt(weight) * (one - (one @ weight)[:, None]) for one in values]
    return np.asarray(np.linalg.qr(np.concatenate(about, axis=1).T, mode="r"))


def _arrive(opd: Array) -> NDArray[np.bool_]:
    """Return which rays (N,) arrive at all instants; of one at the edge of an opening nothing is known."""
    return np.asarray(np.isfinite(opd).all(axis=0), dtype=np.bool_)


def _rms(weight: Array, values: Array) -> Array:
    return np.asarray(np.sqrt((values - (values @ weight)[:, None]) ** 2 @ weight))
