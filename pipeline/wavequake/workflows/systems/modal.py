"""Cases of ``system-disturbance`` by the modal model: matrix products instead of rays, and proof of it.

A random sample of the cases is traced in full besides, and the model's error is stored with them; a case
whose motion is too large for the model is traced in full instead. Both depend on nothing but the case.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from wavequake.errors import UserError
from wavequake.kernels.device.devices import choose_device
from wavequake.mechanics.disturbances.motion import Motion, still
from wavequake.optics.derivatives.modal_light import (
    ModalLight,
    Motions,
    curvatures,
    error_bound,
    modal_light,
    wavefronts,
)
from wavequake.optics.derivatives.sensitivity import default_steps
from wavequake.optics.shapes.shapes import ZernikeDeformation
from wavequake.optics.systems.system import States
from wavequake.optics.wavefronts.record import Wavefront
from wavequake.prepared import prepared
from wavequake.workflows.mirrors.study import FULL
from wavequake.workflows.segments.modal import CERTIFIED, MODAL, TRACED, sampled
from wavequake.workflows.systems.bench import (
    MM_PER_M,
    NM_PER_MM,
    SystemBench,
    field_name,
    system_bench,
    system_states,
)
from wavequake.workflows.systems.draws import drawn_with
from wavequake.workflows.systems.study import SystemStudy

Array = NDArray[np.float64]

TRACED_ONLY = ("wfe_pv", "strehl", "rayleigh")
"""Measures that the modal model does not know."""
_ERRORS = {"wfe_rms_raw": "nm", "wfe_rms": "nm", "zernike": "nm", "los_mm": "mm", "centroid_mm": "mm"}
_IMAGES = {"peak": "1"}


@dataclass(frozen=True)
class Columns:
    """Where the motions of elements stand in a row that holds all that could move, SI units.

    Attributes
    ----------
    rigid, figure : mapping of str to slice
        Of bodies and surfaces, six each; of the surfaces that deform, their Noll terms.
    width : int
        Of a row; its last two numbers are the direction of the light.
    moving : ndarray of bool, shape (width,)
        What a study moves.
    """

    rigid: Mapping[str, slice]
    figure: Mapping[str, slice]
    width: int
    moving: NDArray[np.bool_]

    def row(self, drawn: Motion) -> Array:
        """Return the motion of n instants as rows (n, width)."""
        found = np.zeros((len(drawn.mount), self.width))
        for name, motion in drawn.rigid.items():
            found[:, self.rigid[name]] = motion
        for name, terms in drawn.figure.items():
            at = self.figure[name]
            found[:, at.start : at.start + terms.shape[-1]] = terms
        found[:, -2:] = drawn.mount
        return found

    def motion(self, rows: Array) -> Motion:
        """Return what `row` makes rows of."""
        found = still(
            len(rows),
            rigid={name: rows[:, at] for name, at in self.rigid.items() if self.moving[at].any()},
            figure={name: rows[:, at] for name, at in self.figure.items() if self.moving[at].any()},
        )
        return replace(found, mount=rows[:, -2:])


@dataclass(frozen=True)
class SystemModel:
    """The modal models (`ModalLight`) of a study by field and wavelength.

    ``curvature`` has, by field, the second derivatives at the primary wavelength in nm per squared unit;
    ``static`` what there is at rest.
    """

    columns: Columns
    lights: tuple[tuple[ModalLight, ...], ...]
    curvature: tuple[Array, ...]
    static: tuple[tuple[Wavefront, ...], ...]

    def known(self, drawn: Motion) -> bool:
        """Return whether the model knows all that moves."""
        return not drawn.grid and not self.columns.row(drawn)[:, ~self.columns.moving].any()

    def moved(self, drawn: Motion) -> Array:
        """Return the motion of n instants as the model takes it, (n, D)."""
        return np.ascontiguousarray(self.columns.row(drawn)[:, self.columns.moving])

    def bound(self, drawn: Motion) -> float:
        """Return a bound of the rms over the rays of what is left out, nm; inf if more moves than known."""
        if not self.known(drawn):
            return np.inf
        moved = self.moved(drawn)
        return max(error_bound(curvature, moved) for curvature in self.curvature)

    def see(self, field: int, wavelength: int, drawn: Motion) -> Wavefront:
        """Return the wavefronts of a case, in the light that arrives at rest."""
        found, rest = (
            wavefronts(self.lights[field][wavelength], self.moved(drawn)),
            self.static[field][wavelength],
        )
        return replace(found, lost=rest.lost, vignetted=rest.vignetted)


@prepared(maxsize=2)
def model_of(study_text: str, device_name: str) -> SystemModel:
    """Return the modal model of the study with this identity text.

    It knows what moves in the first realization of any disturbance.

    Raises
    ------
    UserError
        If nothing moves, something deforms on a grid, or there are no derivatives.
    """
    bench, device = system_bench(study_text), choose_device(device_name)
    columns = _columns(bench)
    for population in bench.study.disturbance:
        drawn = drawn_with(bench, population, 0, FULL)
        if drawn.grid:
            raise UserError(
                f"The disturbance {population.name!r} deforms {next(iter(drawn.grid))!r} on a grid, but "
                "optics.light = 'modal' knows rigid motions and Zernike terms alone; choose 'traced'."
            )
        columns.moving[:] |= columns.row(drawn).any(axis=0)
    if not columns.moving.any():
        raise UserError(
            "No disturbance moves anything, so that optics.light = 'modal' has no motion to take "
            "derivatives of; give one that is not 0, or choose 'traced'."
        )
    motions = _motions(bench, columns)
    primary = bench.system.primary_wavelength
    lights, bends = [], []
    for field, row in enumerate(bench.prepared):
        try:
            lights.append(tuple(modal_light(one, device, motions) for one in row))
            bends.append(row[primary].wavelength * NM_PER_MM * curvatures(row[primary], device, motions))
        except UserError as error:
            raise UserError(f"At field {field_name(bench.system, field)} {error}.") from error
    return SystemModel(columns, tuple(lights), tuple(bends), bench.static)


def _columns(bench: SystemBench) -> Columns:
    """Return where all that could move stands."""
    names = bench.layout.others or ()
    forms = {surface.name: surface.deformation for surface in bench.system.surfaces}
    terms = {name: form.terms for name, form in forms.items() if isinstance(form, ZernikeDeformation)}
    rigid = {name: slice(6 * place, 6 * place + 6) for place, name in enumerate(names)}
    figure, width = {}, 6 * len(names)
    for name, count in terms.items():
        figure[name] = slice(width, width + count)
        width += count
    return Columns(rigid, figure, width + 2, np.zeros(width + 2, dtype=np.bool_))


def _motions(bench: SystemBench, columns: Columns) -> Motions:
    steps = default_steps(bench.system)
    rigid = np.repeat([steps.translation / MM_PER_M, steps.rotation], 3)
    figures = columns.width - 2 - 6 * len(columns.rigid)
    each = np.concatenate(
        [
            np.tile(rigid, len(columns.rigid)),
            np.full(figures, steps.figure / MM_PER_M),
            np.full(2, steps.rotation),
        ]
    )
    turns = np.zeros(columns.width, dtype=np.bool_)
    turns[: 6 * len(columns.rigid)] = np.tile(np.arange(6) >= 3, len(columns.rigid))
    turns[-2:] = True

    def move(moved: Array) -> States:
        rows = np.zeros((len(moved), columns.width))
        rows[:, columns.moving] = moved
        return system_states(bench, columns.motion(rows))

    return Motions(move, each[columns.moving], turns[columns.moving])


def routes(study: SystemStudy, cases: list[int] | None, bounds: Array) -> NDArray[np.int8]:
    """Return how cases are computed: MODAL, TRACED or, of those with ids, CERTIFIED."""
    beyond, certified = ~(bounds <= study.optics.modal_tolerance_nm), np.zeros(len(bounds), np.bool_)
    if cases is not None:
        certified = sampled(study.study.seed, np.array(cases, np.int64), study.optics.modal_sample)
    return np.where(beyond, TRACED, np.where(certified, CERTIFIED, MODAL)).astype(np.int8)


def certificate(
    study: SystemStudy, bound: float, route: int, modal: Mapping[str, Array], full: Mapping[str, Array]
) -> dict[str, Array]:
    """Return what is stored of the model's error in a case; ``full`` is empty where it was not traced."""
    found = {"traced": np.asarray(route, dtype=np.int8), "modal_bound": np.asarray(bound)}
    for name in modal_errors_of(study):
        error = np.asarray(np.nan)
        if route == CERTIFIED and full:
            apart = np.abs(modal[name] - full[name])
            error = np.nanmax(np.linalg.norm(apart, axis=-1) if name in ("los_mm", "centroid_mm") else apart)
        found[f"modal_error_{name}"] = np.asarray(error)
    return found


def modal_errors_of(study: SystemStudy) -> dict[str, str]:
    """Return the measures whose errors are kept, with their units."""
    return _ERRORS | (_IMAGES if study.imaging is not None else {})
