"""Poles and margins of a sampled loop of many channels, all that is changed changed in all of them alike.

Where all channels share a filter and the actuator's dynamics, a loop is as many loops of one channel as there
are eigenvalues of W M, decoupling times sight: each is small, whatever the number of channels. A structure
that answers them couples the few directions that drive it or show it.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from wavequake.control.linear import Array, LinearModel, frequency_response
from wavequake.control.robustness.feedback import vector_of
from wavequake.control.robustness.margins import Margins
from wavequake.control.sampled.alike import Parts, apart, coupled, sizes_of, stacked
from wavequake.control.sampled.channel import Dynamics, Timing, in_series, sampled_channel
from wavequake.control.sampled.margins import LoopGain, gain_margins, graded_grid, read_margins
from wavequake.control.sampled.regulator import Regulator, model_of

Complex = NDArray[np.complex128]

# Eigenvalues of W M nearer than this share of the largest one are one.
_ALIKE = 1e-9
# Squares of what W gives below this share of the largest are rounding.
_UNUSED = 1e-13
# A pole that turns by less than this in a period, rad, is real but for rounding.
_STILL = 1e-9
_ROUNDED = 1e-9


@dataclass(frozen=True)
class Sight:
    """What a further sensor reads; attributes as of `SampledLoop`, its dynamics with the actuator's."""

    dynamics: Dynamics
    sees: Array
    shown: Array | None = None


@dataclass(frozen=True)
class SampledLoop:
    """A regulator with what it moves and sees.

    Attributes
    ----------
    timing : Timing
    dynamics : Dynamics
    sees : ndarray, shape (m, p)
        Change of readings with positions, as they truly are.
    regulator : Regulator
    structure : tuple of Dynamics
        How each of K modes of a structure answers what moves along it.
    drives, shown : ndarray, shapes (K, p) and (m, K), or None
        How positions move along modes, and readings with them.
    further : tuple of Sight
        Sensors whose readings come after these; their regulator shares no filter.
    """

    timing: Timing
    dynamics: Dynamics
    sees: Array
    regulator: Regulator
    structure: tuple[Dynamics, ...] = ()
    drives: Array | None = None
    shown: Array | None = None
    further: tuple[Sight, ...] = ()

    def parts(self) -> "tuple[SampledLoop, ...]":
        """Return the loop as each of its sensors sees it."""
        own = replace(self, further=())
        others = (replace(own, dynamics=one.dynamics, sees=one.sees, shown=one.shown) for one in self.further)
        return (own, *others)

    def modes(self) -> tuple[Array, Array]:
        """Return readings per mode of the structure (m, K) and modes per position (K, p)."""
        m, p = self.sees.shape
        return (
            np.zeros((m, 0)) if self.shown is None else self.shown,
            np.zeros((0, p)) if self.drives is None else self.drives,
        )

    def channels(self) -> tuple[LinearModel, ...]:
        """Return one channel by periods, then through each mode of the structure."""
        through = (in_series(self.dynamics, mode) for mode in self.structure)
        return tuple(sampled_channel(one, self.timing) for one in (self.dynamics, *through))


@dataclass(frozen=True)
class Worst:
    """The slowest or fastest growing pole: eigenvalue of a period, 1/s, Hz, and weights (p,) of channels."""

    value: complex
    growth: float
    hertz: float
    channels: Array


def plant_model(loop: SampledLoop) -> LinearModel:
    """Return the plant from commands (p,) to mean readings (m,) by periods; strictly proper."""
    return stacked([coupled(one.channels(), one.sees, *one.modes()) for one in loop.parts()])


def controller_model(loop: SampledLoop) -> LinearModel:
    """Return H of u = -H y by periods."""
    found = model_of(loop.regulator, loop.timing.period)
    return LinearModel(found.a, found.b, -found.c, -found.d, found.sample_time)


@dataclass(frozen=True)
class _Closed:
    """A loop as loops of one channel with real or complex gains, and one of several directions.

    Attributes
    ----------
    channel, own : LinearModel
        Of one channel: plant and filter.
    gains : ndarray of complex, shape (g,)
    weights : ndarray, shape (p, g)
        Which channels take part.
    several, controller : LinearModel or None
        Plant and controller of N directions.
    answers : ndarray, shape (p, states)
        How channels show its first states.
    """

    channel: LinearModel
    own: LinearModel
    gains: Complex
    weights: Array
    several: LinearModel | None
    controller: LinearModel
    answers: Array

    def poles(self, factor: float) -> list[Complex]:
        """Return the poles of each loop, with the loop gain times a factor."""
        found = [_scalar_poles(self.channel, self.own, factor * one) for one in self.gains]
        if self.several is not None:
            found.append(np.asarray(np.linalg.eigvals(self.step(factor)), dtype=np.complex128))
        return found

    def radius(self, factor: float) -> float:
        """Return the size of the largest pole."""
        return max(float(np.abs(one).max(initial=0.0)) for one in self.poles(factor))

    def step(self, factor: float) -> Array:
        """Return the step of the loop of several directions."""
        assert self.several is not None
        plant, own, c = self.several, self.controller, factor * self.several.c
        return np.block([[plant.a + plant.b @ own.d @ c, plant.b @ own.c], [own.b @ c, own.a]])

    def swings(self, factor: float, value: complex) -> Array:
        """Return by how much channels (p,) take part in a pole of the loop of several directions."""
        state = vector_of(self.step(factor), value)
        return np.asarray(np.abs(self.answers @ state[: self.answers.shape[1]]))


