"""The report of a mirror-trace store: both methods, how far they are apart, and what they cost."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import xarray as xr
from rich.table import Table
from rich.text import Text

from wavequake.campaign.contract import DONE
from wavequake.report.histories import has_histories, over_time, what_is_kept
from wavequake.report.mirrors import figures as draw
from wavequake.report.mirrors.variants import few
from wavequake.report.page import Page, Picture, Section, picture
from wavequake.report.populations import left_out
from wavequake.report.table import MISSING, empty_table, number
from wavequake.workflows.mirrors.trace import MODAL, STANDARD

# Stores of earlier versions displaced all nodes at every instant.
_STANDARD = ("displacements", *STANDARD)

_SMALL_PRINT = (
    "WFE: largest rms of the Zernikes j ≥ 4 over time, every instant traced. Difference: largest rms of the "
    "difference of the two wavefronts, as a share of it; of sag, of optics: what of it comes from the sag at "
    "displaced x and y, and from the optics beyond first order. LOS: largest distance of the two lines of "
    "sight. Times in one process, after set-up."
)
_DEFINITIONS = (
    (
        "standard",
        "Sag residual of every instant at the displaced x and y of its nodes, Zernike fit, ray trace of all "
        "rays (Störkle 2018, Section 4.1).",
    ),
    ("modal", "Sensitivities of the modes (Eq. 4.22) times the modal coordinates: one matrix product."),
    (
        "missed, rest",
        "Share of the largest deformation that the Zernike polynomials miss (Eq. 4.11). Where it is above "
        "optics.residual_limit, what they leave is traced with them as a grid, and rest is what that adds to "
        "the wavefront, largest rms over time, in either way.",
    ),
    ("LOS", "Direction of the best-fit plane in the image, Eq. 3.39."),
)
_HEADERS = (
    "variant",
    "excitation",
    "WFE (nm)",
    "difference",
    "of sag",
    "of optics",
    "LOS (λ/D)",
    "missed",
    "rest (nm)",
)
_COSTS = ("standard (ms)", "modal (ms)")
_ONLY_ON_PAPER = ("of sag", "of optics")
# Histories of which the largest value counts.
_HISTORIES = (
    *("wfe_rms_standard", "wfe_difference", "wfe_difference_sag", "wfe_difference_optics"),
    *("los_difference", "wfe_rms_residual"),
)


@dataclass(frozen=True)
class TraceResult:
    """Both methods for one variant of one model under one excitation; see the headers of the table."""

    case: int
    model: str
    variant: str
    excitation: str
    wfe: float
    difference: float
    from_sag: float
    from_optics: float
    los: float
    missed: float
    rest: float
    standard_s: float
    modal_s: float
    stages: dict[str, float]


def trace_results(dataset: xr.Dataset) -> list[TraceResult]:
    """Return the finished cases of a store, one record per excitation."""
    found = []
    names = [str(stage) for stage in dataset["stage"].to_numpy()]
    kept = ["seconds", "resolution_mm", "missed_share"]
    largest = {name: over_time(dataset[name], "max", False) for name in _HISTORIES if name in dataset}
    numbers = xr.Dataset(largest | {name: dataset[name] for name in kept if name in dataset}).compute()
    for row in np.flatnonzero(dataset["status"].to_numpy() == DONE):
        case = numbers.isel(case=int(row))
        for excitation in map(str, dataset["excitation"].to_numpy()):
            part = case.sel(excitation=excitation)
            wfe = float(part["wfe_rms_standard"])
            seconds = dict(zip(names, map(float, part["seconds"].to_numpy()), strict=True))
            found.append(
                TraceResult(
                    case=int(case["case"]),
                    model=str(case["model"].to_numpy()),
                    variant=str(case["variant"].to_numpy()),
                    excitation=excitation,
                    wfe=wfe,
                    difference=_share(part["wfe_difference"], wfe),
                    from_sag=_share(part["wfe_difference_sag"], wfe),
                    from_optics=_share(part["wfe_difference_optics"], wfe),
                    los=float(part["los_difference"]) / float(case["resolution_mm"]),
                    missed=float(part["missed_share"]) if "missed_share" in part else float("nan"),
                    rest=float(part["wfe_rms_residual"]) if "wfe_rms_residual" in part else 0.0,
                    standard_s=sum(seconds.get(stage, 0.0) for stage in _STANDARD),
                    modal_s=sum(seconds.get(stage, 0.0) for stage in MODAL),
                    stages=seconds,
                )
            )
    return found


def _share(value: xr.DataArray, of: float) -> float:
    return float(value) / of if of > 0 else float("nan")


def answer(results: Iterable[TraceResult]) -> str:
    """Say how far the two methods are apart at most, and how their costs compare."""
    results = list(results)
    if not results:
        return "No variant is done, so nothing can be said yet."
    worst = max(results, key=lambda one: -1.0 if np.isnan(one.difference) else one.difference)
    standard, modal = (
        float(np.median([getattr(one, name) for one in results])) for name in ("standard_s", "modal_s")
    )
    cause = (
        "the optics beyond first order" if worst.from_optics > worst.from_sag else "the sag at displaced x, y"
    )
    return (
        f"The two methods differ by at most {worst.difference:.1e} of the wavefront error ({worst.variant}, "
        f"{worst.excitation}), most of it from {cause}. After set-up the standard method takes "
        f"{number(standard * 1e3)} ms, the modal one {number(modal * 1e3)} ms (medians)."
    )


def _row(one: TraceResult) -> dict[str, str]:
    values = (
        one.variant,
        one.excitation,
        number(one.wfe, 4),
        f"{one.difference:.1e}",
        f"{one.from_sag:.1e}",
        f"{one.from_optics:.1e}",
        f"{one.los:.1e}",
        MISSING if np.isnan(one.missed) else f"{one.missed:.1e}",
        number(one.rest) if one.rest else MISSING,
        number(one.standard_s * 1e3),
        number(one.modal_s * 1e3),
    )
    return dict(zip((*_HEADERS, *_COSTS), values, strict=True))


def table_of(store: Path, dataset: xr.Dataset) -> Table:
    """Return the table of a store for the terminal."""
    results = trace_results(dataset)
    caption = answer(results) + what_is_kept(dataset)
    headers = [header for header in (*_HEADERS, *_COSTS) if header not in _ONLY_ON_PAPER]
    table = empty_table(headers, _HEADERS[:2], fixed=True, caption=caption)
    for model in dict.fromkeys(one.model for one in results):
        table.add_row(Text(model, style="bold"))
        for one in results:
            if one.model == model:
                table.add_row(*(Text(_row(one)[header]) for header in headers))
    return table


def page_of(store: Path, dataset: xr.Dataset, device: str) -> Page:
    """Return the HTML report."""
    results = trace_results(dataset)
    return Page(
        answer=answer(results),
        table=[
            {"model": (one.model, ""), **{header: (value, "") for header, value in _row(one).items()}}
            for one in results
        ],
        small_print=_SMALL_PRINT + what_is_kept(dataset),
        overview=[
            picture(
                "cost",
                "Cost of each stage, as in Table 4.1",
                draw.costs(_costs(results)),
                "Processor time per stage: what the faster method saves.",
            )
        ]
        if results
        else [],
        sections=[
            Section(model, list(_figures(dataset, [one for one in results if one.model == model])))
            for model in dict.fromkeys(one.model for one in results)
        ],
        definitions=list(_DEFINITIONS),
        kind="variant",
        left_out=left_out(dataset, ["model", "variant"]),
    )


def _costs(results: Iterable[TraceResult]) -> dict[str, dict[str, float]]:
    """Return seconds by stage for every variant, the means over its excitations."""
    found: dict[str, list[dict[str, float]]] = {}
    for one in results:
        found.setdefault(f"{one.model} {one.variant}", []).append(one.stages)
    return {
        name: {stage: float(np.mean([part[stage] for part in parts])) for stage in parts[0]}
        for name, parts in few(list(found.items()), 40)
    }


def _figures(dataset: xr.Dataset, results: list[TraceResult]) -> Iterable[Picture]:
    for excitation in dict.fromkeys(one.excitation for one in results if has_histories(dataset)):
        mine = [one for one in results if one.excitation == excitation]
        yield picture(
            f"{mine[0].model}-{excitation}",
            f"Wavefront error by both methods, {excitation}",
            draw.both_methods(dataset, excitation, [(one.case, one.variant) for one in few(mine)]),
            "Lines that lie on each other: the linear method is as good as the trace.",
        )
