"""What studies took before: in a store that an earlier run left, and where bundled ones were measured."""

import json
from dataclasses import dataclass
from pathlib import Path

from wavequake.campaign.schema import Study
from wavequake.campaign.store.journal import read_journal
from wavequake.campaign.store.store import JOURNAL, MANIFEST, done_records, read_manifest
from wavequake.errors import StoreDamageError, UserError
from wavequake.files import folder
from wavequake.words import counted, lasting
from wavequake.workflows.study import bundled_studies, load_study

FILE = "times.json"  # beside the bundled studies; `python -m benchmarks.bundled_times` measures it


@dataclass(frozen=True)
class Times:
    """What a study took before, s: `set_up` once in each process, `each` case; `where` says of what."""

    set_up: float
    each: float
    where: str

    def words(self, cases: int) -> str:
        """Return an estimate for so many cases."""
        once = f" after {lasting(self.set_up)} of set-up" if self.set_up else ""
        return f"{lasting(cases * self.each)} of one process{once}, as {self.where}"


def known_times(study: Study, store: Path) -> Times | None:
    """Return what this very study took before; None if nobody knows."""
    return _of_store(study, store) or (
        bundled_times(study.study.name) if _is_bundled(study, study.study.name) else None
    )


def bundled_times(name: str) -> Times | None:
    """Return what a bundled study takes as it stands, by the file beside it; None if that is of another."""
    path = folder("workflows") / FILE
    known = json.loads(path.read_text(encoding="utf-8"))
    set_up, each, of = known["studies"].get(name, (0.0, 0.0, ""))
    if not of or load_study(name).identity() != of:
        return None
    return Times(set_up, each, f"measured on {known['processor']}")


def _is_bundled(study: Study, name: str) -> bool:
    return name in bundled_studies() and load_study(name).identity() == study.identity()


def _of_store(study: Study, store: Path) -> Times | None:
    if not (store / MANIFEST).exists():
        return None
    try:
        manifest = read_manifest(store)
        records = done_records(manifest, read_journal(store / JOURNAL))
    except (UserError, StoreDamageError):  # a plan needs no store; what runs into it says what is wrong
        return None
    done = sum(last - first for first, last in records)
    spent = sum(
        one.timings.get("compute_s", 0.0) + one.timings.get("write_s", 0.0) for one in records.values()
    )
    if manifest.identity != study.identity() or not spent:
        return None
    return Times(0.0, spent / done, f"{counted(done, 'case')} of {store} took")
