"""How much of a result's variance is what is not known of the structure, and how much is excitation."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure
from numpy.typing import NDArray

from wavequake.campaign.statistics.parted import Parted, parted
from wavequake.report.figures import COLORS, HEIGHT, STYLE, one_panel
from wavequake.report.page import Picture, picture

Array = NDArray[np.float64]


@dataclass(frozen=True)
class PartedResult:
    """The parts of the variance of a quantity under a disturbance, rms of a case at its worst place."""

    disturbance: str
    quantity: str
    parts: Parted


def parted_results(
    populations: Iterable[tuple[str, Mapping[str, Array], NDArray[np.int64] | None]],
) -> list[PartedResult]:
    """Return the parts for all disturbances; none where models are known, or no cases share one.

    Parameters
    ----------
    populations : iterable of (str, mapping of str to ndarray of shape (C, place), ndarray of shape (C,))
        Of each disturbance its name, numbers of its cases by what they are, of which the worst place counts,
        and which cases share a model; None where that is not said.
    """
    found = []
    for name, quantities, models in populations:
        for words, values in quantities.items():
            if models is None or not len(values):
                continue
            parts = parted(values[:, int(values.mean(axis=0).argmax())], models)
            if parts is not None:
                found.append(PartedResult(name, words, parts))
    return found


def sentence(found: Sequence[PartedResult]) -> str:
    """Say for which result the model counts most."""
    if not found:
        return ""
    one = max(found, key=lambda result: result.parts.share)
    return (
        f" What is not known of the structure makes up at most {one.parts.share:.0%} of the variance "
        f"between cases ({one.parts.low:.0%} to {one.parts.high:.0%}; {one.quantity}, {one.disturbance}); "
        "the rest is excitation."
    )


def pictures(found: Sequence[PartedResult]) -> Iterator[Picture]:
    """Yield the figure of all parts."""
    if found:
        yield picture(
            "variance-parts",
            "Variance between cases: excitation and model",
            parts_figure(found),
            "Of the rms of a case, of systems at the worst field; bars: 95 % intervals over "
            f"{found[0].parts.models} models. What the model has shrinks by measuring the structure, what "
            "excitation has does not.",
        )


@rc_context(STYLE)
def parts_figure(found: Sequence[PartedResult]) -> Figure:
    """Draw the share of the model in every variance."""
    figure, axes = one_panel(height=0.25 * HEIGHT + 0.22 * len(found))
    at = np.arange(len(found))
    shares = 100.0 * np.array([one.parts.share for one in found])
    ends = 100.0 * np.array([[one.parts.low, one.parts.high] for one in found])
    axes.barh(at, shares, color=COLORS[1], label="model")
    axes.barh(at, 100.0 - shares, left=shares, color="#cccccc", label="excitation")
    off = np.maximum(np.abs(ends.T - shares), 0.0)
    axes.errorbar(shares, at, xerr=off, fmt="none", ecolor="black", capsize=2, linewidth=0.8)
    axes.set_yticks(at, [f"{one.disturbance}, {one.quantity}" for one in found])
    axes.invert_yaxis()
    axes.set_xlim(0.0, 100.0)
    axes.set_xlabel("share of the variance (%)")
    axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
    return figure
