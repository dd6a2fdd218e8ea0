"""How a page is served: at once where one was served before."""

from __future__ import annotations

import socket
import threading
import types

import pytest

pytest.importorskip("dash")

from flask import Flask  # noqa: E402

from torchrl_etdmpc.inspector.page.server import serve  # noqa: E402


def test_a_port_is_served_again_right_after_it_was_given_back():
    app, ports, answers = types.SimpleNamespace(server=Flask(__name__)), [], []
    app.server.add_url_rule("/", view_func=lambda: "here")

    def ask(address, stop):
        ports.append(int(address.strip("/").rsplit(":", 1)[1]))
        with socket.create_connection(("127.0.0.1", ports[-1])) as connection:
            connection.sendall(b"GET / HTTP/1.0\r\nHost: 127.0.0.1\r\n\r\n")
            with connection.makefile("rb") as answer:
                answers.append(answer.read())  # until the server closes, which keeps its port for a minute
        stop()

    for _ in range(2):
        port = ports[0] if ports else 0
        serve(app, port=port, ready=lambda *told: threading.Thread(target=ask, args=told).start())
    assert [answer.endswith(b"here") for answer in answers] == [True, True]
    assert ports[0] == ports[1]
