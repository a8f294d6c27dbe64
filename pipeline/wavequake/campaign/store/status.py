"""How far a store is, and why cases of it have no numbers."""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from wavequake.campaign.contract import STATUS_MEANINGS
from wavequake.campaign.store.journal import read_journal
from wavequake.campaign.store.objects import location
from wavequake.campaign.store.store import JOURNAL, Manifest, done_records, read_manifest
from wavequake.words import counted


@dataclass(frozen=True, repr=False)
class StoreStatus:
    """How far a store is.

    ``counts[s]`` is the number of cases with status s, 0 being what is still to do; ``codes`` is the number
    of chunks that each version of the code computed.
    """

    path: Path
    manifest: Manifest
    counts: tuple[int, ...]
    chunks_done: int
    failures: Mapping[int, tuple[int, str]]
    torn: int
    codes: Mapping[str, int]

    def __repr__(self) -> str:
        return "\n".join(self.lines())

    @property
    def quarantined(self) -> int:
        """Number of cases that ended without valid numbers."""
        return sum(self.counts[2:])

    def lines(self, most: int = 20) -> list[str]:
        """Return the status in words; at most `most` quarantined cases are listed."""
        meanings = STATUS_MEANINGS.split()
        manifest, chunks = self.manifest, len(self.manifest.plan())
        lines = [
            f"{self.path}: {manifest.workflow}, study {manifest.identity[:12]}, device {manifest.device}",
            f"{counted(manifest.cases, 'case')} in {counted(chunks, 'chunk')} of {manifest.chunk}; "
            f"{self.chunks_done} {'is' if self.chunks_done == 1 else 'are'} done",
            ", ".join(f"{count} {word}" for word, count in zip(meanings, self.counts, strict=True) if count),
        ]
        lines += [
            f"case {case} {meanings[code]}: {text}"
            for case, (code, text) in sorted(self.failures.items())[:most]
        ]
        if len(self.failures) > most:
            lines.append(f"... and {len(self.failures) - most} more (open_store(...).message has them all)")
        if len(self.codes) > 1:
            lines.append("mixed: several versions computed this store (--allow-mixed)")
            lines += [
                f"  {counted(count, 'chunk')} by {code or 'an unknown one'}"
                for code, count in self.codes.items()
            ]
        if self.torn:
            lines.append(
                f"{counted(self.torn, 'record')} of the journal cut off by a crash, not counted (harmless)"
            )
        return lines


def store_status(path: Path | str) -> StoreStatus:
    """Count what the journal of a store says is done, quarantined and still to do.

    Raises
    ------
    UserError
        If there is no store at `path`.
    StoreDamageError
        If its manifest is damaged or its journal contradicts itself.
    """
    path = location(path)
    manifest = read_manifest(path)
    journal = read_journal(path / JOURNAL)
    done = done_records(manifest, journal)
    counts = [
        sum(record.counts[code] for record in done.values()) for code in range(len(STATUS_MEANINGS.split()))
    ]
    counts[0] = manifest.cases - sum(counts)
    codes = dict(Counter(record.code for record in done.values()).most_common())
    failures = {case: failure for record in done.values() for case, failure in record.failures.items()}
    return StoreStatus(path, manifest, tuple(counts), len(done), failures, journal.torn, codes)
