"""The places where a campaign can run, by the name that ``--on`` gives them."""

from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING

from wavequake.cluster.address import connected
from wavequake.cluster.local import local_cluster
from wavequake.cluster.slurm import slurm_cluster
from wavequake.cluster.ssh import ssh_cluster
from wavequake.cluster.template import Address, Slurm, Ssh, read_template
from wavequake.errors import UserError
from wavequake.files import folder

if TYPE_CHECKING:
    from distributed import Client

# Takes the number of worker processes (None: the usual one), and whether the dashboard is wanted.
Opener = Callable[[int | None, bool], AbstractContextManager["Client"]]

KUBERNETES = "tcp://wavequake-scheduler:8786"  # the service of cluster/kubernetes.yaml


def elsewhere(on: str) -> bool:
    """Return whether workers may run other code than this process, because somebody else installed them."""
    return on not in ("serial", "local")


def place_of(on: str, template: Path | None = None) -> Opener | None:
    """Return how to get a Dask client that computes at `on`, or None for "serial".

    Parameters
    ----------
    on : str
        "serial", "local", "slurm", "ssh", "kubernetes", "tcp://HOST:PORT" or "tls://HOST:PORT".
    template : Path, optional
        A cluster file; by default the bundled one for "slurm". "ssh" and "tls://" need one.

    Raises
    ------
    UserError
        If the place is unknown, or its cluster file is missing, not wanted or cannot be used.
    """
    if template and on in ("serial", "local"):
        raise UserError(f"--cluster {template} describes a cluster, which --on {on} does not use.")
    if on == "serial":
        return None
    if on == "local":
        return local_cluster
    if on == "slurm":
        slurm = read_template(Slurm, template or folder("cluster") / "slurm.yaml")
        return lambda workers, dashboard: slurm_cluster(slurm, workers, dashboard)
    if on == "ssh":
        if template is None:
            raise UserError("--on ssh needs --cluster FILE.yaml, which says at least `hosts: [one, two]`.")
        ssh = read_template(Ssh, template)
        return lambda workers, dashboard: ssh_cluster(ssh, dashboard)
    if on == "kubernetes" or on.startswith(("tcp://", "tls://")):
        address = KUBERNETES if on == "kubernetes" else on
        tls = read_template(Address, template).tls if template else None
        if address.startswith("tls://") and tls is None:
            raise UserError(
                f"--on {on} needs --cluster FILE.yaml with the certificates (tls: ca, certificate, key)."
            )
        return lambda workers, dashboard: connected(address, tls=tls)
    raise UserError(
        f"on={on!r} is unknown; use serial, local, slurm, ssh, kubernetes, or the tcp://HOST:PORT or "
        "tls://HOST:PORT of a Dask scheduler."
    )
