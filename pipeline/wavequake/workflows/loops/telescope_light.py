"""The telescope of ``telescope-loop``: what sensors see of motions, and what a case draws."""

import json
from dataclasses import dataclass, replace

import numpy as np

from wavequake.chain.loops.block import ACTUATORS, Actuator, Light
from wavequake.control.linear import Array
from wavequake.errors import UserError
from wavequake.kernels.device.devices import choose_device
from wavequake.kernels.device.tiles import TILE, padded
from wavequake.mechanics.disturbances.registry import draw_case, instants_of, parts
from wavequake.optics.derivatives.central import SIGNS, checked_derivative
from wavequake.optics.segments import modal
from wavequake.optics.segments.modal import ModalModel, layout_of
from wavequake.optics.segments.states import SurfaceStates, rest
from wavequake.prepared import prepared
from wavequake.workflows.exposures.telescope_control import ControlBench, imaged_bench_of, segment_text, trace
from wavequake.workflows.loops.telescope_study import TelescopeLoopStudy
from wavequake.workflows.segments.bench import MAS_PER_RAD, MM_PER_M
from wavequake.workflows.segments.launches import CaseDraw
from wavequake.workflows.segments.segment_model import knows, model_of, motion_rows
from wavequake.workflows.segments.vignetting import require_all_rays


@dataclass(frozen=True)
class Optics:
    """A telescope without loops.

    Attributes
    ----------
    control : ControlBench
        Its rays and images.
    model : ModalModel
    light : Light
    sights : dict of ndarray, shape (K, p)
        What sensors see per position of each actuator, by name.
    times : tuple of ndarray, shape (1 + n,)
        Of each population: 0 and its instants, s.
    """

    control: ControlBench
    model: ModalModel
    light: Light
    sights: dict[str, Array]
    times: tuple[Array, ...]

    @property
    def still(self) -> Array:
        """Noll coefficients 4..J at rest, nm."""
        return np.asarray(self.control.static.zernike[0, 3:] * self.control.study.optics.wavelength_nm)


def optics_of(study: TelescopeLoopStudy) -> Optics:
    """Prepare the telescope of a study, and what sensors see per position of each actuator.

    Raises
    ------
    UserError
        If there are no derivatives, or an actuator does not fit the telescope.
    """
    text = study.exposed.identity_text()
    moved = {dof for one in study.actuator for dof in one.segment_dofs}
    sights = {one.name: _sight(text, json.dumps(one.model_dump(), sort_keys=True)) for one in study.actuator}
    control, model, light = _telescope(text, tuple(sorted(moved)))
    if any(one.sees == "segments" for one in study.sensor):
        light = replace(light, segments_too=True)
        for one in study.actuator:
            sights[one.name] = np.vstack([sights[one.name], _moved_segments(control, light, one)])
    times = tuple(
        np.concatenate([[0.0], instants_of(study.disturbance, entry)]) for entry in study.disturbance
    )
    return Optics(control, model, light, sights, times)


def _moved_segments(control: ControlBench, light: Light, one: Actuator) -> Array:
    """Return dz (nm), rx and ry (nrad) of the segments per position of an actuator, (3 S, p)."""
    p = len(one.channels(light))
    if not one.segment_dofs:
        return np.zeros((3 * len(light.layout), p))
    states = rest(p, len(light.layout), 1)
    one.put(states, np.eye(p))
    return in_nm_and_nrad(states.segment_motion / np.repeat([MM_PER_M, 1.0], 3)).T


def in_nm_and_nrad(segment_motion: Array) -> Array:
    """Return motions (n, S, 6) in m and rad as dz, rx, ry of all segments, (n, 3 S), in nm and nrad."""
    return np.asarray(1e9 * np.swapaxes(segment_motion[..., 2:5], 1, 2).reshape(len(segment_motion), -1))


def _telescope(text: str, dofs: tuple[int, ...]) -> tuple[ControlBench, ModalModel, Light]:
    control = imaged_bench_of(text)
    require_all_rays(control.bench.stopped, "so that the linear light of loops has no derivatives")
    model = model_of(segment_text(text), "numpy", dofs)
    bench = control.bench
    light = Light(model.terms, control.prepared.obscuration, bench.system.pupil_outer, bench.layout)
    return control, model, light


