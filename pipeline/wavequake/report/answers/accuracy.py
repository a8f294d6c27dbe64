"""What a study takes to be as accurate as wanted: rays, terms, light, order and cases, from a pilot."""

import math
import re
import shlex
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy.stats import norm

from wavequake.campaign.schema import Study
from wavequake.campaign.statistics.quantiles import CONFIDENCE
from wavequake.campaign.statistics.refinement import refinement_error
from wavequake.errors import UserError
from wavequake.kernels.device.devices import choose_device
from wavequake.report.answers.errors import Key, Sampled, cases_again, numbers_of, reduction_errors
from wavequake.report.plain import Row
from wavequake.report.table import number
from wavequake.workflows.kinds import compared_labels, find_kind
from wavequake.workflows.refinements import LINEAR, RAYS, REDUCTION, Refinement

Array = NDArray[np.float64]

_FORM = re.compile(r"\s*(\d+(?:\.\d+)?(?:[eE][-+]?\d+)?)\s*(%?)\s*")
_EACH, _SPREAD = 4, 24  # cases of each population that are refined, and from whose scatter cases are counted
_QUANTILE = 0.95
_MOST_RAYS = 1_000_000
_COUNTS = 0.01  # share of the largest median from which a field, wavelength or term counts
_LEAST = 1e-3  # scatter of cases that is none


@dataclass(frozen=True)
class Proposal:
    """What is proposed of one origin: a line, and the keys that a study lacks for it."""

    origin: str
    words: str
    keys: dict[str, object]


def accuracy_of(text: str) -> float:
    """Read ``1 %`` or ``0.01``; UserError if it is no share between 0 and 1."""
    match = _FORM.fullmatch(text)
    value = float(match[1]) * (0.01 if match[2] else 1.0) if match else math.nan
    if not 0.0 < value < 1.0:
        raise UserError(f"The accuracy {text!r} is no share between 0 and 1; write it as '1 %'.")
    return value


def plan_accuracy(
    study: Study, accuracy: float, measure: str | None = None, asked: Sequence[str] = ()
) -> dict[str, str]:
    """Return what a study takes for an accuracy of a measure, in lines of its plan.

    Parameters
    ----------
    study : Study
    accuracy : float
        Largest error by each origin, in parts of the median; of sampling half the 95 % interval of the 95 %
        quantile over cases, of which a study that draws them near a limit has none.
    measure : str, optional
        By default ``wfe_rms``, or else the first that there is.
    asked : sequence of str
        The study and its overrides, as the user named them.

    Raises
    ------
    UserError
        If there is no such measure, or the pilot's cases fail.
    """
    rare = getattr(study, "rare", None) is not None
    if rare:  # other rays or terms would draw other cases near the limit
        study = study.model_copy(update={"rare": None})
    kind, text = find_kind(study.study.workflow), study.identity_text()
    device = choose_device(study.campaign.device).name
    every = min(study.cases, 10_000)
    table = kind.case_table(text, 0, every)
    names = [name for name in compared_labels(text) if name in table]
    labels = np.array(["/".join(map(str, row)) for row in zip(*(table[name] for name in names), strict=True)])
    labels = labels if len(labels) else np.full(every, "all cases")
    groups = {name: np.flatnonzero(labels == name) for name in dict.fromkeys(labels.tolist())}
    pilot = np.sort(np.concatenate([places[:_SPREAD] for places in groups.values()]))
    values = numbers_of(kind, text, pilot, device)
    name = _chosen(values, measure)
    keys = [key for key in values if key[0] == name]
    mine = {group: np.flatnonzero(labels[pilot] == group) for group in groups}
    levels = {group: {key: _level(values[key][places]) for key in keys} for group, places in mine.items()}
    if not any(level > 0.0 for one in levels.values() for level in one.values()):
        raise UserError(f"{name} is zero or fails in all {len(pilot)} cases of the pilot: nothing to refine.")
    ids = np.sort(np.concatenate([places[:_EACH] for places in groups.values()]))
    groups_again = {group: np.flatnonzero(labels[ids] == group) for group in groups}
    found = [_refined(one, keys, groups_again, levels, accuracy) for one in cases_again(study, ids, device)]
    coords = {label: ("case", values_of[pilot]) for label, values_of in table.items()}
    found += _reduced(xr.Dataset({}, coords), values, keys, mine, levels, accuracy)
    shares = {group: len(places) / every for group, places in groups.items()}
    if not rare:
        found.append(_cases(study, values, keys, mine, levels, accuracy, shares))
    over = "of cases that are not drawn near the limit" if rare else "P95 over cases"
    changed = {key: value for one in found for key, value in one.keys.items()}
    kept = [one for one in asked[1:] if one.partition("=")[0].strip() not in changed]
    words = [*(asked[:1] or [study.study.name]), *kept, *(f"{key}={value}" for key, value in changed.items())]
    command = shlex.join(["wavequake", "run", *words])
    return {
        "accuracy": f"{_percent(accuracy)} of {name} by each origin; {over}",
        **{one.origin: one.words for one in found},
        "proposal": command if changed else "the study is as accurate as that",
    }


