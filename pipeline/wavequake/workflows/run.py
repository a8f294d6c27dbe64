"""Run a study: the few calls behind ``wavequake run`` and ``wavequake.run``."""

import multiprocessing
import sys
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from wavequake.campaign.contract import StudyKind
from wavequake.campaign.engine.chunk_size import default_chunk
from wavequake.campaign.engine.driver import CampaignSummary, begin_workers, finished, run_campaign
from wavequake.campaign.engine.driver_lock import Shard, shard_of
from wavequake.campaign.engine.plan import share_of
from wavequake.campaign.engine.scripts import script_hidden
from wavequake.campaign.schema import Study
from wavequake.campaign.statistics.until import Goal, described, goal_of, is_met, looks, quantiles_of
from wavequake.campaign.store.retention import stored_template
from wavequake.campaign.store.store import MANIFEST, open_store, read_manifest
from wavequake.errors import NoWorkersError, UserError
from wavequake.kernels.device.devices import choose_device
from wavequake.kernels.device.threads import available_cpus
from wavequake.registry import own_modules
from wavequake.words import counted
from wavequake.workflows.early_notices import early_notices
from wavequake.workflows.kinds import compared_labels, find_kind
from wavequake.workflows.study import chosen_study

if TYPE_CHECKING:
    import xarray as xr

Progress = Callable[[int, int, int], None]


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
    repair: bool = False,
    recheck: float | str = 0.0,
    dashboard: Callable[[str], None] | None = None,
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
    repair : bool
        Read all results first and compute damaged chunks again.
    recheck : float or str
        Compute this share of the chunks again elsewhere, such as ``"1%"``; one of other numbers is an error.
    dashboard : callable, optional
        Serve Dask's dashboard on this machine and call this with its link.
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
    share = share_of(recheck)
    if part is None and not repair and not share and finished_study(loaded, path) is not None:
        return open_store(path)
    how: dict[str, Any] = {
        "shard": part,
        "cluster": None if cluster is None else Path(cluster),
        "allow_mixed": allow_mixed,
        "repair": repair,
        "recheck": share,
        "dashboard": dashboard,
        "progress": progress,
    }
    if on is not None:
        run_study(loaded, path, on=on, workers=workers, **how)
        return open_store(path)
    why = _why_serial(loaded, path, workers)
    if why is None:
        try:
            with script_hidden():
                run_study(loaded, path, on="local", workers=workers, **how)
            return open_store(path)
        except NoWorkersError as error:
            why = str(error).partition(": ")[0]
    if why:
        print(f"Wavequake runs serially: {why.rstrip('.')}.", file=sys.stderr)
    run_study(loaded, path, on="serial", **how)
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


def notices(study: Study) -> Iterator[str]:
    """Yield what the user should read before a run, such as size, mass and doubtful units of a model."""
    yield from early_notices(study)
    yield from kind_of(study).notices(study.identity_text())
