"""The report of a mirror-mor store: its variants in a table, the smallest that is enough, and figures."""

import json
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from rich.table import Table
from rich.text import Text

from wavequake.report.exposures.figures import Panel, exposure_panels
from wavequake.report.histories import has_histories, what_is_kept
from wavequake.report.mirrors import figures as draw
from wavequake.report.mirrors import shapes as mirror_shapes
from wavequake.report.mirrors.variants import (
    MEASURES,
    Criterion,
    ModelResult,
    VariantResult,
    criterion_of,
    few,
    largest,
    model_results,
    representatives,
)
from wavequake.report.page import Page, Picture, Section, picture
from wavequake.report.populations import left_out
from wavequake.report.table import MISSING, empty_table, number

_SMALL_PRINT = (
    "ε: largest relative error of the transfer matrix over frequency, in small print over the lower third of "
    "the band. WFE: largest error over time as a share of the reference's largest value; LOS: largest error; "
    "image: L2 norm of the difference of unit-energy exposures; each for the worst of the excitations that "
    "decide."
)
_TABLE_WORDS = (
    "Made in: time of the reduction. f max: highest frequency of the reduced model. ε mech, ε opt: largest "
    "relative errors over frequency of the motion of the interfaces and of the shape of the surface. WFE, "
    "LOS, image: errors of wavefront, line of sight and exposure over time, under the worst excitation."
)
_DEFINITIONS = (
    ("ε mech", "‖H - H_ref‖ / ‖H_ref‖ of the receptance at the interfaces (Störkle 2018, Eq. 2.10)."),
    ("ε opt", "The same of the response of the Zernike coefficients c_2 and on (Eq. 4.23)."),
    ("WFE", "Root of the sum of squares of the Zernike coefficients j ≥ 4, total, not relative to rest."),
    ("LOS", "Direction of the best-fit plane in the image, Eq. 3.39."),
    ("f max", "Largest eigenfrequency of the reduced model: an integrator's step would have to follow it."),
    (
        "full",
        "The rich intermediate model from which the variants are made; how far it is off the finite-element "
        "model, at frequencies that it was not built on, stands beneath the table.",
    ),
)


def table_of(store: Path, dataset: xr.Dataset) -> Table:
    """Return the table of a store for the terminal."""
    models, criterion = results_of(dataset)
    words = f"{answer(models, criterion)} {_TABLE_WORDS} {checked(dataset)}{what_is_kept(dataset)}"
    headers = [header.replace(" ", "\n") for header in _HEADERS]
    table = empty_table(headers, fixed=True, caption=words, padding=(0, 1, 0, 0), pad_edge=False)
    for model in models:
        table.add_row(Text(model.name, style="bold"))
        for one in model.variants:
            cells = row_of(one, criterion)
            mark = " ←" if one is model.enough else ""
            table.add_row(one.variant + mark, *(value for value, _ in list(cells.values())[1:]))
    return table


def page_of(store: Path, dataset: xr.Dataset, device: str) -> Page:
    """Return the HTML report."""
    models, _ = results_of(dataset)
    beside = picture(
        "models",
        "The models themselves",
        draw.models_side_by_side(dataset, models),
        "What the variants have to reproduce: the full models on one scale.",
    )
    sections = [Section(model.name, list(_figures(dataset, model))) for model in models]
    small_print = f"{_SMALL_PRINT} {checked(dataset)}"
    return page_of_variants(dataset, "model", small_print, sections, _DEFINITIONS, [beside])


def page_of_variants(
    dataset: xr.Dataset,
    label: str,
    small_print: str,
    sections: list[Section],
    definitions: Iterable[tuple[str, str]],
    more: Iterable[Picture] = (),
) -> Page:
    """Return the report of a store whose cases are variants of models, which its table has under a label."""
    models, criterion = results_of(dataset)
    return Page(
        answer=answer(models, criterion),
        table=[
            {label: (model.name, ""), **row_of(one, criterion)} for model in models for one in model.variants
        ],
        small_print=small_print + what_is_kept(dataset),
        overview=[
            picture(
                "order",
                "Error of all variants over their order",
                draw.errors_over_order(models, criterion),
                "Left is cheaper, lower is better: the first variant below the dashed bound is small enough.",
            ),
            *more,
        ],
        sections=sections,
        definitions=list(definitions),
        kind="variant",
        left_out=left_out(dataset, ["model", "variant"]),
    )