def _closed(loop: SampledLoop, parts: Parts | None) -> _Closed:
    channels, period, p = loop.channels(), loop.timing.period, loop.sees.shape[1]
    if parts is None:
        own, several = model_of(loop.regulator, period), plant_model(loop)
        answers = np.asarray(np.kron(channels[0].c, np.eye(p)), dtype=np.float64)
        nothing = np.zeros(0, dtype=complex), np.zeros((p, 0))
        return _Closed(channels[0], own, *nothing, several, own, answers)
    own = filter_of(loop.regulator)
    if not loop.structure:
        gains, vectors = _distinct(parts)
        return _Closed(channels[0], own, gains, np.abs(vectors), None, own, parts.basis)
    core = parts.core()
    rest = [] if core.value is None else [core.value]
    weights = np.sqrt(np.maximum(1.0 - np.sum(parts.basis**2, axis=1, keepdims=True), 0.0))
    unit = np.eye(len(core.sees))
    a, b, c, d = (np.asarray(np.kron(unit, one)) for one in (own.a, own.b, own.c, own.d))
    plant, answers = core.plant(channels, len(loop.dynamics))
    gains = np.array(rest, dtype=complex)
    several, controller = plant, LinearModel(a, b, c, d)
    return _Closed(
        channels[0], own, gains, weights[:, : len(rest)], several, controller, parts.basis @ answers
    )


def parts_of(loop: SampledLoop) -> Parts | None:
    """Return what is alike of a loop whose channels share a filter; None if they do not, or see nothing."""
    shown, drives = loop.modes()
    if loop.further or not loop.regulator.shared or not (loop.sees.any() or drives.any()):
        return None
    through = loop.regulator.decoupling
    if not loop.structure:
        return apart(through @ loop.sees, through @ shown, drives)
    # What is never commanded, or never moves, would stand there as integrators that nothing drives or sees.
    moves = np.any(loop.sees, axis=0) | np.any(drives, axis=0)
    through, sees, drives = through[moves], loop.sees[:, moves], drives[:, moves]
    basis = np.eye(len(moves))[:, moves]
    squares, vectors = np.linalg.eigh(through @ through.T)
    used = vectors[:, squares > _UNUSED * squares[-1]]
    if used.shape[1] < len(through):
        through, sees, drives, basis = used.T @ through, sees @ used, drives @ used, basis @ used
    found = apart(through @ sees, through @ shown, drives)
    return replace(found, basis=basis @ found.basis)


def worst_pole(loop: SampledLoop, factor: float = 1.0) -> Worst:
    """Return the pole that grows most, with the loop gain times a factor."""
    closed = _closed(loop, parts_of(loop))
    found = closed.poles(factor)
    which = int(np.argmax([np.abs(one).max(initial=0.0) for one in found]))
    values = found[which]
    if which < len(closed.gains):
        channels = closed.weights[:, which]
    else:
        channels = closed.swings(factor, complex(values[np.abs(values).argmax()]))
    value = complex(values[np.abs(values).argmax()])
    rate = np.log(max(abs(value), 1e-300)) / loop.timing.period
    turned = abs(np.angle(value))
    hertz = turned / (2 * np.pi * loop.timing.period) if turned > _STILL else 0.0
    return Worst(value, float(rate), float(hertz), channels)


def filter_of(regulator: Regulator) -> LinearModel:
    """Return the filter that all channels of a regulator share."""
    a, b, c, d = regulator.a[0], regulator.b[0], regulator.c[0], regulator.d[0]
    return LinearModel(a, b, c, d)


def _scalar_poles(plant: LinearModel, own: LinearModel, gain: complex) -> Complex:
    """Return the poles of u = filter(gain plant(u))."""
    c = gain * plant.c
    closed = np.block([[plant.a + plant.b @ own.d @ c, plant.b @ own.c], [own.b @ c, own.a]])
    return np.asarray(np.linalg.eigvals(closed), dtype=np.complex128)


