"""Options of the command line."""

from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer

from wavequake.errors import UserError


def folder_named(text: str) -> Path:
    """Return the folder of that name; raises UserError if it has none, which would be the current folder."""
    if not str(text).strip():
        raise UserError("--store is empty: give the path of a folder, or leave --store out.")
    return store_at(text)


def store_at(text: str) -> Path:
    """Return the place of a store: a folder, or s3://BUCKET/PREFIX."""
    from wavequake.campaign.store.objects import location

    return location(text)


def complete_from(*words: str) -> Callable[[str], list[str]]:
    """Return what offers a shell those of some words that begin as what is typed."""

    def offered(beginning: str) -> list[str]:
        return [word for word in words if word.startswith(beginning)]

    return offered


StoreOption = Annotated[
    Path | None,
    typer.Option(
        "--store", parser=folder_named, metavar="FOLDER", help="Folder of the store, or s3://BUCKET/PREFIX."
    ),
]
OnOption = Annotated[
    str,
    typer.Option(
        help="serial, local, slurm, ssh, kubernetes, or tcp:// or tls://HOST:PORT (docs/clusters.md).",
        autocompletion=complete_from("serial", "local", "slurm", "ssh", "kubernetes", "tcp://", "tls://"),
    ),
]
ClusterOption = Annotated[
    Path | None, typer.Option("--cluster", help="File that describes the cluster (.yaml).")
]
WorkersOption = Annotated[int | None, typer.Option(min=1, help="Worker processes (default: one per CPU).")]
DashboardOption = Annotated[
    bool, typer.Option("--dashboard", help="Serve Dask's dashboard on this machine and show its link.")
]
RecheckOption = Annotated[
    str,
    typer.Option(
        "--recheck", metavar="SHARE", help="Compute this share of the chunks again elsewhere, such as 1%."
    ),
]
