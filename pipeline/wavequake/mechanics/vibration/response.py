"""Exact time response of linear models: what an integrator approximates, computed without one.

Between two instants a linear model under a harmonic or a straight line obeys x' = A x + G u with u' = S u, so
one matrix exponential per mode and per kind of input gives the exact step (free, critically and overdamped
modes and resonance need no case of their own). The steps are then chained in blocks, all modes at once.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import scipy  # its parts load when first used
from numpy.typing import NDArray

from wavequake.errors import UserError
from wavequake.mechanics.model import Array, Integers
from wavequake.mechanics.vibration.drive import Drive, values
from wavequake.mechanics.vibration.exponential import exponentials
from wavequake.mechanics.vibration.modal import ModalModel

_COUPLED = 1e-12


@dataclass(frozen=True)
class Response:
    """Motion of a model over time, batch of cases first; displacements are what `displacements` makes of it.

    Attributes
    ----------
    time : ndarray, shape (t,)
        s.
    coordinates : ndarray, shape (case, t, r)
        Elastic modal coordinates.
    rigid : ndarray, shape (case, t, f)
        Coordinates of the free modes; six for a free body, none for a held one.
    drive : ndarray, shape (case, t, c)
        Prescribed displacements, m.
    modes, rigid_modes, lift : ndarray, shapes (n, r), (n, f), (n, c)
        What the three are multiplied with to give the coordinates of the model.
    """

    time: Array
    coordinates: Array
    rigid: Array
    drive: Array
    modes: Array
    rigid_modes: Array
    lift: Array


@dataclass(frozen=True)
class _Block:
    """Modes that do not interact with others: first-order systems of states (scale x, x' - G1 u).

    ``modes`` (g, m), ``system`` (g, 2 m, 2 m), ``inputs`` (g, 2 m, p), ``scale`` (g, m); ``gains`` remembers
    the steps of harmonics by angular frequency and duration, which cases share.
    """

    modes: Integers
    system: Array
    inputs: Array
    scale: Array
    transition: Array
    hold: Array
    gains: dict[tuple[float, float], NDArray[np.complex128]] = field(default_factory=dict)


def respond(modal: ModalModel, drives: Sequence[Drive], time: Array) -> Response:
    """Return the response from rest to each drive.

    Exact for harmonics and impulses, and for samples that are joined by straight lines. Each case's bits are
    those it has alone.

    Parameters
    ----------
    modal : ModalModel
    drives : sequence of Drive
        At least one; all with the prescribed directions of `modal`.
    time : ndarray, shape (t,)
        Evenly spaced instants from 0, s.

    Raises
    ------
    UserError
        If the instants are not evenly spaced from 0, or a drive does not fit the model or is not finite.
    """
    if not len(drives):
        raise UserError("a response needs at least one drive")
    step = time_step(time)
    blocks = _blocks(modal, step)
    free, held = int(np.sum(modal.free)), modal.prescribed
    moved = np.empty((len(drives), len(time), len(modal.squared)))
    prescribed = np.empty((len(drives), len(time), int(np.sum(held))))
    for case, drive in enumerate(drives):
        _check_drive(modal, drive, time)
        for block in blocks:
            states = _chain(block.transition, *_forcing(block, drive, time, step))
            position = states[:, :, : block.modes.shape[1]]
            moved[case][:, block.modes] = _over_time(position, len(time)) / block.scale
        prescribed[case] = values(drive, time)[:, held]
    # Modes are sorted by stiffness: the free ones come first.
    return Response(
        time,
        moved[..., free:],
        moved[..., :free],
        prescribed,
        modal.modes[:, free:],
        modal.modes[:, :free],
        modal.lift[:, held],
    )


def propagate(modal: ModalModel, drive: Drive, time: Array) -> tuple[Array, Array]:
    """Return modal positions and velocities from rest, each (r, t), under one drive; see `respond`.

    The velocity of a prescribed model is that of x less G1 u, which is continuous.
    """
    step = time_step(time)
    _check_drive(modal, drive, time)
    position, rate = np.empty((2, len(time), len(modal.squared)))
    for block in _blocks(modal, step):
        states = _chain(block.transition, *_forcing(block, drive, time, step))
        both = _over_time(states, len(time))
        count = block.modes.shape[1]
        position[:, block.modes] = both[..., :count] / block.scale
        rate[:, block.modes] = both[..., count:]
    return position.T, rate.T


def displacements(response: Response, rows: Array) -> Array:
    """Return rows @ q over time, shape (case, t, m): displacements of chosen nodes, m.

    Parameters
    ----------
    response : Response
    rows : ndarray or sparse array, shape (m, n)
        For example ``model.surface`` or ``model.inputs.T``.
    """
    shapes = [np.asarray(rows @ part) for part in (response.modes, response.rigid_modes, response.lift)]
    result: Array = response.coordinates @ shapes[0].T
    result += response.rigid @ shapes[1].T
    result += response.drive @ shapes[2].T
    return result


def time_step(time: Array) -> float:
    """Return the step of evenly spaced instants that begin at 0.

    Raises
    ------
    UserError
        If they are fewer than two, do not begin at 0, or are not evenly spaced and increasing.
    """
    if time.ndim != 1 or len(time) < 2 or not np.isfinite(time).all():
        raise UserError("a response needs at least two finite instants in s")
    step = float(time[-1] - time[0]) / (len(time) - 1)
    if step <= 0:
        raise UserError(f"the time step is {step:g} s; it has to be positive")
    if time[0] != 0 or np.abs(np.diff(time) - step).max() > 1e-6 * step:
        raise UserError("the instants of a response have to be evenly spaced and begin at 0 s")
    return step


def _blocks(modal: ModalModel, step: float) -> list[_Block]:
    """Split the modes into single oscillators (one stack) and groups that damping couples."""
    strong = np.abs(modal.damping) > _COUPLED * np.abs(modal.damping).max(initial=0.0)
    labels = np.arange(len(strong))
    if np.count_nonzero(strong) > np.count_nonzero(strong.diagonal()):
        labels = scipy.sparse.csgraph.connected_components(strong, directed=False)[1]
    counts = np.bincount(labels)
    single = np.flatnonzero(counts[labels] == 1)
    groups = [single[:, None]] if len(single) else []
    groups += [np.flatnonzero(labels == label)[None] for label in np.flatnonzero(counts > 1)]
    return [_block(modal, modes, step) for modes in groups]


def _block(modal: ModalModel, modes: Integers, step: float) -> _Block:
    stack, count = modes.shape
    squared, rates = modal.squared[modes], modal.damping[modes[:, :, None], modes[:, None, :]]
    # Position and velocity of one magnitude keep the exponential well scaled.
    scale = np.maximum(np.sqrt(squared), 1.0 / step)
    system = np.zeros((stack, 2 * count, 2 * count))
    here = np.arange(count)
    system[:, here, count + here] = scale
    system[:, count + here, here] = -squared / scale
    system[:, count:, count:] = -rates
    direct = modal.input_rates[modes]
    inputs = np.concatenate([scale[..., None] * direct, modal.inputs[modes] - rates @ direct], axis=1)
    hold = np.array([[0.0, 1.0 / step], [0.0, 0.0]])
    transition, gain = _step(system, inputs, hold, step)
    if count == 1:
        free = (rates[:, 0, 0] == 0.0) & (squared[:, 0] >= 0.0)
        transition[free] = _turn(np.sqrt(squared[free, 0]), scale[free, 0], step)
    return _Block(modes, system, inputs, scale, transition, gain)


def _turn(omega: Array, scale: Array, step: float) -> Array:
    """Exact step (g, 2, 2) of undamped oscillators.

    Every squaring of an exponential doubles its error, and with thousands of steps per second modes far above
    the step would gain energy.
    """
    ratio, sine = omega / scale, np.sin(omega * step)
    moved = np.divide(sine, ratio, out=scale * step, where=ratio > 0.0)
    cosine = np.cos(omega * step)
    return np.stack([cosine, moved, -ratio * sine, cosine], axis=-1).reshape(-1, 2, 2)


def _step(
    system: Array, inputs: Array, generator: NDArray[np.inexact[Any]], step: float
) -> tuple[Array, NDArray[Any]]:
    """Exact step of x' = A x + G u with u' = S u in every input: transition and gain.

    Parameters
    ----------
    generator : ndarray, shape (q, q)
        S; u is its first state. A harmonic is [[i omega]], a straight line [[0, 1], [0, 0]].

    Returns
    -------
    transition : ndarray, shape (g, s, s)
    gain : ndarray, shape (g, s, p, q)
        What each state of each input at the start of the step adds at its end.
    """
    stack, states, count = inputs.shape
    order = len(generator)
    narrow = count < states
    columns = inputs if narrow else np.broadcast_to(np.eye(states), (stack, states, states))
    # Exponentials take as many squarings as the largest entry asks for: give the columns the size of A.
    size = max(float(np.abs(columns).max(initial=0.0)) * step, np.finfo(float).tiny)
    width = columns.shape[2]
    whole = np.zeros((stack, states + width * order, states + width * order), dtype=generator.dtype)
    whole[:, :states, :states] = system * step
    whole[:, :states, states::order] = columns * step / size
    whole[:, states:, states:] = np.kron(np.eye(width), generator * step)
    power = exponentials(whole)
    gain = power[:, :states, states:].reshape(stack, states, width, order) * size
    if not narrow:
        gain = np.einsum("gswq,gwp->gspq", gain, inputs)
    return np.ascontiguousarray(power[:, :states, :states].real), gain


def _forcing(block: _Block, drive: Drive, time: Array, step: float) -> tuple[Array, Array]:
    """Return what the drive adds to the states by each instant, as gains (g, s, f) @ signals (f, t)."""
    gains: list[Array] = []
    signals: list[Array] = []
    if drive.samples is not None:
        begin = np.pad(drive.samples[:-1].T, ((0, 0), (1, 0)))
        rise = np.diff(drive.samples, axis=0, prepend=drive.samples[:1]).T
        gains += [block.hold[..., 0], block.hold[..., 1]]
        signals += [begin, rise]
    for harmonic in drive.harmonics:
        first, rest = _next_instant(harmonic.start, time, step)
        turning = np.exp(1j * harmonic.omega * time)
        turning[: min(first, len(time))] = 0.0
        pattern = harmonic.cosine - 1j * harmonic.sine
        each = _harmonic_gain(block, harmonic.omega, step) @ pattern
        gains.append(np.stack([each.real, -each.imag], axis=-1))
        signals.append(np.pad(np.stack([turning.real, turning.imag])[:, :-1], ((0, 0), (1, 0))))
        if rest > 0.0:
            begun = _harmonic_gain(block, harmonic.omega, rest) @ pattern
            gains.append((begun * np.exp(1j * harmonic.omega * harmonic.start)).real[..., None])
            signals.append((np.arange(len(time)) == first)[None])
    for impulse in drive.impulses:
        first, rest = _next_instant(impulse.at, time, step)
        jump = block.inputs @ impulse.momentum
        gains.append(exponentials(block.system * rest) @ jump[..., None])
        signals.append((np.arange(len(time)) == first)[None])
    if not gains:
        return np.zeros((*block.inputs.shape[:2], 1)), np.zeros((1, len(time)))
    return np.concatenate(gains, axis=-1), np.concatenate(signals).astype(np.float64)


def _harmonic_gain(block: _Block, omega: float, duration: float) -> NDArray[np.complex128]:
    key = (omega, duration)
    if key not in block.gains:
        block.gains[key] = _step(block.system, block.inputs, np.array([[1j * omega]]), duration)[1][..., 0]
    return block.gains[key]


def _next_instant(at: float, time: Array, step: float) -> tuple[int, float]:
    """Index of the first instant that is not before `at`, and how long after `at` it is."""
    first = math.ceil(at / step - 1e-9)
    return first, max(first * step - at, 0.0)


def _chain(transition: Array, gains: Array, signals: Array) -> Array:
    """Chain the steps x_k = T x_(k-1) + gains @ signals_k from x = 0; states (length, g, s, blocks).

    In about sqrt(t) blocks side by side, first each from rest and then with what the block before leaves.
    """
    (stack, states, _), (count, instants) = gains.shape, signals.shape
    length = math.isqrt(instants - 1) + 1
    blocks = -(-instants // length)
    padded = np.pad(signals, ((0, 0), (0, blocks * length - instants)))
    in_blocks = np.ascontiguousarray(padded.reshape(count, blocks, length).transpose(2, 0, 1))
    chained: Array = (gains.reshape(stack * states, count) @ in_blocks).reshape(length, stack, states, blocks)
    for k in range(1, length):
        chained[k] += transition @ chained[k - 1]
    carry = np.zeros((stack, states, blocks))
    power = np.linalg.matrix_power(transition, length)
    for b in range(1, blocks):
        carry[..., b] = chained[-1, ..., b - 1] + (power @ carry[..., b - 1, None])[..., 0]
    for k in range(length):
        carry = transition @ carry
        chained[k] += carry
    return chained


def _over_time(chained: Array, instants: int) -> Array:
    """Put blocks of instants one after the other: (length, g, s, blocks) to (t, g, s)."""
    length, stack, states, blocks = chained.shape
    return chained.transpose(3, 0, 1, 2).reshape(blocks * length, stack, states)[:instants]


def _check_drive(modal: ModalModel, drive: Drive, time: Array) -> None:
    if not np.array_equal(drive.prescribed, modal.prescribed):
        raise UserError(
            f"the drive prescribes other directions than the modal form of {modal.name} was made for; "
            "call modal_model(model, drive.prescribed)"
        )
    samples = drive.samples
    if samples is not None and samples.shape != (len(time), len(drive.prescribed)):
        raise UserError(
            f"samples of shape {samples.shape} do not fit {len(time)} instants and "
            f"{len(drive.prescribed)} interface directions"
        )
    patterns = [pattern for wave in drive.harmonics for pattern in (wave.cosine, wave.sine)]
    patterns += [impulse.momentum for impulse in drive.impulses]
    if any(not np.isfinite(part).all() for part in (*patterns, *([] if samples is None else [samples]))):
        raise UserError("the drive of a response has values that are not finite")
    if any(not (wave.omega >= 0.0 and wave.start >= 0.0) for wave in drive.harmonics):
        raise UserError("harmonics need a frequency and a start of at least 0")
    if any(not impulse.at >= 0.0 for impulse in drive.impulses):
        raise UserError("impulses need an instant of at least 0 s")
    if any((impulse.momentum[drive.prescribed] != 0.0).any() for impulse in drive.impulses):
        raise UserError("an impulse is a force and cannot act where the displacement is prescribed")