def _distinct(parts: Parts) -> tuple[Complex, Complex]:
    """Return the eigenvalues of W M, without those that are alike or nothing, and their vectors."""
    gains, vectors = parts.gains()
    largest = np.abs(gains).max()
    kept = np.unique(np.round(gains / largest, 9), return_index=True)[1]
    kept = kept[np.abs(gains[kept]) > _ALIKE * largest]  # nothing drives the others
    return gains[kept], vectors[:, kept]


def _loop_gain(loop: SampledLoop, parts: Parts | None) -> LoopGain:
    channels, period = loop.channels(), loop.timing.period
    if parts is None:
        model = model_of(loop.regulator, period)
        sights = [(one.channels(), one.sees, *one.modes()) for one in loop.parts()]

        def full(hertz: Array) -> Complex:
            plants = []
            for through, sees, shown, drives in sights:
                sizes = sizes_of(through, hertz)[:, None]
                plants.append(sees * sizes[..., :1] + (shown * sizes[..., 1:]) @ drives)
            seen = np.concatenate(plants, axis=1)
            return np.asarray(-frequency_response(model, 2 * np.pi * hertz) @ seen)

        return LoopGain(
            lambda hertz: np.asarray(np.linalg.eigvals(full(hertz)), dtype=np.complex128),
            lambda hertz: np.asarray(full(np.array([hertz]))[0]),
        )
    own = filter_of(loop.regulator)
    own = LinearModel(own.a, own.b, own.c, own.d, period)

    def sizes(hertz: Array) -> Complex:
        found = -frequency_response(own, 2 * np.pi * hertz)[:, 0] * sizes_of(channels, hertz)
        return np.asarray(found)

    def whole(hertz: float) -> Complex:
        return parts.whole(sizes(np.array([hertz]))[0])

    if not loop.structure:
        gains = _distinct(parts)[0]
        return LoopGain(lambda hertz: np.asarray(sizes(hertz) * gains), whole)

    core = parts.core()
    return LoopGain(lambda hertz: core.eigenvalues(sizes(hertz)), whole)


def sampled_margins(loop: SampledLoop) -> Margins:
    """Return the margins of a stable loop, at the commands; delay in s, frequencies in rad/s.

    The last frequency is that at which an eigenvalue of the loop gain reaches 1. The sensitivity is
    (I - K G)^-1 of what the actuators should do, G the plant and K the regulator.
    """
    parts = parts_of(loop)
    closed = _closed(loop, parts)
    models = (*loop.channels(), closed.own)
    values = np.concatenate(
        [*(np.linalg.eigvals(one.a).astype(complex) for one in models), *closed.poles(1.0)]
    )
    return gain_margins(_loop_gain(loop, parts), graded_grid(values, loop.timing.period), closed.radius)


@dataclass(frozen=True)
class LoopCurve:
    """A loop over frequency, NaN beyond half the rate of commands.

    Attributes
    ----------
    gain : ndarray of complex, shape (f, 2)
        The eigenvalues of the loop gain that have the gain and the phase margin.
    rejection, passed : ndarray, shape (f,)
        Largest 1 / (1 + L) and L / (1 + L) of an eigenvalue L.
    gain_up, phase : float
        Margins (rad) as these frequencies show them, see `wavequake.control.sampled.margins.read_margins`.
    """

    gain: Complex
    rejection: Array
    passed: Array
    gain_up: float
    phase: float


def curve(loop: SampledLoop, hertz: Array) -> LoopCurve:
    """Return a stable loop at rising frequencies in Hz (f,).

    A loop gain is real at half the rate of commands, where slow loops have their margins: let it be among
    the frequencies, or these margins are not seen.
    """
    inside = below_half(hertz, loop.timing)
    parts = parts_of(loop)
    gain = _loop_gain(loop, parts)
    if parts is None or not loop.structure:
        return curve_of_loci(gain.loci(hertz[inside]), inside)
    # Pairs of equal modes are told apart by rounding: stores have those of the whole matrix.
    loci = [np.linalg.eigvals(gain.whole(float(one))) for one in hertz[inside]]
    return curve_of_loci(np.array(loci), inside)


def below_half(hertz: Array, timing: Timing) -> NDArray[np.bool_]:
    """Return which frequencies are not above half the rate of commands, but for rounding."""
    return np.asarray(hertz <= (0.5 + _ROUNDED) / timing.period)


def curve_of_loci(loci: Complex, inside: NDArray[np.bool_]) -> LoopCurve:
    """Return a stable loop by the eigenvalues (n, q) of its loop gain at those n of f frequencies."""
    gain = np.full((len(inside), 2), np.nan + 0j)
    rejection, passed = np.full((2, len(inside)), np.nan)
    gain_up, phase, gain[inside] = read_margins(loci)
    rejection[inside] = (1.0 / np.abs(1.0 + loci)).max(axis=1)
    passed[inside] = np.abs(loci / (1.0 + loci)).max(axis=1)
    return LoopCurve(gain, rejection, passed, gain_up, phase)
