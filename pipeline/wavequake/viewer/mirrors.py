"""Vibrating mirrors, the reference beside a reduced model: their modes, and what excitations do to them."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import xarray as xr
from threadpoolctl import threadpool_limits

from wavequake.campaign.store.store import Manifest
from wavequake.drawing.solid import MOUNT, model_scene
from wavequake.imaging.exposures.exposure_models import cut, full_exposure
from wavequake.kernels.device.devices import Device, choose_device
from wavequake.mechanics.model import Model, ReducedModel
from wavequake.reduction.metrics import pseudo_frequencies, surface_modes
from wavequake.report.at_hand import device_at_hand
from wavequake.viewer.chosen import some_cases
from wavequake.viewer.film import Array, Stage, Take, principal, same_reach, zernike_map
from wavequake.workflows.exposures.exposure_study import MirrorExposureStudy
from wavequake.workflows.exposures.mirror_exposure import local_images
from wavequake.workflows.mirrors.bench import (
    Bench,
    bench_of,
    cases_of,
    over_time,
    study_of,
    variant_of,
)
from wavequake.workflows.mirrors.model_store import shown_name
from wavequake.workflows.mirrors.optics import optical_rows
from wavequake.workflows.mirrors.study import FULL, AnyMirrorStudy, MirrorStudy

_MODES = 12
_PERIOD = 40  # instants of a mode
_MOST_INSTANTS = 200
_MOST_IMAGES = 60
_GAP = 1.15  # between both mirrors, of a width
_EXACT = 2e-5
_LEFT, _RIGHT = "#9cc4e4", "#b9d7b0"


def film_of(
    dataset: xr.Dataset, manifest: Manifest, chosen: Sequence[int], tell: Callable[[str], None]
) -> tuple[tuple[Stage, ...], tuple[Take, ...]]:
    """Return a stage for every variant, and its modes and excitations."""
    study = study_of(manifest.study)
    every = cases_of(study)
    others = [k for k, (_, variant) in enumerate(every) if variant not in (FULL, _reference(study))]
    cases = list(chosen) or some_cases(dataset, others)
    device = choose_device(device_at_hand(manifest))
    stages, takes = list[Stage](), list[Take]()
    with threadpool_limits(1):
        for case in cases:
            name, variant = every[case]
            bench = bench_of(manifest.study, name)
            whole = variant_of(bench, _reference(study))
            reduced = variant_of(bench, variant)
            name = shown_name(study.model.content, name)
            label = f"case {case}, {name} {variant}"
            excited = _excited(study, bench, (whole, reduced), variant, device)
            takes += [
                replace(take, label=f"{label}: {take.label}", stage=len(stages), case=case)
                for take in (*mode_takes(modes_of(whole), modes_of(reduced)), *excited)
            ]
            stages.append(side_by_side(whole, reduced, name, variant))
            tell(label)
    return tuple(stages), tuple(takes)


def _reference(study: AnyMirrorStudy) -> str:
    return study.reduction.reference if isinstance(study, MirrorStudy) else FULL


def side_by_side(whole: Model, reduced: Model, name: str, variant: str) -> Stage:
    """Return the optical surface of a reference and, beside it, of a reduced model, with their mounts."""
    scene = model_scene(whole)
    skin, count = scene.skins[0], len(scene.skins[0].points)
    shift = np.array([_GAP * np.ptp(skin.points[:, 0]), 0.0, 0.0])
    edge = np.array([0.0, 1.1 * skin.points[:, 1].min(), 0.0])
    names = (f"{name}, reference: order {whole.order}", f"{variant}: order {reduced.order}")
    crosses = [
        (MOUNT, point + by + size * line)
        for by in (0.0 * shift, shift)
        for point in scene.dots
        for size in (0.02 * shift[0],)
        for line in (np.array([[-1.0, 0, 0], [1, 0, 0]]), np.array([[0.0, -1, 0], [0, 1, 0]]))
    ]
    return Stage(
        np.concatenate([skin.points, skin.points + shift]),
        np.concatenate([skin.faces, skin.faces + count]),
        np.repeat([0, 1], count),
        (_LEFT,) * len(skin.faces) + (_RIGHT,) * len(skin.faces),
        names,
        np.stack([0.0 * shift, shift]),
        np.broadcast_to(np.eye(3), (2, 3, 3)),
        tuple(crosses),
        ((names[0], edge), (names[1], shift + edge)),
    )


def modes_of(model: ReducedModel) -> tuple[Array, Array]:
    """Return the frequencies (r,) of a model in Hz, and its modes at the surface nodes, (3 q, r)."""
    return pseudo_frequencies(model), surface_modes(model)


def mode_takes(whole: tuple[Array, Array], reduced: tuple[Array, Array]) -> list[Take]:
    """Return the elastic modes of both, by rising frequency, over one period of the reference's."""
    both = (whole, reduced)
    elastic = [np.flatnonzero(frequencies > 0.0)[:_MODES] for frequencies, _ in both]
    takes = []
    for number, places in enumerate(zip(*elastic, strict=False), start=1):
        shapes, hertz = [], []
        for place, (frequencies, modes) in zip(places, both, strict=True):
            shape = modes[:, place]
            shapes.append(shape / np.abs(shape).max())
            hertz.append(float(frequencies[place]))
        sign = -1.0 if shapes[0] @ shapes[1] < 0.0 else 1.0
        moved = np.concatenate([shapes[0].reshape(-1, 3), sign * shapes[1].reshape(-1, 3)])
        phase = 2.0 * np.pi * np.arange(_PERIOD) / _PERIOD
        takes.append(
            Take(
                f"mode {number}, {hertz[0]:.4g} and {hertz[1]:.4g} Hz",
                np.arange(_PERIOD) / _PERIOD / hertz[0],
                note="Left the reference, right the reduced model, each scaled to a largest motion of 1 m.",
                shapes=moved[None],
                weights=np.cos(phase)[:, None],
                of=f"mode {number}",
            )
        )
    return takes


