"""The server's begin and end: Ctrl-C ends it without a complaint, and one that cannot begin says so."""

import re
import signal
import socket

import pytest

from gsplat_edu.server.serving import Server
from processes import Program
from waiting import PATIENCE, until

SERVE = """
import sys
from gsplat_edu.server import page_server, serving
serving.GRACEFUL = 0.1
with page_server.PageServer() as server:
    server.page = bytes(64 << 20)
    try:
        server.run(server.application(), lambda: print(server.url, flush=True))
    except KeyboardInterrupt:
        print("ended", flush=True)
"""
"""Serves a page that no socket's buffers hold."""


@pytest.mark.own_process
def test_ctrl_c_ends_a_server_although_a_browser_does_not_read(tmp_path):
    program = Program(SERVE, [], tmp_path)
    try:
        until(lambda: not program.runs or "\n" in program.said())
        port = int(re.fullmatch(r"http://127\.0\.0\.1:(\d+)/\n", program.said())[1])
        with socket.create_connection(("127.0.0.1", port), timeout=PATIENCE) as connection:
            connection.sendall(b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n")
            assert connection.recv(100).startswith(b"HTTP/1.1 200")
            program.send(signal.SIGINT)
            code, said, complaints = program.ended(PATIENCE)
        assert (code, complaints) == (0, "") and said.endswith("/\nended\n")
    finally:
        program.process.kill()
        program.process.join()


async def broken(scope, receive, send):
    """An application that does not start."""
    await receive()
    await send({"type": "lifespan.startup.failed", "message": "broken"})


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_a_server_whose_application_does_not_start_says_so():
    with Server() as server:
        with pytest.raises(RuntimeError, match="ended before it answered"):
            server.start(broken)
        port = server.port
    with Server(port=port):
        pass
