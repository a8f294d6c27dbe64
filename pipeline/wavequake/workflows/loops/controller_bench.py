"""What the cases of ``controller-mor`` share: the full model, its modes, a bound of the others, its light."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from wavequake.control.robustness.plant import Complex, Plant, Truncated, in_units, whole_plant
from wavequake.control.robustness.residual import open_covariance, shown_forces
from wavequake.errors import UserError
from wavequake.imaging.exposures.stationary import Beams, mean_coherence, mean_image
from wavequake.mechanics.mirrors.models import (
    AnnularMirror,
    CircularMirror,
    HexagonalSegment,
    annular_mirror,
    circular_mirror,
    hexagonal_segment,
    on_springs,
)
from wavequake.mechanics.model import Array, FiniteElementModel, Integers, RayleighDamping, ReducedModel
from wavequake.mechanics.vibration.full_response import dynamic_response
from wavequake.prepared import prepared
from wavequake.reduction.limits import check_size
from wavequake.reduction.method import METHODS
from wavequake.reduction.metrics import modal_form
from wavequake.reduction.names import parse
from wavequake.reduction.reduce import needs_intermediate, reduce, shared_intermediate
from wavequake.reduction.structure import elastic_flexibility, elastic_modes, structure
from wavequake.workflows.loops.controller_study import ControllerStudy
from wavequake.workflows.mirrors.model_store import digest, kept_arrays, kept_intermediate

# Modes of the full model that are looked for in a reduced one.
COMPARED = 60
# Points of curves over the whole band, and about a mode in its half widths: out to where even a sharp
# resonance is small.
_SHOWN, _BESIDE = 400, np.geomspace(0.3, 300.0, 30)
_ABOUT = np.concatenate([-_BESIDE[::-1], [0.0], _BESIDE])
# A sensor at the edge may be written in few digits.
_EDGE = 1.01
# A wavefront changes by twice the way of the mirror.
_REFLECTED = 2.0
_NM = 1e-9


@dataclass(frozen=True)
class Bench:
    """The full model of a study.

    Attributes
    ----------
    study : ControllerStudy
    full : callable
        Builds the finite-element model.
    sensors : ndarray of int, shape (m,)
        Places of the sensors among the optical nodes.
    plant : Plant
        From forces at the supports to sensors, in the study's units; modal coordinates in SI.
    shapes : ndarray, shape (3 q, COMPARED)
        The first modes at the optical nodes.
    gram, figure_gram : ndarray, shape (n, n)
        Wavefront^2 = q' gram q, in m^2, averaged over the surface; with piston and tilt taken out.
    open_wavefront : float
        rms without a controller, m.
    hertz : ndarray, shape (f,)
        Frequencies of curves, some about each mode up to twice the last that errors are looked at.
    forces : ndarray of complex, shape (f, p, p)
        What forces of these frequencies do to the wavefront, see `shown_forces`.
    beams : Beams
        Its optical nodes in the pupil.
    heights : ndarray, shape (q, n)
        Motion of these along z per modal coordinate, m.
    """

    study: ControllerStudy
    full: Callable[[], FiniteElementModel]
    sensors: Integers
    plant: Plant
    shapes: Array
    gram: Array
    figure_gram: Array
    open_wavefront: float
    hertz: Array
    forces: Complex
    beams: Beams
    heights: Array

    @property
    def time_unit(self) -> float:
        """The unit of time of the plant, s."""
        return time_unit(self.study)


def time_unit(study: ControllerStudy) -> float:
    """Return the unit of time of a study, s."""
    return 1.0 / (2 * np.pi * study.controller.frequency_hz)


def build_model(study: ControllerStudy) -> FiniteElementModel:
    """Return the full model of a study, on its springs."""
    section = study.model
    damping = RayleighDamping(section.damping_alpha, section.damping_beta)
    if section.shape == "segment":
        free = hexagonal_segment(HexagonalSegment(divisions=section.divisions, damping=damping))
    elif section.shape == "circular":
        free = circular_mirror(CircularMirror(core=section.divisions, damping=damping))
    else:
        around = 6 * -(-8 * section.divisions // 6)
        free = annular_mirror(AnnularMirror(rings=section.divisions, around=around, damping=damping))
    return on_springs(free, section.spring_n_m)


def bench_of(study: ControllerStudy) -> Bench:
    """Prepare a study.

    Raises
    ------
    UserError
        If a variant does not suit the model, or two sensors fall on one node.
    """
    full = prepared(maxsize=1)(partial(build_model, study))
    model = full()
    body = structure(model)
    for name in map(parse, study.reduction.variants):
        check_size(body.size, name, METHODS.entries()[name.method])
    sensors = _sensor_nodes(study, model)
    if 2 * study.model.modes >= model.order:
        raise UserError(
            f"model.modes is {study.model.modes}, but the full model has {model.order} degrees of freedom; "
            "ask for fewer than half of them."
        )
    record = {"loop": study.model.model_dump(mode="json"), "sensors": sensors.tolist()}
    kept = kept_arrays(digest(record), lambda: _modes(study, model, sensors))
    damping = model.damping
    plant = Plant(
        kept["squared"],
        damping.mass + damping.stiffness * kept["squared"],
        kept["inputs"],
        kept["outputs"],
        kept["static"],
        Truncated(kept["squared"][-1], damping.mass, damping.stiffness, float(kept["flexibility"])),
    )
    plant = scaled(study, plant)
    heights = kept["shapes"][2::3]
    gram, figure = wavefront_grams(model, heights)
    open_wavefront = float(np.sqrt(np.sum(gram * open_covariance(plant))))
    shapes, hertz = kept["shapes"][:, :COMPARED], _shown(study, plant)
    forces = shown_forces(plant, gram, 2 * np.pi * hertz * time_unit(study))
    return Bench(
        study,
        full,
        sensors,
        plant,
        shapes,
        gram,
        figure,
        open_wavefront,
        hertz,
        forces,
        _beams(model),
        heights,
    )


def _beams(model: FiniteElementModel) -> Beams:
    places = model.nodes[model.surface_nodes, :2]
    diameter = 2.0 * float(np.linalg.norm(places, axis=1).max())
    return Beams(places / diameter, np.asarray(model.surface_weights / model.surface_weights.sum()))


def exposed(bench: Bench, covariance: Array) -> Array:
    """Return the mean image (y, x) under modal coordinates of a covariance; the middle is the Strehl ratio.

    The mean exp(i phase) over piston, too, is that of differences alone, so that piston does not count.
    """
    section = bench.study.image
    moved = _REFLECTED**2 * bench.heights @ covariance @ bench.heights.T
    coherence = mean_coherence(moved, _NM * section.wavelength_nm)
    return mean_image(bench.beams, coherence, section.angles())


def reduced(bench: Bench, name: str) -> ReducedModel:
    """Reduce the full model; the intermediate model of those methods that take one is kept on disk."""
    model, variant = bench.full(), parse(name)
    if needs_intermediate(model, variant):
        record = {"intermediate": bench.study.model.model_dump(mode="json", exclude={"modes"})}
        shared_intermediate(
            model, variant, lambda hertz, build: kept_intermediate(digest(record | {"hz": hertz}), build)
        )
    return reduce(model, name)


def _shown(study: ControllerStudy, plant: Plant) -> Array:
    section = study.reduction
    first, last = section.first_hz, 2 * section.beyond_hz
    poles = plant.poles / time_unit(study) / (2 * np.pi)
    about = (poles.imag[:, None] + np.abs(poles.real)[:, None] * _ABOUT).ravel()
    inside = about[(about > first) & (about < last)]
    return np.unique(np.concatenate([np.geomspace(first, last, _SHOWN), inside]))


def scaled(study: ControllerStudy, plant: Plant) -> Plant:
    """Return a plant in SI in the units of a study."""
    return in_units(plant, time_unit(study), study.controller.force_n, study.controller.length_m)


def _sensor_nodes(study: ControllerStudy, model: FiniteElementModel) -> Integers:
    front = model.nodes[model.surface_nodes, :2]
    reach = float(np.linalg.norm(front, axis=1).max())
    radius = study.sensors.radius_m or 0.9 * reach
    if radius > _EDGE * reach:
        raise UserError(
            f"sensors.radius_m is {radius:g}, but the mirror ends at {reach:.4g} m; its sensors stand on it."
        )
    angles = np.radians(study.sensors.angles_deg)
    places = radius * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    apart = np.linalg.norm(front[None] - places[:, None], axis=2)
    chosen = apart.argmin(axis=1)
    if len(set(chosen.tolist())) < len(chosen):
        raise UserError(
            "Two sensors of [sensors] fall on one node of the mesh; set their angles farther apart, or raise "
            "model.divisions."
        )
    return np.asarray(chosen, dtype=np.int64)


def _modes(study: ControllerStudy, model: FiniteElementModel, sensors: Integers) -> dict[str, Array]:
    """Return the lower modes of the full model, and the flexibility of all others."""
    body = structure(model)
    squared, modes = elastic_modes(body, study.model.modes)
    forces, rows = force_columns(model), sensor_rows(model, sensors)
    inputs, outputs = modes.T @ forces, rows @ modes
    solved = elastic_flexibility(body)(np.hstack([forces, rows.T]))
    moved, back = solved[:, : forces.shape[1]], solved[:, forces.shape[1] :]
    weighted = inputs / squared[:, None]
    far = [
        forces.T @ moved - inputs.T @ weighted,
        rows @ back - (outputs / squared) @ outputs.T,
    ]
    sizes = [float(np.linalg.eigvalsh((one + one.T) / 2)[-1]) for one in far]
    return {
        "squared": squared,
        "inputs": inputs,
        "outputs": outputs,
        "static": rows @ moved - outputs @ weighted,
        "flexibility": np.array(np.sqrt(max(sizes[0], 0.0) * max(sizes[1], 0.0))),
        "shapes": np.asarray(model.surface @ modes),
    }


def force_columns(model: FiniteElementModel) -> Array:
    """Return the unit forces along z at the supports, shape (n, p)."""
    return np.asarray(model.inputs.toarray()[:, 2::3])


def sensor_rows(model: FiniteElementModel, sensors: Integers) -> Array:
    """Return the rows of the displacements along z at optical nodes, shape (m, n)."""
    return np.asarray(model.surface[3 * sensors + 2].toarray())


def wavefront_grams(model: FiniteElementModel | ReducedModel, heights: Array) -> tuple[Array, Array]:
    """Return the matrices whose quadratic forms are the mean square of the wavefront, m^2.

    Parameters
    ----------
    model : FiniteElementModel or ReducedModel
        Whose optical nodes and their weights count.
    heights : ndarray, shape (q, n)
        Motion of the optical nodes along z, m per unit coordinate.

    Returns
    -------
    whole, figure : ndarray, shape (n, n)
        Of the whole wavefront, and with piston, tip and tilt taken out.
    """
    weights = model.surface_weights[:, None]
    x, y = model.nodes[model.surface_nodes, :2].T
    rigid = np.stack([np.ones_like(x), x, y], axis=1)
    moved = rigid @ np.linalg.solve(rigid.T @ (weights * rigid), rigid.T @ (weights * heights))
    bent = heights - moved
    return (
        _REFLECTED**2 * heights.T @ (weights * heights),
        _REFLECTED**2 * bent.T @ (weights * bent),
    )


def reduced_plant(bench: Bench, model: ReducedModel) -> tuple[Plant, Array]:
    """Return a reduced model in the study's units, and its modes at the optical nodes, (3 q, r)."""
    form = modal_form(model)
    shapes = np.asarray(model.surface @ form.modes)
    plant = whole_plant(
        form.squared, np.diag(form.damping).copy(), form.inputs[:, 2::3], shapes[3 * bench.sensors + 2]
    )
    return scaled(bench.study, plant), shapes


def exact_response(bench: Bench) -> Callable[[complex], tuple[Complex, Complex]]:
    """Return the transfer function of the full model in the study's units, by sparse factorizations."""
    model, unit = bench.full(), bench.time_unit
    forces, rows = force_columns(model), sensor_rows(model, bench.sensors)
    section = bench.study.controller
    size = section.force_n / section.length_m

    def response(s: complex) -> tuple[Complex, Complex]:
        found, slope = dynamic_response(model, s / unit, forces, rows)
        return found * size, slope * size / unit

    return response