def response_take(name: str, time: Array, left: Array, right: Array) -> Take:
    """Return what an excitation does to both, from displacements (T, V, 3) in m."""
    shapes, weights = principal(np.concatenate([left, right], axis=1), _EXACT)
    rms = [_rms(left), _rms(right), _rms(right - left)]
    return Take(
        f"excited by {name}",
        time,
        note="Left the reference, right the reduced model; both share one scale.",
        shapes=shapes,
        weights=weights,
        series={
            "displacement along z, rms (reference, reduced)": ("um", 1e6 * np.stack(rms[:2], axis=1)),
            "difference, rms": ("um", 1e6 * rms[2][:, None]),
        },
        of=name,
    )


def _excited(
    study: AnyMirrorStudy,
    bench: Bench,
    both: tuple[ReducedModel, ReducedModel],
    variant: str,
    device: Device,
) -> list[Take]:
    """Return the response of both to every excitation, how far apart they are, and what the light does."""
    found = [over_time(study, one, one.surface, optical_rows(bench.optics, one)) for one in both]  # type: ignore[arg-type]
    time, exposed = study.time.seconds, isinstance(study, MirrorExposureStudy)
    step = -(-len(time) // (_MOST_IMAGES if exposed else _MOST_INSTANTS))
    takes = []
    for number, excitation in enumerate(study.excitation):
        left, right = (moved[number, ::step].reshape(len(time[::step]), -1, 3) for moved, _ in found)
        take = response_take(excitation.name, time[::step], left, right)
        light = [aberrations[number, ::step] for _, aberrations in found]
        maps = [
            zernike_map(f"wavefront, {name}", _figure(one), bench.optics.obscuration)
            for name, one in zip(("reference", variant), light, strict=True)
        ]
        take = replace(take, maps=same_reach(maps))
        takes.append(_imaged(study, bench, take, light[1], device) if exposed else take)  # type: ignore[arg-type]
    return takes


def _figure(aberrations: Array) -> Array:
    """Return the Noll coefficients of aberrations (T, 2 + J) without piston and tilt."""
    return np.concatenate([np.zeros((len(aberrations), 3)), aberrations[:, 5:]], axis=1)


def _imaged(study: MirrorExposureStudy, bench: Bench, take: Take, history: Array, device: Device) -> Take:
    """Return a take with the images of its instants, aberrations scaled as those of the store."""
    imaging, optics = study.imaging, bench.optics
    track = history[:, :2] * (imaging.scale / optics.resolution)
    local = np.concatenate(list(local_images(study, optics, history, device)))
    images = [
        cut(full_exposure([one[None]], place[None], imaging.sampling), imaging.pixels)
        for one, place in zip(local, track, strict=True)
    ]
    note = f"{take.note} Images are those of {imaging.scale:g} times the wavefront."
    return replace(take, images=np.array(images), pixel=imaging.sampling, track=track, note=note)


def _rms(moved: Array) -> Array:
    return np.asarray(np.sqrt(np.mean(moved[..., 2] ** 2, axis=1)))
