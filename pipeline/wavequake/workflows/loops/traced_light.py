"""Light that is traced in the loop: what each frame's readings have beside those of linear light."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from wavequake.chain.loops.answers import put_all
from wavequake.chain.loops.designed import Designed
from wavequake.chain.loops.light import RayLight
from wavequake.control.linear import Array
from wavequake.control.sampled.readings import means
from wavequake.kernels.device.devices import Device
from wavequake.kernels.device.tiles import padded
from wavequake.kernels.trace.train import Traced
from wavequake.optics.systems.system import States
from wavequake.optics.wavefronts.record import Wavefront
from wavequake.workflows.exposures.telescope_control import ControlBench, measured_opd, ray_phase, trace
from wavequake.workflows.loops.telescope_bench import Bench
from wavequake.workflows.loops.telescope_light import seen_units
from wavequake.workflows.segments.launches import CaseDraw, states_at_rest, surface_states

# Farther than this, nm or nrad, nothing is traced: such a loop diverges.
_FARTHEST = 1e8


def beyond_linear(
    bench: Bench, one: Designed, draws: list[CaseDraw], seen: list[Array], columns: list[int], device: Device
) -> Callable[[int, int, Array], Array]:
    """Return what gives the readings of a frame beside those of linear light.

    The telescope is traced once a frame, where everything is on its mean over the frame. What that has more
    than linear light of the same motion is added to what sensors read: cameras of the image that rays make,
    others of line of sight and wavefront; NaN where rays are lost.

    Parameters
    ----------
    bench, one
    draws, seen
        Cases, and what sensors see of their disturbances by linear light.
    columns : list of int
        Where each case stands in the loop's arrays. The others are at rest: launches have one shape, and a
        case the same bits in every batch.
    device : Device

    Returns
    -------
    callable
        Of a loop, a frame and mean positions over it (P + K, columns): readings (m, columns).
    """
    control, optical = bench.optics.control, bench.optics.light.optical
    to_mas, to_nm = seen_units(control, bench.study.optics.wavelength_nm)
    sight = one.sight[:optical]
    still = control.static
    running = bench.study.running(bench.study.part("controller", one.name))
    sensors = [bench.study.sensors(each) for each in running]
    rest = _rays(control, *trace(control.prepared, states_at_rest(control.bench, padded(1)), device), 1)
    dark = [[sensor.of_rays(bench.optics.light, rest) for sensor in each] for each in sensors]

    def beyond(place: int, frame: int, moved: Array) -> Array:
        timing = one.loops[place].timing
        end = (frame + 1) * timing.frame
        span = np.array([end - timing.integration]), np.array([end])
        states = states_at_rest(control.bench, padded(moved.shape[1]))
        near = (np.abs(moved) < _FARTHEST).all(axis=0)
        positions = np.where(near, moved, 0.0).T
        linear = positions @ sight.T
        for column, case, values in zip(columns, draws, seen, strict=True):
            _put_mean(states, column, bench, case, *span)
            linear[column] += means(case.time, values[:, :optical], *span)[0]
        first = 0
        for actuator in one.actuators:
            last = first + len(actuator.channels(bench.optics.light))
            actuator.put(bench.optics.light, states, positions[:, first:last])
            first = last
        put_all(one.answers, states, positions[:, first:])
        traced, found = trace(control.prepared, states, device)
        sights = (found.los - still.los[0]) * to_mas, (found.zernike[:, 3:] - still.zernike[0, 3:]) * to_nm
        more = np.hstack(sights)[: len(linear)] - linear
        readings = []
        for sensor, matrix, at_rest in zip(sensors[place], one.readings[place], dark[place], strict=True):
            exact = sensor.of_rays(bench.optics.light, _rays(control, traced, found, len(linear)))
            if exact is None or at_rest is None:
                readings.append(matrix[:, :optical] @ more.T)
            else:
                readings.append(exact - at_rest - matrix[:, :optical] @ linear.T)
        given = np.vstack(readings)
        given[:, (found.lost[: len(linear)] > 0) | ~near] = np.nan
        return given

    return beyond


def _rays(control: ControlBench, traced: Traced, wavefront: Wavefront, count: int) -> RayLight:
    """Return the light of the first instants of a batch."""
    phase = ray_phase(control, measured_opd(control, traced), wavefront, control.static.los[:1])
    rays = control.prepared.rays
    return RayLight(rays.x, rays.y, control.prepared.weight, phase[:count])


def _put_mean(states: States, column: int, bench: Bench, case: CaseDraw, begin: Array, end: Array) -> None:
    """Write the mean of a disturbance, which goes in straight lines, over one instant at rest."""
    first = max(int(np.searchsorted(case.time, begin[0], side="right")) - 1, 0)
    last = min(int(np.searchsorted(case.time, end[0], side="left")), len(case.time) - 1)
    near = np.arange(first, last + 1)
    time = case.time[near]
    share = means(time, np.eye(len(near)), begin, end)[0]
    part = replace(case, time=time, motion=case.motion.at(near))
    moved = surface_states(bench.optics.control.bench, part, 0, len(near))
    names = ("segment_motion", "segment_figure", "surface_motion", "line_of_sight")
    here, there = ([*(getattr(one, name) for name in names), *one.deformations] for one in (states, moved))
    for values, given in zip(here, there, strict=True):
        if values is not None and given is not None:
            values[column] = np.tensordot(share, given[: len(near)], 1)
