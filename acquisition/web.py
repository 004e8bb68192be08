"""A page in the browser, served by viser, behind a check that viser itself does not have.

Without a token a page is for this computer alone: it listens on the loopback network, and refuses requests
under another host name and from other sites' pages, which a browser would otherwise pass on. On any other
network every request, the WebSocket included, must carry the token.
"""

from __future__ import annotations

import contextlib
import hmac
import inspect
import io
import ipaddress
import re
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from http import HTTPStatus
from http.cookies import CookieError, SimpleCookie
from typing import TYPE_CHECKING, Any
from urllib.parse import parse_qs, urlsplit

from dataset.errors import ToolkitError

if TYPE_CHECKING:
    import viser
    from websockets.http11 import Request, Response

_TOKEN = re.compile(r"[A-Za-z0-9_-]{16,}")
_constructing = threading.Lock()


@dataclass(frozen=True)
class Address:
    """Where a page listens, and who may see it.

    Attributes:
        host: address to listen on; anything but the loopback network needs a token.
        port: TCP.
        token: what a request must carry; None only on the loopback network.

    Raises:
        ToolkitError: another network without a token, a token that is easily guessed, or no such port.
    """

    host: str = "127.0.0.1"
    port: int = 8080
    token: str | None = None

    def __post_init__(self) -> None:
        if not 0 < self.port < 65536:
            raise ToolkitError(f"--port {self.port} does not exist; give one from 1024 to 65535")
        if self.token is None and not is_loopback(self.host):
            raise ToolkitError(
                f"--host {self.host} shows the page to the network: give a --token of 16 letters and digits "
                "or more that its users must know, or leave --host out to serve this computer only"
            )
        if self.token is not None and not _TOKEN.fullmatch(self.token):
            raise ToolkitError(
                "--token must be 16 characters or more, letters, digits, '-' and '_'; for example the output "
                "of: python3 -c 'import secrets; print(secrets.token_urlsafe())'"
            )

    @property
    def url(self) -> str:
        """What to open in a browser, token included."""
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"http://{host}:{self.port}/" + (f"?token={self.token}" if self.token else "")


@contextmanager
def page_server(address: Address, title: str) -> Iterator[viser.ViserServer]:
    """A viser server at an address, guarded, for the length of a `with` block.

    Raises:
        ToolkitError: viser is not installed or too different from the one this was written for, the host
            is no address, or the port is taken.
    """
    try:
        import viser
    except ImportError as error:
        raise ToolkitError(
            "pages in the browser need viser, which is not installed; run: pip install 's2p3[console]'"
        ) from error

    try:
        socket.getaddrinfo(address.host, address.port)  # viser would go on asking for ever
    except (OSError, UnicodeError) as error:
        raise ToolkitError(f"--host {address.host} is no address; give one of this computer") from error

    class Server(viser.ViserServer):
        """Never opens viser's tunnel to the public internet, which any client may ask for."""

        def request_share_url(self, verbose: bool = True) -> None:
            del verbose

    # Its constructor and its end print advice of their own.
    with contextlib.redirect_stdout(io.StringIO()), _guarded(address) as guards:
        server = Server(host=address.host, port=address.port, label=title, verbose=False)
    try:
        if not guards:
            raise ToolkitError(
                f"viser {viser.__version__} serves in a way that cannot be guarded; install viser 1.1"
            )
        if server.get_port() != address.port:
            raise ToolkitError(
                f"port {address.port} of {address.host} cannot be served (taken, or no address of this "
                "computer); give another --port or --host"
            )
        yield server
    finally:
        with contextlib.redirect_stdout(io.StringIO()):
            server.stop()


@contextmanager
def _guarded(address: Address) -> Iterator[list[bool]]:
    """While viser's constructor runs, its server is made with our check in front of its own handler.

    viser offers no hook for requests; it calls `websockets.asyncio.server.serve` by that name. Yields a list
    that is not empty when it did.
    """
    import websockets.asyncio.server as websockets_server

    serve = websockets_server.serve
    guards: list[bool] = []

    def guarded_serve(*arguments: Any, process_request: Callable[..., Any], **options: Any) -> Any:
        async def check(connection: Any, request: Request) -> Response | None:
            refusal = refuse(address, request)
            if refusal is not None:
                return refusal
            answer = process_request(connection, request)
            return await answer if inspect.isawaitable(answer) else answer

        guards.append(True)
        return serve(*arguments, process_request=check, **options)

    with _constructing:
        websockets_server.serve = guarded_serve  # type: ignore[assignment,misc]
        try:
            yield guards
        finally:
            websockets_server.serve = serve  # type: ignore[misc]


def refuse(address: Address, request: Request) -> Response | None:
    """The answer to a request that may not pass; None for one that may.

    With a token: it must be in the address (`?token=`, answered by a cookie for the requests that follow), in
    that cookie, or in `Authorization: Bearer`. Always: a WebSocket opened by another site's page is refused,
    and without a token, a host name that is not this computer's own (DNS rebinding).
    """
    host, origin = request.headers.get("Host", ""), request.headers.get("Origin")
    if origin is not None and urlsplit(origin).netloc != host:
        return _answer(HTTPStatus.FORBIDDEN, f"a page of {origin} may not connect here")
    if address.token is None:
        name = urlsplit(f"//{host}").hostname or ""
        if is_loopback(name):
            return None
        return _answer(HTTPStatus.FORBIDDEN, f"this page is for the computer it runs on, not for {name!r}")
    given = parse_qs(urlsplit(request.path).query).get("token", [""])[0]
    cookie = f"s2p3-{address.port}"
    if _same(given, address.token):
        # The page's own requests do not repeat the address's query; a cookie speaks for them.
        value = f"{cookie}={address.token}; Path=/; HttpOnly; SameSite=Strict"
        return _answer(HTTPStatus.SEE_OTHER, "", {"Location": "/", "Set-Cookie": value})
    bearer = request.headers.get("Authorization", "").removeprefix("Bearer ")
    if _same(bearer, address.token) or _same(_cookie(request, cookie), address.token):
        return None
    return _answer(HTTPStatus.UNAUTHORIZED, "open this page with its token: /?token=...")


def is_loopback(host: str) -> bool:
    """Whether a host name or address is this computer's own, out of the network's reach."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def _same(given: str, token: str) -> bool:
    return hmac.compare_digest(given.encode(), token.encode())


def _cookie(request: Request, name: str) -> str:
    for header in request.headers.get_all("Cookie"):
        with contextlib.suppress(CookieError):
            found = SimpleCookie(header).get(name)
            if found is not None:
                return found.value
    return ""


def _answer(status: HTTPStatus, text: str, headers: dict[str, str] | None = None) -> Response:
    from websockets import Headers
    from websockets.http11 import Response

    body = f"{text}\n".encode()
    fields = Headers({"Content-Type": "text/plain; charset=utf-8", "Content-Length": str(len(body))})
    fields.update({"Cache-Control": "no-store", **(headers or {})})
    return Response(status.value, status.phrase, fields, body)