def _chosen(values: dict[Key, Array], measure: str | None) -> str:
    names = list(dict.fromkeys(name for name, _ in values))
    if measure is None:
        return "wfe_rms" if "wfe_rms" in names else names[0]
    if measure not in names:
        raise UserError(f"There is no measure {measure!r} to be accurate; use one of {', '.join(names)}.")
    return measure


def _level(values: Array) -> float:
    known = values[np.isfinite(values)]
    return float(np.abs(np.median(known))) if known.size else 0.0


def _counting(levels: dict[Key, float]) -> list[Key]:
    """Return the places that are not negligible."""
    return [key for key, level in levels.items() if 0.0 < level >= _COUNTS * max(levels.values())]


def _refined(
    sampled: Sampled,
    keys: list[Key],
    groups: dict[str, NDArray[np.int64]],
    levels: dict[str, dict[Key, float]],
    accuracy: float,
) -> Proposal:
    """Return what is proposed of one refinement: the worst population and place count."""
    one = sampled.refinement
    if sampled.trouble:
        return Proposal(one.origin, f"not measured: {sampled.trouble}", {})
    worst = [0.0] * len(one.counts)  # of the error at each step
    orders, settled = list[float](), True
    for group, places in groups.items():
        for key in _counting(levels[group]):
            if any(key not in step for step in sampled.values):
                continue
            values = np.array([step[key][places] for step in sampled.values])
            values = values[:, np.isfinite(values).all(axis=0)]
            for base in range(len(one.counts)) if values.size else ():
                refined = refinement_error(one.counts, values, base)
                share = refined.error / levels[group][key]
                if share > worst[base]:
                    worst[base] = share
                if share > accuracy and base == one.base:
                    settled &= refined.settled
                    orders += [refined.order] if np.isfinite(refined.order) else []
    now = worst[one.base]
    if one.origin == REDUCTION:
        return _of_models(one, worst, accuracy)
    given = one.steps[one.base].get(one.key, "")
    setting = f"{one.key}={given}" if given != "" else "optics.light=modal"
    if now <= accuracy:
        return Proposal(one.origin, f"{setting} suffices ({_percent(now)})", {})
    if one.origin == LINEAR:
        words = f"the modal model errs by {_percent(now)}: optics.light=traced"
        return Proposal(one.origin, words, {"optics.light": "traced"})
    if one.origin != RAYS or not settled or not orders or one.key != "optics.rays":
        good = [count for count, share in zip(one.counts, worst, strict=True) if share <= accuracy]
        best = int(good[0]) if good and settled else int(one.counts[-1])
        # Two steps say how far they are apart, and not how far the last is from the truth.
        known = bool(good) and settled and (len(one.counts) > 2 or best < one.counts[-1])
        sure = "" if known else ", which may not suffice: plan that one again"
        return Proposal(one.origin, f"{setting} errs by {_percent(now)}: {best}{sure}", {one.key: best})
    wanted = one.counts[one.base] * (now / accuracy) ** (1.0 / min(orders))
    if wanted > _MOST_RAYS:
        return Proposal(
            one.origin, f"{setting} errs by {_percent(now)}, and {_MOST_RAYS} do not suffice either", {}
        )
    best = _rounded_up(wanted)
    return Proposal(one.origin, f"{setting} errs by {_percent(now)}: {best}", {one.key: best})


