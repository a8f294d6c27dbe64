"""Run and plan a study: the few calls behind ``wavequake run`` and ``wavequake.run``."""

import multiprocessing
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from wavequake.campaign.contract import StudyKind
from wavequake.campaign.engine.chunk_size import default_chunk, stored_bytes
from wavequake.campaign.engine.driver import CampaignSummary, begin_workers, finished, run_campaign
from wavequake.campaign.engine.driver_lock import Shard, shard_of
from wavequake.campaign.engine.scripts import script_hidden
from wavequake.campaign.schema import Study
from wavequake.campaign.statistics.until import Goal, described, goal_of, is_met, looks, quantiles_of
from wavequake.campaign.store.retention import stored_template
from wavequake.campaign.store.store import MANIFEST, open_store, read_manifest
from wavequake.errors import NoWorkersError, UserError
from wavequake.kernels.device.devices import Device, choose_device
from wavequake.kernels.device.threads import available_cpus
from wavequake.posix import peak_memory_mb
from wavequake.prepared import one_thread, preparation_seconds
from wavequake.registry import own_modules
from wavequake.words import counted, lasting
from wavequake.workflows.early_notices import early_notices
from wavequake.workflows.kinds import compared_labels, find_kind
from wavequake.workflows.known_times import bundled_times, known_times
from wavequake.workflows.study import chosen_study
from wavequake.workflows.time_limit import OutOfTimeError, time_limit

if TYPE_CHECKING:
    import xarray as xr

Progress = Callable[[int, int, int], None]

_PILOT_S = 0.05  # a pilot that is shorter says little: it is repeated with more cases
_LONG_S = 2.5  # a pilot of more cases than one takes no longer
# Engine and store shall take at most 2 % of a chunk; but a chunk is what a crash may cost, and the least that
# a worker takes on.
_CHUNK_S = (2.0, 10.0)


def kind_of(study: Study) -> StudyKind:
    """Return the study kind that a study asks for."""
    return find_kind(study.study.workflow)


def finished_study(study: Study, path: Path) -> CampaignSummary | None:
    """Return the summary of a run that finds its store complete; None where there is something to do."""
    if study.campaign.until is not None:
        return None
    return finished(kind_of(study), study.identity_text(), path, study.cases, study.campaign.device)


def run_study(
    study: Study,
    path: Path,
    *,
    on: str = "local",
    workers: int | None = None,
    progress: Progress | None = None,
    repair: bool = False,
    allow_mixed: bool = False,
    dashboard: Callable[[str], None] | None = None,
    shard: Shard | None = None,
    cluster: Path | None = None,
    recheck: float = 0.0,
) -> CampaignSummary:
    """Compute what of `study` the store at `path` lacks; with `repair`, also what is damaged there.

    With `campaign.until`, cases are added until the goal is met, at most `campaign.cases`. Further arguments
    are those of :func:`wavequake.campaign.engine.driver.run_campaign`.

    Raises
    ------
    UserError
        If the store belongs to another study, is in use or cannot be written, the device does not exist, or
        a shard is asked to judge statistics of all cases.
    """
    if shard and study.campaign.until is not None:
        raise UserError("campaign.until judges all cases together, which no shard has: leave out one.")
    workflow = kind_of(study)
    text = study.identity_text()
    begin_workers(workflow, path, on)
    device = choose_device(study.campaign.device)
    workflow.check(text)  # a study that cannot work says so before a store is made or a worker started

    chunk = chunk_of(study, path)

    def run_to(cases: int) -> CampaignSummary:
        return run_campaign(
            workflow,
            text,
            path,
            cases=cases,
            chunk=chunk,
            device=device.name,
            on=on,
            workers=workers,
            progress=progress,
            title=study.study.title,
            timeout_s=study.campaign.timeout_s,
            allow_mixed=allow_mixed,
            repair=repair,
            dashboard=dashboard,
            shard=shard,
            cluster=cluster,
            recheck=recheck,
        )

    if study.campaign.until is None:
        return run_to(study.cases)
    goal = goal_of(study.campaign.until, stored_template(workflow, text))
    return _run_until(goal, study, path, looks(study.cases, chunk), run_to)


