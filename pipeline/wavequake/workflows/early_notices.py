"""What can be said of a study before anything of it is prepared."""

from collections.abc import Iterator, Mapping
from typing import Any

from wavequake.campaign.schema import Study
from wavequake.mechanics.disturbances.folded import folded_lines
from wavequake.mechanics.disturbances.population import Population
from wavequake.words import counted
from wavequake.workflows.kinds import find_kind
from wavequake.workflows.systems.out_of_focus import out_of_focus

_OF_INSTANTS = ("system-disturbance", "segment-disturbance")  # their reports draw spectra over instants
_MOST_LISTED = 10_000  # cases; more leave no disturbance out
# Largest amplitude of a vibration or misalignment that nobody asks about: a centimeter, a tenth of a radian.
_M, _RAD = (1e-2, "m"), (0.1, "rad")
_UNITS = {
    "nm": (1e-9, _M),
    "um": (1e-6, _M),
    "nrad": (1e-9, _RAD),
    "urad": (1e-6, _RAD),
    "mas": (4.84813681109536e-9, _RAD),
}


def early_notices(study: Study) -> Iterator[str]:
    """Yield sentences on doubtful units, disturbances without a case, optics out of focus."""
    yield from doubts(study)
    yield from without_cases(study)
    yield from out_of_focus(study)


def folded_notices(study: Study) -> Iterator[str]:
    """Yield sentences on lines that spectra of a report will fold: images do not need them."""
    if study.study.workflow in _OF_INSTANTS and study.store.reduce == "none":
        entries: tuple[Population, ...] = getattr(study, "disturbance", ())
        named = (one.name for one in entries if one.share)
        yield from filter(None, (folded_lines(entries, name, study.store.every) for name in named))


def without_cases(study: Study) -> Iterator[str]:
    """Say which disturbances so few cases leave out."""
    entries = [one for one in getattr(study, "disturbance", ()) if getattr(one, "share", 0)]
    if len(entries) < 2 or study.cases > _MOST_LISTED:
        return
    table = find_kind(study.study.workflow).case_table(study.identity_text(), 0, study.cases)
    there = set(table["disturbance"].tolist()) if "disturbance" in table else {one.name for one in entries}
    lacking = [one.name for one in entries if one.name not in there]
    if lacking:
        few = f"{counted(study.cases, 'case')} {'is' if study.cases == 1 else 'are'} too few"
        has = "has" if len(lacking) == 1 else "have"
        yield f"note: {few} for all disturbances: {', '.join(lacking)} {has} none; raise campaign.cases."


def doubts(study: Study) -> Iterator[str]:
    """Yield a sentence for every amplitude of a disturbance whose unit is likely to be mistaken."""
    for entry in study.model_dump().get("disturbance", ()):
        yield from _doubted(entry, f"disturbance.{entry['name']}", "")


def _doubted(value: Any, where: str, unit: str) -> Iterator[str]:
    if isinstance(value, Mapping):
        for key, part in value.items():
            yield from _doubted(
                part, f"{where}.{key}", str(key).rpartition("_")[2] if "_" in str(key) else unit
            )
    elif isinstance(value, list | tuple):
        for place, part in enumerate(value):
            yield from _doubted(part, f"{where}.{place}", unit)
    elif isinstance(value, float) and unit in _UNITS:
        factor, (largest, base) = _UNITS[unit]
        if abs(value) * factor > largest:
            yield f"warning: {where} = {value:g} is {value * factor:.3g} {base}; is {unit} its unit?"
