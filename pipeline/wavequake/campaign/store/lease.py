"""Who is at work on a store in object storage: a table that changes by conditional writes, and heartbeats.

The table says who holds the store. Each holder writes an object of its own again and again; who finds the
store held watches that object by its own stopwatch, and takes one that no longer changes for dead. No two
clocks are compared. A holder that was wrongly taken for dead (it was stopped) is shut out by the fence.
"""

import json
import threading
import time
import uuid
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field

from wavequake.campaign.store.objects import ObjectPath, change, overwrite, versions
from wavequake.errors import UserError

TABLE, BEATS = "lock", "beats"
BEAT_S, EXPIRY_S = 2.0, 20.0
_LOOK_S = 0.1


@dataclass(frozen=True)
class Holder:
    """Who holds a shard ("": the whole store), in words."""

    shard: str
    words: str


@dataclass(frozen=True)
class Table:
    """The holders of a store by their ids, and which of them prepares it, "" if none does."""

    holders: Mapping[str, Holder] = field(default_factory=dict)
    preparing: str = ""

    def rivals(self, shard: str) -> dict[str, Holder]:
        """Return the holders beside which a run of `shard` may not begin."""
        return {
            one: holder
            for one, holder in self.holders.items()
            if not (shard and holder.shard and holder.shard != shard) or one == self.preparing
        }

    def without(self, gone: Collection[str]) -> "Table":
        """Return the table without some holders."""
        holders = {one: holder for one, holder in self.holders.items() if one not in gone}
        return Table(holders, "" if self.preparing in gone else self.preparing)


def read_table(content: bytes | None) -> Table:
    """Return the table in an object; an empty one if it is missing or damaged."""
    try:
        entry = json.loads(content or b"{}")
        found = entry["holders"].items()
        holders = {str(one): Holder(str(shard), str(words)) for one, (shard, words) in found}
        return Table(holders, str(entry["preparing"]))
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError):
        return Table()


def _text(table: Table) -> bytes:
    holders = {one: [holder.shard, holder.words] for one, holder in table.holders.items()}
    return json.dumps({"holders": holders, "preparing": table.preparing}).encode()


@contextmanager
def held(path: ObjectPath, shard: str, words: str) -> Iterator[tuple[str, ExitStack]]:
    """Hold a store; yield the holder's id and what ends its time to prepare the store when it is closed.

    Raises
    ------
    UserError
        If somebody else is at work on it, or on the shard.
    """
    own = uuid.uuid4().hex
    with _beating(path / BEATS / own), ExitStack() as left:
        _join(path, own, Holder(shard, words))
        left.callback(_leave, path, own)
        with ExitStack() as setup:
            setup.callback(_edit, path, lambda table: Table(table.holders, _others(table.preparing, own)))
            yield own, setup


def others_of(path: ObjectPath, own: str) -> dict[str, Holder]:
    """Return the other holders of a store that are alive; those that are not lose it."""
    table = _table(path)
    living = alive(path, table.holders.keys() - {own})
    dead = table.holders.keys() - living - {own}
    if dead:
        table = _edit(path, lambda now: now.without(dead))
    return {one: holder for one, holder in table.holders.items() if one != own}


def alive(path: ObjectPath, holders: Collection[str]) -> set[str]:
    """Return which holders' hearts beat; watches each until it has, or for EXPIRY_S."""
    beats = {path / BEATS / one: one for one in holders}
    first = versions(list(beats))
    waiting = {beat for beat in beats if first[beat] is not None}
    found: set[str] = set()
    end = time.monotonic() + EXPIRY_S
    while waiting and time.monotonic() < end:
        time.sleep(_LOOK_S)
        now = versions(list(waiting))
        changed = {beat for beat in waiting if now[beat] not in (first[beat], None)}
        found |= {beats[beat] for beat in changed}
        waiting = {beat for beat in waiting - changed if now[beat] is not None}
    return found


def _join(path: ObjectPath, own: str, holder: Holder) -> None:
    while True:
        rivals = _table(path).rivals(holder.shard)
        if rivals:
            living = alive(path, rivals)
            dead = rivals.keys() - living
            table = _edit(path, lambda now, gone=dead: now.without(gone))  # type: ignore[misc]
            for one in living & table.rivals(holder.shard).keys():
                if one != table.preparing or holder.shard in ("", rivals[one].shard):
                    words = f"{path} is in use by {rivals[one].words}"
                    raise UserError(f"{words}: wait for it, or choose another --store.")

        def joined(table: Table) -> Table:
            free = not table.rivals(holder.shard)
            return Table({**table.holders, own: holder}, own) if free else table

        if own in _edit(path, joined).holders:
            return


def _leave(path: ObjectPath, own: str) -> None:
    with suppress(OSError, UserError):  # who cannot say that it leaves is found dead
        _edit(path, lambda table: table.without({own}))


def _others(preparing: str, own: str) -> str:
    return "" if preparing == own else preparing


def _table(path: ObjectPath) -> Table:
    try:
        return read_table((path / TABLE).read_bytes())
    except FileNotFoundError:
        return Table()


def _edit(path: ObjectPath, edited: Callable[[Table], Table]) -> Table:
    return read_table(change(path / TABLE, lambda content: _text(edited(read_table(content)))))


@contextmanager
def _beating(beat: ObjectPath) -> Iterator[None]:
    """Write an object that nobody else writes, again and again, until this ends."""
    overwrite(beat, b"0")
    over = threading.Event()

    def work() -> None:
        count = 0
        while not over.wait(BEAT_S):
            count += 1
            with suppress(OSError, UserError):  # the next one may come through
                overwrite(beat, b"%d" % count)

    thread = threading.Thread(target=work, name="heartbeat", daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()
        with suppress(OSError, UserError):
            beat.unlink()
