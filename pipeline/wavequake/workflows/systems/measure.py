"""What a system-disturbance study measures of a case: the numbers of its wavefronts at all instants."""

from collections.abc import Callable, Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from wavequake.campaign.stopwatch import Stopwatch
from wavequake.chain.images.system import SystemImager, expose
from wavequake.errors import UserError
from wavequake.kernels.device.devices import Device
from wavequake.kernels.device.tiles import TILE
from wavequake.kernels.trace.sequence import Moving
from wavequake.kernels.trace.sequential_numpy import moving_part
from wavequake.mechanics.disturbances.motion import Motion
from wavequake.optics.polynomials.transforms import known_transformed
from wavequake.optics.rays.packing import moving
from wavequake.optics.wavefronts.quality import meets_marechal, meets_rayleigh
from wavequake.optics.wavefronts.record import Wavefront, joined
from wavequake.optics.wavefronts.wavefront import (
    PreparedSystem,
    analyse_system,
    incoming_lights,
    trace_lights,
)
from wavequake.workflows.systems.bench import NM_PER_MM, SystemBench, failure, system_states

Array = NDArray[np.float64]

See = Callable[[int, int, Motion], Wavefront]
"""From field, wavelength and motion to the wavefronts of a case."""
# Of each case at a field and wavelength, and the instant that has no wavefront and why, if any.
_Light = Callable[[int, int], Iterator[tuple[Wavefront, tuple[int, str] | None]]]

# Rays of all instants that are traced together; of each there are a dozen numbers.
_RAYS = 1 << 22


def measured(bench: SystemBench, time: Array, drawn: Motion, device: Device) -> tuple[dict[str, Array], str]:
    """Return the numbers of a case by name, ([time], field, wavelength, ...); or none, and why."""
    return measured_cases(bench, [(time, drawn)], device, Stopwatch())[0]


def measured_cases(
    bench: SystemBench,
    motions: list[tuple[Array, Motion]],
    device: Device,
    clock: Stopwatch,
    imager: SystemImager | None = None,
    away: Sequence[Array | None] | None = None,
    see: See | None = None,
) -> list[tuple[dict[str, Array], str]]:
    """Return what `measured` does for each of several cases, their times and motions; and exposures.

    ``away`` (fields, exposed instants, m, 2) in mm is where the line of sight of each case is besides. Light
    is traced, or seen by ``see``.
    """
    away = away or [None] * len(motions)
    light = _traced(bench, motions, device, clock) if see is None else _seen(bench, motions, see, clock)
    found: list[dict[str, list[Array]]] = [{} for _ in motions]
    messages = [""] * len(motions)
    images: list[dict[str, list[Array]]] = [{} for _ in motions]
    for field, (row, still) in enumerate(zip(bench.prepared, bench.static, strict=True)):
        seen: list[list[Wavefront]] = [[] for _ in motions]
        for wavelength, (prepared, rest) in enumerate(zip(row, still, strict=True)):
            for case, (wavefront, trouble) in enumerate(light(field, wavelength)):
                if trouble:
                    at = motions[case][0][trouble[0]]
                    messages[case] = messages[case] or f"at t = {at:.4g} s {trouble[1]}"
                    continue
                numbers = wavefront_numbers(prepared, wavefront, rest, bench.study.wavefront.basis)
                seen[case].append(wavefront)
                for name, values in numbers.items():
                    found[case].setdefault(name, []).append(values)
        for case, wavefronts in enumerate(seen):
            if imager is None or messages[case]:
                continue
            there = away[case]
            try:
                with clock("image"):
                    exposed = expose(imager, field, wavefronts, None if there is None else there[field])
            except UserError as error:  # a line of sight that moves too far concerns this case alone
                messages[case] = str(error)
                continue
            for name, values in exposed.items():
                images[case].setdefault(name, []).append(values)
    return [
        ({}, message)
        if message
        else (
            {"time_s": time}
            | {name: shaped(bench, values) for name, values in numbers.items()}
            | {name: np.stack(values) for name, values in exposed.items()},
            "",
        )
        for (time, _), numbers, exposed, message in zip(motions, found, images, messages, strict=True)
    ]


