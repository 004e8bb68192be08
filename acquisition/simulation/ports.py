"""The TCP ports of a simulated controller: who is connected to which, and how connections are lost."""

from __future__ import annotations

import contextlib
import socket
import threading
from collections import Counter
from collections.abc import Callable

from dataset.errors import DeviceError

Serve = Callable[[socket.socket], None]


class Ports:
    """Listens on the ports of one address and serves every connection in a thread of its own.

    Attributes:
        muted: connections are taken and never answered, as by a controller that hangs while it boots.
        opened: how many connections each port has had.
    """

    def __init__(self, host: str) -> None:
        self.muted = False
        self.opened: Counter[int] = Counter()
        self._host = host
        self._connections: set[socket.socket] = set()

    def listen(self, port: int, serve: Serve) -> None:
        """Serves a port from now on. Raises DeviceError where it is taken."""
        listener = socket.socket()
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            listener.bind((self._host, port))
        except OSError as error:
            raise DeviceError(
                f"cannot serve a simulated arm at {self._host}:{port} ({error}); is another one running "
                "there? Use another --host such as 127.0.0.7"
            ) from error
        listener.listen(16)
        threading.Thread(target=self._accept, args=(listener, port, serve), daemon=True).start()

    def cut(self) -> None:
        """Ends every connection, as the power switch does."""
        for connection in list(self._connections):
            with contextlib.suppress(OSError):  # the client may just have gone
                connection.shutdown(socket.SHUT_RDWR)

    def _accept(self, listener: socket.socket, port: int, serve: Serve) -> None:
        while True:
            connection, _ = listener.accept()
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self.opened[port] += 1
            serve_this = _say_nothing if self.muted else serve
            threading.Thread(target=self._converse, args=(connection, serve_this), daemon=True).start()

    def _converse(self, connection: socket.socket, serve: Serve) -> None:
        self._connections.add(connection)
        try:
            with connection, contextlib.suppress(OSError, DeviceError):  # however the client goes away
                serve(connection)
        finally:
            self._connections.discard(connection)


def _say_nothing(connection: socket.socket) -> None:
    while connection.recv(65536):
        continue
