"""The report of a mirror-exposure store: what each reduced model makes of an exposure."""

import json
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from rich.table import Table

from wavequake.report.exposures import figures as draw
from wavequake.report.exposures import tables as common
from wavequake.report.exposures.psf_figures import Mask, annulus, focus_panels
from wavequake.report.histories import has_histories, over_time, wander, what_is_kept
from wavequake.report.mirrors.variants import few
from wavequake.report.page import Page, Picture, Section, picture
from wavequake.report.populations import frame_of, left_out
from wavequake.report.table import MISSING, number, radius, table_of_rows
from wavequake.workflows.mirrors.bench import bench_of, cases_of, study_of

Array = NDArray[np.float64]

_HEADERS = (
    *("model", "excitation", "variant", "WFE (nm)", "off", "LOS rms (λ/D)", "peak", "EE80 (λ/D)"),
    *("image off", *common.SHORTCUT_HEADERS),
)
_LEGEND = (
    "WFE: largest rms over time of the Zernike terms j ≥ 4, not scaled; off: largest error of a variant as a "
    "share of it. Image off: L2 norm of the difference of unit-energy images, of the variant from the "
    "reference. LOS only and Gaussian are shortcuts for the exposure: the same norm."
)
_SMALL_PRINT = f"{_LEGEND} In small print the error of the peak."

_SCALE = (
    "scale",
    "Images, line of sight and MTF are those of deformations times imaging.scale; wavefront errors are not "
    "scaled.",
)


def table_of(store: Path, dataset: xr.Dataset) -> Table:
    """Return the table of a store for the terminal."""
    rows = _rows(dataset)
    return table_of_rows(rows, f"{_LEGEND} {answer(rows)}{what_is_kept(dataset)}", 3)


def page_of(store: Path, dataset: xr.Dataset, device: str) -> Page:
    """Return the HTML report."""
    rows = _rows(dataset)
    return Page(
        answer=answer(rows),
        table=rows,
        small_print=_SMALL_PRINT + what_is_kept(dataset),
        overview=[],
        sections=[
            Section(f"{model}, {excitation}", list(_figures(cases, f"{model}-{excitation}", excitation)))
            for model, cases in common.finished(dataset, "model")
            for excitation in map(str, dataset["excitation"].to_numpy())
        ],
        definitions=[*common.DEFINITIONS, _SCALE],
        kind="variant",
        left_out=left_out(dataset, ["model", "variant"]),
    )


def answer(rows: Iterable[dict[str, tuple[str, str]]]) -> str:
    """Say how far the exposures of variants, rows of the table, are off the reference's."""
    words = []
    for row in rows:
        cells = {header: value for header, (value, _) in row.items()}
        if cells["image off"] != "reference":
            image = "" if cells["image off"] == MISSING else f" and {cells['image off']} in the exposed image"
            words.append(
                f"{cells['model']}, {cells['excitation']}: {cells['variant']} is off by "
                f"{cells['off']} in wavefront{image}."
            )
    return " ".join(words) or "No variant is done yet."


def _study(dataset: xr.Dataset) -> dict[str, Any]:
    study: dict[str, Any] = json.loads(dataset.attrs["study"])
    return study


def _rows(dataset: xr.Dataset) -> list[dict[str, tuple[str, str]]]:
    study = _study(dataset)
    reference, scale = study["reduction"]["reference"], study["imaging"]["scale"]
    rows = []
    for model, cases in common.finished(dataset, "model"):
        numbers = _per_case(cases, reference, scale)
        for excitation in map(str, cases["excitation"].to_numpy()):
            for case in range(cases.sizes["case"]):
                cells = _cells(
                    numbers.sel(excitation=excitation).isel(case=case), reference, frame_of(dataset)
                )
                rows.append(dict(zip(_HEADERS, ((model, ""), (excitation, ""), *cells), strict=True)))
    return rows


def _per_case(cases: xr.Dataset, reference: str, scale: float) -> xr.Dataset:
    """Reduce histories and images of one model to numbers, chunk by chunk, and read what is left."""
    los = cases["los_mm"] * scale / cases["resolution_mm"]
    found = cases[["peak", "ee80", "image_error", "peak_error"]].assign(
        wfe=over_time(cases["wfe_rms"], "max"),
        off=over_time(cases["wfe_error"], "max"),
        los=wander(los),
    )
    others = np.flatnonzero(cases["variant"].to_numpy() == reference)
    if len(others) and "exposure" in cases:
        images = cases["exposure"].astype(np.float64)
        images = images / images.sum(["y", "x"])
        truth = images.isel(case=int(others[0]), drop=True).compute()
        found["image_off"] = ((images - truth) ** 2).sum(["y", "x"]) ** 0.5
    numbers: xr.Dataset = found.compute()
    return numbers


