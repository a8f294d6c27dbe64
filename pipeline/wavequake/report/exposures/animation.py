"""A moving picture of one case of an exposure: wavefront, image and line of sight over time."""

import subprocess
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib import rc_context
from matplotlib.animation import FFMpegWriter
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image
from threadpoolctl import threadpool_limits

from wavequake.campaign.store.store import read_manifest
from wavequake.errors import UserError
from wavequake.imaging.exposures.exposure_models import cut, full_exposure
from wavequake.kernels.device.devices import choose_device
from wavequake.optics.polynomials.zernike import annular_zernike
from wavequake.report.figures import STYLE
from wavequake.workflows.exposures import mirror_exposure, telescope_exposure
from wavequake.workflows.exposures.mirror_exposure import aberrations_of, study_of
from wavequake.workflows.exposures.mirror_exposure import local_images as local_mirror_images
from wavequake.workflows.exposures.telescope_control import (
    CONTROLLERS,
    ControlBench,
    control_bench_of,
    local_images,
    measured_opd,
    position,
)
from wavequake.workflows.exposures.telescope_exposure import case_blocks, scaled_draw
from wavequake.workflows.mirrors.mirror_bench import bench_of, time_of
from wavequake.workflows.mirrors.mirror_mor import cases_of

Array = NDArray[np.float64]

_MOST_FRAMES = 60
_FRAMES_PER_SECOND = 12
_DOTS_PER_INCH = 80
FORMATS = ("gif", "mp4")


@dataclass(frozen=True)
class Film:
    """What a moving picture shows.

    Attributes
    ----------
    time_ms : ndarray, shape (instants,)
    x, y : ndarray, shape (N,)
        Places in the pupil; ``unit`` labels them.
    unit : str
    waves : ndarray, shape (instants, N)
        OPDs in nm about the line of sight.
    images : ndarray, shape (instants, n, n)
        In place, ``sampling`` wavelengths / diameter apart.
    los : ndarray, shape (instants, 2)
        Track of the line of sight, wavelengths / diameter.
    sampling : float
    """

    time_ms: Array
    x: Array
    y: Array
    unit: str
    waves: Array
    images: Array
    los: Array
    sampling: float


def animate_case(
    store: Path, case: int, of: str | None = None, device: str = "auto", kind: str = "gif"
) -> Path:
    """Write a moving picture of one case into its store's folder and return where it is.

    The case is computed anew from its seed, at most 60 instants of it.

    Parameters
    ----------
    store : Path
        Of telescope-exposure or mirror-exposure.
    case : int
    of : str, optional
        The controller ("disturbed" by default), or the excitation of a mirror (the first by default).
    device : str
        Where to compute.
    kind : {"gif", "mp4"}
        Format; the program ffmpeg writes MP4.

    Raises
    ------
    UserError
        If the store is not one of an exposure, case, controller or excitation do not exist, or ffmpeg is
        missing or fails.
    """
    if _named(kind, FORMATS, "format") == "mp4" and not FFMpegWriter.isAvailable():
        raise UserError(
            "an MP4 needs the program ffmpeg, which is not on the PATH: install the package ffmpeg "
            "(apt install ffmpeg, brew install ffmpeg), or take the format gif"
        )
    manifest = read_manifest(store)
    if case not in range(manifest.cases):
        raise UserError(f"{store} has cases 0 to {manifest.cases - 1}; there is no case {case}")
    if manifest.workflow == telescope_exposure.KIND.name:
        name = _named(of or "disturbed", CONTROLLERS, "controller")
        film = _telescope(control_bench_of(manifest.study), case, name, device)
    elif manifest.workflow == mirror_exposure.KIND.name:
        names = [excitation.name for excitation in study_of(manifest.study).excitation]
        name = _named(of or names[0], names, "excitation")
        film = _mirror(manifest.study, case, names.index(name), device)
    else:
        raise UserError(
            f"only stores of telescope-exposure and mirror-exposure can be animated; {store} is one of "
            f"{manifest.workflow}"
        )
    path = Path(store) / f"case-{case}-{name}.{kind}"
    unfinished = path.with_name(f".{path.name}.part")
    try:
        (_write_gif if kind == "gif" else _write_mp4)(unfinished, film)
        unfinished.replace(path)
    finally:
        unfinished.unlink(missing_ok=True)
    return path


def _named(name: str, names: Sequence[str], kind: str) -> str:
    if name not in names:
        raise UserError(f"there is no {kind} {name!r}; choose one of {', '.join(names)}")
    return name


