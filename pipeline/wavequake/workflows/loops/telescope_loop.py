"""The workflow "telescope-loop": a disturbed telescope in closed loop, under several controllers on one draw.

In the loop, light is linear: line of sight and Zernike coefficients by sensitivities. Between its instants
the disturbance goes in straight lines; sensors, delays and actuators are exact for that. Some instants are
traced in full beside: they make the exposure, and say how far the linear light is off.
"""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wavequake.campaign.measured import Block, CaseTable, study_kind
from wavequake.campaign.measures import Axis, Measure, stored
from wavequake.campaign.stopwatch import Stopwatch
from wavequake.chain.images.camera import frame_axes
from wavequake.chain.images.coherent import mean_image
from wavequake.chain.images.extended import image_measures, object_image
from wavequake.chain.loops.answers import dynamics_of, put_all
from wavequake.chain.loops.designed import Designed, design_notices, readings_of
from wavequake.chain.sampling import slots
from wavequake.control.linear import Array
from wavequake.control.sampled.run import run
from wavequake.errors import UserError
from wavequake.imaging.exposures.exposure import encircled_energy_radius
from wavequake.imaging.exposures.exposure_models import cut, full_exposure
from wavequake.kernels.device.devices import Device, choose_device
from wavequake.kernels.trace.train import Traced
from wavequake.mechanics.disturbances.plant_source import PlantSource
from wavequake.mechanics.disturbances.registry import parts
from wavequake.mechanics.model import Integers
from wavequake.optics.systems.system import States
from wavequake.optics.wavefronts.record import Wavefront
from wavequake.workflows.bodies.stages import stage_notices
from wavequake.workflows.exposures.telescope_control import (
    ControlBench,
    local_images,
    measured_opd,
    position,
    ray_phase,
    trace,
)
from wavequake.workflows.exposures.telescope_exposure import lit_object_of
from wavequake.workflows.loops.curves import curve_axes, curves, shown
from wavequake.workflows.loops.telescope_bench import Bench, bench_of
from wavequake.workflows.loops.telescope_light import (
    drawn,
    off_straight_lines,
    optics_of,
    seen_of,
    seen_units,
)
from wavequake.workflows.loops.telescope_study import TelescopeLoopStudy
from wavequake.workflows.loops.traced_light import beyond_linear
from wavequake.workflows.segments.launches import CaseDraw, surface_states

# Of what is seen of bodies, how far straight lines between instants may be off.
_STRAIGHT = 0.02
# Cases that are stepped together; products have this many columns whatever is computed, and a case its own.
ROWS = 16


def cases(study: TelescopeLoopStudy, ids: Integers) -> CaseTable:
    """Return disturbance and realization of cases; all controllers of a case share its draw."""
    which, realizations = slots([entry.share for entry in study.disturbance], np.asarray(ids))
    names = np.array([entry.name for entry in study.disturbance], dtype=object)
    return {"disturbance": names[which], "realization": realizations}


def compute(bench: Bench, table: CaseTable, device: str, clock: Stopwatch) -> Iterator[Block]:
    """Run cases in batches of a population, under one controller after the other."""
    names = [entry.name for entry in bench.study.disturbance]
    for index, name in enumerate(names):
        mine = np.flatnonzero(table["disturbance"] == name)
        tiles = table["realization"][mine] // ROWS
        for tile in np.unique(tiles):
            rows = mine[tiles == tile]
            yield _batch(bench, index, rows, table["realization"][rows], choose_device(device), clock)


def _batch(
    bench: Bench, index: int, rows: Integers, realizations: Integers, device: Device, clock: Stopwatch
) -> Block:
    with clock("draw"):
        draws = [drawn(bench.study, bench.optics, index, int(one)) for one in realizations]
        seen = [seen_of(bench.study, bench.optics, one) for one in draws]
    parts: list[dict[str, Array]] = []
    messages: dict[int, str] = {}
    for one in bench.controllers:
        with clock("loop"):
            positions, limited, diverged = positions_of(bench, one, index, draws, seen, device)
        series = []
        for row, case in enumerate(draws):
            if diverged[row]:
                messages.setdefault(row, f"it diverges under the controller {one.name!r}")
            values = _numbers(bench, one, seen[row][1:], positions[row])
            channels = positions[row][:, : one.channels(bench.optics.light)]
            values |= {"limited": limited[row], "largest": np.abs(channels).max(initial=0.0)}
            if row in messages or not bench.study.look.traces(case.realization):
                values |= _nothing(bench)
            else:
                try:
                    values |= _traced(bench, one, case, positions[row], values, device, clock)
                except UserError as error:
                    messages[row] = f"{one.name}: {error}"
                    values |= _nothing(bench)
            series.append(values)
        parts.append({name: np.stack([values[name] for values in series]) for name in series[0]})
    found = {name: np.stack([part[name] for part in parts], axis=1) for name in parts[0]}
    found["time_s"] = np.stack([case.time[1:] for case in draws])
    return Block(found, rows, messages)


