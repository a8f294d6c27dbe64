"""Where the line of sight of a system is between the instants that are traced: linear in all motions."""

import numpy as np
from numpy.typing import NDArray

from wavequake.chain.images.streak import around_rows, times_between
from wavequake.chain.images.system import exposed_instants
from wavequake.kernels.device.devices import NUMPY
from wavequake.mechanics.disturbances.element_motion import ElementDisturbance
from wavequake.mechanics.disturbances.motion import Motion
from wavequake.mechanics.disturbances.registry import instants_of, parts
from wavequake.optics.derivatives.central import SensitivityMatrix, gradient
from wavequake.optics.derivatives.sensitivity import default_steps, figure_sensitivity, rigid_sensitivity
from wavequake.optics.shapes.shapes import ZernikeDeformation
from wavequake.optics.systems.kinematics import rest_states
from wavequake.optics.systems.paraxial import entrance_pupil_center
from wavequake.optics.systems.system import OpticalSystem, States
from wavequake.optics.wavefronts.wavefront import PreparedSystem, measure_system
from wavequake.prepared import prepared
from wavequake.workflows.systems.bench import SystemBench, system_bench, system_states
from wavequake.workflows.systems.study import SystemStudy

Array = NDArray[np.float64]


def streaked_times(study: SystemStudy, population: ElementDisturbance) -> Array | None:
    """Return the times (n, m), s, at which the sight of exposed instants is followed; None: at them alone.

    Of histories from files nothing is known between their rows: see `places_of_rows`.
    """
    one = study.disturbance
    if study.imaging is None or _is_given(study, population):
        return None
    time = instants_of(one, population)
    chosen = exposed_instants(study.imaging, len(time))
    return times_between(time[chosen], population.duration_s)


def places_between(bench: SystemBench, shape: tuple[int, ...], drawn: Motion) -> Array:
    """Return how far the line of sight is from where its instant has it, (fields, n, m, 2) in mm.

    Parameters
    ----------
    bench : SystemBench
    shape : tuple of int
        Of the times, (n, m), the first of each row at its instant.
    drawn : Motion
        At all of these times.
    """
    rows = flat(bench.system, system_states(bench, drawn))
    gains = sight_gains(bench.text)
    sight = np.stack([rows @ gain for gain in gains]).reshape(len(gains), *shape, 2)
    return np.asarray(sight - sight[:, :, :1])


def places_of_rows(bench: SystemBench, population: ElementDisturbance, drawn: Motion) -> Array | None:
    """Return the same of a population with a history from a file: linear between its rows, exposed or not.

    Half the way to the exposed rows before and after. None for any other population, and where nothing is
    exposed.
    """
    study = bench.study
    if study.imaging is None or not _is_given(study, population):
        return None
    time = instants_of(study.disturbance, population)
    chosen = exposed_instants(study.imaging, len(time))
    rows = flat(bench.system, system_states(bench, drawn))
    sight = np.stack([around_rows(time, chosen, rows @ gain) for gain in sight_gains(bench.text)])
    return np.asarray(sight - sight[:, :, :1])


def _is_given(study: SystemStudy, population: ElementDisturbance) -> bool:
    return any(part.instants_of_file() is not None for part in parts(study.disturbance, population))


@prepared(maxsize=2)
def sight_gains(study_text: str) -> tuple[Array, ...]:
    """Return, for each field, how its line of sight follows all that moves, (columns, 2), mm per mm or rad.

    At the primary wavelength. Columns are motions of surfaces, their figures and the direction of the light.
    """
    return tuple(np.ascontiguousarray(one[:, :2]) for one in light_gains(study_text))


@prepared(maxsize=2)
def light_gains(study_text: str) -> tuple[Array, ...]:
    """Return the same with Noll coefficients after the line of sight, (columns, 2 + J), waves per mm, rad."""
    bench = system_bench(study_text)
    return tuple(_gain(bench, row[bench.system.primary_wavelength]) for row in bench.prepared)


def _gain(bench: SystemBench, one: PreparedSystem) -> Array:
    def seen(found: SensitivityMatrix) -> Array:
        return np.concatenate([found.los, found.zernike], axis=2)

    terms_seen = 2 + one.fit.basis.shape[1]
    found = [seen(rigid_sensitivity(one, (), NUMPY)).reshape(-1, terms_seen)]
    forms = [(at, surface.deformation) for at, surface in enumerate(bench.system.surfaces)]
    terms = {at: form.terms for at, form in forms if isinstance(form, ZernikeDeformation)}
    figures: dict[int, Array] = {}
    for same in sorted(set(terms.values())):  # together: what each call prepares takes longer than a figure
        surfaces = [at for at in terms if terms[at] == same]
        figures |= zip(surfaces, seen(figure_sensitivity(one, surfaces, same, NUMPY)), strict=True)
    found += [figures[at] for at in terms]
    if not np.isfinite(entrance_pupil_center(bench.system)).all():
        return np.concatenate([*found, np.zeros((2, terms_seen))])  # such light cannot turn
    step = default_steps(bench.system).rotation
    states = rest_states(bench.system, 4)
    states.line_of_sight[[0, 1], [0, 0]] = step, -step
    states.line_of_sight[[2, 3], [1, 1]] = step, -step
    turned = measure_system(one, states, NUMPY)
    values = np.hstack([turned.los, turned.zernike])
    return np.concatenate([*found, gradient(values, step).T])


def flat(system: OpticalSystem, states: States) -> Array:
    """Return states as rows (T, columns), as `sight_gains` has them; without heights on grids."""
    count = len(states.surface_motion)
    figures = [
        form[:, : surface.deformation.terms]
        for surface, form in zip(system.surfaces, states.deformations, strict=True)
        if isinstance(surface.deformation, ZernikeDeformation) and form is not None
    ]
    return np.hstack([states.surface_motion.reshape(count, -1), *figures, states.line_of_sight])
