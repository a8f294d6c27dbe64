"""What can be said of a study before anything of it is prepared."""

from collections.abc import Iterator

from wavequake.campaign.schema import Study
from wavequake.chain.doubts import doubts
from wavequake.mechanics.disturbances.folded import folded_lines
from wavequake.mechanics.disturbances.population import Population
from wavequake.words import counted
from wavequake.workflows.kinds import find_kind
from wavequake.workflows.systems.out_of_focus import out_of_focus

_OF_INSTANTS = ("system-disturbance", "segment-disturbance")  # their reports draw spectra over instants
_MOST_LISTED = 10_000  # cases; more leave no disturbance out


def early_notices(study: Study) -> Iterator[str]:
    """Yield sentences on doubtful units, disturbances without a case, folded lines, optics out of focus."""
    yield from doubts(study)
    yield from without_cases(study)
    yield from out_of_focus(study)
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