@prepared(maxsize=8)
def _sight(text: str, actuator: str) -> Array:
    """Return what sensors see per position of an actuator, (K, p); kept by the texts of both."""
    record = json.loads(actuator)
    one = ACTUATORS.entries()[record["model"]].model_validate(record, strict=False)
    control, model, light = _telescope(text, one.segment_dofs)
    return (
        _modal_sight(control, model, light, one) if one.segment_dofs else _traced_sight(control, light, one)
    )


def seen_units(control: ControlBench, wavelength_nm: float) -> tuple[float, float]:
    """Return the factors of line of sight (mm to mas) and of coefficients (waves to nm)."""
    return MAS_PER_RAD / control.bench.first_order.focal_length, wavelength_nm


def _modal_sight(control: ControlBench, model: ModalModel, light: Light, one: Actuator) -> Array:
    """Return the sight of an actuator of segments, which the modal model has."""
    to_mas, to_nm = seen_units(control, control.study.optics.wavelength_nm)
    places, segments = layout_of(model.terms), len(light.layout)
    unit = rest(1, segments, 1)
    one.put(unit, np.ones((1, len(one.channels(light)))))
    rows = []
    for dof in one.segment_dofs:
        first = model.dofs.index(dof) * segments
        block = model.columns[first : first + segments]
        seen = np.hstack([block[:, places.los] * to_mas, block[:, places.zernike][:, 3:] * to_nm])
        rows.append(seen * unit.segment_motion[0, :, dof, None])
    return np.vstack(rows).T


def _traced_sight(control: ControlBench, light: Light, one: Actuator) -> Array:
    """Return the sight of any actuator, by central differences of traces of each of its channels."""
    to_mas, to_nm = seen_units(control, control.study.optics.wavelength_nm)
    p = len(one.channels(light))
    states = states_at_rest(control, padded(4 * p))
    one.put(states, np.concatenate([factor * one.step * np.eye(p) for factor in SIGNS]))
    found = trace(control.prepared, states, choose_device("numpy"))[1]
    values = np.hstack([found.los * to_mas, found.zernike[:, 3:] * to_nm])[: 4 * p]
    slopes = checked_derivative(
        values.reshape(4, p, -1), one.step, f"the actuator {one.name}", "use other optics.rays"
    )
    return np.ascontiguousarray(slopes.T)


def states_at_rest(control: ControlBench, batch: int) -> SurfaceStates:
    """Return the telescope at rest, at the field point of the study."""
    bench, terms = control.bench, control.study.figure_terms
    still = rest(batch, len(bench.system.segments), len(bench.system.surfaces), bench.figure_terms, terms)
    still.field[:] += bench.field
    return still


def drawn(study: TelescopeLoopStudy, optics: Optics, index: int, realization: int) -> CaseDraw:
    """Draw a case at 0 and at its instants; what is given over time stands still before its first one."""
    population, time = study.disturbance[index], optics.times[index]
    own = any(part.instants_of_file() is not None for part in parts(study.disturbance, population))
    at = time[1:] if own else time
    motion = draw_case(
        study.disturbance, population, optics.light.layout, study.study.seed, realization, time=at
    )
    if own:
        motion = motion.at([0, *range(len(at))])
    if not knows(optics.model, motion):
        raise UserError(
            f"The disturbance {population.name!r} moves what the linear light of loops does not know: "
            "surfaces beside M1's segments."
        )
    return CaseDraw(population, realization, time, motion)


def seen_of(study: TelescopeLoopStudy, optics: Optics, case: CaseDraw) -> Array:
    """Return what sensors see of a disturbance at 0 and its instants, (1 + n, K); mas and nm."""
    to_mas, to_nm = seen_units(optics.control, study.optics.wavelength_nm)
    count, places = len(case.time), layout_of(optics.model.terms)
    rows = motion_rows(optics.control.bench, optics.model, case.motion, padded(count))
    linear = modal.forms(optics.model, rows, TILE).linear[:count]
    seen = [linear[:, places.los] * to_mas, linear[:, places.zernike][:, 3:] * to_nm]
    if optics.light.segments_too:
        seen.append(in_nm_and_nrad(case.motion.segment_motion))
    return np.hstack(seen)
