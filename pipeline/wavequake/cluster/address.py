"""Dask that somebody else runs, at the address of its scheduler."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from wavequake.cluster.local import close, prepare_driver
from wavequake.cluster.template import Tls, tls_settings
from wavequake.errors import UserError

if TYPE_CHECKING:
    from distributed import Client


@contextmanager
def connected(address: str, timeout_s: float = 10.0, tls: Tls | None = None) -> Iterator["Client"]:
    """Connect to the scheduler at `address` and yield the client once there is a worker.

    With `tls`, both sides prove by their certificates who they are. Workers must see the store under the
    same path, and have the same versions installed.

    Raises
    ------
    UserError
        If nothing answers at `address`, or no worker comes in time.
    """
    import dask
    from distributed import Client
    from distributed.security import Security

    prepare_driver()
    try:
        with dask.config.set(tls_settings(tls)):
            client = Client(address, timeout=timeout_s, security=Security(), set_as_default=False)
    except (OSError, TimeoutError, ValueError) as error:
        raise UserError(f"No Dask scheduler answers at {address} ({error}).") from None
    try:
        try:
            client.wait_for_workers(1, timeout=3 * timeout_s)
        except TimeoutError:
            raise UserError(
                f"The Dask scheduler at {address} has no workers; start some with `dask worker`."
            ) from None
        yield client
    finally:
        close(client, 2.0)