def results_of(dataset: xr.Dataset) -> tuple[list[ModelResult], Criterion]:
    """Return the finished variants of every model of a store, and what decides between them."""
    study: dict[str, Any] = json.loads(dataset.attrs["study"])
    criterion = criterion_of(study)
    return model_results(dataset, study["reduction"]["reference"], criterion), criterion


_HEADERS = ("variant", "order", "made in (ms)", "f max (kHz)", "ε mech", "ε opt", "WFE", "LOS (λ/D)", "image")


def row_of(one: VariantResult, criterion: Criterion) -> dict[str, tuple[str, str]]:
    """Return header -> (value, small print) of one variant."""
    values = (
        (one.variant, ""),
        (str(one.order), ""),
        (number(one.reduce_seconds * 1e3), ""),
        (number(one.pseudo_frequency_max / 1e3), ""),
        (_tiny(one.eps_mech), _tiny(one.eps_mech_low)),
        (_tiny(one.eps_opt), _tiny(one.eps_opt_low)),
        (_percent(largest(one, replace(criterion, measure="wfe"))), ""),
        (_tiny(largest(one, replace(criterion, measure="los"))), ""),
        (_tiny(largest(one, replace(criterion, measure="image"))), ""),
    )
    return dict(zip(_HEADERS, values, strict=True))


def _tiny(value: float) -> str:
    return MISSING if value != value else f"{value:.1e}"


def _percent(value: float) -> str:
    if 0.0 < value < 1e-5:  # more digits would make two lines of a row
        return "<0.001 %"
    return MISSING if value != value else f"{number(100 * value)} %"


def answer(models: Iterable[ModelResult], criterion: Criterion) -> str:
    """Say per model which variant is the smallest that is good enough."""
    limit = worded(criterion.bound, criterion)
    words = []
    for model in models:
        if model.reference is None:
            words.append(f"{model.name}: the reference is not done, so nothing can be said yet.")
        elif not model.variants:
            words.append(f"{model.name}: no variant is done beside the reference, so nothing can be said.")
        elif model.enough is None:
            words.append(f"{model.name}: no variant keeps the {MEASURES[criterion.measure]} below {limit}.")
        else:
            found = largest(model.enough, criterion)
            words.append(
                f"{model.name}: {model.enough.variant} ({model.enough.order} coordinates) is the smallest "
                f"variant that keeps the {MEASURES[criterion.measure]} below {limit} "
                f"({worded(found, criterion)})."
            )
    return " ".join(words)


def checked(dataset: xr.Dataset) -> str:
    """Say how far the intermediate models are off the full ones where their bases were not built."""
    frequencies = [f"{one:.0f}" for one in dataset["spot_frequency"].to_numpy()]
    if not frequencies:
        return "The intermediate models were not checked (reduction.spot_checks = 0)."
    errors = dataset["spot_error"].max("check").to_numpy()
    worst = ", ".join(
        f"{error:.0e} ({name})"
        for name, error in zip(dataset["checked_model"].to_numpy(), errors, strict=True)
    )
    return (
        f"Spot check at {', '.join(frequencies)} Hz, where no basis was built: the intermediate model is at "
        f"most {worst} off full-size solutions."
    )


def worded(value: float, criterion: Criterion) -> str:
    """Return an error with the unit of the criterion's measure."""
    units = {"wfe": " %", "los": " λ/D", "image": ""}[criterion.measure]
    return number(100 * value if criterion.measure == "wfe" else value) + units