def _telescope(control: ControlBench, case: int, controller: str, device: str) -> Film:
    """Compute the instants of a case of telescope-exposure under a controller."""
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
    return Film(
        time_ms=drawn.time[::step] * 1e3,
        x=rays.x / 1e3,
        y=rays.y / 1e3,
        unit="pupil x (m)",
        waves=np.concatenate(waves),
        images=np.array(images),
        los=np.concatenate(los),
        sampling=imaging.sampling,
    )


def _mirror(study_text: str, case: int, excitation: int, device: str) -> Film:
    """Compute the instants of a variant of mirror-exposure under an excitation, scaled as its images are."""
    study = study_of(study_text)
    model, variant = cases_of(study)[case]
    optics, imaging = bench_of(study_text, model).optics, study.imaging
    history = aberrations_of(study_text, model, variant)[excitation]
    chosen = np.arange(0, len(history), -(-len(history) // _MOST_FRAMES))
    shown = history[chosen]
    radius, angle = np.meshgrid(np.linspace(optics.obscuration, 1.0, 16), np.arange(64) * np.pi / 32)
    x, y = (radius * np.cos(angle)).ravel(), (radius * np.sin(angle)).ravel()
    modes = annular_zernike(x, y, shown.shape[1] - 2, optics.obscuration)[:, 3:]
    los = shown[:, :2] * (imaging.scale / optics.resolution)
    with threadpool_limits(1):
        local = np.concatenate(list(local_mirror_images(study, optics, shown, choose_device(device))))
    images = [
        cut(full_exposure([one[None]], place[None], imaging.sampling), imaging.pixels)
        for one, place in zip(local, los, strict=True)
    ]
    return Film(
        time_ms=time_of(study)[chosen] * 1e3,
        x=x,
        y=y,
        unit="pupil x (radii)",
        waves=imaging.scale * shown[:, 5:] @ modes.T,
        images=np.array(images),
        los=los,
        sampling=imaging.sampling,
    )


@rc_context(STYLE)
def _write_gif(path: Path, film: Film) -> None:
    figure = _figure()
    frames = []
    for _ in _drawn(figure, film):
        drawn = np.asarray(figure.canvas.buffer_rgba())  # type: ignore[attr-defined]
        frames.append(Image.fromarray(drawn[..., :3].copy()))
    milliseconds = 1000 // _FRAMES_PER_SECOND
    frames[0].save(path, "GIF", save_all=True, append_images=frames[1:], duration=milliseconds, loop=0)


@rc_context(STYLE)
def _write_mp4(path: Path, film: Film) -> None:
    figure = _figure()
    # H.264 for players and browsers alike; the name of an unfinished file does not tell the format.
    writer = FFMpegWriter(_FRAMES_PER_SECOND, codec="h264", extra_args=["-f", "mp4"])
    try:
        with writer.saving(figure, str(path), _DOTS_PER_INCH):
            for _ in _drawn(figure, film):
                writer.grab_frame()
    except (subprocess.CalledProcessError, OSError) as error:
        said = (getattr(error, "stderr", None) or str(error)).strip().splitlines()
        raise UserError(
            f"ffmpeg could not write the MP4 ({said[-1]}); mend it, or take the format gif"
        ) from None


def _figure() -> Figure:
    figure = Figure(figsize=(7.2, 3.4), dpi=_DOTS_PER_INCH, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def _drawn(figure: Figure, film: Film) -> Iterator[None]:
    """Draw one instant after the other."""
    left, right = figure.subplots(1, 2)
    waves, images, sampling = film.waves, film.images, film.sampling
    reach = max(float(np.abs(waves).max()), 1e-9)
    dots = left.scatter(film.x, film.y, c=waves[0], s=6.0, cmap="RdBu_r", vmin=-reach, vmax=reach)
    left.set_aspect("equal")
    left.set_xlabel(film.unit)
    figure.colorbar(dots, ax=left, label="wavefront (nm)", shrink=0.8)
    half = 0.5 * images.shape[-1] * sampling
    top = float(images.max())
    picture = right.imshow(
        np.maximum(images[0], 1e-4 * top),
        norm=LogNorm(1e-4 * top, top),
        origin="lower",
        extent=(-half - 0.5 * sampling, half - 0.5 * sampling) * 2,
    )
    (track,) = right.plot([], [], color="#ff4d4d", linewidth=0.8)
    right.set_xlabel("image x (λ/D)")
    right.set_autoscale_on(False)
    for number, instant in enumerate(film.time_ms):
        dots.set_array(waves[number])
        picture.set_data(np.maximum(images[number], 1e-4 * top))
        track.set_data(film.los[: number + 1, 0], film.los[: number + 1, 1])
        left.set_title(f"t = {instant:.1f} ms")
        figure.canvas.draw()
        figure.set_layout_engine("none")  # the first frame's is that of all, and takes as long as the frame
        yield
