"""The line of sight of a segmented telescope whose bodies move, between the instants that are traced.

It is linear in what bodies do: images at the instants are exact, and the way between them is followed.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import orth

from wavequake.kernels.device.devices import NUMPY
from wavequake.kernels.device.tiles import padded
from wavequake.mechanics.assembly.answers import moved
from wavequake.mechanics.assembly.plant import Plant
from wavequake.mechanics.disturbances.motion import still
from wavequake.mechanics.disturbances.plant_source import PlantSource
from wavequake.mechanics.disturbances.registry import Disturbance, on_elements, parts, randoms_of
from wavequake.mechanics.disturbances.streams import Streams
from wavequake.optics.segments.prepared import chief_rays, trace_states
from wavequake.optics.segments.wavefront import analyse
from wavequake.prepared import prepared
from wavequake.workflows.segments.bench import Bench, bench_of
from wavequake.workflows.segments.launches import CaseDraw, surface_states

Array = NDArray[np.float64]

_STEP = 1e-7  # m and rad: far above rounding, and second order is below a part in a million
_ROWS = 256  # of which the motions are traced at once


def bodies_sight(
    bench: Bench,
    plant: Plant,
    model: str,
    population: Disturbance,
    realization: int,
    streams: Streams,
    time: Array,
) -> Array | None:
    """Return where bodies move the line of sight (n, 2) to at any instants, rad on the sky; None: nowhere.

    With the numbers that the realization has at its own instants, and the `model` of bodies that `plant` is,
    or is drawn from.
    """
    study = bench.study
    acting = [one for one in parts(study.disturbance, population) if isinstance(one, PlantSource)]
    if not acting:
        return None
    rows = _per_output(bench.text, model)
    seen = replace(plant, shapes=rows @ plant.shapes, carried=rows @ plant.carried)
    found = np.zeros((len(time), 2))
    for part in acting:
        random = randoms_of(part, len(bench.layout), study.study.seed, realization, streams)(part.name)
        found += part.answer(seen, time, random)
    return found


@prepared(maxsize=8)
def _per_output(study_text: str, model: str) -> Array:
    """Return the line of sight (2, m), rad, per m or rad of what bodies do, as far as their modes do it."""
    bench = bench_of(study_text)
    plant = bench.bodies.plants[model]
    able = np.hstack([plant.shapes, plant.carried])
    sizes = np.linalg.norm(able, axis=0)
    able = able[:, sizes > 0.0] / sizes[sizes > 0.0]
    basis = np.eye(len(able)) if len(able) <= able.shape[1] else orth(able)
    steps = _STEP * basis.T
    found = [_seen(bench, plant, steps[first : first + _ROWS]) for first in range(0, len(steps), _ROWS)]
    return np.asarray(np.concatenate(found).T / _STEP @ basis.T)


def _seen(bench: Bench, plant: Plant, values: Array) -> Array:
    """Return the line of sight (n, 2) of outputs (n, m) relative to rest, rad."""
    rigid, figure = moved(plant, values)
    motion = on_elements(still(len(values), len(bench.layout), rigid=rigid, figure=figure), bench.layout)
    time = np.zeros(len(values))
    drawn = CaseDraw(bench.study.disturbance[0], 0, time, motion)
    states = surface_states(bench, drawn, 0, len(values))
    assert len(states) == padded(len(values))
    traced = trace_states(bench.prepared, states, NUMPY)
    wavefront = analyse(bench.prepared, traced, chief_rays(bench.prepared, states))
    off = wavefront.los[: len(values)] - bench.static.los[0]
    return np.asarray(off / bench.first_order.focal_length)
