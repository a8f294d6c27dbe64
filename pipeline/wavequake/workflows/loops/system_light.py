"""The system of ``system-loop``: what sensors see of motions, and when a case is looked at."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from wavequake.chain.loops.answers import Answer
from wavequake.chain.loops.block import Actuator
from wavequake.chain.loops.design import Shaken
from wavequake.chain.loops.designed import Designed
from wavequake.chain.loops.light import Light
from wavequake.chain.loops.sensors.camera import Camera
from wavequake.chain.loops.sensors.slopes import SlopeSensor
from wavequake.control.linear import Array
from wavequake.errors import UserError
from wavequake.mechanics.assembly.answers import moved as split_outputs
from wavequake.mechanics.disturbances.element_motion import ElementDisturbance
from wavequake.mechanics.disturbances.layout import NO_SEGMENTS
from wavequake.mechanics.disturbances.motion import RAD_PER_MAS, Motion, add, still
from wavequake.mechanics.disturbances.registry import instants_of, parts
from wavequake.optics.systems.paraxial import paraxial
from wavequake.optics.systems.system import OpticalSystem
from wavequake.workflows.bodies.nodes import moved_nodes, node_columns, with_nodes
from wavequake.workflows.bodies.shaken import shaken_bodies
from wavequake.workflows.loops.pushing import pushing_of
from wavequake.workflows.loops.system_loop_study import SystemLoopStudy
from wavequake.workflows.mirrors.study import FULL
from wavequake.workflows.systems.bench import NM_PER_MM, SystemBench, system_states
from wavequake.workflows.systems.disturbance import prepare
from wavequake.workflows.systems.draws import drawn_with
from wavequake.workflows.systems.streaks import flat, light_gains, streaked_times

# A straight line between two instants is at most this far, rms, off what is seen of a disturbance.
_STRAIGHT = 0.01
# Motions at which derivatives of carried bodies are taken, m and rad.
_SMALL = 1e-8
_FEWEST, _MOST = 64, 1 << 16  # instants of a case between which lines are straight


@dataclass(frozen=True)
class Times:
    """When a case of a population is looked at.

    Attributes
    ----------
    seen : ndarray, shape (n,)
        Rising from 0, s, so near each other that what is seen goes straight between them.
    looks : ndarray of int, shape (l,)
        Which of them, without 0, are looked at.
    instants : ndarray of int, shape (t,)
        Which of the looks are the case's own instants.
    between : ndarray of int, shape (e, m), or None
        Which of the looks the line of sight of exposed instants is followed at.
    given : bool
        Whether a file gives the motion, at its own instants alone.
    """

    seen: Array
    looks: np.ndarray
    instants: np.ndarray
    between: np.ndarray | None
    given: bool


@dataclass(frozen=True)
class SystemOptics:
    """A system without loops, as the first field point sees it at the primary wavelength.

    Attributes
    ----------
    bench : SystemBench
    light : Light
        Its line of sight is in mas for an object at infinity, else that of the image in nm.
    mm : float
        Image motion, mm, of one unit of line of sight.
    gain : ndarray, shape (columns, J - 1)
        Light per motion, see `wavequake.workflows.systems.streaks.flat`.
    sights : dict of ndarray, shape (K, p)
    times : tuple of Times or None
        Of each population that has cases.
    shaken : Shaken or None
        Modes of bodies that controllers expect.
    answers : tuple of Answer
        Bodies with mass that stages push.
    pushed : ndarray, shape (m, M), or None
        Outputs of the plant per position of these modes.
    """

    bench: SystemBench
    light: Light
    mm: float
    gain: Array
    sights: Mapping[str, Array]
    times: tuple[Times | None, ...]
    shaken: Shaken | None = None
    answers: tuple[Answer, ...] = ()
    pushed: Array | None = None

    @property
    def still(self) -> Array:
        """Noll coefficients 4..J at rest, nm."""
        primary = self.bench.system.primary_wavelength
        prepared, rest = self.bench.prepared[0][primary], self.bench.static[0][primary]
        return np.asarray(rest.zernike[0, 3:] * prepared.wavelength * NM_PER_MM)

    def see(self, motion: Motion) -> Array:
        """Return what sensors see of a motion, (n, K)."""
        optical = flat(self.bench.system, system_states(self.bench, motion)) @ self.gain
        if not self.light.bodies_too:
            return optical
        beside = np.zeros((len(optical), self.light.bodies - len(self.light.nodes)))  # a telescope's M2
        return np.hstack([optical, beside, node_columns(self.light, motion.rigid, len(optical))])


def optics_of(study: SystemLoopStudy) -> SystemOptics:
    """Prepare the system of a study, and what sensors see per position of each actuator.

    Raises
    ------
    UserError
        If there are no derivatives, an actuator does not fit the system, or what a disturbance does is not
        linear in what loops know, or too fast.
    """
    bench = prepare(study.disturbed)
    system = bench.system
    _require_even_light(study, system)
    prepared = bench.prepared[0][system.primary_wavelength]
    first_order = paraxial(system, prepared.wavelength)
    mm = first_order.focal_length * RAD_PER_MAS if np.isinf(system.object_distance) else 1.0 / NM_PER_MM
    aperture = prepared.image_index * float(np.abs(np.linalg.det(prepared.cosines))) ** 0.5
    names = bench.layout.others or ()
    light = Light(
        prepared.fit.basis.shape[1],
        system.pupil.obscuration,
        # Of the pupil of an instrument in whose sky one unit is 1 mas.
        aperture * abs(mm) / RAD_PER_MAS,
        NO_SEGMENTS,
        movable=dict.fromkeys((one for one in names if names.count(one) == 1), np.zeros((6, 0, 6))),
        wavelength_nm=prepared.wavelength * NM_PER_MM,
    )
    gain = light_gains(bench.text)[0]
    gain = np.hstack([gain[:, :2] / mm, gain[:, 5:] * (prepared.wavelength * NM_PER_MM)])
    plant, light = with_nodes(
        (), study.sensor, replace(light, layout=replace(NO_SEGMENTS, plant=bench.plants.get(FULL)))
    )
    if plant is not None and light.nodes:
        light = replace(light, bodies_too=True)
        bench = replace(bench, plants={**bench.plants, FULL: plant})
    bare = SystemOptics(bench, light, mm, gain, {}, ())
    sights = {one.name: _sight(bare, one) for one in study.actuator}
    times = tuple(_times(study, bare, entry) if entry.share else None for entry in study.disturbance)
    shaken, pushing = None, pushing_of(study, bench, light)
    if plant is not None and any(one.asks_modes for one in study.controller):
        known = bench.study.disturbance
        shaken = shaken_bodies(known, plant, study.study.seed, partial(_shown, bare))
    if pushing is None:
        return SystemOptics(bench, light, mm, gain, sights, times, shaken)
    shown = _shown(bare, pushing.outputs)
    answer = Answer(pushing.names, pushing.dynamics, None, shown, pushing.drives)
    return SystemOptics(bench, light, mm, gain, sights, times, shaken, (answer,), pushing.outputs)


def _require_even_light(study: SystemLoopStudy, system: OpticalSystem) -> None:
    """Raise UserError if a sensor that takes the pupil as evenly lit looks at one that is not."""
    for one in study.sensor:
        if system.pupil.apodization is not None and isinstance(one, Camera | SlopeSensor):
            raise UserError(
                f"sensor.{one.name}: the pupil of {system.name} is apodized, but the sensor {one.model} "
                "knows evenly lit ones alone; take line-of-sight or wavefront."
            )


def _shown(optics: SystemOptics, outputs: Array) -> Array:
    """Return what is seen per mode that moves outputs of the plant (m, M)."""
    sizes = np.abs(outputs).max(axis=0, initial=0.0)
    units = _SMALL / np.where(sizes > 0, sizes, 1.0)
    return np.ascontiguousarray(optics.see(carried(optics.bench, (outputs * units).T)).T / units)


def carried(bench: SystemBench, outputs: Array) -> Motion:
    """Return the motion of elements that outputs (n, m) of the plant are."""
    rigid, figure = split_outputs(bench.plants[FULL], outputs)
    return still(len(outputs), rigid=rigid, figure=figure)


def _sight(optics: SystemOptics, one: Actuator) -> Array:
    """Return what is seen per position of an actuator."""
    light, unit = optics.light, np.eye(len(one.channels(optics.light)))
    found = optics.see(still(len(unit), rigid=one.motion(one.step * unit))).T / one.step
    if light.nodes:
        found[len(light) - len(light.nodes) :] = moved_nodes(one, optics.bench.bodies, light)
    return np.ascontiguousarray(found)


def moved(optics: SystemOptics, one: Designed, positions: Array) -> Motion:
    """Return how the actuators of a controller move elements at positions (n, P) of all their channels."""
    found, first = still(len(positions)), 0
    for actuator in one.actuators:
        last = first + len(actuator.channels(optics.light))
        found = add([found, still(len(positions), rigid=actuator.motion(positions[:, first:last]))])
        first = last
    if one.answers:
        assert optics.pushed is not None
        found = add([found, carried(optics.bench, positions[:, first:] @ optics.pushed.T)])
    return found


def drawn_at(optics: SystemOptics, population: ElementDisturbance, realization: int, time: Array) -> Motion:
    """Draw a realization at other instants than its own."""
    return drawn_with(optics.bench, population, realization, FULL, time)


def seen_of(optics: SystemOptics, index: int, realization: int) -> Array:
    """Return what sensors see of a disturbance at the instants `Times.seen`, (n, K)."""
    population, times = optics.bench.study.disturbance[index], optics.times[index]
    assert times is not None
    if not times.given:
        return optics.see(drawn_at(optics, population, realization, times.seen))
    rows = optics.see(drawn_with(optics.bench, population, realization, FULL))
    return rows if len(rows) == len(times.seen) else np.concatenate([rows[:1], rows])


def _times(study: SystemLoopStudy, optics: SystemOptics, population: ElementDisturbance) -> Times:
    """Return when cases of a population are looked at, as its first realization tells."""
    known = optics.bench.study
    instants = instants_of(known.disturbance, population)
    if drawn_with(optics.bench, population, 0, FULL).grid:
        raise UserError(
            f"The disturbance {population.name!r} deforms a surface on a grid, which the light of loops "
            "does not know; give Zernike terms."
        )
    if any(part.instants_of_file() is not None for part in parts(known.disturbance, population)):
        seen = instants if instants[0] == 0.0 else np.concatenate([[0.0], instants])
        looks = np.arange(len(seen) - len(instants), len(seen))
        return Times(seen, looks, np.arange(len(instants)), None, True)
    ways = streaked_times(known, population)
    wanted = instants if ways is None else np.concatenate([instants, ways.ravel()])
    at, places = np.unique(wanted, return_inverse=True)
    between = None if ways is None else places[len(instants) :].reshape(ways.shape)
    seen = np.union1d(_even(study, optics, population), at)
    return Times(seen, np.searchsorted(seen, at), places[: len(instants)], between, False)


def _even(study: SystemLoopStudy, optics: SystemOptics, population: ElementDisturbance) -> Array:
    """Return even instants from 0 on between which what is seen of a population goes straight."""
    duration = population.duration_s
    rate = max((one.rate_hz for one in study.sensor), default=0.0)
    count = int(np.clip(np.ceil(2.0 * rate * duration), _FEWEST, _MOST))
    while True:
        time = np.linspace(0.0, duration, 2 * count + 1)
        seen = optics.see(drawn_at(optics, population, 0, time))
        off = seen[1::2] - 0.5 * (seen[:-1:2] + seen[2::2])
        # Of the largest among the line of sight, coefficients, and nodes.
        kinds = (slice(0, 2), slice(2, optics.light.optical), slice(optics.light.optical, None))
        apart, size = ([np.abs(one[:, kind]).max(initial=0.0) for kind in kinds] for one in (off, seen))
        if all(a <= _STRAIGHT * s for a, s in zip(apart, size, strict=True)):
            return time
        if count >= _MOST:
            raise UserError(
                f"The disturbance {population.name!r} is too fast for its loops: {2 * count} instants in "
                f"{duration:g} s do not follow it; shorten duration_s, or take lower frequencies."
            )
        count *= 2
