"""Which reduced models of bodies or segments are good enough: their errors, by disturbance."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import xarray as xr
from matplotlib import rc_context
from matplotlib.figure import Figure

from wavequake.campaign.contract import DONE
from wavequake.report.figures import COLORS, STYLE, one_panel
from wavequake.report.page import Picture, picture
from wavequake.report.table import number
from wavequake.workflows.mirrors.compared_models import ComparedSection

_MARKS = "osD^v<>Pp*"


@dataclass(frozen=True)
class ModelResult:
    """The rms over cases of the error of a model under a disturbance, at its worst field point.

    ``share`` is in parts of what the disturbance does.
    """

    disturbance: str
    model: str
    share: float


def model_results(dataset: xr.Dataset, variants: Sequence[str]) -> list[ModelResult]:
    """Return the errors of the variants of which cases are done, by disturbance."""
    names, models = (
        np.array([str(one) for one in dataset[key].to_numpy()]) for key in ("disturbance", "reduction")
    )
    done = dataset["status"].to_numpy() == DONE
    errors = dataset["model_error"].transpose("case", ...).to_numpy()
    found = []
    for name in dict.fromkeys(names.tolist()):
        for model in variants:
            rows = np.flatnonzero(done & (names == name) & (models == model))
            if len(rows):
                share = float(np.sqrt(np.mean(errors[rows] ** 2, axis=0)).max())
                found.append(ModelResult(name, model, share))
    return found


def verdict(found: Sequence[ModelResult], largest: float) -> str:
    """Say which models are good enough under all disturbances; nothing if none are compared."""
    if not found:
        return ""
    worst: dict[str, ModelResult] = {}
    for one in found:
        if one.model not in worst or one.share > worst[one.model].share:
            worst[one.model] = one
    good = [f"{name} ({_percent(one)})" for name, one in worst.items() if one.share <= largest]
    bad = [
        f"{name} ({_percent(one)}, {one.disturbance})" for name, one in worst.items() if one.share > largest
    ]
    limit = f"{number(100.0 * largest)} %"
    if not good:
        return f" No reduced model is good to {limit} of the motion: {', '.join(bad)}."
    words = (
        f" Reduced models that are good to {limit} of the motion under every disturbance: {', '.join(good)}"
    )
    return words + (f"; not so {', '.join(bad)}." if bad else ".")


def _percent(one: ModelResult) -> str:
    return f"{number(100.0 * one.share, 2)} %"


def compared_models(dataset: xr.Dataset, section: ComparedSection | None) -> tuple[str, list[Picture]]:
    """Return the verdict on the models that a store compares, and the figure of their errors.

    Nothing of both, where its study has no such section.
    """
    found = model_results(dataset, section.variants) if section is not None else []
    if section is None or not found:
        return "", []
    figure = picture(
        "models",
        "Errors of reduced models",
        errors_figure(found, section.largest),
        "Each mark is a disturbance: rms of the error of line of sight or wavefront, the larger one, "
        "in parts of what the disturbance does. Below the line a model is good enough.",
    )
    return verdict(found, section.largest), [figure]


@rc_context(STYLE)
def errors_figure(found: Sequence[ModelResult], largest: float) -> Figure:
    """Draw the errors of every model, a mark for each disturbance."""
    figure, axes = one_panel()
    models = list(dict.fromkeys(one.model for one in found))
    for index, name in enumerate(dict.fromkeys(one.disturbance for one in found)):
        mine = {one.model: one.share for one in found if one.disturbance == name}
        axes.plot(
            [models.index(model) for model in mine],
            list(mine.values()),
            linestyle="none",
            marker=_MARKS[index % len(_MARKS)],
            color=COLORS[index % len(COLORS)],
            label=name,
        )
    axes.axhline(largest, color="#444444", linewidth=0.8)
    axes.set_yscale("log")
    axes.set_xticks(range(len(models)), models)
    axes.set_ylabel("error relative to the motion")
    axes.legend()
    return figure
