"""Identify what shook an instrument from its telemetry, by what a study says its signals see."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from wavequake.campaign.schema import Study
from wavequake.errors import UserError
from wavequake.mechanics.telemetry.columns import ANGLES, SIGHT, Channel
from wavequake.mechanics.telemetry.floor import Floor, floor_of
from wavequake.mechanics.telemetry.line import Line
from wavequake.mechanics.telemetry.lines import find_lines
from wavequake.mechanics.telemetry.record import Record, read_record
from wavequake.mechanics.telemetry.spectra import Averaged, welch
from wavequake.workflows.identify.explain import (
    Explanation,
    FoldedMode,
    MeasuredMode,
    explained,
    folded_modes,
    measured_modes,
)
from wavequake.workflows.identify.seen import Seen, rank_of, seen_by, unseen
from wavequake.workflows.segments.study import SegmentStudy
from wavequake.workflows.systems.study import SystemStudy

Array = NDArray[np.float64]

_PIECES = 30  # of a record, whose spectra are averaged
_TOP = 0.8  # of half the sampling frequency
_FOLDED = 0.3  # of a signal's mean square above that: nearly half would be there if the signal were white


@dataclass(frozen=True)
class Identified:
    """What a record says.

    Attributes
    ----------
    record : Record
    lines : tuple of Line
        By increasing frequency.
    spectra : Averaged
        For pictures, with their confidence.
    floor : Floor
        What is left beside the lines.
    explanations : tuple of Explanation or None
        What moves at each line; None where the signals are those of the line of sight alone, which any motion
        may turn.
    modes : tuple of MeasuredMode
    folded : tuple of FoldedMode
        Modes beyond half the sampling frequency that lines may be.
    seen : Seen or None
    dark : tuple of str
        Motions that the signals do not see.
    alike : tuple of tuple of str
        Groups of motions that look alike to them.
    rank : int
        Combinations of motions that they tell apart.
    """

    record: Record
    lines: tuple[Line, ...]
    spectra: Averaged
    floor: Floor
    explanations: tuple[Explanation | None, ...]
    modes: tuple[MeasuredMode, ...]
    folded: tuple[FoldedMode, ...]
    seen: Seen | None
    dark: tuple[str, ...]
    alike: tuple[tuple[str, ...], ...]
    rank: int

    def pattern(self, number: int) -> dict[str, float]:
        """Return what moves at a line, as `pattern-vibration` takes it, for a series of rms 1."""
        explanation = self.explanations[number]
        if explanation is None:
            return sight_pattern(self.record.channels, self.lines[number].rms)
        return motion_pattern(explanation.motion)


def identified_file(data: str | Path, study: Study) -> Identified:
    """Return what the telemetry in a file says of a study; raises as `read_record` and `identified`."""
    return identified(read_record(data), study)


def identified(record: Record, study: Study) -> Identified:
    """Return what a record says of a study.

    Raises
    ------
    UserError
        If the study is of another kind, or a column names nothing of it.
    """
    only_sight = all(one.element == SIGHT and one.unit in ANGLES for one in record.channels)
    seen = None
    if isinstance(study, SystemStudy):
        seen = seen_by(study, record.channels)
    elif not isinstance(study, SegmentStudy) or study.study.workflow != "segment-disturbance":
        raise UserError(
            "Sources are identified for studies of segment-disturbance and system-disturbance, not of "
            f"{study.study.workflow}."
        )
    elif not only_sight:
        name = next(one.name for one in record.channels if one.element != SIGHT or one.unit not in ANGLES)
        raise UserError(
            f"The column {name!r} needs the sensitivities of a system-disturbance study; of a segmented "
            "telescope angles of the line of sight are taken, such as line_of_sight.x_mas."
        )
    lines, rest = find_lines(record.values, record.step)
    length = max(256, 2 ** int(np.log2(2.0 * len(record.values) / (_PIECES + 1))))
    explanations = tuple(None if seen is None or only_sight else explained(line, seen) for line in lines)
    dark, alike = unseen(seen) if seen else ([], [])
    return Identified(
        record,
        lines,
        welch(record.values, record.step, min(length, len(record.values))),
        floor_of(rest, lines),
        explanations,
        measured_modes(lines, seen, _prior(study)) if seen else (),
        folded_modes(lines, seen, record.nyquist_hz, _prior(study)[0]) if seen else (),
        seen,
        tuple(dark),
        tuple(alike),
        rank_of(seen) if seen else 0,
    )


def _prior(study: Study) -> tuple[float, float]:
    """Return how far the study says that its modes may be off; infinitely where it does not say."""
    assert isinstance(study, SystemStudy)
    uncertain = study.structure.uncertain
    if uncertain is None:
        return np.inf, np.inf
    return uncertain.frequency or np.inf, uncertain.damping or np.inf


def sight_pattern(channels: tuple[Channel, ...], rms: Array) -> dict[str, float]:
    """Return a direction of the line of sight, in mas, of the first field point that has signals."""
    first = min(one.field for one in channels)
    return {
        f"{SIGHT}.{one.axis}_mas": float(value * one.si / ANGLES["mas"])
        for one, value in zip(channels, rms, strict=True)
        if one.field == first
    }


def motion_pattern(motion: dict[tuple[str, str], float]) -> dict[str, float]:
    """Return motions in m and rad as `pattern-vibration` names them."""
    return {
        f"{element}.{axis}_{'um' if axis[0] == 'd' else 'urad'}": 1e6 * value
        for (element, axis), value in motion.items()
    }


def floor_patterns(found: Identified) -> list[tuple[dict[str, float], Array, float]]:
    """Return pattern, density (B,) and explained share of what is left beside the lines, series by series.

    Accelerations are left out: divided by the fourth power of the frequency, their noise would be motion.
    """
    channels = found.record.channels
    result = []
    for direction, density in zip(found.floor.directions, found.floor.densities, strict=True):
        if not density.max() > 0.0:
            continue
        if found.seen is None or all(one.element == SIGHT and one.unit in ANGLES for one in channels):
            result.append((sight_pattern(channels, direction), density, 1.0))
            continue
        kept = ~found.seen.accelerations & (np.abs(found.seen.motions).max(axis=(1, 2)) > 0.0)
        if not kept.any():
            continue
        scale = found.record.values.std(axis=0)[kept]
        columns = found.seen.motions[kept].reshape(int(kept.sum()), -1) / scale[:, None]
        target = direction[kept] / scale
        moved, *_ = np.linalg.lstsq(columns, target, rcond=1e-6)
        rest = target - columns @ moved
        names = [(name, dof) for name in found.seen.elements for dof in ("dx", "dy", "dz", "rx", "ry", "rz")]
        largest = np.abs(moved).max(initial=0.0)
        motion = {n: float(v) for n, v in zip(names, moved, strict=True) if abs(v) > 1e-6 * largest}
        if motion:
            result.append(
                (motion_pattern(motion), density, 1.0 - float(rest @ rest) / float(target @ target))
            )
    return result


def doubts(found: Identified) -> list[str]:
    """Return what may be folded: signals that rise towards half the sampling frequency, modes beyond it."""
    frequency, density = found.spectra.frequency, found.spectra.density
    top = frequency > _TOP * found.record.nyquist_hz
    said = []
    for one, column in zip(found.record.channels, density.T, strict=True):
        share = float(column[top].sum() / column.sum())
        if share > _FOLDED:
            said.append(
                f"warning: {share:.0%} of the mean square of {one.name!r} is above "
                f"{_TOP * found.record.nyquist_hz:.4g} Hz; what is beyond {found.record.nyquist_hz:.4g} Hz "
                "may be folded into it (aliasing), unless a filter took it out."
            )
    limit = found.record.nyquist_hz
    said.extend(
        f"warning: the line at {mode.line.frequency_hz:.4g} Hz may be mode {mode.number} of the structure, "
        f"at {mode.model_hz:.4g} Hz, folded at {limit:.4g} Hz (aliasing), unless a filter took it out."
        for mode in found.folded
    )
    return said
