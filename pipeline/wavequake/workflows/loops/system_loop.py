"""The workflow "system-loop": any optical system in closed loop, under several controllers on one draw.

In the loop, light is linear: line of sight and Zernike coefficients of the first field point at the primary
wavelength by sensitivities. What controllers leave is traced in full at all instants of a case, at every
field point and wavelength, as ``system-disturbance`` does, and imaged.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np

from wavequake.campaign.contract import Fixed
from wavequake.campaign.measured import Block, CaseTable, study_kind
from wavequake.campaign.measures import Axis, Measure, stored
from wavequake.campaign.stopwatch import Stopwatch
from wavequake.chain.images.camera import noise_of, seen
from wavequake.chain.loops.answers import dynamics_of
from wavequake.chain.loops.designed import Designed, design_notices, readings_of
from wavequake.chain.loops.judged import judged_loops
from wavequake.control.linear import Array
from wavequake.control.sampled.run import run
from wavequake.control.sampled.stability import SampledLoop
from wavequake.errors import UserError
from wavequake.kernels.device.devices import choose_device
from wavequake.mechanics.disturbances.motion import Motion, add
from wavequake.workflows.disturbed_study import case_labels
from wavequake.workflows.loops.curves import curve_axes, curves, shown, spectrum
from wavequake.workflows.loops.loop_margins import Makers, linear_loops
from wavequake.workflows.loops.pushing import pushing_notices
from wavequake.workflows.loops.system_light import SystemOptics, drawn_at, moved, optics_of, seen_of
from wavequake.workflows.loops.system_loop_study import SystemLoopStudy
from wavequake.workflows.mirrors.study import FULL
from wavequake.workflows.systems import disturbance as system_disturbance
from wavequake.workflows.systems.bench import imager_on
from wavequake.workflows.systems.draws import drawn_with
from wavequake.workflows.systems.measure import measured_cases
from wavequake.workflows.systems.measures import axes as system_axes
from wavequake.workflows.systems.streaks import places_between, places_of_rows
from wavequake.workflows.systems.variants import slot_of


@dataclass(frozen=True)
class Bench:
    """A study with its system and controllers; `linear` are the loops of linear ones, each alone."""

    study: SystemLoopStudy
    optics: SystemOptics
    controllers: tuple[Designed, ...]
    linear: dict[str, SampledLoop]


def bench_of(study: SystemLoopStudy) -> Bench:
    """Prepare a study.

    Raises
    ------
    UserError
        As `system_disturbance.prepare` and `optics_of`; if a controller cannot be designed, its loop is
        unstable, or a stroke is too short; names the block.
    """
    optics = optics_of(study)
    looks = [one.seen[one.looks] for one in optics.times if one is not None]

    def seen(index: int) -> tuple[Array, Array]:
        times = optics.times[index]
        assert times is not None
        return times.seen, seen_of(optics, index, 0)

    return Bench(
        study, optics, *judged_loops(study, study.study.name, optics, study.disturbance, looks, seen)
    )


def compute(bench: Bench, table: CaseTable, device_name: str, clock: Stopwatch) -> Iterator[Block]:
    """Run cases one by one under all controllers; one that diverges or loses its light is quarantined."""
    for row, case in enumerate(table["case"].tolist()):
        result, message = _case(bench, case, device_name, clock)
        numbers = {name: values[None] for name, values in result.items()}
        yield Block(numbers, np.array([row]), {0: message} if message else {})


def _case(bench: Bench, case: int, device_name: str, clock: Stopwatch) -> tuple[dict[str, Array], str]:
    """Return the numbers of a case, (controller, ...), or none, and why."""
    study, optics = bench.study, bench.optics
    system, imager = optics.bench, imager_on(optics.bench.text, device_name)
    population, realization, _ = slot_of(system.study, case)
    index = system.study.disturbance.index(population)
    times = optics.times[index]
    assert times is not None
    with clock("draw"):
        shaken = drawn_with(system, population, realization, FULL)
        disturbance, at_instants = seen_of(optics, index, realization), optics.see(shaken)
        way = None
        if times.between is not None:
            way = drawn_at(optics, population, realization, times.seen[times.looks[times.between.ravel()]])
    motions, away, own = [], [], []
    for one in bench.controllers:
        with clock("loop"):
            positions, limited, diverged = _positions(bench, one, index, disturbance, realization)
        if diverged:
            return {}, f"it diverges under the controller {one.name!r}"
        left = add([shaken, moved(optics, one, positions[times.instants])])
        motions.append((times.seen[times.looks[times.instants]], left))
        away.append(_away(bench, one, index, left, way, positions))
        linear = at_instants + positions[times.instants] @ one.sight.T
        channels = positions[:, : one.channels(optics.light)]
        own.append((linear, limited, np.abs(channels).max(initial=0.0)))
    found = measured_cases(system, motions, choose_device(device_name), clock, imager, away)
    numbers: list[dict[str, Array]] = []
    for one, (values, message), (linear, limited, largest) in zip(bench.controllers, found, own, strict=True):
        if message:
            return {}, f"{one.name}: {message}"
        if imager is not None:
            noise = noise_of(study.study.seed, population.name, realization)
            values |= seen(imager.camera, values["exposure"], noise)
        numbers.append(values | _linear(optics, values, linear) | {"limited": limited, "largest": largest})
    time = numbers[0].pop("time_s")
    sight = disturbance[:, :2] * (_UM * optics.mm)
    of_case = {"time_s": time, "open_psd": spectrum(times.seen, sight, shown(study))}
    return {name: np.stack([one[name] for one in numbers]) for name in numbers[0]} | of_case, ""


def motion_left(bench: Bench, one: Designed, case: int) -> Motion:
    """Return how the elements of a case move under a controller, at its instants.

    Raises
    ------
    UserError
        If it diverges.
    """
    optics = bench.optics
    population, realization, _ = slot_of(optics.bench.study, case)
    index = optics.bench.study.disturbance.index(population)
    times = optics.times[index]
    assert times is not None
    positions, _, diverged = _positions(bench, one, index, seen_of(optics, index, realization), realization)
    if diverged:
        raise UserError(f"Case {case} diverges under the controller {one.name!r}.")
    shaken = drawn_with(optics.bench, population, realization, FULL)
    return add([shaken, moved(optics, one, positions[times.instants])])


def _positions(
    bench: Bench, one: Designed, index: int, disturbance: Array, realization: int
) -> tuple[Array, Array, bool]:
    """Return positions (l, P) at the looks of a case, the share of limited commands, and divergence."""
    times, study = bench.optics.times[index], bench.study
    assert times is not None
    if one.instant is not None:
        return disturbance[times.looks] @ one.instant.T, np.zeros(()), False
    if not one.loops:
        return np.zeros((len(times.looks), 0)), np.zeros(()), False
    case = times.seen, disturbance, realization
    given = readings_of(study, bench.optics.light, one, [case], study.study.seed)
    place = sum(entry.share > 0 for entry in study.disturbance[:index])  # schedules are of those with cases
    found = run(one.loops, one.schedules[place], given, len(times.looks), dynamics_of(one.answers))
    return np.ascontiguousarray(found.positions[..., 0]), found.limited[0], bool(found.diverged[0])


def _away(
    bench: Bench, one: Designed, index: int, left: Motion, way: Motion | None, positions: Array
) -> Array | None:
    """Return where the line of sight is between exposed instants, if it is followed."""
    optics, times = bench.optics, bench.optics.times[index]
    assert times is not None
    if times.between is None or way is None:
        return places_of_rows(optics.bench, optics.bench.study.disturbance[index], left)
    held = moved(optics, one, positions[times.between.ravel()])
    return places_between(optics.bench, times.between.shape, add([way, held]))


def _linear(optics: SystemOptics, traced: Mapping[str, Array], linear: Array) -> dict[str, Array]:
    """Return how far the linear light (n, K) is off what was traced."""
    primary = optics.bench.system.primary_wavelength
    rms = np.sqrt(np.sum((optics.still + linear[:, 2 : optics.light.optical]) ** 2, axis=1))
    away = linear[:, :2] * optics.mm - traced["los_mm"][:, 0, primary]
    return {
        "light_error_wfe_rms": np.abs(rms - traced["wfe_rms"][:, 0, primary]).max(),
        "light_error_los": np.linalg.norm(away, axis=1).max(),
    }


_UM = 1e3  # per mm
_OWN = (
    ("limited", "1", "share of the actuator channels' commands that stroke or slew limited"),
    ("largest", "1", "largest position of an actuator, in its unit"),
    (
        "light_error_wfe_rms",
        "nm",
        "largest difference of the loop's linear and traced wavefront error rms, first field point",
    ),
    ("light_error_los", "mm", "largest difference of the loop's linear and traced line of sight, there"),
)


def measures(bench: Bench) -> Iterator[Measure]:
    """Yield the measures of ``system-disturbance`` under every controller, and what loops add."""
    for one in system_disturbance.measures_of(bench.optics.bench):
        if one.coordinate:
            yield one
        else:
            yield replace(one, dims=("controller", *one.dims))
    for name, units, words in _OWN:
        yield stored(name, units, words, ("controller",))
    words = "line of sight without a loop, both axes, at all instants that loops see, first field point"
    yield stored("open_psd", "um^2/Hz", words, ("frequency",))


def axes(bench: Bench) -> dict[str, Axis]:
    """Return the dimensions of the measures."""
    names = [one.name for one in bench.study.controller]
    return {
        "controller": Axis(names, "what is done about the disturbance"),
        **system_axes(bench.optics.bench),
        **curve_axes(shown(bench.study)),
    }


def fixed(bench: Bench) -> dict[str, Fixed]:
    """Return the system at rest, and linear loops over frequency, each alone."""
    words = {"units": "nm", "long_name": "wavelength that the loops see, at the first field point"}
    return {
        **system_disturbance.fixed_of(bench.optics.bench),
        "loop_wavelength_nm": ((), np.array(bench.optics.light.wavelength_nm), words),
        **curves(bench.study, bench.optics, bench.linear, "um", _UM * bench.optics.mm),
    }


def describe(bench: Bench) -> dict[str, str]:
    """Return channels of actuators, and what there is of the system, for the plan."""
    light = bench.optics.light
    channels = {one.name: ", ".join(one.channels(light)) for one in bench.study.actuator}
    return {f"actuator {name}": words for name, words in channels.items()} | system_disturbance.describe(
        bench.optics.bench
    )


def loops(study: SystemLoopStudy) -> Makers:
    """Return every linear controller that acts, each alone."""
    return linear_loops(study, optics_of(study))


def notices(study: SystemLoopStudy) -> Iterator[str]:
    """Yield what is to say of the system."""
    yield from system_disturbance.notices(study.disturbed)
    yield from pushing_notices(study)
    if any(one.asks_modes for one in study.controller):
        yield from design_notices(study, optics_of(study))


KIND = study_kind(
    "system-loop",
    SystemLoopStudy,
    prepare=bench_of,
    cases=case_labels,
    compute=compute,
    measures=measures,
    axes=axes,
    fixed=fixed,
    describe=describe,
    notices=notices,
)