def positions_of(
    bench: Bench, one: Designed, index: int, draws: list[CaseDraw], seen: list[Array], device: Device
) -> tuple[list[Array], Array, NDArray[np.bool_]]:
    """Return of each case positions (n, P) at its instants, the share of limited commands, and divergence."""
    count, looks = len(draws), len(draws[0].time) - 1
    if one.instant is not None:
        return [values[1:] @ one.instant.T for values in seen], np.zeros(count), np.zeros(count, bool)
    if not one.loops:
        return [np.zeros((looks, 0))] * count, np.zeros(count), np.zeros(count, bool)
    columns = [case.realization % ROWS for case in draws]
    tile: list[tuple[Array, Array, int] | None] = [None] * ROWS
    for column, case, values in zip(columns, draws, seen, strict=True):
        tile[column] = case.time, values, case.realization
    given = readings_of(bench.study, bench.optics.light, one, tile, bench.study.study.seed)
    traced = bench.study.look.sensors == "traced"
    beyond = beyond_linear(bench, one, draws, seen, columns, device) if traced else None
    found = run(one.loops, one.schedules[index], given, looks, dynamics_of(one.answers), beyond)
    positions = [np.ascontiguousarray(found.positions[..., column]) for column in columns]
    return positions, found.limited[columns], found.diverged[columns]


def _numbers(bench: Bench, one: Designed, seen: Array, positions: Array) -> dict[str, Array]:
    with np.errstate(over="ignore", invalid="ignore"):
        left = seen + positions @ one.sight.T
        rms = np.sqrt(np.sum((bench.optics.still + left[:, 2 : bench.optics.light.optical]) ** 2, axis=1))
    return {"wfe_rms": rms, "los": left[:, :2]}


def _nothing(bench: Bench) -> dict[str, Array]:
    """Return what was not traced."""
    traced = bench.study.look.traced
    if not traced:
        return {}
    pixels = bench.study.imaging.pixels
    shapes: dict[str, tuple[int, ...]] = {"traced_wfe_rms": (traced,), "traced_los": (traced, 2)}
    shapes |= dict.fromkeys(["exposure"] + ["object_image"] * (bench.study.object is not None), (pixels,) * 2)
    single = ("light_error_wfe_rms", "light_error_los", "peak", "ee50", "ee80")
    return {name: np.full(shape, np.nan) for name, shape in {**shapes, **dict.fromkeys(single, ())}.items()}


def states_of(bench: Bench, one: Designed, case: CaseDraw, positions: Array, chosen: Integers) -> States:
    """Return a case at the chosen of its instants under a controller, whole tiles of states."""
    control = bench.optics.control
    moved = replace(case, time=case.time[1 + chosen], motion=case.motion.at(1 + chosen))
    states = surface_states(control.bench, moved, 0, len(chosen))
    first = 0
    for actuator in one.actuators:
        last = first + len(actuator.channels(bench.optics.light))
        actuator.put(bench.optics.light, states, positions[chosen, first:last])
        first = last
    put_all(one.answers, states, positions[chosen, first:])
    return states


def chosen_instants(count: int, traced: int) -> Integers:
    """Return which of so many instants are traced: evenly spread, the last one among them."""
    return (np.arange(1, traced + 1) * count) // traced - 1


def _traced(
    bench: Bench,
    one: Designed,
    case: CaseDraw,
    positions: Array,
    linear: Mapping[str, Array],
    device: Device,
    clock: Stopwatch,
) -> dict[str, Array]:
    """Trace some instants of a case in full: their numbers, exposure, and how far linear light is off."""
    traced, control = bench.study.look.traced, bench.optics.control
    if not traced:
        return {}
    chosen = chosen_instants(len(positions), traced)
    with clock("trace"):
        states = states_of(bench, one, case, positions, chosen)
        rays, wavefront = trace(control.prepared, states, device)
    lost = wavefront.lost[:traced]
    if lost.any():
        raise UserError(f"{int(lost.max())} rays are lost, so that the image would have holes")
    to_mas, to_nm = seen_units(control, bench.study.optics.wavelength_nm)
    rms = wavefront.rms[:traced] * to_nm
    los = (wavefront.los[:traced] - control.static.los[0]) * to_mas
    imaging = bench.study.imaging
    with clock("image"):
        images = local_images(control, measured_opd(control, rays), wavefront)[:traced]
        canvas = full_exposure([images], position(control, wavefront)[:traced], imaging.sampling)
        exposure = cut(canvas, imaging.pixels)
        scale = imaging.sampling, control.area, control.diameter
        ee50, ee80 = encircled_energy_radius(exposure, (0.5, 0.8), *scale)
        seen = _object(control, canvas, rays, wavefront, traced)
    return {
        **seen,
        "traced_wfe_rms": rms,
        "traced_los": los,
        "light_error_wfe_rms": np.abs(linear["wfe_rms"][chosen] - rms).max(),
        "light_error_los": np.linalg.norm(linear["los"][chosen] - los, axis=1).max(),
        "exposure": exposure,
        "peak": exposure.max(),
        "ee50": np.asarray(ee50),
        "ee80": np.asarray(ee80),
    }


