"""Addresses of servers: names that no external page can have, ports, URLs and warnings."""

import pytest

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.server.address import (
    bound_socket,
    free_port,
    is_loopback,
    names_this_computer,
    url_of,
    warning_for,
)

NAMES = ("--host", "--port")


@pytest.mark.parametrize(
    ("header", "bound", "is_ours"),
    [
        ("localhost:8080", "0.0.0.0", True),
        ("192.168.0.7:8080", "0.0.0.0", True),
        ("[fe80::1]:8080", "::", True),
        ("desktop", "0.0.0.0", True),
        ("desktop.lan:80", "0.0.0.0", True),
        ("desktop.local", "192.168.0.7", True),
        ("scenes.example.org", "scenes.example.org", True),
        ("evil.example.org", "0.0.0.0", False),
        ("evil.example.org:8080", "192.168.0.7", False),
        ("1.2.3.4.example.org", "0.0.0.0", False),
        ("192.168.0.7", "127.0.0.1", False),
        ("desktop", "127.0.0.1", False),
        ("localhost", "127.0.0.1", True),
        ("", "0.0.0.0", False),
        ("a b", "0.0.0.0", False),
        ("localhost:8080/", "0.0.0.0", False),
    ],
)
def test_only_names_of_this_computer_are_accepted(header, bound, is_ours):
    assert names_this_computer(header, bound) is is_ours


def test_a_port_that_is_taken_is_named():
    with bound_socket("127.0.0.1", 0, NAMES) as first:
        port = first.getsockname()[1]
        says = f"^--port: {port} is in use on 127.0.0.1; choose another port, or 0 for any free one$"
        with pytest.raises(ArgumentError, match=says):
            bound_socket("127.0.0.1", port, NAMES)
        with pytest.raises(ArgumentError, match=says):
            free_port("127.0.0.1", port, NAMES)
    assert free_port("127.0.0.1", port, NAMES) == port, "a closed server frees its port"


@pytest.mark.parametrize(
    ("host", "port", "says"),
    [
        ("127.0.0.1", 70_000, "--port: is 70000, but has to be a whole number from 0 to 65535"),
        ("127.0.0.1", -1, "--port: is -1"),
        ("no such host", 0, "--host: 'no such host' is not an address"),
        ("a" * 300, 0, "--host: '"),
        ("", 0, "--host: '' is not an address"),
        ("203.0.113.1", 0, "--host: cannot listen on 203.0.113.1"),  # an address reserved for documentation
    ],
)
def test_an_unusable_address_is_a_one_line_error(host, port, says):
    for ask_for in (bound_socket, free_port):
        with pytest.raises(ArgumentError) as caught:
            ask_for(host, port, NAMES)
        assert str(caught.value).startswith(says) and "\n" not in str(caught.value)


def test_a_free_port_is_free():
    port = free_port("127.0.0.1", 0, NAMES)
    with bound_socket("127.0.0.1", port, NAMES) as bound:
        assert bound.getsockname()[1] == port


def test_only_addresses_beyond_this_computer_give_a_warning():
    for host in ("127.0.0.1", "127.3.2.1", "localhost", "::1"):
        assert is_loopback(host) and warning_for(host, "sees it") is None
    for host in ("0.0.0.0", "::", "192.168.0.7", "example.org"):
        said = warning_for(host, "sees it")
        assert said.startswith(f"warning: listening on {host}: anyone who can reach") and "\n" not in said


def test_urls():
    assert url_of("::1", 80) == "http://[::1]:80/"
    assert url_of("::", 80) == "http://[::1]:80/"
    assert url_of("localhost", 81) == "http://localhost:81/"