def _of_models(one: Refinement, worst: Sequence[float], accuracy: float) -> Proposal:
    """Return which order of the models that a study takes suffices."""
    words = [", ".join(f"{key}={value}" for key, value in step.items()) for step in one.steps]
    if worst[one.base] <= accuracy:
        return Proposal("order", f"{words[one.base]} suffices ({_percent(worst[one.base])})", {})
    best = next(k for k, share in enumerate(worst) if share <= accuracy)  # the last is the full model
    said = f"{words[one.base]} errs by {_percent(worst[one.base])}: {words[best]}"
    if best < len(words) - 1:
        said += f" ({_percent(worst[best])})"
    return Proposal("order", said, dict(one.steps[best]))


def _reduced(
    labels: xr.Dataset,
    values: dict[Key, Array],
    keys: list[Key],
    groups: dict[str, NDArray[np.int64]],
    levels: dict[str, dict[Key, float]],
    accuracy: float,
) -> list[Proposal]:
    """Return which reduced model suffices, if there are some to choose from."""
    errors = reduction_errors(labels, [Row(*key, "", values[key]) for key in keys])
    if not errors:
        return []
    models, shares = labels["reduction"].to_numpy(), dict[str, float]()
    for group, places in groups.items():
        flags: NDArray[np.bool_] = np.isin(np.arange(len(models)), places)
        for key in _counting(levels[group]):
            model = str(models[places[0]])
            share = errors[key](flags) / levels[group][key]
            shares[model] = max(shares.get(model, 0.0), share if np.isfinite(share) else 0.0)
    shares.pop("full", None)
    good = [f"{model} ({_percent(share)})" for model, share in shares.items() if share <= accuracy]
    least = min(shares, key=lambda model: shares[model])
    words = (
        f"{', '.join(good)} suffice{'s' if len(good) == 1 else ''}"
        if good
        else f"none suffices; {least} errs by {_percent(shares[least])}: raise its order, or take full"
    )
    return [Proposal("order", words, {})]


def _cases(
    study: Study,
    values: dict[Key, Array],
    keys: list[Key],
    groups: dict[str, NDArray[np.int64]],
    levels: dict[str, dict[Key, float]],
    accuracy: float,
    shares: dict[str, float],
) -> Proposal:
    """Return how many cases give the 95 % quantile of the population that needs most.

    From the scatter of the pilot's logarithms, and from what populations have of the cases, which those of a
    sweep have at every point.
    """
    wanted, asked = 0.0, study.campaign.cases
    for group, places in groups.items():
        scatter = _LEAST
        for key in _counting(levels[group]):
            known = np.abs(values[key][places])
            known = known[np.isfinite(known) & (known > 0.0)]
            if known.size > 2:
                scatter = max(scatter, float(np.log(known).std(ddof=1)))
        own = shares[group] * study.cases / asked
        wanted = max(wanted, cases_for_quantile(scatter, _QUANTILE, accuracy) / own)
    whole, now = _rounded_up(wanted), accuracy * math.sqrt(wanted / asked)
    if whole <= asked:
        return Proposal("cases", f"campaign.cases={asked} suffice ({_percent(now)})", {})
    words = f"campaign.cases={asked} give P95 to {_percent(now)}: {whole} ({len(groups)} populations)"
    words = words.replace(" (1 populations)", "")
    return Proposal("cases", words, {"campaign.cases": whole})


def cases_for_quantile(scatter: float, probability: float, accuracy: float) -> float:
    """Return how many independent cases know a quantile to a share of itself, by 95 % confidence.

    Of a lognormal distribution whose logarithm has the standard deviation `scatter`: the error of the share
    below the quantile over its density there.
    """
    width = norm.isf((1.0 - CONFIDENCE) / 2.0) * math.sqrt(probability * (1.0 - probability))
    density = norm.pdf(norm.ppf(probability)) / scatter  # of the logarithm
    return float((width / density / accuracy) ** 2)


def _rounded_up(value: float) -> int:
    """Return the next number of two digits."""
    step = 10.0 ** max(math.floor(math.log10(max(value, 1.0))) - 1, 0)
    return int(math.ceil(value / step - 1e-9) * step)


def _percent(share: float) -> str:
    return f"{number(100.0 * share, 2)} %" if share >= 1e-5 or share == 0.0 else "< 0.001 %"
