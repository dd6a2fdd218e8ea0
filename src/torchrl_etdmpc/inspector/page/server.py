"""Serving: on this machine's own address, to requests by its name."""

from __future__ import annotations

import errno
import socket
import threading
from collections.abc import Callable
from typing import Any

LOOPBACK = ("127.0.0.1", "localhost", "::1")


def serve(
    app: Any,
    *,
    host: str = "127.0.0.1",
    port: int = 8050,
    allow_remote: bool = False,
    ready: Callable[[str, Callable[[], None]], None] | None = None,
) -> None:
    """Serves a page until it is stopped.

    Args:
        app (dash.Dash): of :func:`make_page`.

    Keyword Args:
        host (str): address to listen on. Default: ``"127.0.0.1"``.
        port (int): 0 takes a free one. Default: 8050.
        allow_remote (bool): whether ``host`` may be another address than this machine's own.
        ready (callable, optional): called with the page's address and a function that stops serving.

    Raises:
        ValueError: if ``host`` can be reached from other machines and that is not allowed.
        OSError: if the port is in use.
    """
    from werkzeug.serving import WSGIRequestHandler, make_server

    class Quiet(WSGIRequestHandler):
        def log_request(self, code: Any = "-", size: Any = "-") -> None:
            pass

    if host not in LOOPBACK and not allow_remote:
        raise ValueError(
            f"host must be this machine's own address, 127.0.0.1, got {host!r}: anybody who reaches the page can make "
            "this machine plan and write files; add allow_remote=true if that is meant."
        )
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with socket.socket(family, socket.SOCK_STREAM) as listening:
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            listening.bind((host, port))
            listening.listen()
        except OSError as error:
            if isinstance(error, socket.gaierror) or error.errno == errno.EADDRNOTAVAIL:
                raise OSError(f"host={host} is no address of this machine ({error.strerror}).") from error
            other = port + 1 if port < 65_535 else 8_050
            raise OSError(
                f"port={port} cannot be used ({error.strerror}); choose another one, e.g. port={other}."
            ) from error
        number = listening.getsockname()[1]
        server = make_server(host, number, app.server, threaded=True, request_handler=Quiet, fd=listening.fileno())
        try:
            if ready is not None:
                address = f"http://{f'[{host}]' if ':' in host else host}:{number}/"
                ready(address, lambda: threading.Thread(target=server.shutdown).start())
            server.serve_forever()
        finally:
            server.server_close()


def answer_this_machine_only(server: Any) -> None:
    """Refuses requests by another name: a site that points its own name at this machine is not to use the page."""
    from flask import abort, request

    @server.before_request
    def check() -> None:
        name = (
            request.host.rsplit(":", 1)[0].strip("[]") if not request.host.endswith("]") else request.host.strip("[]")
        )
        if name not in LOOPBACK:
            abort(403)