def chunk_of(study: Study, path: Path | None = None) -> int:
    """Return the number of cases per chunk: of the store at `path` if there is one, or of a new one."""
    if path is not None and (path / MANIFEST).exists():
        return read_manifest(path).chunk
    if study.store.chunk_cases is not None:
        return study.store.chunk_cases
    return default_chunk(study.cases, stored_template(kind_of(study), study.identity_text()))


def _run_until(
    goal: Goal,
    study: Study,
    path: Path,
    steps: Iterable[int],
    run_to: Callable[[int], CampaignSummary],
) -> CampaignSummary:
    """Add cases until the goal is met; the summary is of all steps together."""
    compared = compared_labels(study.identity_text())
    total: CampaignSummary | None = None
    for cases in steps:
        step = run_to(cases)
        total = step if total is None else total.followed_by(step)
        found = quantiles_of(goal, open_store(path).isel(case=slice(cases)), compared)
        words = "is met" if is_met(goal, found) else "is not met"
        total = replace(
            total,
            goal=(f"{study.campaign.until} {words} after {counted(cases, 'case')}", *described(goal, found)),
        )
        if is_met(goal, found):
            break
    assert total is not None
    return total


def run(
    study: str | Path | Study,
    *,
    cases: int | None = None,
    store: str | Path | None = None,
    on: str | None = None,
    workers: int | None = None,
    allow_mixed: bool = False,
    shard: str | None = None,
    cluster: str | Path | None = None,
    progress: Progress | None = None,
    **overrides: Any,
) -> "xr.Dataset":
    """Run a study and return its results as a labelled lazy dataset.

    Parameters
    ----------
    study : str, Path or Study
        Name of a bundled study, path of a study file, or a loaded study.
    cases : int, optional
        Number of cases (``campaign.cases``). A store that has more already gives all of them.
    store : str or Path, optional
        Folder of the store; by default ``runs/<name>-<identity>``. What it already holds is not computed
        again.
    on : {"serial", "local", "slurm", "ssh", "kubernetes", "tcp://HOST:PORT", "tls://HOST:PORT"}, optional
        Where to run. By default on all CPUs, in worker processes that do not run the calling script again;
        or serially, where there is but one chunk of cases, or workers cannot start, which a line on the
        standard error output says. ``local`` starts worker processes that see what the script defines: it
        then needs ``if __name__ == "__main__"``.
    workers : int, optional
        Worker processes of ``local``; one per CPU by default.
    allow_mixed : bool
        Go on with a store that another version of the code began.
    shard : str, optional
        ``"i/n"``, from ``"0/n"``: compute every n-th chunk only, while n - 1 others compute the rest.
    cluster : str or Path, optional
        A cluster file (``docs/clusters.md``) for ``slurm``, ``ssh`` and ``tls://``.
    progress : callable, optional
        Called with the numbers of cases that are done, wanted and quarantined.
    **overrides
        Further keys with double underscores for dots, e.g. ``optics__wavelength_nm=1000.0``.

    Returns
    -------
    xarray.Dataset
        What :func:`wavequake.open_store` gives.

    Raises
    ------
    UserError
        For a study, a key or a store that cannot be used; says which and what would be right.

    Examples
    --------
    >>> ds = run("tmt-segments", cases=8, optics__wavelength_nm=1000.0)  # doctest: +SKIP
    """
    loaded = chosen_study(study, overrides, cases)
    path = loaded.folder(store)
    part = None if shard is None else shard_of(shard)
    if part is None and finished_study(loaded, path) is not None:
        return open_store(path)
    file = None if cluster is None else Path(cluster)
    how = {"shard": part, "cluster": file, "allow_mixed": allow_mixed, "progress": progress}
    if on is not None:
        run_study(loaded, path, on=on, workers=workers, **how)  # type: ignore[arg-type]
        return open_store(path)
    why = _why_serial(loaded, path, workers)
    if why is None:
        try:
            with script_hidden():
                run_study(loaded, path, on="local", workers=workers, **how)  # type: ignore[arg-type]
            return open_store(path)
        except NoWorkersError as error:
            why = str(error).partition(": ")[0]
    if why:
        print(f"Wavequake runs serially: {why.rstrip('.')}.", file=sys.stderr)
    run_study(loaded, path, on="serial", **how)  # type: ignore[arg-type]
    return open_store(path)


