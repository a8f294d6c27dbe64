"""A pure function over many pieces of work, in this process or on Dask's workers, without a store."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from wavequake.cluster.local import leave_if_imported_by_a_worker
from wavequake.cluster.places import place_of
from wavequake.errors import UserError

Piece = TypeVar("Piece")
Result = TypeVar("Result")


@dataclass(frozen=True)
class Place:
    """Where work is done: ``on``, ``workers`` and ``cluster`` as of `wavequake run`."""

    on: str = "serial"
    workers: int | None = None
    cluster: Path | None = None


HERE = Place()


def mapped(
    function: Callable[[Any, Piece], Result],
    shared: Any,
    pieces: Sequence[Piece],
    place: Place = HERE,
) -> Iterator[tuple[Piece, Result]]:
    """Yield every piece with ``function(shared, piece)``, as they come; where they are done changes no bit.

    Parameters
    ----------
    function : callable
        Of a module, so that it travels by name.
    shared : object
        What all pieces need.
    pieces : sequence
    place : Place

    Raises
    ------
    UserError
        If the place is unknown or goes away.
    """
    leave_if_imported_by_a_worker()
    opener = place_of(place.on, place.cluster)
    if opener is None or not pieces:
        for piece in pieces:
            yield piece, function(shared, piece)
        return
    from concurrent.futures import CancelledError

    from distributed import as_completed
    from distributed.scheduler import KilledWorker

    with opener(place.workers and min(place.workers, len(pieces)), False) as client:
        futures = {
            client.submit(function, shared, piece, key=("piece", index), pure=False): piece
            for index, piece in enumerate(pieces)
        }
        try:
            for future in as_completed(futures, loop=client.loop):
                yield futures[future], future.result()
        except KilledWorker as death:
            raise UserError(f"A worker died over its work ({death}); run the same command again.") from None
        except CancelledError:
            raise UserError(
                "The Dask scheduler went away; what is done is kept, so run the same command again."
            ) from None