def _traced(
    bench: SystemBench, motions: list[tuple[Array, Motion]], device: Device, clock: Stopwatch
) -> _Light:
    """Return what traces several cases."""
    states = [system_states(bench, drawn) for _, drawn in motions]
    lights = [moving(bench.system, one, device=device) for one in states]

    def light(field: int, wavelength: int) -> Iterator[tuple[Wavefront, tuple[int, str] | None]]:
        prepared = bench.prepared[field][wavelength]
        with clock("aim"):
            incoming = incoming_lights(prepared, states, lights)
            pieces = [_pieces(prepared, one) for one in incoming]
            traces = trace_lights(prepared, [one for case in pieces for one in case], device)
        for state, case in zip(states, pieces, strict=True):
            parts = []
            for _ in case:
                with clock("trace"):
                    traced = next(traces)
                with clock("wavefront"):
                    parts.append(analyse_system(prepared, *traced, device))
            wavefront = joined(parts)
            yield wavefront, failure(prepared, wavefront, state)

    return light


def _seen(bench: SystemBench, motions: list[tuple[Array, Motion]], see: See, clock: Stopwatch) -> _Light:
    """Return what sees several cases without rays."""

    def light(field: int, wavelength: int) -> Iterator[tuple[Wavefront, None]]:
        for _, drawn in motions:
            with clock("modal"):
                found = see(field, wavelength, drawn)
            yield found, None

    return light


def _pieces(prepared: PreparedSystem, light: Moving) -> list[Moving]:
    """Return what moves in a case in pieces of so many instants as are traced together."""
    count, most = len(light.poses), max(_RAYS // len(prepared.pupil) // TILE, 1) * TILE
    if count <= most:
        return [light]
    return [moving_part(light, slice(first, first + most)) for first in range(0, count, most)]


def worst_instant(bench: SystemBench, time: Array, drawn: Motion, device: Device) -> int:
    """Return the instant at which the wavefront at the primary wavelength changes most at any field point."""
    found, trouble = measured(bench, time, drawn, device)
    if trouble:
        return 0
    change = found["wfe_change"][:, :, bench.system.primary_wavelength]
    return int(change.max(axis=1).argmax())


def shaped(bench: SystemBench, values: list[Array]) -> Array:
    """Return ([time], field, wavelength, ...) from one array ([time], ...) per field and wavelength."""
    grid = (len(bench.prepared), len(bench.prepared[0]))
    if not np.ndim(values[0]):
        return np.array(values).reshape(grid)
    stacked = np.stack(values, axis=1)
    return stacked.reshape(len(stacked), *grid, *stacked.shape[2:])


def wavefront_numbers(
    prepared: PreparedSystem, wavefront: Wavefront, rest: Wavefront, basis: str
) -> dict[str, Array]:
    """Return what is stored of the wavefronts of a case, in the store's units; `rest` is the one at rest."""
    to_nm = prepared.wavelength * NM_PER_MM
    coefficients = wavefront.zernike
    if basis == "circular":
        coefficients = known_transformed(coefficients, prepared.system.pupil.obscuration, 0.0)
    return {
        "wfe_rms": wavefront.rms * to_nm,
        "wfe_change": np.sqrt(np.sum((wavefront.zernike - rest.zernike)[:, 3:] ** 2, axis=1)) * to_nm,
        "wfe_rms_raw": wavefront.rms_raw * to_nm,
        "wfe_pv": wavefront.pv * to_nm,
        "zernike": coefficients * to_nm,
        "los_mm": wavefront.los - rest.los,
        "centroid_mm": wavefront.centroid - rest.centroid,
        "spot_rms": wavefront.spot_rms * 1e3,
        "strehl": wavefront.strehl,
        "rayleigh": np.mean(meets_rayleigh(wavefront.pv)),
        "marechal": np.mean(meets_marechal(wavefront.rms_flat)),
        "vignetted": np.asarray(wavefront.vignetted.max(), dtype=np.float64),
        "lost": np.asarray(wavefront.lost.max(), dtype=np.float64),
    }
