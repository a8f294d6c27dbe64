"""What the noise of sensors does to anything that the actuators move, over frequency."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from wavequake.control.linear import Array, frequency_response
from wavequake.control.sampled.alike import Complex, Parts, sizes_of
from wavequake.control.sampled.channel import in_series, sampled_channel
from wavequake.control.sampled.regulator import model_of
from wavequake.control.sampled.stability import SampledLoop, Sight, below_half, filter_of, parts_of


def noise_spectra(loop: SampledLoop, look: Sight, noise: Array, hertz: Array) -> Array:
    """Return the one-sided spectra (f, r) of what noise moves, as means over the exposures of a period.

    Parameters
    ----------
    loop : SampledLoop
        Stable.
    look : Sight
        What is looked at, (r, p) and (r, K), and how it follows commands.
    noise : ndarray, shape (m,)
        Rms of the readings of a period, of all sensors; white by periods, independent.
    hertz : ndarray, shape (f,)

    Returns
    -------
    ndarray, shape (f, r)
        unit^2/Hz: 2 T |(I - K G)^-1 K|^2 of noise through what is looked at, K the regulator, G the plant
        and T the period; NaN beyond half the rate of commands.
    """
    found = np.full((len(hertz), len(look.sees)), np.nan)
    inside = below_half(hertz, loop.timing)
    parts = parts_of(loop)
    moved = (
        _whole(loop, look, noise, hertz[inside])
        if parts is None
        else _apart(loop, parts, look, noise, hertz[inside])
    )
    powers = [np.sum(np.abs(one) ** 2, axis=1) for one in moved]
    found[inside] = 2 * loop.timing.period * np.reshape(powers, (-1, len(look.sees)))
    return found


def _seen(loop: SampledLoop, look: Sight, hertz: Array) -> tuple[Complex, Array, Array]:
    """Return responses (f, 1 + K) of what is looked at, and what it shows of modes (r, K), these (K, p)."""
    through = (in_series(look.dynamics, mode) for mode in loop.structure)
    channels = tuple(sampled_channel(one, loop.timing) for one in (look.dynamics, *through))
    shown = np.zeros((len(look.sees), len(loop.structure))) if look.shown is None else look.shown
    return sizes_of(channels, hertz), shown, loop.modes()[1]


def _whole(loop: SampledLoop, look: Sight, noise: Array, hertz: Array) -> Iterator[Complex]:
    """Yield what is looked at per unit of white noise, (r, m), by the loop as it stands."""
    own = frequency_response(model_of(loop.regulator, loop.timing.period), 2 * np.pi * hertz)
    plants = [(sizes_of(one.channels(), hertz), one.sees, *one.modes()) for one in loop.parts()]
    seen, shown, drives = _seen(loop, look, hertz)
    for k, mine in enumerate(own):
        plant = np.concatenate([_at(size[k], *rest) for size, *rest in plants])
        commands = np.linalg.solve(np.eye(len(mine)) - mine @ plant, mine * noise)
        yield _at(seen[k], look.sees, shown, drives) @ commands


def _at(sizes: Complex, sees: Array, shown: Array, drives: Array) -> Complex:
    return np.asarray(sizes[0] * sees + (shown * sizes[1:]) @ drives)


def _apart(loop: SampledLoop, parts: Parts, look: Sight, noise: Array, hertz: Array) -> Iterator[Complex]:
    """Yield the same, by the few directions of a shared filter that matter, and all others alike."""
    model = replace(filter_of(loop.regulator), sample_time=loop.timing.period)
    own = frequency_response(model, 2 * np.pi * hertz)[:, 0, 0]
    sizes = -own[:, None] * sizes_of(loop.channels(), hertz)
    seen, shown, drives = _seen(loop, look, hertz)
    read = loop.regulator.decoupling * noise
    along = parts.basis.T @ read
    rest = read - parts.basis @ along
    inside, outside = ((look.sees @ one, shown, drives @ one) for one in (parts.basis, rest))
    for mine, size, each in zip(own, sizes, seen, strict=True):
        small = parts.whole(size)[: len(along), : len(along)]
        found = _at(each, *inside) @ np.linalg.solve(np.eye(len(along)) + small, along)
        if parts.value is not None:
            found = found + _at(each, *outside) / (1.0 + size[0] * parts.value)
        yield mine * found
