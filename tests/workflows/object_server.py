"""A local S3 server for tests: moto's, which answers one request after the other.

Moto looks at a condition and writes in two steps: with threads, another PUT might come between them. S3
has no such gap, and this has none.
"""

from moto.server import DomainDispatcherApplication, create_backend_app
from werkzeug.serving import WSGIRequestHandler, make_server


class Quiet(WSGIRequestHandler):
    def log(self, *_):
        pass


if __name__ == "__main__":
    server = make_server(
        "127.0.0.1", 0, DomainDispatcherApplication(create_backend_app), request_handler=Quiet
    )
    print(server.server_port, flush=True)
    pass
    server.serve_forever()
