"""Cases of ``segment-disturbance`` that are drawn near a limit, with weights that undo it (``[rare]``).

A disturbance whose motions are sums of Gaussian numbers makes the mean square of a wavefront error, or of a
line of sight, a quadratic form of these numbers: by the modal model its distribution is known exactly, and so
is the one that makes a rare case a common one. What a case draws depends on its number and the study alone.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from wavequake.campaign.rare.quadratic import QuadraticForm, Tilt, exceedance, limit_of, tilt_to
from wavequake.campaign.statistics.judged import Judged, judged_of_template
from wavequake.chain.gaussian_forms import form_of_numbers
from wavequake.errors import UserError
from wavequake.mechanics.disturbances.gaussian import GaussianMotions, gaussian_motions
from wavequake.mechanics.disturbances.motion import generator
from wavequake.mechanics.disturbances.registry import Disturbance, draw_case, instants_of
from wavequake.mechanics.disturbances.streams import Streams
from wavequake.optics.segments.modal import ModalModel, layout_of
from wavequake.optics.segments.modal_forms import MotionForm, length_form, raw_form
from wavequake.prepared import prepared
from wavequake.workflows.segments.bench import MAS_PER_RAD, Bench, bench_of, in_basis
from wavequake.workflows.segments.model import knows, model_of, motion_rows
from wavequake.workflows.segments.template import template

Array = NDArray[np.float64]

MEASURES = ("wfe_rms", "wfe_rms_raw", "zernike", "los", "centroid")
_STREAM = "~rare"  # no disturbance can have this in its name
_RARE = 0.5


@dataclass(frozen=True)
class RareCases:
    """How cases near a limit are drawn.

    ``limit`` is in the measure's unit and exceeded with ``probability`` by the modal model, of which
    ``tilt.form`` is the square.
    """

    motions: GaussianMotions
    tilt: Tilt
    limit: float
    probability: float
    seed: int
    stream: str

    def numbers(self, realization: int) -> Array:
        """Return the Gaussian numbers (d,) of a realization."""
        return self.tilt.drawn(self._unit(realization))

    def _unit(self, realization: int) -> Array:
        return generator(self.seed, self.stream, realization).standard_normal(len(self.motions.moving))

    def of(self, realization: int) -> Streams:
        """Return what the streams of a realization draw from."""
        return self.motions.of(self.numbers(realization))

    def labels(self, realizations: NDArray[np.int64]) -> dict[str, Array]:
        """Return the weights and modal values of realizations, by the names of their variables."""
        along = (self.tilt.along(self._unit(int(one))) for one in realizations)
        squares = np.array([float(self.tilt.form.along(one)) for one in along])  # one by one: equal bits
        return {
            "log_weight": self.tilt.norm - self.tilt.rate * squares,
            "modal_value": np.sqrt(np.maximum(squares, 0.0)),
        }


@prepared(maxsize=2)
def rare_cases(study_text: str) -> RareCases:
    """Return how the cases of a study with the section [rare] are drawn.

    Raises
    ------
    UserError
        If the disturbance is no sum of Gaussian numbers, the measure no length of what is linear in them, or
        the limit is exceeded by most cases or by none.
    """
    bench = bench_of(study_text)
    section = bench.study.rare
    assert section is not None
    population = next(entry for entry in bench.study.disturbance if entry.share)
    judged = judged_of_template(section.measure, template(study_text))
    if judged.variable not in MEASURES:
        raise UserError(
            f"rare.measure: {judged.variable!r} is not among what is known of rare cases by the modal model: "
            f"{', '.join(MEASURES)}."
        )
    model = model_of(study_text, "numpy")  # the same on every worker
    motions = segment_motions(bench, model, population)
    form = form_of_numbers(form_of_motions(bench, model, judged), motions)
    if section.limit is None:
        assert section.probability is not None
        limit = float(np.sqrt(limit_of(form, section.probability)))
    else:
        limit = section.limit
    chance = exceedance(form, limit * limit)  # which is infinite from 1e155 on, not an error
    if not 0.0 < chance < _RARE:
        unit = str(template(study_text).per_case[judged.variable].attrs["units"])
        raise UserError(_common(form, limit, chance, unit))
    tilt = tilt_to(form, limit * limit)
    return RareCases(motions, tilt, limit, chance, bench.study.study.seed, population.name + _STREAM)


def _common(form: QuadraticForm, limit: float, chance: float, unit: str) -> str:
    """Say how often a limit is exceeded that is no rare event, and which would be."""
    typical, far = (float(np.sqrt(limit_of(form, share))) for share in (0.5, 1e-6))
    words = "less than 1e-280" if chance == 0.0 else f"{100.0 * chance:.3g} %"
    return (
        f"rare.limit: {limit:g} {unit} is exceeded by {words} of the cases, which is no rare event; half of "
        f"them exceed {typical:.4g} {unit}, and one of a million {far:.4g} {unit}."
    )


def segment_motions(bench: Bench, model: ModalModel, population: Disturbance) -> GaussianMotions:
    """Return the motions of a disturbance, rows (n, D S + 4) in mm and rad, as sums of Gaussian numbers.

    Raises
    ------
    UserError
        If they are no such sums, too many, or the modal model does not know them.
    """
    study = bench.study

    def rows(streams: Streams, time: Array) -> Array:
        moved = draw_case(study.disturbance, population, bench.layout, 0, 0, streams, time)
        if not knows(model, moved):
            raise UserError(
                f"The disturbance {population.name!r} moves what the modal model does not know; rare events "
                "are of motions of segments, M2 and mount."
            )
        return motion_rows(bench, model, moved, len(time))

    return gaussian_motions(population.name, rows, instants_of(study.disturbance, population))


def form_of_motions(bench: Bench, model: ModalModel, judged: Judged) -> MotionForm:
    """Return the square of a measure, in its unit, as a form of the motions."""
    places, to_nm = layout_of(model.terms), bench.study.optics.wavelength_nm
    if judged.variable == "wfe_rms_raw":
        raw = raw_form(model)
        return MotionForm(raw.constant * to_nm**2, raw.linear * to_nm**2, raw.square * to_nm**2)
    if judged.variable in ("los", "centroid"):
        place = places.los if judged.variable == "los" else places.centroid
        columns = model.columns[:, place] * (MAS_PER_RAD / bench.first_order.focal_length)
        if "axis" in judged.chosen:
            columns = columns[:, judged.chosen["axis"]][:, None]
        return length_form(np.zeros(columns.shape[1]), columns)
    rest, columns = model.rest[places.zernike] * to_nm, model.columns[:, places.zernike] * to_nm
    if judged.variable == "wfe_rms":
        return length_form(rest[3:], columns[:, 3:])
    term = judged.chosen["noll"]
    return length_form(in_basis(bench, rest)[[term]], in_basis(bench, columns)[:, [term]])
