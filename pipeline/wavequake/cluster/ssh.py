"""Dask on hosts that are reached by ssh, by Dask's SSHCluster."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from wavequake.cluster.local import SETTINGS, THREADS, UNSET, close, silence
from wavequake.cluster.template import Ssh, tls_settings
from wavequake.errors import UserError

if TYPE_CHECKING:
    from distributed import Client


@contextmanager
def ssh_cluster(template: Ssh, dashboard: bool) -> Iterator["Client"]:
    """Start a scheduler on the first host and workers on every host, yield the client, and end them.

    Hosts must be among the known ones of ssh: nothing is sent to one that cannot prove who it is.

    Raises
    ------
    UserError
        If asyncssh is not installed, a host cannot be reached or is unknown, or a process does not start.
    """
    if find_spec("asyncssh") is None:
        raise UserError("--on ssh needs asyncssh: pip install 'wavequake[ssh]'.")
    import dask
    from distributed import Client, SSHCluster

    silence()
    environment = " ".join(
        [*(f"-u {name}" for name in UNSET), *(f"{name}={value}" for name, value in THREADS.items())]
    )
    worker: dict[str, Any] = {"nthreads": 1, "n_workers": template.processes}
    if template.interface:
        worker["interface"] = template.interface
    with dask.config.set({**SETTINGS, **tls_settings(template.tls)}):
        try:
            cluster = SSHCluster(
                [template.hosts[0], *template.hosts],
                connect_options=connection(template),
                worker_options=worker,
                scheduler_options={
                    "host": template.listen,
                    "port": 0,
                    "dashboard_address": "127.0.0.1:0",
                    "dashboard": dashboard,
                    # A run that is killed cannot end the processes it has started elsewhere.
                    "idle_timeout": "5 minutes",
                },
                remote_python=f"env {environment} {template.python or sys.executable}",
            )
        except Exception as error:  # Dask raises plain exceptions where a process does not start
            raise UserError(f"Dask does not start by ssh on {', '.join(template.hosts)}: {error}.") from None
        try:
            client = Client(cluster, set_as_default=False)
            try:
                _wait(client, template)
                yield client
            finally:
                close(client, 2.0)
        finally:
            close(cluster, 10.0)


def _wait(client: "Client", template: Ssh) -> None:
    try:
        client.wait_for_workers(1, timeout=60)
    except TimeoutError:
        raise UserError(
            f"No worker on {', '.join(template.hosts)} reaches the scheduler at {client.scheduler.address}: "
            "`listen` must be an address of the first host that all of them reach."
        ) from None


def connection(template: Ssh) -> dict[str, Any]:
    """Return how asyncssh connects; what the template leaves open, it takes from where ssh does."""
    options: dict[str, Any] = {"port": template.port}
    if template.user:
        options["username"] = template.user
    if template.key:
        options["client_keys"] = [str(Path(template.key).expanduser())]
    if template.known_hosts:
        options["known_hosts"] = str(Path(template.known_hosts).expanduser())
    return options