def _why_serial(study: Study, path: Path, workers: int | None) -> str | None:
    """Say why worker processes would not do here, "" if they would be of no use; None if they would."""
    alone = (workers or available_cpus()) < 2 or study.cases <= chunk_of(study, path)
    if alone or choose_device(study.campaign.device).kind == "gpu":
        return ""
    if multiprocessing.current_process().daemon:
        return "this process is a worker itself, and may start no others"
    if own := own_modules():
        return (
            f"workers do not know what {own[0]} has registered; make it a plug-in (docs/extending.md), or "
            "take on='local'"
        )
    return None


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
    study = chosen_study(study, overrides, cases)
    device = choose_device(study.campaign.device)
    known = {"note": "", "study": f"{study.study.name} ({study.identity()[:12]})", "cases": f"{study.cases}"}
    known["device"] = f"{device.name} ({device.kind})"
    begun = time.perf_counter()
    try:
        with time_limit(seconds):
            for more in _planned(study, device):
                known |= more
    except OutOfTimeError:
        still = "a case of the pilot runs" if "store" in known else "what all cases share is prepared"
        late = (
            f"{still} still after {lasting(time.perf_counter() - begun)}; --wait (Python: no seconds) waits"
        )
        before = known_times(study, study.folder(store))
        known["estimate"] = f"{before.words(study.cases)}; {late}" if before else _without_times(study, late)
    return {name: words for name, words in known.items() if words}


def _without_times(study: Study, late: str) -> str:
    """Return what is known of the time of a study that nobody has run, with why no more is."""
    like = bundled_times(study.study.name)
    words = f"; as it is bundled, {study.study.name} takes {like.words(study.cases)}" if like else ""
    return f"not known: {late}{words}"


def _planned(study: Study, device: Device) -> Iterator[dict[str, str]]:
    """Yield what a plan says, as soon as it is known."""
    workflow, text, cases = kind_of(study), study.identity_text(), study.cases
    yield {"note": "\n".join(early_notices(study))}
    workflow.check(text)
    template = stored_template(workflow, text)
    chunk = chunk_of(study)
    if study.campaign.until is not None:
        goal_of(study.campaign.until, template)  # says what is wrong with it
    per_case = stored_bytes(template)
    yield {
        "note": "\n".join(notices(study)),
        "cases": f"{cases} in {counted(-(-cases // chunk), 'chunk')} of {min(cases, chunk)}",
        "store": f"{cases * per_case / 1e6:.1f} MB, {per_case / 1e3:.1f} kB per case",
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


def notices(study: Study) -> Iterator[str]:
    """Yield what the user should read before a run, such as size, mass and doubtful units of a model."""
    yield from early_notices(study)
    yield from kind_of(study).notices(study.identity_text())


def _chunk_advice(cases: int, chunk: int, each: float) -> str:
    """Say how long a chunk takes, and if that is unsuitable, which number of cases would do."""
    least, most = _CHUNK_S
    words = f"{each * min(chunk, cases):.3g} s"
    if chunk > 1 and each * chunk > most:
        return f"{words}; a crash costs less with store.chunk_cases={max(1, int(most / each))}"
    if chunk < cases and each * chunk < least and each * cases > 10 * least:
        return f"{words}; the store takes a smaller share with store.chunk_cases={round(least / each)}"
    return words
