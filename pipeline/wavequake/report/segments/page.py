"""The report of a segment-disturbance campaign: table, figures and definitions of one HTML page."""

from collections.abc import Iterator, Sequence

import numpy as np
import xarray as xr
from matplotlib.figure import Figure
from numpy.typing import NDArray

from wavequake.campaign.contract import DONE
from wavequake.drawing.periodogram import has_spectrum
from wavequake.errors import UserError
from wavequake.report import figures
from wavequake.report.certificate import ERRORS, modal_errors
from wavequake.report.exposures.camera import CAMERA, camera_pictures
from wavequake.report.exposures.tables import object_picture
from wavequake.report.histories import what_is_kept
from wavequake.report.page import Page, Picture, Section, picture
from wavequake.report.populations import Histories, Population, excluded, histories_of, nothing_known
from wavequake.report.segments.detail import Detail
from wavequake.report.segments.fields import of_population
from wavequake.report.statistics import FEWEST
from wavequake.report.table import OF_OTHERS, number, row_of
from wavequake.report.vibration import histories_and_spectra

_SMALL_PRINT = (
    "Small print below a number: its 95 % confidence interval (≤, ≥: too few cases for both bounds); ± is "
    "the standard error of the number above it."
)
_FRAME = " “the frame”: the circle leaves the image, whose half width is given."
# Term, variable of the store whose own long_name opens the definition, and how the report uses it.
_DEFINITIONS = (
    ("WFE on glass", "wfe_rms_raw", "A case has the rms over its instants; P50 and P95 are over cases."),
    (
        "WFE j ≥ 4",
        "wfe_rms",
        "Cases and percentiles as above. It is over the whole annulus, also where there is no glass, so it "
        "may exceed the WFE on glass. What the fit does not resolve, such as steps between segments, is not "
        "in it.",
    ),
    (
        "LOS",
        "los",
        "The chief ray minus 2 c λ / NA, on the sky. Of the four definitions in use (chief ray, centroid, "
        "tilt of a circular or of an annular pupil) this is the last one. It is not the center of "
        "irradiance: segments that only move along their normals shift it although no ray turns.",
    ),
    ("centroid", "centroid", "On the sky. Where the light goes, by ray optics."),
    (
        "jitter",
        "",
        "Rms of both axes together over all cases and instants, about one mean per axis over all cases and "
        "instants of the population. An offset that the whole population shares is pointing and does not "
        "count; one that differs from case to case does.",
    ),
    (
        "LOS model",
        "",
        "The same rms as the disturbance's definition implies it without sampling, where that is known.",
    ),
    ("segments", "segment_piston_rms", "Over all cases and instants; the model's value as for the LOS."),
    ("Strehl", "strehl", "P5 and P50 are over the instants of all cases."),
    (
        "Rayleigh",
        "rayleigh",
        "Over the rays on glass, piston and tilt removed: a tilt moves the image and does not blur it.",
    ),
    ("Maréchal", "marechal", "The Strehl ratio is then about 0.8 or more."),
    ("peak", "peak", "P5 is over cases: 5 % of the exposures are worse."),
    ("EE80", "ee80", "The exposure of a case is the mean of the images of its instants; P50 is over cases."),
    (
        "confidence interval",
        "",
        "From order statistics and the binomial distribution, so at least 95 % for any distribution. Cases "
        "are the independent draws: where instants are pooled, all instants of a case count as one. "
        "Where cases are stratified (coordinate replicate), from the scatter between their sets instead.",
    ),
    (
        "median and worst case",
        "",
        "By WFE on glass, or by LOS where the cases differ by less than 1 % in WFE. Maps show the instant at "
        "which the rms without piston and tilt is largest.",
    ),
)


# Terms of which nothing is known without images or instants.
_OF_WHOLE = ("centroid", "jitter", "LOS model", "Strehl", "Rayleigh", "peak", "EE80", "median and worst case")
_LISTED = 1000


def page_of(
    found: Sequence[Population],
    dataset: xr.Dataset,
    details: Sequence[Detail],
    more: Sequence[Picture] = (),
    words: str = "",
) -> Page:
    """Return the report of a store.

    Parameters
    ----------
    found : sequence of Population
        Those of the store.
    dataset : xarray.Dataset
        What ``open_store`` gives.
    details : sequence of Detail
        Cases to show as maps, beneath their disturbance; any number, also none.
    more : sequence of Picture
        Further figures of all disturbances together.
    words : str
        What else to say of the store.

    Raises
    ------
    UserError
        If a detail belongs to no disturbance of the store.
    """
    for detail in details:
        if detail.disturbance not in [population.name for population in found]:
            raise UserError(
                f"Case {detail.case} is of {detail.disturbance!r}, which is no disturbance of this store."
            )
    whole = any(one.whole for one in found)
    return Page(
        answer=f"{answer(found)} {words}".rstrip(),
        table=[row_of(one) for one in found],
        small_print=f"{_SMALL_PRINT}{_FRAME if whole else f' {OF_OTHERS}'}{what_is_kept(dataset)}",
        overview=[*_overview([one for one in found if len(one.cases)]), *more],
        sections=[
            _section(place, population, details, of_population(dataset, population.name))
            for place, population in enumerate(found)
            if whole
        ],
        definitions=[
            (term, _definition(dataset, name, use))
            for term, name, use in _DEFINITIONS
            if whole or term not in _OF_WHOLE
        ],
        kind="disturbance",
        left_out=excluded(dataset, found, _LISTED),
    )


