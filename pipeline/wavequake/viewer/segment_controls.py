"""What moves under the loop of a mirror's edge sensors: modes of the mirror and of the structure."""

from collections.abc import Callable, Sequence

import numpy as np
import xarray as xr

from wavequake.campaign.schema import study_from_identity
from wavequake.campaign.store.store import Manifest
from wavequake.mechanics.segment_control import SeenModes
from wavequake.optics.segments.catalog import telescope
from wavequake.viewer.chosen import some_cases
from wavequake.viewer.film import Array, Stage, Take
from wavequake.viewer.segments import stage_of_segments
from wavequake.workflows.loops.segment_control_bench import mirror_of, sensing_of, structure_of
from wavequake.workflows.loops.segment_control_study import SegmentControlStudy

_PERIOD = 48  # instants
_SEEN_LEAST = 8


def film_of(
    dataset: xr.Dataset, manifest: Manifest, chosen: Sequence[int], tell: Callable[[str], None]
) -> tuple[tuple[Stage, ...], tuple[Take, ...]]:
    """Return the telescope with the modes of its structure and those that its sensors see least.

    They are the same in all cases, which differ in errors of what is read and moved.
    """
    study = study_from_identity(SegmentControlStudy, manifest.study)
    layout, modes, _ = mirror_of(study.mirror.telescope, sensing_of(study))
    structure = structure_of(study, layout, modes)
    stage = stage_of_segments(telescope(study.mirror.telescope))
    case = some_cases(dataset, list(chosen) or list(range(manifest.cases)))[0]
    takes = []
    for number, one in enumerate(study.mode):
        shape, size = modes.shapes @ structure.shapes[:, number], one.rms_nm or 1.0
        peaks = dataset["peak_by_mode"].isel(structure_mode=number).to_numpy()
        said = [
            f"{peak:.3g} at {hz:g} Hz"
            for hz, peak in zip(dataset["bandwidth"].to_numpy(), peaks, strict=True)
            if np.isfinite(peak)
        ]
        note = (
            f"{size:.3g} nm rms of the surface. The loop's largest sensitivity along it: {', '.join(said)}."
        )
        takes.append(
            _swing(stage, modes, shape, size, one.hz, f"structure, {one.name}: {one.hz:g} Hz", note, case)
        )
    for number in range(min(_SEEN_LEAST, modes.shapes.shape[1])):
        size = float(modes.multipliers[number]) * study.mirror.sensor_nm
        note = (
            f"{size:.3g} nm rms of the surface, by white noise of {study.mirror.sensor_nm:g} nm in sensors; "
            "slowed down for the eye."
        )
        label = f"mirror, mode {number + 1}: the least seen first of {modes.shapes.shape[1]}"
        takes.append(_swing(stage, modes, modes.shapes[:, number], size, 1.0, label, note, case))
    tell(f"{len(takes)} modes, the same in every case")
    return (stage,), tuple(takes)


def _swing(
    stage: Stage, modes: SeenModes, shape: Array, size: float, hertz: float, label: str, note: str, case: int
) -> Take:
    """Return one period of a motion (3 S,), piston and slopes times radius, of `size` nm rms."""
    piston, x_slope, y_slope = shape.reshape(-1, 3).T * size * np.sqrt(len(modes.radius)) * 1e-9
    phase = 2.0 * np.pi * np.arange(_PERIOD) / _PERIOD
    pose = np.zeros((len(stage.names), 6))
    # z = slope_x x + slope_y y is the rotation (slope_y, -slope_x).
    pose[: len(piston), 2:5] = np.stack([piston, y_slope / modes.radius, -x_slope / modes.radius], axis=1)
    return Take(
        label,
        np.arange(_PERIOD) / _PERIOD / hertz,
        note=note,
        poses=np.cos(phase)[:, None, None] * pose,
        case=case,
        of=label.partition(":")[0],
    )
