"""A moving picture of one case of any store that the viewer shows, as GIF or MP4."""

import subprocess
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib import colormaps, rc_context
from matplotlib.animation import FFMpegWriter
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import LogNorm, Normalize, to_rgba
from matplotlib.figure import Figure
from PIL import Image

from wavequake.drawing.still import viewing
from wavequake.drawing.style import COLORS, STYLE
from wavequake.errors import UserError
from wavequake.viewer.encode import SHOWN
from wavequake.viewer.film import Array, Map, Stage, Take, displacements
from wavequake.viewer.view import Tell, film_of, silent

Frame = Callable[[int], object]  # draws an instant of a panel

FORMATS = ("gif", "mp4")
_MOST_FRAMES = 60
_FRAMES_PER_SECOND = 12
_DOTS_PER_INCH = 80
_DECADES = 4
_EDGE = "#5b6670"
COLOR_MAP = colormaps["RdBu_r"]


def animate(
    store: str | Path,
    case: int,
    of: str | None = None,
    kind: str = "gif",
    tell: Tell = silent,
    progress: Callable[[int, int], None] | None = None,
    file: str | Path | None = None,
) -> Path:
    """Write a moving picture of one case, by default into its store's folder, and return where it is.

    The case is computed anew, as for the viewer; at most 60 instants are drawn.

    Parameters
    ----------
    store : str or Path
        Of any study that the viewer shows.
    case : int
    of : str, optional
        Which take of the case: a controller, an excitation or a mode; the first response by default.
    kind : {"gif", "mp4"}
        Format; the program ffmpeg writes MP4.
    tell, progress : callable, optional
        Called with a line when a case is computed, and with frames drawn and their number.
    file : str or Path, optional
        Whose name ends in the format.

    Raises
    ------
    UserError
        If nothing in the store moves, case, take or format do not exist, or ffmpeg is missing or fails.

    Examples
    --------
    >>> animate("runs/tmt-exposure-1a2b3c4d", 0, "elastic")  # doctest: +SKIP
    """
    if _named(kind, FORMATS, "format") == "mp4" and not FFMpegWriter.isAvailable():
        raise UserError(
            "an MP4 needs the program ffmpeg, which is not on the PATH: install the package ffmpeg "
            "(apt install ffmpeg, brew install ffmpeg), or take the format gif"
        )
    if file is not None and Path(file).suffix.lower() != f".{kind}":
        raise UserError(f"{file} does not end in .{kind}, the format; name it so, or choose another format")
    film = film_of(Path(store), [case], tell)
    names = [take.of for take in film.takes]
    first = next((name for name in names if not name.startswith("mode ")), names[0])
    take = film.takes[names.index(_named(first if of is None else of, names, "take"))]
    name = f"{'-'.join(['case', str(case), *take.of.split()])}.{kind}"
    path = Path(store) / name if file is None else Path(file)
    unfinished = path.with_name(f".{path.name}.part")
    try:
        with rc_context(STYLE):
            moving = _Moving(film.stages[take.stage], take, progress)
            (_write_gif if kind == "gif" else _write_mp4)(unfinished, moving)
        unfinished.replace(path)
    finally:
        unfinished.unlink(missing_ok=True)
    return path


def _named(name: str, names: Sequence[str], kind: str) -> str:
    if name not in names:
        raise UserError(f"there is no {kind} {name!r}; choose one of {', '.join(names)}")
    return name


