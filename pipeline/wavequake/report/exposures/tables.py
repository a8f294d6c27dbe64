"""What the reports of all exposures have in common: words, tables, groups of cases, and figures."""

from collections.abc import Iterator, Mapping, Sequence

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from wavequake.campaign.contract import DONE
from wavequake.report.exposures import figures as draw
from wavequake.report.exposures.psf_figures import Mask, focus_panels, image_row, log_psf, mtf_curves
from wavequake.report.page import Picture, picture
from wavequake.report.table import number

Array = NDArray[np.float64]

SHORTCUT_HEADERS = ("LOS only", "Gaussian")
DEFINITIONS = (
    (
        "exposure",
        "Mean of every instant's own image, placed at its own line of sight (Störkle 2018, Eq. 3.79).",
    ),
    ("LOS only", "The image at rest convolved with the trajectory of the line of sight, Eq. 3.80."),
    ("Gaussian", "The image at rest blurred by a Gaussian of the trajectory's mean and covariance."),
)


def without_what_is_alike(rows: Sequence[dict[str, tuple[str, str]]]) -> list[dict[str, tuple[str, str]]]:
    """Return rows without their first column where it says the same in all of them."""
    if len(rows) < 2 or len({next(iter(row.values())) for row in rows}) > 1:
        return list(rows)
    return [dict(list(row.items())[1:]) for row in rows]


def finished(dataset: xr.Dataset, label: str) -> Iterator[tuple[str, xr.Dataset]]:
    """Yield the finished cases of each value of a label, in order of appearance."""
    done = dataset.isel(case=np.flatnonzero(dataset["status"].to_numpy() == DONE))
    names = done[label].to_numpy()
    for name in dict.fromkeys(names):
        yield str(name), done.isel(case=np.flatnonzero(names == name))


def shortcut_cells(one: xr.Dataset) -> Iterator[tuple[str, str]]:
    """Yield the error of each shortcut's image and, in small print, of its peak; medians over cases."""
    for shortcut in ("los_only", "gaussian"):
        values = (one[key].sel(shortcut=shortcut).to_numpy() for key in ("image_error", "peak_error"))
        image, peak = (float(np.nanmedian(value)) for value in values)
        yield f"{image:.1e}", f"{number(100.0 * peak)} %"


def shortcut_titles(one: xr.Dataset) -> tuple[str, str]:
    """Return the titles of the shortcuts' images of one exposure, with their errors."""
    los_only, gaussian = one["image_error"].to_numpy()
    return f"LOS only, {los_only:.1e} off", f"Gaussian, {gaussian:.1e} off"


def image_pictures(
    key: str,
    text: str,
    images: Mapping[str, Array],
    axis: Array,
    pupil: Mask,
    focus: tuple[str, xr.DataArray],
) -> Iterator[Picture]:
    """Yield the MTF of images, and the first of them on a logarithmic scale; `pupil` as `frame_mtf`.

    Of `focus`, a title and images (focus, y, x), the images through focus are shown.
    """
    first, image = next(iter(images.items()))
    yield picture(
        f"{key}-mtf",
        f"Modulation transfer of {text}",
        mtf_curves(images, float(axis[1] - axis[0]), pupil),
        "The contrast that is left of fine detail; the gray line is the limit of the same pupil without "
        "aberration. Light beyond the frame counts as lost contrast.",
    )
    yield picture(
        f"{key}-log",
        f"Image of {text}, {first}, five decades",
        log_psf(image, axis),
        "Five decades: what lies far from the core.",
    )
    title, through = focus
    yield picture(
        f"{key}-focus",
        title,
        focus_panels(through.to_numpy(), through["focus"].to_numpy().tolist(), axis),
        "The same scale everywhere; symmetric pictures about 0 mean that the focus is right.",
    )


def object_picture(
    key: str, words: str, images: Mapping[str, Array], stored: xr.DataArray, axis: Array
) -> Picture:
    """Return images of an object side by side; what is stored of them says in which light."""
    light = str(stored.attrs["long_name"]).partition(" in ")[2].partition(";")[0]
    figure = image_row(np.array(list(images.values())), list(images), axis)
    return picture(
        f"{key}-object",
        f"The object as {words}, in {light}",
        figure,
        "What the detector sees of the object; the same scale of square roots everywhere.",
    )


def history_pictures(
    key: str, time_ms: Array, tracks: Mapping[str, Array], unit: str, wfe: Mapping[str, Array]
) -> Iterator[Picture]:
    """Yield line of sight and wavefront error over time."""
    yield picture(
        f"{key}-los",
        "Line of sight over time",
        draw.line_of_sight(time_ms, tracks, unit),
        "Motion of the image in x and y.",
    )
    yield picture(
        f"{key}-wfe",
        "Wavefront error over time",
        draw.wavefront_error(time_ms, wfe),
        "Zernike terms from focus on: what tip and tilt cannot explain.",
    )
