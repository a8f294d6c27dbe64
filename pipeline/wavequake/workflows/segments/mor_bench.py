"""What a ``segment-mor`` study prepares once per process: telescope, segment model, maps to the optics."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from wavequake.errors import UserError
from wavequake.mechanics.disturbances.motion import generator
from wavequake.mechanics.model import ReducedModel
from wavequake.mechanics.vibration.drive import Drive
from wavequake.mechanics.vibration.excitations import AnyExcitation, RandomVibration, drive_of
from wavequake.mechanics.vibration.modal import modal_model
from wavequake.mechanics.vibration.response import displacements, respond
from wavequake.prepared import prepared
from wavequake.reduction.metrics import receptance
from wavequake.workflows.kinds import study_of
from wavequake.workflows.mirrors.compared_models import checked_model
from wavequake.workflows.mirrors.segment_body import (
    SegmentBody,
    height_rows,
    motion_rows,
    segment_body,
    stage_record,
    variant_of,
)
from wavequake.workflows.segments.bench import Bench, bench_of
from wavequake.workflows.segments.mor_study import SegmentMorStudy, telescope_study
from wavequake.workflows.segments.vignetting import require_all_rays

Array = NDArray[np.float64]

MM_PER_M = 1e3
# Segments whose responses are held at once.
_BLOCK = 32


@dataclass(frozen=True)
class SegmentModel(SegmentBody):
    """The segment of a study, its optical fit, and the answers of its reference.

    Attributes
    ----------
    bench : Bench
        The telescope.
    reference : ReducedModel
    mechanical, optical : ndarray
        Transfer matrices of the reference, (f, 9, 9) in m/N and (f, J, 9) in nm/N.
    """

    bench: Bench
    reference: ReducedModel
    mechanical: NDArray[np.complex128]
    optical: NDArray[np.complex128]


@prepared(maxsize=2)
def model_of(text: str) -> SegmentModel:
    """Prepare a study; one BLAS thread, so that its bits are the same in every process.

    Raises
    ------
    UserError
        If the telescope has no hexagonal segments, a dimension is not possible, or the surface has too few
        nodes for the Zernike terms.
    """
    study = study_of(text)
    bench = bench_of(telescope_study(study).identity_text())
    require_all_rays(bench.stopped, "so that there are no wavefronts of all segments to compare")
    body = segment_body(study.model, bench.system, study.reduction.last_hz, study.segments.figure_terms)
    chosen, frequencies = variant_of(body, study.reduction.reference), study.reduction.hertz
    return SegmentModel(
        stage=body.stage,
        full=body.full,
        fit=body.fit,
        turn=body.turn,
        bench=bench,
        reference=chosen,
        mechanical=receptance(chosen, frequencies),
        optical=receptance(chosen, frequencies, height_rows(body.fit, body.turn, chosen)),
    )


def traced_instants(study: SegmentMorStudy) -> NDArray[np.int64]:
    """Return which instants of the time response are traced: evenly spread, the last one among them.

    The first instant, at which all is at rest, is left out.
    """
    count = study.fewest_instants
    places = np.rint(np.arange(1, count + 1) * ((study.time.instants - 1) / count))
    return np.asarray(places, dtype=np.int64)


def chosen_segments(study: SegmentMorStudy, bench: Bench, disturbed: str) -> NDArray[np.int64]:
    """Return which segments are shaken.

    Raises
    ------
    UserError
        If the telescope has no segment of the name that the study gives.
    """
    names = bench.system.segments.names
    if disturbed == "all":
        return np.arange(len(names))
    wanted = study.segments.name or names[0]
    if wanted not in names:
        raise UserError(
            f"segments.name is {wanted!r}, but the segments of {bench.system.name} are called {names[0]} to "
            f"{names[-1]}."
        )
    return np.array([names.index(wanted)])


def motions(
    study: SegmentMorStudy, model: SegmentModel, variant: ReducedModel, which: Sequence[int]
) -> Array:
    """Return motion and figure of segments at the traced instants: (excitation, time, segment, 6 + J), mm.

    A random vibration is a realization of its own at every segment, the same for all variants; others are
    alike but for the sign.
    """
    rows = motion_rows(model.fit, model.turn, variant)
    time, instants = study.time.seconds, traced_instants(study)
    found = np.empty((len(study.excitation), len(instants), len(which), len(rows)))
    for number, excitation in enumerate(study.excitation):
        if isinstance(excitation, RandomVibration):
            for place, drives in _blocks(study, excitation, which, time):
                response = respond(modal_model(variant, drives[0].prescribed), drives, time)
                moved = displacements(response, rows)[:, instants]
                found[number, :, place] = moved.transpose(1, 0, 2)
        else:
            drive = segment_drive(study, excitation, time, 0)
            response = respond(modal_model(variant, drive.prescribed), [drive], time)
            moved = displacements(response, rows)[0, instants]
            signs = segment_signs(study, excitation, model.bench)[list(which)]
            found[number] = moved[:, None, :] * signs[:, None]
    return found


def _blocks(
    study: SegmentMorStudy, excitation: AnyExcitation, which: Sequence[int], time: Array
) -> Iterator[tuple[slice, list[Drive]]]:
    for first in range(0, len(which), _BLOCK):
        part = which[first : first + _BLOCK]
        yield (
            slice(first, first + len(part)),
            [segment_drive(study, excitation, time, int(segment)) for segment in part],
        )


def segment_drive(study: SegmentMorStudy, excitation: AnyExcitation, time: Array, segment: int) -> Drive:
    """Return what an excitation does at the three supports of one segment."""
    drive = _drawn(excitation, len(time), study.time.step_s, study.study.seed, segment)
    return drive if study.model.support == "rigid" else through_springs(drive, study.model.spring_n_m)


@prepared(maxsize=2048)
def _drawn(excitation: AnyExcitation, instants: int, step: float, seed: int, segment: int) -> Drive:
    """Draw an excitation once for all variants."""
    return drive_of(excitation, 3, np.arange(instants, dtype=np.float64) * step, seed, segment)


def through_springs(drive: Drive, stiffness: tuple[float, float, float]) -> Drive:
    """Return the forces by which the moving far ends of the springs shake a body; forces stay as they are.

    The dampers beside the springs (of a damping proportional to stiffness) are taken to end on still ground:
    their share is damping_beta times the angular frequency.
    """
    held = drive.prescribed
    factor = np.where(held, np.tile(stiffness, len(held) // 3), 1.0)
    return replace(
        drive,
        prescribed=np.zeros_like(held),
        harmonics=tuple(
            replace(wave, cosine=factor * wave.cosine, sine=factor * wave.sine) for wave in drive.harmonics
        ),
        samples=None if drive.samples is None else factor * drive.samples,
    )


def segment_signs(study: SegmentMorStudy, excitation: AnyExcitation, bench: Bench) -> Array:
    """Return the sign (S,) of an excitation at every segment, which does not depend on other excitations."""
    count = len(bench.system.segments)
    if study.segments.signs == "alike":
        return np.ones(count)
    random = generator(study.study.seed, f"{excitation.name} sign", 0)
    signs: Array = random.choice([-1.0, 1.0], count)
    return signs


def spot_check(text: str) -> tuple[Array, Array]:
    """Compare the intermediate model with the full one; see `checked_model`."""
    study, model = study_of(text), model_of(text)
    section = study.reduction
    record = stage_record(study.model, model.bench.system, section.last_hz)
    return checked_model(section, section.first_hz, lambda: model, record)
