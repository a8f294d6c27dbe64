"""Dask on hosts that are reached by ssh, by Dask's SSHCluster."""

import asyncio
import secrets
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from wavequake.cluster.certificate import make_certificate, make_security
from wavequake.cluster.local import THREADS, UNSET, close, prepare_driver, settings
from wavequake.cluster.scratch import SETTING
from wavequake.cluster.template import Ssh, tls_paths, tls_settings
from wavequake.errors import UserError

if TYPE_CHECKING:
    from distributed import Client, SSHCluster
    from distributed.security import Security

_ATTEMPTS = 5


@contextmanager
def ssh_cluster(template: Ssh, dashboard: bool) -> Iterator["Client"]:
    """Start a scheduler on the first host and workers on every host, yield the client, and end them.

    Hosts must be among the known ones of ssh: nothing is sent to one that cannot prove who it is. Without
    certificates in the template, one is made for this run and sent to the hosts by ssh.

    Raises
    ------
    UserError
        If asyncssh is not installed, a host cannot be reached or is unknown, or a process does not start.
    """
    if find_spec("asyncssh") is None:
        raise UserError("--on ssh needs asyncssh: pip install asyncssh.")
    import dask
    from distributed import SSHCluster

    prepare_driver()
    environment = " ".join(
        [*(f"-u {name}" for name in UNSET), *(f"{name}={value}" for name, value in THREADS.items())]
    )
    worker: dict[str, Any] = {"nthreads": 1, "n_workers": template.processes}
    if template.interface:
        worker["interface"] = template.interface
    with _on_all_hosts(template) as (own, security), dask.config.set(settings(dashboard) | own):
        try:
            cluster = SSHCluster(
                [template.hosts[0], *template.hosts],
                connect_options=connection(template),
                worker_options=worker,
                scheduler_options={
                    "host": template.listen,
                    "port": 0,
                    "protocol": "tls://",
                    "dashboard_address": "127.0.0.1:0",
                    "dashboard": dashboard,
                    # A run that is killed cannot end the processes it has started elsewhere.
                    "idle_timeout": "5 minutes",
                },
                remote_python=f"env {environment} {template.python or sys.executable}",
                security=security,
            )
        except Exception as error:  # Dask raises plain exceptions where a process does not start
            raise _unreachable(template, error) from None
        try:
            client = _client(cluster, template)
            try:
                _wait(client, template)
                yield client
            finally:
                close(client, 2.0)
        finally:
            close(cluster, 10.0)


@contextmanager
def _on_all_hosts(template: Ssh) -> Iterator[tuple[dict[str, object], "Security"]]:
    """Yield Dask's settings for the hosts, and what this process shows to them.

    A folder on every host, which only its user can write, has Dask's files, and the certificate of the run if
    the template names none.
    """
    import dask
    from distributed.security import Security

    certificate = None if template.tls else make_certificate()
    folder = f"/tmp/wavequake-run-{secrets.token_hex(16)}"
    # Two names may mean one host, where it is there already; made by somebody else, it is refused.
    own = f"umask 077; mkdir -p {folder} && test -O {folder} && test ! -L {folder}"
    if certificate is None:
        _on_hosts(template, own)
    else:
        _on_hosts(template, f"{own} && cat > {folder}/run.pem", "".join(certificate))
    try:
        if certificate is None:
            tls = tls_settings(template.tls)
            with dask.config.set(tls):
                security = Security()
        else:
            tls, security = tls_paths(*[f"{folder}/run.pem"] * 3), make_security(certificate)
        yield tls | {SETTING: folder}, security
    finally:
        _on_hosts(template, f"rm -rf {folder}")


def _on_hosts(template: Ssh, command: str, text: str = "") -> None:
    """Run `command` on every host, with `text` as its input: command lines can be read by everybody there."""
    import asyncssh

    async def run(host: str) -> None:
        async with asyncssh.connect(host, **connection(template)) as reached:
            await reached.run(f"sh -c '{command}'", input=text, check=True, timeout=60)

    async def run_all() -> None:
        await asyncio.gather(*(run(host) for host in dict.fromkeys(template.hosts)))

    try:
        with ThreadPoolExecutor(1) as thread:  # of its own: this one may have a running loop, as in notebooks
            thread.submit(asyncio.run, run_all()).result()
    except (OSError, asyncssh.Error) as error:
        raise _unreachable(template, error) from None


def _unreachable(template: Ssh, error: Exception) -> UserError:
    return UserError(f"Dask does not start by ssh on {', '.join(template.hosts)}: {error}.")


def _client(cluster: "SSHCluster", template: Ssh) -> "Client":
    """Connect; a connection may break as it is made (`wavequake.cluster.local.CONNECTIONS_BREAK`)."""
    from distributed import Client
    from distributed.comm import CommClosedError

    for _ in range(_ATTEMPTS - 1):
        with suppress(CommClosedError):
            return Client(cluster, set_as_default=False)
    try:
        return Client(cluster, set_as_default=False)
    except CommClosedError as error:
        raise _unreachable(template, error) from None


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
