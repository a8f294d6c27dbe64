"""The report of a telescope-exposure store: what each controller does for the image, what shortcuts miss."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from rich.table import Table

from wavequake.campaign.schema import study_from_identity
from wavequake.optics.segments.layout import is_monolithic
from wavequake.report.exposures import figures as draw
from wavequake.report.exposures import tables as common
from wavequake.report.exposures.psf_figures import Mask, annulus, polygons
from wavequake.report.histories import has_histories, over_time, wander, what_is_kept
from wavequake.report.page import Page, Picture, Section, picture
from wavequake.report.populations import frame_of, left_out
from wavequake.report.table import number, radius, table_of_rows
from wavequake.workflows.exposures.exposure_study import TelescopeExposureStudy
from wavequake.workflows.segments.bench import build_telescope

Array = NDArray[np.float64]

_HEADERS = (
    *("disturbance", "controller", "WFE (nm)", "LOS rms (mas)", "peak", "EE50 (λ/D)", "EE80 (λ/D)"),
    *common.SHORTCUT_HEADERS,
)
_IMAGES = ("exposure", "exposure_fitted", "exposure_los_only", "exposure_gaussian")
_LEGEND = (
    "Medians over cases; WFE: mean over time of the rms of the fitted Zernike terms j ≥ 4; EE: the frame "
    "where the circle leaves the image, whose half width is given. LOS only and Gaussian are shortcuts for "
    "the exposure: L2 norm of the difference of unit-energy images."
)
_SMALL_PRINT = f"{_LEGEND} In small print the error of the peak."
_DEFINITIONS = (
    ("static", "The telescope at rest."),
    ("disturbed", "Nothing is done about the disturbance."),
    ("rigid", "M2 tilts so that the line of sight stays, Störkle 2018, Eq. 4.25, without delay or error."),
    ("elastic", "M2 deforms so that line of sight and fitted wavefront stay, Eq. 4.27, likewise."),
    *common.DEFINITIONS,
    (
        "fitted terms",
        "Images of the wavefronts that the Zernike terms describe; those of all rays also hold what segments "
        "leave beside the terms, which no deformation of M2 by these terms takes away.",
    ),
)


def table_of(store: Path, dataset: xr.Dataset) -> Table:
    """Return the table of a store for the terminal."""
    caption = f"{_LEGEND} {answer(dataset)}{what_is_kept(dataset)}"
    return table_of_rows(_rows(dataset), caption, 2)


def page_of(store: Path, dataset: xr.Dataset, device: str) -> Page:
    """Return the HTML report."""
    return Page(
        answer=answer(dataset),
        table=_rows(dataset),
        small_print=_SMALL_PRINT + what_is_kept(dataset),
        overview=[],
        sections=[
            Section(name, list(_figures(cases, name)))
            for name, cases in common.finished(dataset, "disturbance")
        ],
        definitions=list(_DEFINITIONS),
        kind="disturbance",
        left_out=left_out(dataset),
    )


def answer(dataset: xr.Dataset) -> str:
    """Say what is left of the peak under each controller."""
    words = []
    for name, cases in common.finished(dataset, "disturbance"):
        peaks = {
            str(c): float(np.median(np.asarray(cases["peak"].sel(controller=c))))
            for c in cases["controller"].values
        }
        words.append(
            f"{name}: of the peak at rest the exposure keeps {_part(peaks, 'disturbed')} disturbed, "
            f"{_part(peaks, 'rigid')} with a rigid M2 and {_part(peaks, 'elastic')} with an elastic one."
        )
    return " ".join(words) or "No case is done yet."


def _part(peaks: dict[str, float], controller: str) -> str:
    return f"{number(100.0 * peaks[controller] / peaks['static'])} %"


def _rows(dataset: xr.Dataset) -> list[dict[str, tuple[str, str]]]:
    rows, frame = [], frame_of(dataset)
    for name, cases in common.finished(dataset, "disturbance"):
        numbers = _per_case(cases)
        for controller in map(str, cases["controller"].to_numpy()):
            one = numbers.sel(controller=controller)
            cells = [
                (name, ""),
                (controller, ""),
                (number(float(one["wfe_rms"].median())), ""),
                (number(float(one["los"].median())), ""),
                (number(float(one["peak"].median())), ""),
                *((radius(float(one[key].median()), frame), "") for key in ("ee50", "ee80")),
            ]
            cells += common.shortcut_cells(one)
            rows.append(dict(zip(_HEADERS, cells, strict=True)))
    return rows


def _per_case(cases: xr.Dataset) -> xr.Dataset:
    """Reduce histories to a number per case and controller, chunk by chunk, and read what is left."""
    found = cases[["peak", "ee50", "ee80", "image_error", "peak_error"]].assign(
        wfe_rms=over_time(cases["wfe_rms"], "mean"), los=wander(cases["los"])
    )
    numbers: xr.Dataset = found.drop_vars("time_s", errors="ignore").compute()
    return numbers


def _figures(cases: xr.Dataset, name: str) -> Iterator[Picture]:
    """Draw the case with the median peak of the disturbed exposure."""
    peaks = cases["peak"].sel(controller="disturbed").to_numpy()
    shown = cases.isel(case=int(np.argsort(peaks, kind="stable")[(len(peaks) - 1) // 2])).load()
    controllers = [str(one) for one in shown["controller"].to_numpy()]
    los = dict.fromkeys(controllers, np.zeros((0, 2)))
    if has_histories(shown):
        kept = np.isfinite(shown["time_s"].to_numpy())
        time = shown["time_s"].to_numpy()[kept] * 1e3
        los = {one: shown["los"].sel(controller=one).to_numpy()[kept] for one in controllers}
        wfe = {one: shown["wfe_rms"].sel(controller=one).to_numpy()[kept] for one in controllers}
    if "exposure" in shown:
        yield from _image_pictures(shown, name, los)
    if has_histories(shown):
        yield from common.history_pictures(name, time, los, "mas", wfe)


def _pupil(shown: xr.Dataset) -> Mask:
    """Return which part of the pupil is glass."""
    study = study_from_identity(TelescopeExposureStudy, str(shown.attrs["study"]))
    system = build_telescope(study)
    round_one = annulus(system.annulus.inner / system.annulus.outer)
    if is_monolithic(system.segments):
        return round_one
    glass = polygons(system.segments.corners, system.annulus.outer)
    return glass if study.optics.sampling == "segments" else glass & round_one


def _image_pictures(shown: xr.Dataset, name: str, los: dict[str, Array]) -> Iterator[Picture]:
    """Draw the images of a case, with lines of sight in mas by controller."""
    controllers, axis, case = list(los), shown["x"].to_numpy(), int(shown["case"])
    per_mas = 1.0 / float(shown["resolution_mas"])
    pictures = {key: shown[key].to_numpy() for key in _IMAGES}
    for key, text in (
        ("exposure", f"Exposures of case {case}, and the line of sight"),
        ("exposure_fitted", f"Exposures of case {case}, of the fitted Zernike terms alone"),
    ):
        panels = [
            draw.Panel(one, pictures[key][row], los[one] * per_mas) for row, one in enumerate(controllers)
        ]
        yield picture(
            f"{name}-{key}",
            text,
            draw.exposure_panels(panels, axis),
            "Red: the line of sight during the exposure. A good controller keeps it on one spot and the "
            "core bright.",
        )
    row = controllers.index("disturbed")
    titles = (
        "disturbed, in full",
        "of the fitted terms",
        *common.shortcut_titles(shown.isel(controller=row)),
    )
    panels = [
        draw.Panel(title, pictures[key][row], los["disturbed"] * per_mas)
        for title, key in zip(titles, _IMAGES, strict=True)
    ]
    text = f"The disturbed exposure of case {case} and its shortcuts"
    yield picture(
        f"{name}-shortcuts",
        text,
        draw.exposure_panels(panels, axis),
        "The full exposure beside cheaper ways to it; the number above each is how far it is off.",
    )
    exposures = dict(zip(controllers, pictures["exposure"], strict=True))
    focus = "The image at rest through focus", shown["static_focus"]
    words = f"the exposures of case {case}"
    yield from common.image_pictures(name, words, exposures, axis, _pupil(shown), focus)
    if "object_image" in shown:
        seen = shown["object_image"]
        objects = dict(zip(controllers, seen.to_numpy(), strict=True))
        yield common.object_picture(name, f"case {case} exposes it", objects, seen, axis)