@dataclass(frozen=True)
class _Moving:
    stage: Stage
    take: Take
    progress: Callable[[int, int], None] | None

    def drawn(self, figure: Figure) -> Iterator[None]:
        """Draw one instant after the other."""
        take, frames = self.take, list[Frame]()
        panels = len(take.maps) + (take.images is not None) + min(2, len(take.series))
        columns, bodies = -(-panels // 2), len(self.stage.points) > 0
        places = figure.add_gridspec(2, bodies + columns, width_ratios=[1.6] * bodies + [1.0] * columns)
        if bodies:
            frames.append(_scene(figure.add_subplot(places[:, 0]), self.stage, take))
        free = iter(
            figure.add_subplot(places[k % 2 if panels > 1 else slice(None), bodies + k // 2])
            for k in range(panels)
        )
        frames += [_map(figure, next(free), one) for one in take.maps]
        frames += [_image(next(free), take)] if take.images is not None else []
        for (name, (unit, values)), axes in zip(take.series.items(), free, strict=False):
            frames.append(_curve(axes, f"{name} ({unit})", take.time, values))
        shown = range(0, len(take.time), -(-len(take.time) // _MOST_FRAMES))
        for number, instant in enumerate(shown, start=1):
            for frame in frames:
                frame(instant)
            figure.suptitle(f"{take.label}, t = {1e3 * take.time[instant]:.2f} ms", fontsize=9)
            figure.canvas.draw()
            figure.set_layout_engine("none")  # that of the first frame is that of all
            if self.progress:
                self.progress(number, len(shown))
            yield


def _scene(axes: Axes, stage: Stage, take: Take) -> Frame:
    """Return what draws the bodies: exaggerated, colored by what moves along their normals."""
    pair = take.poses is None and take.shapes is not None  # side by side along x
    eye = viewing(stage.up, np.pi / 2.0) if pair else viewing(stage.up)
    moved, faces = displacements(stage, take), stage.faces
    largest = float(np.linalg.norm(moved, axis=2).max(initial=0.0))
    by = SHOWN * float(np.ptp(stage.points, axis=0).max()) / largest if largest else 0.0
    along = np.einsum("tvi,vi->tv", moved, stage.axes[stage.body, :, 2])
    if take.planes is not None:
        along = 1e-9 * take.planes[:, stage.body, 0]
    values = along[:, faces].mean(axis=2)
    reach = float(np.abs(values).max(initial=0.0))
    still = ~along[:, faces].any(axis=(0, 2)) if take.shapes is None else np.zeros(len(faces), dtype=bool)
    fixed = np.array([to_rgba(one) for one in stage.colors])
    colors, norm = COLOR_MAP, Normalize(-reach or -1.0, reach or 1.0)
    polygons = PolyCollection([], edgecolors=_EDGE, linewidths=0.2)
    axes.add_collection(polygons)
    lines = [points @ eye[:2].T for _, points in stage.lines]
    axes.add_collection(
        LineCollection(lines, colors=[color for color, _ in stage.lines], linewidths=0.4, alpha=0.6)
    )
    seen = np.concatenate([stage.points @ eye[:2].T, *lines])
    low, high = seen.min(axis=0), seen.max(axis=0)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
    axes.set_axis_off()
    what = "wavefront" if take.planes is not None else "displacement along the normal"
    words = f"drawn {by:.2g} times" if by else "nothing moves"
    axes.set_title(f"{words}; colors: {what}, ±{1e9 * reach:.3g} nm" if reach else words, fontsize=8)

    def frame(instant: int) -> None:
        there = (stage.points + by * moved[instant]) @ eye.T
        order = there[faces, 2].mean(axis=1).argsort(kind="stable")
        tints = np.where(still[:, None], fixed, colors(norm(values[instant])) if reach else fixed)
        polygons.set_verts(list(there[faces[order], :2]))
        polygons.set_facecolor(tints[order])

    return frame


def _map(figure: Figure, axes: Axes, shown: Map) -> Frame:
    """Return what draws numbers over the pupil."""
    reach = shown.reach or 1.0
    picture = axes.imshow(
        np.full(shown.cells.shape, np.nan), cmap=COLOR_MAP, vmin=-reach, vmax=reach, origin="lower"
    )
    axes.set_axis_off()
    axes.set_title(shown.name, fontsize=8)
    figure.colorbar(picture, ax=axes, label=shown.unit, shrink=0.8)

    def frame(instant: int) -> None:
        values = shown.weights[instant] @ shown.shapes
        picture.set_data(np.where(shown.cells < 0, np.nan, values[shown.cells]))

    return frame


def _image(axes: Axes, take: Take) -> Frame:
    """Return what draws the image of an instant, with the line of sight up to it."""
    if take.images is None:
        raise ValueError("a take without images")
    size, pixel = take.images.shape[-1], take.pixel
    ends = (-0.5 * (size + 1) * pixel, 0.5 * (size - 1) * pixel)
    top = float(np.nanmax(take.images)) or 1.0
    floor = 10.0**-_DECADES * top
    picture = axes.imshow(
        np.full((size, size), floor), norm=LogNorm(floor, top), origin="lower", extent=(*ends, *ends)
    )
    (line,) = axes.plot([], [], color="#5ad1ff", linewidth=0.8)
    axes.set_autoscale_on(False)
    axes.set_title("image (λ/D), logarithmic", fontsize=8)

    def frame(instant: int) -> None:
        if take.images is not None:
            picture.set_data(np.maximum(np.nan_to_num(take.images[instant]), floor))
        if take.track is not None:
            line.set_data(*take.track[: instant + 1].T)

    return frame


def _curve(axes: Axes, title: str, time: Array, values: Array) -> Frame:
    """Return what draws numbers over time with a line at the instant."""
    for column, color in zip(values.T[:2], COLORS, strict=False):
        axes.plot(1e3 * time, column, color=color, linewidth=1.0)
    line = axes.axvline(0.0, color="black", linewidth=0.8)
    axes.ticklabel_format(axis="y", useOffset=False)
    axes.set_xlabel("time (ms)")
    axes.set_title(title, fontsize=8)
    return lambda instant: line.set_xdata([1e3 * time[instant]] * 2)


def _figure(moving: _Moving) -> Figure:
    take = moving.take
    panels = len(take.maps) + (take.images is not None) + min(2, len(take.series))
    wide = 4.2 if len(moving.stage.points) else 2.9
    figure = Figure(figsize=(wide + 2.9 * -(-panels // 2), 4.4), dpi=_DOTS_PER_INCH, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def _write_gif(path: Path, moving: _Moving) -> None:
    figure, frames = _figure(moving), []
    for _ in moving.drawn(figure):
        drawn = np.asarray(figure.canvas.buffer_rgba())  # type: ignore[attr-defined]
        frames.append(Image.fromarray(drawn[..., :3].copy()))
    milliseconds = 1000 // _FRAMES_PER_SECOND
    frames[0].save(path, "GIF", save_all=True, append_images=frames[1:], duration=milliseconds, loop=0)


def _write_mp4(path: Path, moving: _Moving) -> None:
    figure = _figure(moving)
    # H.264 for players and browsers alike; the name of an unfinished file does not tell the format.
    writer = FFMpegWriter(_FRAMES_PER_SECOND, codec="h264", extra_args=["-f", "mp4"])
    try:
        with writer.saving(figure, str(path), _DOTS_PER_INCH):
            for _ in moving.drawn(figure):
                writer.grab_frame()
    except (subprocess.CalledProcessError, OSError) as error:
        said = (getattr(error, "stderr", None) or str(error)).strip().splitlines()
        raise UserError(
            f"ffmpeg could not write the MP4 ({said[-1]}); mend it, or take the format gif"
        ) from None