def over_frequency(
    dataset: xr.Dataset,
    name: str,
    shown: Sequence[VariantResult],
    reference: VariantResult | None,
    mechanical: str,
    optical: str,
) -> Iterable[Picture]:
    """Draw both responses of some variants and their errors; ids of the pictures begin with `name`."""
    for part, response, error in (("mech", mechanical, "receptance"), ("opt", optical, optical)):
        for key, text, ground in (("frf", response, reference), ("eps", f"error of the {error}", None)):
            yield picture(
                f"{name}-{key}_{part}",
                f"{text[0].upper()}{text[1:]} over frequency",
                draw.spectra(dataset, f"{key}_{part}", shown, ground),
                "A variant is good as far as its line follows the reference (responses) or stays low "
                "(errors); peaks are modes.",
            )


def _figures(dataset: xr.Dataset, model: ModelResult) -> Iterable[Picture]:
    reference = model.reference
    if reference is None or not model.variants:
        return
    shown, name = representatives(model), model.name
    krylov = few([one for one in model.variants if one.method == "krylov"])
    drawn = {one.case for one in (reference, *shown, *krylov)}
    dataset = dataset.sel(case=sorted(drawn)).load()  # once, not figure by figure
    yield from over_frequency(dataset, name, shown, reference, "receptance", "mechanical-optical response")
    if len(krylov) > 1:
        yield picture(
            f"{name}-krylov",
            "Choice of the expansion points",
            draw.spectra(dataset, "eps_mech", krylov, None),
            "Each is exact at its expansion points and loses accuracy away from them.",
        )
    yield picture(
        f"{name}-both",
        "Mechanics and light, scaled alike",
        draw.mechanical_and_optical(dataset, reference),
        "Modes that the mechanical response shows and the optical does not are harmless to the image.",
    )
    yield picture(
        f"{name}-zernike",
        "Response of each aberration",
        draw.coefficient_spectra(dataset, reference),
        "Which aberration each resonance excites.",
    )
    yield picture(
        f"{name}-fits",
        "Fit of each mode by Zernike polynomials",
        draw.mode_fits(dataset, shown),
        "What the fit leaves of each mode: high bars are shapes that more Zernike terms would be needed for.",
    )
    yield picture(
        f"{name}-fmax",
        "Largest pseudo-eigenfrequencies",
        draw.pseudo_frequencies(shown),
        "The highest frequency sets the time step of explicit simulations: lower is faster.",
    )
    yield from excitation_pictures(dataset, name, model, reference)
    yield from mirror_shapes.pictures(dataset, model)
    for one in representatives(model, 2):
        yield picture(
            f"{name}-mac-{one.case}",
            f"MAC of {one.variant}",
            draw.mac_map(dataset, one, reference),
            "1 on the diagonal: the mode is that of the full model; elsewhere modes are mixed or missing.",
        )


def excitation_pictures(
    dataset: xr.Dataset, name: str, model: ModelResult, reference: VariantResult
) -> Iterable[Picture]:
    """Draw what each excitation does: wavefront errors over time, and exposures, of what is enough too."""
    shown, exposed = representatives(model), representatives(model, draw.EXPOSED)
    for excitation in map(str, dataset["excitation"].to_numpy()):
        if has_histories(dataset):
            yield picture(
                f"{name}-{excitation}-time",
                f"Wavefront error over time, {excitation}",
                draw.wavefront_history(dataset, excitation, shown, reference),
                "A variant is good where its line lies on the reference.",
            )
        if "exposure" in dataset:
            images = dataset["exposure"].sel(excitation=excitation)
            panels = [
                Panel(one.variant, images.sel(case=one.case).to_numpy(), np.zeros((0, 2)))
                for one in (reference, *exposed)
            ]
            yield picture(
                f"{name}-{excitation}-image",
                f"Exposures, {excitation}",
                exposure_panels(panels, dataset["x"].to_numpy()),
                "What the camera sees after the whole vibration: equal pictures mean that the reduction "
                "does not matter.",
            )