def _cells(one: xr.Dataset, reference: str, frame: float) -> Iterator[tuple[str, str]]:
    variant, wfe = str(one["variant"].to_numpy()), float(one["wfe"])
    yield variant, ""
    yield number(wfe), ""
    yield f"{number(100.0 * float(one['off']) / wfe)} %" if wfe > 0.0 else "–", ""
    yield number(float(one["los"])), ""
    yield number(float(one["peak"])), ""
    yield radius(float(one["ee80"]), frame), ""
    if variant == reference or "image_off" not in one:
        yield "reference" if variant == reference else MISSING, ""
    else:
        yield f"{float(one['image_off']):.1e}", ""
    yield from common.shortcut_cells(one)


def _figures(cases: xr.Dataset, key: str, excitation: str) -> Iterator[Picture]:
    scale = float(_study(cases)["imaging"]["scale"])
    every = range(cases.sizes["case"])
    part = cases.isel(case=few(every)).sel(excitation=excitation).load()
    variants = [str(one) for one in part["variant"].to_numpy()]
    tracks = dict.fromkeys(variants, np.zeros((0, 2)))
    if has_histories(part):
        sight = (part["los_mm"] * scale / part["resolution_mm"]).transpose("case", "time", "axis")
        tracks = dict(zip(variants, sight.to_numpy(), strict=True))
        wfe = dict(zip(variants, part["wfe_rms"].to_numpy(), strict=True))
    if "exposure" in part:
        yield from _image_pictures(part, key, excitation, scale, tracks)
    if has_histories(part):
        time = part["time"].to_numpy() * 1e3
        yield from common.history_pictures(key, time, tracks, "λ/D", wfe)


def _pupil(part: xr.Dataset) -> Mask:
    """Return which part of the pupil reflects."""
    text = str(part.attrs["study"])
    name, _ = cases_of(study_of(text))[int(part["case"][0])]
    return annulus(bench_of(text, name).optics.obscuration)


def _image_pictures(
    part: xr.Dataset, key: str, excitation: str, scale: float, tracks: dict[str, Array]
) -> Iterator[Picture]:
    """Draw the images of some variants, with lines of sight in lambda/D by variant."""
    variants, axis = list(tracks), part["x"].to_numpy()
    images = {name: part[name].to_numpy() for name in ("exposure", "exposure_los_only", "exposure_gaussian")}
    static = draw.Panel("static", part["exposure_static"].isel(case=0).to_numpy(), np.zeros((1, 2)))
    exposed = [draw.Panel(one, images["exposure"][row], tracks[one]) for row, one in enumerate(variants[:3])]
    los_only, gaussian = common.shortcut_titles(part.isel(case=0))
    shortcuts = [
        draw.Panel(title, images[name][0], tracks[variants[0]])
        for title, name in (
            (f"{variants[0]} in full", "exposure"),
            (los_only, "exposure_los_only"),
            (gaussian, "exposure_gaussian"),
        )
    ]
    for name, text, panels in (
        ("exposure", "Exposures, and the line of sight", exposed),
        ("shortcuts", "The exposure and its shortcuts", shortcuts),
    ):
        figure = draw.exposure_panels([static, *panels], axis)
        yield picture(
            f"{key}-{name}",
            f"{text}, scale {scale:g}",
            figure,
            "Red: the line of sight during the exposure; the static image is the best that there can be.",
        )
    exposures = {static.title: static.image, **dict(zip(variants, images["exposure"], strict=True))}
    yield from common.image_pictures(
        key, f"rest and exposures, scale {scale:g}", exposures, axis, _pupil(part)
    )
    focus, waves = part["exposure_focus"].isel(case=0).to_numpy(), part["focus"].to_numpy().tolist()
    text = f"The exposure through focus, {variants[0]}, scale {scale:g}"
    yield picture(
        f"{key}-focus",
        text,
        focus_panels(focus, waves, axis),
        "The same scale everywhere; symmetric pictures about 0 mean that the focus is right.",
    )
    if "object_image" in part:
        seen = part["object_image"]
        objects = {"static": part["object_static"].isel(case=0).to_numpy()}
        objects |= dict(zip(variants[:3], seen.to_numpy(), strict=False))
        yield common.object_picture(key, f"{excitation} exposes it, scale {scale:g}", objects, seen, axis)