def _object(
    control: ControlBench, canvas: Array, rays: Traced, wavefront: Wavefront, traced: int
) -> dict[str, Array]:
    """Return the exposed image of the study's object, if there is one."""
    shown, imaging = control.study.object, control.study.imaging
    if shown is None:
        return {}
    lit = lit_object_of(control)
    if lit is None:
        sizes = imaging.pixels, imaging.sampling, control.area, control.diameter
        return {"object_image": object_image(shown, canvas, *sizes)}
    phases = ray_phase(control, measured_opd(control, rays), wavefront, control.static.los[:1])
    return {"object_image": mean_image(lit, [phases[:traced]])}


_MEASURES = (
    ("wfe_rms", "nm", "wavefront error rms of the fitted Zernikes j >= 4, by linear light", ("time",)),
    (
        "los",
        "mas",
        "line of sight relative to rest (Störkle 2018, Eq. 3.39), by linear light",
        ("time", "axis"),
    ),
    ("limited", "1", "share of the actuator channels' commands that stroke or slew limited", ()),
    ("largest", "1", "largest position of an actuator, in its unit", ()),
)
_OF_TRACES = (
    ("traced_wfe_rms", "nm", "the same of traced rays, at some instants", ("traced",)),
    ("traced_los", "mas", "the same of traced rays, at some instants", ("traced", "axis")),
    ("light_error_wfe_rms", "nm", "largest difference of linear and traced wavefront error rms", ()),
    ("light_error_los", "mas", "largest difference of linear and traced line of sight", ()),
)


def measures(bench: Bench) -> Iterable[Measure]:
    """Return what is stored of a case."""
    yield stored("time_s", "s", "time of the instant", ("time",), coordinate=True)
    for name, units, words, dims in _MEASURES + (_OF_TRACES if bench.study.look.traced else ()):
        yield stored(name, units, words, ("controller", *dims))
    if bench.study.look.traced:
        words = "mean image of the traced instants; 1 = peak of the perfect one"
        yield from image_measures(("controller",), bench.study.object, words=words)


def axes(bench: Bench) -> Mapping[str, Axis]:
    """Return controllers, instants and pixels."""
    study, imaging = bench.study, bench.study.imaging
    instants = max(len(time) - 1 for time in bench.optics.times)
    names = [one.name for one in study.controller]
    found = {
        "controller": Axis(names, "what is done about the disturbance"),
        "time": Axis(instants),
        "axis": Axis(["x", "y"], "axis of the image plane"),
        **curve_axes(shown(study)),
    }
    if not study.look.traced:
        return found
    return {**found, "traced": Axis(study.look.traced), **frame_axes(imaging.pixels, imaging.sampling)}


def fixed(bench: Bench) -> dict[str, Any]:
    """Return the telescope at rest, and linear loops over frequency, each alone."""
    words = {"units": "nm", "long_name": "wavefront error rms of the fitted Zernikes j >= 4 at rest"}
    found: dict[str, Any] = {"static_wfe_rms": ((), np.sqrt(np.sum(bench.optics.still**2)), words)}
    return found | curves(bench.study, bench.optics, bench.linear)


def notices(study: TelescopeLoopStudy) -> Iterator[str]:
    """Yield what controllers leave out in their designs, and what loops do not know of bodies."""
    optics = optics_of(study)
    yield from design_notices(study, optics)
    yield from stage_notices(study.actuator, optics.control.bench, optics.light)
    for index, entry in enumerate(study.disturbance):
        if entry.share and any(isinstance(one, PlantSource) for one in parts(study.disturbance, entry)):
            off = off_straight_lines(study, optics, index)
            if off > _STRAIGHT:
                yield (
                    f"disturbance.{entry.name}: between its instants loops take straight lines, which are "
                    f"off what bodies do by up to {off:.2g} of it; give more instants than {entry.instants}."
                )


def describe(bench: Bench) -> Mapping[str, str]:
    """Return rays and channels, for the plan."""
    channels = {name: len(one.channels(bench.optics.light)) for name, one in _actuators(bench).items()}
    rays = f"{len(bench.optics.control.prepared.weight)} on {len(bench.optics.light.layout)} segments"
    return {"rays": rays, **{name: f"{count} channels" for name, count in channels.items()}}


def _actuators(bench: Bench) -> dict[str, Any]:
    return {one.name: one for one in bench.study.actuator}


KIND = study_kind(
    "telescope-loop",
    TelescopeLoopStudy,
    prepare=bench_of,
    cases=cases,
    compute=compute,
    measures=measures,
    axes=axes,
    fixed=fixed,
    describe=describe,
    notices=notices,
)
