"""A moving picture of one case of telescope-exposure: wavefront, image and line of sight over time."""

from pathlib import Path

import numpy as np
from matplotlib import rc_context
from matplotlib.animation import PillowWriter
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from numpy.typing import NDArray

from wavequake.errors import UserError
from wavequake.imaging.exposure_models import cut, full_exposure
from wavequake.kernels.devices import choose_device
from wavequake.report.figures import STYLE
from wavequake.workflows.store import read_manifest
from wavequake.workflows.telescope_control import (
    CONTROLLERS,
    ControlBench,
    control_bench_of,
    local_images,
    measured_opd,
    position,
)
from wavequake.workflows.telescope_exposure import WORKFLOW, case_blocks, scaled_draw

Array = NDArray[np.float64]

_MOST_FRAMES = 60
_FRAMES_PER_SECOND = 12


def animate_case(store: Path, case: int, controller: str = "disturbed", device: str = "auto") -> Path:
    """Write an animated GIF of one case into its store's folder and return where it is.

    The case is computed anew from its seed, at most 60 instants of it.

    Raises
    ------
    UserError
        If the store is not one of telescope-exposure, or case or controller do not exist.
    """
    manifest = read_manifest(store)
    if manifest.workflow != WORKFLOW.name:
        raise UserError(
            f"only stores of {WORKFLOW.name} can be animated; {store} is one of {manifest.workflow}"
        )
    if controller not in CONTROLLERS:
        raise UserError(f"there is no controller {controller!r}; choose one of {', '.join(CONTROLLERS)}")
    if case < 0:
        raise UserError(f"cases count from 0; there is none with the number {case}")
    control = control_bench_of(manifest.study)
    time, waves, images, los = _instants(control, case, controller, device)
    path = Path(store) / f"case-{case}-{controller}.gif"
    _write(path, control, time, waves, images, los)
    return path


def _instants(
    control: ControlBench, case: int, controller: str, device: str
) -> tuple[Array, Array, Array, Array]:
    """Return time in ms, OPDs (instants, N) in nm about the line of sight, images in place, their track."""
    drawn = scaled_draw(control, case)
    imaging, to_nm = control.study.imaging, control.study.optics.wavelength_nm
    step = -(-len(drawn.time) // _MOST_FRAMES)
    rays = control.prepared.rays
    waves, images, los, first = [], [], [], 0
    for count, traced, wavefront in case_blocks(control, drawn, choose_device(device), controller):
        chosen = np.arange(count)[(first + np.arange(count)) % step == 0]
        first += count
        opd = measured_opd(control, traced)
        slopes = (wavefront.los - wavefront.chief) / (
            control.prepared.wavelength * control.prepared.focal_length
        )
        flat = opd + slopes[:, :1] * rays.x + slopes[:, 1:] * rays.y
        waves.append((flat - flat.mean(axis=1, keepdims=True))[chosen] * to_nm)
        places = position(control, wavefront)[chosen]
        local = local_images(control, opd, wavefront)[chosen]
        images += [
            cut(full_exposure([one[None]], place[None], imaging.sampling), imaging.pixels)
            for one, place in zip(local, places, strict=True)
        ]
        los.append(places)
    return drawn.time[::step] * 1e3, np.concatenate(waves), np.array(images), np.concatenate(los)


@rc_context(STYLE)
def _write(path: Path, control: ControlBench, time: Array, waves: Array, images: Array, los: Array) -> None:
    figure = Figure(figsize=(7.2, 3.4), layout="constrained")
    FigureCanvasAgg(figure)
    left, right = figure.subplots(1, 2)
    rays, imaging = control.prepared.rays, control.study.imaging
    reach = max(float(np.abs(waves).max()), 1e-9)
    dots = left.scatter(rays.x / 1e3, rays.y / 1e3, c=waves[0], s=6.0, cmap="RdBu_r", vmin=-reach, vmax=reach)
    left.set_aspect("equal")
    left.set_xlabel("pupil x (m)")
    figure.colorbar(dots, ax=left, label="wavefront (nm)", shrink=0.8)
    half = 0.5 * imaging.pixels * imaging.sampling
    top = float(images.max())
    picture = right.imshow(
        np.maximum(images[0], 1e-4 * top),
        norm=LogNorm(1e-4 * top, top),
        origin="lower",
        extent=(-half - 0.5 * imaging.sampling, half - 0.5 * imaging.sampling) * 2,
    )
    (track,) = right.plot([], [], color="#ff4d4d", linewidth=0.8)
    right.set_xlabel("image x (λ/D)")
    right.set_autoscale_on(False)
    writer = PillowWriter(fps=_FRAMES_PER_SECOND)
    with writer.saving(figure, str(path), dpi=80):
        for number, instant in enumerate(time):
            dots.set_array(waves[number])
            picture.set_data(np.maximum(images[number], 1e-4 * top))
            track.set_data(los[: number + 1, 0], los[: number + 1, 1])
            left.set_title(f"t = {instant:.1f} ms")
            writer.grab_frame()
