"""Who may see a page: asked over real HTTP and WebSocket, on a server that runs."""

from __future__ import annotations

import http.client
import socket
from collections.abc import Iterator

import pytest
import viser
import websockets.asyncio.server
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect
from websockets.typing import Origin, Subprotocol

from acquisition.web import Address, page_server
from dataset.errors import ToolkitError

TOKEN = "open-sesame-0123456789"


def free_port() -> int:
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        port: int = listener.getsockname()[1]
        return port


@pytest.fixture(scope="module")
def with_token() -> Iterator[Address]:
    """A page that listens on every network."""
    address = Address("0.0.0.0", free_port(), TOKEN)
    with page_server(address, "guarded"):
        yield address


@pytest.fixture(scope="module")
def local() -> Iterator[Address]:
    """A page for this computer."""
    address = Address(port=free_port())
    with page_server(address, "local"):
        yield address


def get(address: Address, path: str = "/", **headers: str) -> http.client.HTTPResponse:
    connection = http.client.HTTPConnection("127.0.0.1", address.port, timeout=10)
    connection.request("GET", path, headers=headers)
    response = connection.getresponse()
    response.read()
    return response


def websocket_status(address: Address, origin: str | None = None, **headers: str) -> int:
    """101 where a WebSocket opens, else the answer."""
    try:
        with connect(
            f"ws://127.0.0.1:{address.port}/",
            subprotocols=[Subprotocol(f"viser-v{viser.__version__}")],
            additional_headers=headers,
            origin=None if origin is None else Origin(origin),
            max_size=None,
        ) as websocket:
            assert len(websocket.recv(timeout=10)) > 0
            return 101
    except InvalidStatus as refused:
        return refused.response.status_code


@pytest.mark.parametrize("path", ["/", "/index.html", "/?token=", "/?token=wrong", f"/{TOKEN}"])
def test_a_request_without_the_token_is_refused(with_token: Address, path: str) -> None:
    assert get(with_token, path).status == 401


@pytest.mark.parametrize(
    "headers",
    [
        {"Authorization": "Bearer wrong"},
        {"Authorization": f"Basic {TOKEN}"},
        {"Cookie": "s2p3=x; =;"},
        {"Cookie": f"token={TOKEN}"},
    ],
)
def test_nor_does_another_header_let_in(with_token: Address, headers: dict[str, str]) -> None:
    assert get(with_token, **headers).status == 401
    assert websocket_status(with_token, **headers) == 401


def test_the_token_in_the_address_is_answered_by_a_cookie_that_lets_in(with_token: Address) -> None:
    answer = get(with_token, f"/?token={TOKEN}")
    assert (answer.status, answer.getheader("Location")) == (303, "/")
    cookie = str(answer.getheader("Set-Cookie"))
    assert "HttpOnly" in cookie
    assert "SameSite=Strict" in cookie
    pair = cookie.split(";")[0]
    assert get(with_token, Cookie=pair).status == 200
    assert websocket_status(with_token, Cookie=pair) == 101


def test_a_script_gives_the_token_as_a_header(with_token: Address) -> None:
    assert get(with_token, Authorization=f"Bearer {TOKEN}").status == 200
    assert websocket_status(with_token, Authorization=f"Bearer {TOKEN}") == 101


def test_a_websocket_without_the_token_is_refused(with_token: Address) -> None:
    assert websocket_status(with_token) == 401


def test_the_redirect_never_leads_elsewhere(with_token: Address) -> None:
    assert get(with_token, f"//evil.example/?token={TOKEN}").getheader("Location") == "/"


def test_this_computer_needs_no_token(local: Address) -> None:
    assert get(local).status == 200
    assert websocket_status(local) == 101
    assert websocket_status(local, origin=f"http://127.0.0.1:{local.port}") == 101


def test_another_sites_page_may_not_connect(local: Address) -> None:
    assert websocket_status(local, origin="http://evil.example") == 403
    assert websocket_status(local, origin=f"http://127.0.0.1:{local.port + 1}") == 403


@pytest.mark.parametrize("host", ["evil.example", "evil.example:8080", "192.168.1.5", ""])
def test_a_name_that_was_bent_to_this_computer_is_refused(local: Address, host: str) -> None:
    assert get(local, Host=host).status == 403


@pytest.mark.parametrize("host", ["localhost:9000", "127.0.0.1", "[::1]:9000"])
def test_a_tunnel_to_this_computer_is_let_in(local: Address, host: str) -> None:
    assert get(local, Host=host).status == 200


def test_a_taken_port_is_named(local: Address) -> None:
    refused = pytest.raises(ToolkitError, match=f"port {local.port} of 127.0.0.1 cannot be served")
    with refused, page_server(local, "second"):
        pass
    assert get(local).status == 200


def test_the_guard_is_nobody_elses(local: Address) -> None:
    assert websockets.asyncio.server.serve.__name__ == "serve"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"host": "0.0.0.0"}, "give a --token"),
        ({"host": "192.168.10.4"}, "give a --token"),
        ({"host": "lab-pc"}, "give a --token"),
        ({"token": "short"}, "16 characters or more"),
        ({"host": "0.0.0.0", "token": "with space and ; semicolon"}, "16 characters or more"),
        ({"port": 0}, "--port 0 does not exist"),
        ({"port": 65536}, "--port 65536 does not exist"),
    ],
)
def test_an_address_that_would_be_unsafe_is_refused(arguments: dict[str, object], message: str) -> None:
    with pytest.raises(ToolkitError, match=message):
        Address(**arguments)  # type: ignore[arg-type]


def test_the_url_opens_the_page() -> None:
    assert Address("::1", 81, TOKEN).url == f"http://[::1]:81/?token={TOKEN}"
    assert Address().url == "http://127.0.0.1:8080/"
