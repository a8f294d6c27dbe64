"""Reduced models of a segment: their modes beside the reference's, and the telescope that they shake."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from wavequake.campaign.store.store import Manifest
from wavequake.kernels.device.devices import Device, choose_device
from wavequake.kernels.device.tiles import from_tiles
from wavequake.report.at_hand import device_at_hand
from wavequake.viewer.chosen import some_cases
from wavequake.viewer.film import Array, Stage, Take, map_of, over_pupil
from wavequake.viewer.mirrors import mode_takes, modes_of, side_by_side
from wavequake.viewer.segments import figures_on, stage_of_telescope
from wavequake.workflows.kinds import study_of
from wavequake.workflows.mirrors.segment_body import variant_of
from wavequake.workflows.segments.images import instant_images
from wavequake.workflows.segments.mor import (
    SHAKEN,
    at_rest,
    cases_of,
    flattened,
    launches,
    resolution,
)
from wavequake.workflows.segments.mor_bench import (
    MM_PER_M,
    SegmentModel,
    chosen_segments,
    model_of,
    motions,
    traced_instants,
)

_MOST_INSTANTS = 64
_MOST_CASES = 3


def film_of(
    dataset: xr.Dataset, manifest: Manifest, chosen: Sequence[int], tell: Callable[[str], None]
) -> tuple[tuple[Stage, ...], tuple[Take, ...]]:
    """Return the telescope, and for each case both segments: modes, and what excitations do to the light."""
    study, model = study_of(manifest.study), model_of(manifest.study)
    every, reference = cases_of(study), study.reduction.reference
    others = [k for k, (_, variant) in enumerate(every) if variant != reference]
    cases = list(chosen) or some_cases(dataset, others, _MOST_CASES)
    device = choose_device(device_at_hand(manifest))
    stages, takes = [stage_of_telescope(model.bench)], list[Take]()
    with threadpool_limits(1):
        for case in cases:
            disturbed, variant = every[case]
            label = f"case {case}, {SHAKEN[disturbed]}, {variant}"
            small = model.reference if variant == reference else variant_of(model, variant)
            which = chosen_segments(study, model.bench, disturbed)
            moved = motions(study, model, small, which.tolist())
            time = study.time.seconds[traced_instants(study)]
            for excitation, history in zip(study.excitation, moved, strict=True):
                take = shaken(model, which, time, history, device)
                takes.append(
                    replace(take, label=f"{label}: {excitation.name}", case=case, of=excitation.name)
                )
            takes += [
                replace(take, label=f"{label}: {take.label}", case=case, stage=len(stages))
                for take in mode_takes(modes_of(model.reference), modes_of(small))
            ]
            stages.append(side_by_side(model.reference, small, "segment", variant))
            tell(label)
    return tuple(stages), tuple(takes)


def shaken(
    model: SegmentModel, which: NDArray[np.int64], time: Array, history: Array, device: Device
) -> Take:
    """Return the telescope whose segments `which` move and deform by (T, segment, 6 + J), mm and rad."""
    bench, step = model.bench, -(-len(history) // _MOST_INSTANTS)
    time, history = time[::step], history[::step]
    still, prepared = at_rest(bench.text, device.name), bench.prepared
    waves, images, los = [], [], []
    for first, last, rays, wavefront in launches(bench, which, history, device):
        here = slice(0, last - first)
        waves.append(from_tiles(flattened(prepared, rays.opd - still))[here])
        images.append(instant_images(bench, rays, wavefront, here))
        los.append((wavefront.los[here] - bench.static.los[0]) / resolution(bench))
    opd, track = np.concatenate(waves), np.concatenate(los)
    stage = stage_of_telescope(bench)
    poses = np.zeros((len(history), len(stage.names), 6))
    poses[:, which] = history[..., :6]
    poses[..., :3] /= MM_PER_M
    return Take(
        "",
        time,
        note=f"One instant in {step} is shown." if step > 1 else "",
        poses=poses,
        figures=figures_on(stage, history[..., 6:] / MM_PER_M, which) if stage.terms is not None else None,
        images=np.concatenate(images),
        pixel=bench.study.imaging.sampling,
        track=track,
        maps=(map_of("wavefront from rest", "nm", over_pupil(prepared.rays.x, prepared.rays.y), opd),),
        series={
            "wavefront error from rest, rms": ("nm", np.sqrt(opd**2 @ prepared.weight)[:, None]),
            "line of sight, x and y": ("lambda/D", track),
        },
    )
