"""Plan a study: what is behind ``wavequake plan`` and ``wavequake.plan``."""

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from wavequake.campaign.engine.chunk_size import stored_bytes
from wavequake.campaign.schema import Study
from wavequake.campaign.statistics.until import goal_of
from wavequake.campaign.store.retention import stored_template
from wavequake.errors import UserError
from wavequake.kernels.device.devices import choose_device
from wavequake.posix import peak_memory_mb
from wavequake.prepared import one_thread, preparation_seconds
from wavequake.words import counted, lasting, sized
from wavequake.workflows.early_notices import early_notices, folded_notices
from wavequake.workflows.planning.known_times import bundled_times, known_times
from wavequake.workflows.planning.time_limit import OutOfTimeError, time_limit
from wavequake.workflows.run import chunk_of, kind_of, notices
from wavequake.workflows.study import chosen_study

_PILOT_S = 0.05  # a pilot that is shorter says little: it is repeated with more cases
_LONG_S = 2.5  # a pilot of more cases than one takes no longer
_LONGEST_S = 1e8  # that clocks of all systems count
# Engine and store shall take at most 2 % of a chunk; but a chunk is what a crash may cost, and the least that
# a worker takes on.
_CHUNK_S = (2.0, 10.0)
# What a plan does once it knows so much, the last first.
_STEPS = {
    "store": "running first cases",
    "device": "preparing what all cases share",
    "study": "testing the device",
}


def plan(
    study: str | Path | Study,
    seconds: float | None = None,
    *,
    cases: int | None = None,
    store: str | Path | None = None,
    **overrides: Any,
) -> dict[str, str]:
    """Describe what running `study` would take: a pilot of a few cases gives the time; nothing is stored.

    Parameters
    ----------
    study : str, Path or Study
    seconds : float, optional
        Say after this time what is known by then; the estimate is then what an earlier run of the study took,
        or a bundled study where it was measured, or what is left unknown. What is prepared and kept on disk
        is there the next time.
    cases, store, **overrides
        As of `run`, which says what it raises.

    Examples
    --------
    >>> plan("tmt-segments")["cases"]  # doctest: +SKIP
    '1000 in 50 chunks of 20'
    """
    if seconds is not None and not (isinstance(seconds, int | float) and 0.0 < seconds <= _LONGEST_S):
        raise UserError(f"seconds is {seconds!r}; it must be a positive number, or None, which waits.")
    return planned(chosen_study(study, overrides, cases), seconds, store)


def planned(
    study: Study,
    seconds: float | None,
    store: str | Path | None = None,
    last_word: Callable[[dict[str, str]], None] | None = None,
) -> dict[str, str]:
    """As `plan`; with `last_word`, compiled code is not waited for either.

    Then `last_word` is called soon after the time is over, in another thread, with what is known: it ends the
    process.
    """
    known = {"note": "", "study": f"{study.study.name} ({study.identity()[:12]})", "cases": f"{study.cases}"}
    begun = time.perf_counter()

    def late() -> dict[str, str]:
        so_far, spent = dict(known), lasting(time.perf_counter() - begun)
        still = next(words for name, words in _STEPS.items() if name in so_far)
        words = f"{still} was not done after {spent}; --wait (Python: no seconds) waits for it"
        before = known_times(study, study.folder(store))
        told = f"{before.words(study.cases)}; {words}" if before else _without_times(study, words)
        return _said(so_far | {"estimate": told})

    try:
        with time_limit(seconds, last_word and (lambda: last_word(late()))):
            for more in _planned(study):
                known |= more
    except OutOfTimeError:
        return late()
    return _said(known)


def _said(known: dict[str, str]) -> dict[str, str]:
    return {name: words for name, words in known.items() if words}


def _without_times(study: Study, late: str) -> str:
    """Return what is known of the time of a study that nobody has run, with why no more is."""
    like = bundled_times(study.study.name)
    words = f"; as it is bundled, {study.study.name} takes {like.words(study.cases)}" if like else ""
    return f"not known: {late}{words}"


def _planned(study: Study) -> Iterator[dict[str, str]]:
    """Yield what a plan says, as soon as it is known."""
    # First: what is wrong needs no device.
    yield {"note": "\n".join((*early_notices(study), *folded_notices(study)))}
    device = choose_device(study.campaign.device)  # kernels are built for its test
    yield {"device": f"{device.name} ({device.kind})"}
    workflow, text, cases = kind_of(study), study.identity_text(), study.cases
    workflow.check(text)
    template = stored_template(workflow, text)
    chunk = chunk_of(study)
    if study.campaign.until is not None:
        goal_of(study.campaign.until, template)  # says what is wrong with it
    per_case = stored_bytes(template)
    yield {
        "note": "\n".join(notices(study)),
        "cases": f"{cases} in {counted(-(-cases // chunk), 'chunk')} of {min(cases, chunk)}",
        "store": f"{sized(cases * per_case)}, {sized(per_case)} per case",
    }
    yield workflow.describe(text)

    def fly(pilot: int) -> None:
        ids = np.arange(cases - pilot, cases)  # the first ones may be special
        try:
            with one_thread():
                workflow.compute(text, ids, device.name)
        except UserError:
            raise
        except Exception as error:
            more = f"cases of the pilot, {ids[0]} to {ids[-1]}, fail"
            which = f"case of the pilot, {ids[0]}, fails" if pilot == 1 else more
            raise UserError(f"The {which}: {type(error).__name__}: {error}.") from error

    each, pilot = _time_case(fly, min(cases, chunk))
    yield {
        "memory": f"{peak_memory_mb():.0f} MB in the pilot's process, which is what each worker needs",
        "one case": f"{lasting(each)} in one process (pilot of {counted(pilot, 'case')}, after set-up)",
        "one chunk": _chunk_advice(cases, chunk, each),
        "estimate": f"{lasting(cases * each)} of one process",
    }


def _time_case(fly: Callable[[int], None], whole: int) -> tuple[float, int]:
    """Return how long a case takes, s, without what is prepared once, and of how many cases that is the mean.

    `fly` computes so many cases; `whole` are a chunk. One case that takes long is the whole pilot.
    """

    def each_of(pilot: int) -> float:
        start, prepared = time.perf_counter(), preparation_seconds()
        fly(pilot)
        return (time.perf_counter() - start - (preparation_seconds() - prepared)) / pilot

    pilot, each = 1, each_of(1)
    while pilot < whole and 2 * each < _LONG_S:
        if pilot > 1 and each * pilot > _PILOT_S and each * whole > _LONG_S:
            break
        pilot = whole if each * whole < _LONG_S else min(whole, 8 * pilot, int(_LONG_S / each))
        each = each_of(pilot)
    return each, pilot


def _chunk_advice(cases: int, chunk: int, each: float) -> str:
    """Say how long a chunk takes, and if that is unsuitable, which number of cases would do."""
    least, most = _CHUNK_S
    words = f"{each * min(chunk, cases):.3g} s"
    if chunk > 1 and each * chunk > most:
        return f"{words}; a crash costs less with store.chunk_cases={max(1, int(most / each))}"
    if chunk < cases and each * chunk < least and each * cases > 10 * least:
        return f"{words}; the store takes a smaller share with store.chunk_cases={round(least / each)}"
    return words