def answer(found: Sequence[Population]) -> str:
    """Say in one or two sentences which disturbance matters most."""
    known = [one for one in found if len(one.cases)]
    if not known:
        lost = sum(_failed(one) for one in found)
        return f"No case is done: all {lost} that were computed failed." if lost else "No case is done yet."
    largest, several = max(known, key=lambda one: one.quantile(one.wfe_raw, 0.95).value), len(known) > 1
    failed = nothing_known({one.name: _failed(one) for one in found if not len(one.cases)})
    wavefront, sight = _of_wavefront(largest, several), _of_sight(known, several)
    if not largest.whole:
        return f"{failed}{wavefront if several else f'{largest.name}: {wavefront[0].lower()}{wavefront[1:]}'}"
    worst = min(known, key=lambda one: one.quantile(one.peak, 0.05).value)
    which = "the other " if failed else ""
    lead = f"Of {which}{len(known)} disturbances, {worst.name} costs the most" if several else worst.name
    cases = len(worst.cases)
    dim = (
        f"5 % of its {cases} exposures have a peak below {number(worst.quantile(worst.peak, 0.05).value)}"
        if cases >= FEWEST
        else f"{_dimmest(cases)} has a peak of {number(float(worst.peak.min()))}"
    )
    return (
        f"{failed}{lead}: {dim} of the perfect image's, motion of the line of sight included. "
        f"{wavefront}{sight}"
    )


def _failed(one: Population) -> int:
    return one.quarantined + len(one.incomplete)


def _of_sight(known: Sequence[Population], several: bool) -> str:
    scattered = [one for one in known if np.isfinite(one.los_jitter.radial)]
    if not scattered:  # single cases that stand still
        return ""
    shaken = max(scattered, key=lambda one: one.los_jitter.radial)
    where = f" most under {shaken.name}," if several else ""
    return f" The line of sight scatters{where} by {number(shaken.los_jitter.radial)} mas rms."


def _dimmest(cases: int) -> str:
    return "its only exposure" if cases == 1 else f"the dimmest of its {cases} exposures"


def _of_wavefront(largest: Population, several: bool) -> str:
    """Say how large the wavefront error of a disturbance is: of few cases, all of them."""
    who = f"The largest wavefront error is that of {largest.name}: " if several else ""
    cases = len(largest.cases)
    if cases < FEWEST:
        most = number(float(largest.wfe_raw.max()))
        said = f"at most {most} nm rms in {cases} cases." if cases > 1 else f"{most} nm rms."
        return who + said if several else f"Its wavefront error is {said}"
    bound = f"below {number(largest.quantile(largest.wfe_raw, 0.95).value)} nm rms."
    return (
        f"{who}95 % of its cases stay {bound}"
        if several
        else f"The wavefront error of 95 % of its cases stays {bound}"
    )


def _definition(dataset: xr.Dataset, name: str, use: str) -> str:
    long_name = str(dataset[name].attrs.get("long_name", "")) if name else ""
    return f"{long_name[0].upper()}{long_name[1:].rstrip('.')}. {use}" if long_name else use


def _overview(found: Sequence[Population]) -> Iterator[Picture]:
    if not found:
        return
    sets, whole = {one.name: one.sets for one in found}, found[0].whole
    yield picture(
        "wfe",
        "Distribution of the wavefront error over cases",
        figures.distributions(
            {one.name: one.wfe_raw for one in found}, "WFE rms on glass of a case (nm)", sets
        ),
        "The curve gives the share of cases at or below a value: further left is better; steep means "
        "that cases hardly differ.",
    )
    if whole:
        yield picture(
            "strehl",
            "Distribution of the Strehl ratio over instants",
            figures.distributions(
                {one.name: one.strehl for one in found}, "Strehl ratio of an instant", sets, of_instants=True
            ),
            "The share of instants at or below a Strehl ratio: further right is better. Strehl leaves "
            "the line of sight out.",
        )
    else:
        yield picture(
            "los",
            "Distribution of the line of sight over cases",
            figures.distributions(
                {one.name: one.los for one in found}, "LOS, rms of a case about rest (mas)", sets
            ),
            "The curve gives the share of cases at or below a value: further left is better.",
        )


