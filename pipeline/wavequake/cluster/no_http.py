"""Close the HTTP server that every scheduler and worker of Dask opens: it asks nobody who they are.

Dask calls this in each process before it joins the others (its settings ``distributed.*.preload``).
"""

from typing import Any


def dask_setup(server: Any) -> None:
    """Stop to serve HTTP in `server`, a scheduler or worker."""
    server.http_server.stop()
    server.services.pop("dashboard", None)
