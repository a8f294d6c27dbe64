"""What is computed next: the decisions of a run, apart from the workers and the disk that carry them out."""

import re
from collections import deque
from collections.abc import Collection, Iterable, Sequence
from collections.abc import Set as AbstractSet

from wavequake.campaign.engine.driver_lock import Shard
from wavequake.campaign.store.journal import Chunk
from wavequake.errors import UserError


def share_of(text: str | float) -> float:
    """Read a share such as ``1%`` or ``0.01``, or check a number.

    Raises
    ------
    UserError
        If it is no share from 0 to 1.
    """
    share = _read(text) if isinstance(text, str) else text
    if not 0 <= share <= 1:
        raise UserError(f"--recheck {text!r} is no share: write 1% or 0.01, from 0 to 100%.")
    return share


def _read(text: str) -> float:
    match = re.fullmatch(r"(\d{1,9}(?:\.\d{0,9})?|\.\d{1,9})\s*(%?)", text.strip())
    return float(match[1]) / (100 if match[2] else 1) if match else -1.0


def pieces_of(plan: Sequence[Chunk], cases: int, chunk: int, shard: Shard | None) -> list[Chunk]:
    """Return the chunks that a run shall see done: of the first `cases` cases, and of its shard."""
    return [piece for piece in plan if piece[0] < cases and (shard is None or shard.owns(piece, chunk))]


def todo_of(wanted: Sequence[Chunk], done: Collection[Chunk], again: AbstractSet[Chunk]) -> list[Chunk]:
    """Return the chunks to compute: those that no record has, and those to compute again."""
    return [piece for piece in wanted if piece not in done or piece in again]


class Feed:
    """Which chunks wait, which are with the workers, and which are suspects: they killed, or never ended."""

    def __init__(self, todo: Iterable[Chunk], window: int) -> None:
        self._waiting, self._window = deque(todo), window
        self.at_work: dict[int, Chunk] = {}  # by first case
        self.suspects: list[Chunk] = []

    def fill(self) -> list[Chunk]:
        """Return the chunks to hand out now; they count as handed out."""
        count = min(len(self._waiting), self._window - len(self.at_work))
        taken = [self._waiting.popleft() for _ in range(count)]
        self.at_work.update((piece[0], piece) for piece in taken)
        return taken

    def answered(self, first: int) -> Chunk | None:
        """Return the chunk whose answer came; None if it came before, or the chunk was given up."""
        return self.at_work.pop(first, None)

    def suspected(self, first: int) -> Chunk | None:
        """Give up a chunk; returns None if it is not with the workers any more."""
        piece = self.at_work.pop(first, None)
        self.suspects += [piece] if piece else []
        return piece
