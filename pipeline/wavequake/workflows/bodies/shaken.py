"""How disturbances shake the modes of bodies with mass, for controllers that are to expect them."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from wavequake.chain.loops.design import Shaken
from wavequake.control.linear import Array
from wavequake.mechanics.assembly.plant import Plant
from wavequake.mechanics.disturbances.motion import generator
from wavequake.mechanics.disturbances.plant_source import PlantSource
from wavequake.mechanics.disturbances.population import Population
from wavequake.mechanics.disturbances.registry import instants_of, parts

# Of each disturbance, drawn beside its cases: the rms of a narrow resonance comes out to some percent.
_DRAWS, _INSTANTS = 16, 16
# Instants that fall in with no sinusoid.
_GOLDEN = 0.6180339887498949
# Of a radian of the fastest mode, about an instant, for its velocity.
_SHORT = 0.01


def shaken_bodies(
    populations: Sequence[Population], plant: Plant, seed: int, shown: Callable[[Array], Array]
) -> Shaken:
    """Return the modes of bodies that swing, as the disturbances of a study shake them on average.

    Parameters
    ----------
    populations : sequence of Population
        Disturbances, weighted by their shares of the cases.
    plant : Plant
    seed : int
    shown : callable
        Gives what sensors see (K, M) of outputs of the plant (m, M).
    """
    zeta = 0.5 * np.diag(plant.modal.damping) / plant.omega
    rms = rms_of_modes(populations, plant, seed)
    kept = np.flatnonzero((rms > 0.0) & (zeta < 1.0))
    names = tuple(f"mode {k + 1} of the bodies" for k in kept)
    seen = shown(plant.shapes)[:, kept] * rms[kept]
    return Shaken(names, plant.omega[kept] / (2 * np.pi), zeta[kept], seen)


def rms_of_modes(populations: Sequence[Population], plant: Plant, seed: int) -> Array:
    """Return the rms (r,) by which modes swing at their own frequencies, in root of kg times m.

    A mode that white forces shake has the same rms of q and of q' / omega. What is slower is less in q' /
    omega and what is faster in q: the smaller one counts, so that neither sag nor forced vibration is taken
    for a resonance.
    """
    r, (p, f) = len(plant.omega), (plant.modal.inputs.shape[1], plant.free.shape[1])
    modal = replace(plant, outputs={}, shapes=np.eye(r), carried=np.zeros((r, p)), free=np.zeros((r, f)))
    half = _SHORT / plant.omega.max()
    squares, total = np.zeros((2, r)), sum(one.share for one in populations)
    for population in populations:
        acting = [one for one in parts(populations, population) if isinstance(one, PlantSource)]
        if not (population.share and acting):
            continue
        middle = instants_of(populations, population)[-1] * (_GOLDEN * np.arange(1, _INSTANTS + 1) % 1.0)
        time = np.concatenate([middle - half, middle + half])
        for draw in range(_DRAWS):
            drawn = [one.answer(modal, time, generator(seed, f"modes by {one.name}", draw)) for one in acting]
            before, after = np.split(np.sum(drawn, axis=0), 2)
            both = np.stack([0.5 * (before + after), (after - before) / (2 * half * plant.omega)])
            squares += population.share / total / _DRAWS * np.mean(both**2, axis=1)
    return np.asarray(np.sqrt(squares).min(axis=0))