def error_pictures(dataset: xr.Dataset) -> Iterator[Picture]:
    """Yield how the errors of wavefronts are distributed, of cases that were traced."""
    errors = modal_errors(dataset, dataset["status"].to_numpy() == DONE) if "traced" in dataset else {}
    in_nm = {ERRORS[name]: one for name, one in errors.items() if name not in ("los", "centroid")}
    if in_nm:
        label = "largest error of the modal model in a case (nm)"
        how = "What the modal model is off by in cases that were traced in full, too: further left is better."
        yield picture("modal-error", f"Distribution: {label}", figures.distributions(in_nm, label), how)


def _section(place: int, population: Population, details: Sequence[Detail], dataset: xr.Dataset) -> Section:
    if not len(population.cases):
        return Section(population.name, [])
    pictures, histories = [], histories_of(dataset, population)
    mine = [detail for detail in details if detail.disturbance == population.name]
    for detail in mine:
        of, id_ = f"of case {detail.case}", f"d{place}c{detail.case}"
        image = figures.psf_image(
            detail.image, detail.image_x, detail.image_y, detail.case, _track(population, histories, detail)
        )
        pictures += [
            picture(
                f"{id_}-m1",
                f"Displacement of each segment {of}",
                figures.segment_map(detail),
                "Red segments are nearer to the light, blue ones further; white is at rest. Pointing at one "
                "tells its name and value.",
            ),
            *_bent(detail, of, id_),
            picture(
                f"{id_}-opd",
                f"Optical path differences {of}",
                figures.opd_map(detail),
                "Steps between neighbors are what phasing leaves; slopes within a segment are its tilt.",
            ),
            picture(
                f"{id_}-spot",
                f"Spot diagram {of}",
                figures.spot_diagram(detail),
                "Each dot is where geometrical rays of a segment meet the image; dots outside the circle "
                "widen the core.",
            ),
            picture(
                f"{id_}-psf",
                f"Image {of}",
                image,
                "The irradiance over five decades: rings of the perfect image, and the speckles of the "
                "error. Light blue: the track of the line of sight, which blurs the image.",
            ),
        ]
    # What is not there is not looked for: choosing a case of a dataset loads Dask's arrays.
    if "exposure" in dataset and not dataset.keys().isdisjoint(CAMERA | {"object_image"}):
        worst = int(population.cases[population.worst_index])
        one = dataset.sel(case=worst)
        pictures += camera_pictures(population.name, worst, one, [""])
        if "object_image" in one:
            rest = {"at rest": one["object_static"].to_numpy()} if "object_static" in one else {}
            seen, axis = one["object_image"], one["x"].to_numpy()
            images = rest | {f"case {worst}": seen.to_numpy()}
            pictures.append(object_picture(f"d{place}", f"case {worst} exposes it", images, seen, axis))
    if not mine:
        pictures.append(
            picture(f"d{place}-psf", "Image of the worst case", _stored_image(population, dataset))
        )
    pictures.append(
        picture(
            f"d{place}-time",
            "Median and worst case over time",
            figures.history(population, histories),
            "Flat lines are static errors, waves are vibration; the band holds 90 % of the cases.",
        )
    )
    pictures += _spectra(place, population, histories, mine[0].folded if mine else "")
    return Section(population.name, pictures)


def _bent(detail: Detail, of: str, id_: str) -> Iterator[Picture]:
    if detail.bent is not None:
        yield picture(
            f"{id_}-figure",
            f"Figure of each segment {of}",
            figures.figure_map(detail, detail.bent),
            "How far the glass bends out of its shape at rest, motion as a rigid body left out: one color "
            "all over a segment means that it does not bend.",
        )


def _track(population: Population, histories: Histories, detail: Detail) -> NDArray[np.float64]:
    """Return the line of sight (T, 2) of a case in lambda/D."""
    row = int((population.cases == detail.case).argmax())
    return np.asarray(histories.los[row] / (detail.airy_mas / 1.22))


def _spectra(place: int, population: Population, histories: Histories, folded: str) -> Iterator[Picture]:
    """Yield history and spectrum of the worst case, where it has enough instants and something moves."""
    row = population.worst_index
    time, los, wfe = histories.time_s[row], histories.los[row], histories.wfe_raw[row]
    if not has_spectrum(time) or not (np.ptp(los, axis=0).any() or np.ptp(wfe)):
        return
    series = {
        "WFE on glass": ("nm", {"rms": wfe}),
        "line of sight": ("mas", {"x": los[:, 0], "y": los[:, 1]}),
    }
    yield picture(
        f"d{place}-spectrum",
        f"Worst case over time and over frequency, case {population.cases[row]}",
        histories_and_spectra(time, series),
        f"Left what happens, right at which frequencies: peaks are resonances or the machine that shakes. "
        f"{folded}".strip(),
    )


def _stored_image(population: Population, dataset: xr.Dataset) -> Figure:
    case = int(population.cases[population.worst_index])
    row = int((dataset["case"].to_numpy() == case).argmax()) if "case" in dataset.coords else case
    image = dataset["exposure"].transpose("case", "y", "x").isel(case=row).to_numpy()
    return figures.psf_image(image, dataset["x"].to_numpy(), dataset["y"].to_numpy(), case)
