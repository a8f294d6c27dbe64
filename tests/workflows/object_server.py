"""A local S3 server for tests: moto's, which answers one request after the other.

Moto looks at a condition and writes in two steps: with threads, another PUT might come between them. S3
has no such gap, and this has none. A thread for each connection all the same: a client that keeps one open
without a word holds nobody up.
"""

from threading import Lock

from moto.server import create_backend_app
from werkzeug.serving import WSGIRequestHandler, make_server


class Quiet(WSGIRequestHandler):
    def log(self, *_):
        pass


def one_at_a_time(answer):
    """Return a WSGI application that answers as another does, no two requests at once."""
    turn = Lock()

    def answer_in_turn(environ, start_response):
        with turn:
            return list(answer(environ, start_response))

    return answer_in_turn


if __name__ == "__main__":
    app = one_at_a_time(create_backend_app("s3"))  # with all of AWS, it would look for each request's service
    server = make_server("127.0.0.1", 0, app, threaded=True, request_handler=Quiet)
    print(server.server_port, flush=True)
    server.serve_forever()
