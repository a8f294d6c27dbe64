"""What looks after stores, and begins studies: the command of the same name prints what these return."""

import warnings
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from wavequake.errors import UserError
from wavequake.notebook import progress_bar

if TYPE_CHECKING:
    import pandas as pd

    from wavequake.campaign.engine.driver import CampaignSummary
    from wavequake.campaign.store.status import StoreStatus
    from wavequake.optics.systems.system import OpticalSystem
    from wavequake.report.exports.rerun import CaseRerun


def new(source: str | Path, file: str | Path | None = None) -> Path:
    """Write a commented study file of what a name, lens file or finite-element model holds; return its path.

    Parameters
    ----------
    source : str or Path
        Name of a bundled study, system or telescope, a lens file (.zmx), or a model (.sti).
    file : str or Path, optional
        By default ``NAME.toml`` in the current folder.

    Raises
    ------
    UserError
        If there is no such thing, it cannot be read, or the file exists.

    Warns
    -----
    UserWarning
        If something has to be set in the file before it runs, such as a node set of the model.

    Examples
    --------
    >>> new("double-gauss", "my-lens.toml")  # doctest: +SKIP
    """
    from wavequake.workflows.new_study import new_study

    path, to_edit = new_study(str(source), None if file is None else Path(file))
    if to_edit:
        warnings.warn(f"{path.name} has to be edited before it runs: {to_edit}", stacklevel=2)
    return path


def info(what: "str | Path | OpticalSystem", glass: str | Path | None = None, **overrides: Any) -> str:
    """Return in words what a system, telescope, mirror, study or file of another program is or holds.

    Parameters
    ----------
    what : str, Path or OpticalSystem
        Name of a system, telescope or study, a lens file, catalogue of glasses, deck, file of matrices or of
        results at nodes, a study file, or a system.
    glass : str or Path, optional
        Catalogue of glasses for a lens file (.agf), before all others.
    **overrides
        Keys of a study with double underscores for dots.

    Raises
    ------
    UserError
        If there is no such thing, it cannot be read, or glasses or keys are given for a system.

    Examples
    --------
    >>> print(info("euv").splitlines()[0][:3])
    euv
    """
    from wavequake.drawing.draw import described_study
    from wavequake.optics.systems.info import info as table
    from wavequake.workflows.systems.source import described

    if not isinstance(what, str | Path):
        if glass is not None or overrides:
            raise UserError("A system has its glasses and numbers; give them to load_system.")
        return table(what)
    keys = [f"{key.replace('__', '.')}={value}" for key, value in overrides.items()]
    catalogue = None if glass is None else Path(glass)
    return described_study(str(what), keys) or described(str(what), keys, catalogue)


def status(store: str | Path) -> "StoreStatus":
    """Say what of a store is done, quarantined (and why) and still to do.

    Returns
    -------
    StoreStatus
        ``counts`` by status, ``failures`` by case, ``quarantined``; ``lines()`` are the words.

    Raises
    ------
    UserError
        If there is no store.
    StoreDamageError
        If its manifest or journal is damaged.

    Examples
    --------
    >>> status("runs/tmt-segments-1a2b3c4d").quarantined  # doctest: +SKIP
    0
    """
    from wavequake.campaign.store.status import store_status

    return store_status(store)


def retry(
    store: str | Path,
    statuses: str = "raised,crashed,timed_out,diverged",
    *,
    on: str = "serial",
    workers: int | None = None,
    cluster: str | Path | None = None,
    dashboard: Callable[[str], None] | None = None,
) -> "CampaignSummary":
    """Compute quarantined cases of a store again, with the others of their chunks.

    Parameters
    ----------
    store : str or Path
    statuses : str
        Which failed cases, by name or number of their status.
    on, workers, cluster, dashboard
        As of `run`.

    Returns
    -------
    CampaignSummary
        ``chunks`` were computed, ``quarantined`` cases are left.

    Raises
    ------
    UserError
        If there is no store or status, or the store is in use.
    StoreDamageError
        If a case that was done comes out with other numbers.

    Examples
    --------
    >>> retry("runs/tmt-segments-1a2b3c4d", "crashed").quarantined  # doctest: +SKIP
    0
    """
    from wavequake.campaign.engine.rerun import retry_store
    from wavequake.campaign.engine.rerun import statuses as codes
    from wavequake.campaign.store.store import read_manifest
    from wavequake.workflows.kinds import find_kind

    wanted, kind = codes(statuses), find_kind(read_manifest(store).workflow)
    file = None if cluster is None else Path(cluster)
    with progress_bar() as progress:
        return retry_store(
            kind,
            store,
            wanted,
            on=on,
            workers=workers,
            progress=progress,
            cluster=file,
            dashboard=dashboard,
        )


def rerun(store: str | Path, case: int, file: str | Path | None = None) -> "CaseRerun":
    """Compute one case again in full detail and compare its bits with the store, which is not changed.

    Parameters
    ----------
    store : str or Path
    case : int
    file : str or Path, optional
        Where its numbers go (.nc), by default ``STORE/case-ID.nc``.

    Returns
    -------
    CaseRerun
        ``differing`` names variables of other bits, ``trouble`` is why it failed, ``file`` has the numbers.

    Raises
    ------
    UserError
        If there is no store or case, or the file cannot be written.

    Examples
    --------
    >>> rerun("runs/tmt-segments-1a2b3c4d", 7).differing  # doctest: +SKIP
    ()
    """
    from wavequake.report.exports.rerun import rerun_stored

    return rerun_stored(Path(store), case, None if file is None else Path(file))


def rank(store: str | Path, by: str) -> "pd.DataFrame":
    """Rank the disturbances of a store by any of its numbers, the costliest first: `report --by`.

    Parameters
    ----------
    store : str or Path
    by : str
        A number that the store keeps, such as ``"ee80"``.

    Returns
    -------
    pandas.DataFrame
        A row per population: ``median`` over cases, ``far`` (the P95, or the P5 of what is bad where it is
        small), ``worst``.

    Raises
    ------
    UserError
        If there is no such number, or no case is finished.

    Examples
    --------
    >>> rank("runs/tmt-segments-1a2b3c4d", "ee80")  # doctest: +SKIP
    """
    from dataclasses import asdict

    import pandas as pd

    from wavequake.report.answers.ranking import ranking

    found = ranking(store, by)
    return pd.DataFrame([{**asdict(one), "units": found.unit} for one in found.found])


def devices() -> "pd.DataFrame":
    """Return the devices that kernels can run on, and how far each is from the NumPy twin.

    Returns
    -------
    pandas.DataFrame
        A row per device: ``result`` is the largest difference of its self test, mm, or why it is unusable.

    Examples
    --------
    >>> devices()["kind"].iloc[-1]  # doctest: +SKIP
    'numpy'
    """
    import pandas as pd

    from wavequake.kernels.device.devices import self_tests

    rows = [(one.name, one.kind, one.platform, said) for one, said in self_tests()]
    return pd.DataFrame(rows, columns=["device", "kind", "platform", "result"])


def profile(store: str | Path) -> dict[str, str]:
    """Say where the time of a store's chunks went, kind by kind and kernel by kernel: `run --profile`.

    Parameters
    ----------
    store : str or Path

    Raises
    ------
    UserError
        If there is no store.

    Examples
    --------
    >>> profile("runs/tmt-segments-1a2b3c4d")  # doctest: +SKIP
    """
    from wavequake.report.answers.profile import profile as spent

    return spent(store)
