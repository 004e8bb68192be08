"""The simulated controller's RTDE port: recipes, and packages of variables to every client when due."""

from __future__ import annotations

import contextlib
import random
import socket
import struct
import threading
from collections import deque
from collections.abc import Callable, Mapping, Sequence

from acquisition.robots.rtde import PROTOCOL_VERSION, TYPES, MessageType, pack_message, take_messages

Value = float | int | Sequence[float] | Sequence[int]
WriteInput = Callable[[str, Value], None]

_UNKNOWN = "NOT_FOUND"
_LARGEST_BACKLOG = 1 << 20  # bytes; a client that leaves more unread is cut off, as the real controller does


class RtdeServer:
    """Serves RTDE clients.

    Args:
        outputs: type name of every variable that a client may ask for.
        inputs: type name of every variable that a client may write.
        write_input: called with the name and value of each input that arrives.
        version: (major, minor, bugfix, build) of the controller's software.
        rate_hz: how often `publish` will be called.
    """

    def __init__(
        self,
        outputs: Mapping[str, str],
        inputs: Mapping[str, str],
        write_input: WriteInput,
        version: tuple[int, int, int, int],
        rate_hz: float,
    ) -> None:
        self._outputs, self._inputs = outputs, inputs
        self._write_input = write_input
        self._version = version
        self._rate_hz = rate_hz
        self._clients: list[_Client] = []
        self._last: Mapping[str, Value] = {}
        self.stalled = False  # True: nothing is sent, the connections stay open
        self.hung = False  # True: the same state is sent again and again
        self.lateness_s = 0.0  # packages leave up to this much late, at random, in order

    def serve(self, connection: socket.socket) -> None:
        """Talks to one client until it goes away; call it in a thread of its own."""
        client = _Client(connection)
        self._clients.append(client)
        buffer = bytearray()
        try:
            while chunk := connection.recv(65536):
                buffer += chunk
                for kind, payload in take_messages(buffer):
                    self._handle(client, kind, payload)
        finally:
            self._clients.remove(client)

    def publish(self, values: Mapping[str, Value], now_s: float) -> None:
        """Sends the state to every client whose turn it is. `now_s` is the host's monotonic clock."""
        if not self.hung:
            self._last = dict(values)
        for client in list(self._clients):
            if client.due(self._rate_hz) and not self.stalled:
                client.queue(
                    self._last if self.hung else values, now_s + random.uniform(0.0, self.lateness_s)
                )
            client.flush(now_s)

    def drop(self) -> None:
        """Cuts every connection, as a pulled cable or a restarted switch does."""
        for client in list(self._clients):
            client.cut()

    def _handle(self, client: _Client, kind: int, payload: bytes) -> None:
        if kind == MessageType.PROTOCOL_VERSION:
            (version,) = struct.unpack(">H", payload)
            client.answer(MessageType.PROTOCOL_VERSION, struct.pack(">B", version == PROTOCOL_VERSION))
        elif kind == MessageType.CONTROLLER_VERSION:
            client.answer(MessageType.CONTROLLER_VERSION, struct.pack(">IIII", *self._version))
        elif kind == MessageType.OUTPUT_RECIPE:
            (frequency,) = struct.unpack_from(">d", payload)
            names = _names(payload[8:])
            types = [self._outputs.get(name, _UNKNOWN) for name in names]
            known = _UNKNOWN not in types
            if known:
                client.subscribe(names, types, frequency)
            client.answer(MessageType.OUTPUT_RECIPE, struct.pack(">B", known) + ",".join(types).encode())
        elif kind == MessageType.INPUT_RECIPE:
            names = _names(payload)
            types = [self._inputs.get(name, _UNKNOWN) for name in names]
            recipe = client.accept(names, types) if _UNKNOWN not in types else 0
            client.answer(MessageType.INPUT_RECIPE, struct.pack(">B", recipe) + ",".join(types).encode())
        elif kind == MessageType.START:
            client.answer(MessageType.START, b"\x01")
            client.started = True
        elif kind == MessageType.PAUSE:
            client.started = False
            client.answer(MessageType.PAUSE, b"\x01")
        elif kind == MessageType.DATA:
            for name, value in client.read_inputs(payload):
                self._write_input(name, value)


class _Client:
    """One connection: what it subscribed to, what it may write, and what still has to go out."""

    def __init__(self, connection: socket.socket) -> None:
        self.started = False
        self._socket = connection
        self._lock = threading.Lock()
        self._names: list[str] = []
        self._layout = struct.Struct(">B")
        self._frequency = 0.0
        self._credit = 0.0
        self._inputs: list[list[tuple[str, struct.Struct]]] = []
        self._waiting: deque[tuple[float, bytes]] = deque()
        self._backlog = bytearray()

    def answer(self, kind: MessageType, payload: bytes) -> None:
        with self._lock:
            self._backlog += pack_message(kind, payload)
            self._send()

    def subscribe(self, names: list[str], types: list[str], frequency_hz: float) -> None:
        self._names = names
        self._layout = struct.Struct(">B" + "".join(TYPES[kind][0] for kind in types))
        self._frequency = frequency_hz

    def accept(self, names: list[str], types: list[str]) -> int:
        self._inputs.append(
            [(name, struct.Struct(">" + TYPES[kind][0])) for name, kind in zip(names, types, strict=True)]
        )
        return len(self._inputs)

    def read_inputs(self, payload: bytes) -> list[tuple[str, Value]]:
        if not 1 <= payload[0] <= len(self._inputs):
            return []
        written: list[tuple[str, Value]] = []
        offset = 1
        for name, layout in self._inputs[payload[0] - 1]:
            if offset + layout.size > len(payload):  # ur_rtde sends some recipes cut short
                break
            values = layout.unpack_from(payload, offset)
            written.append((name, values[0] if len(values) == 1 else values))
            offset += layout.size
        return written

    def due(self, rate_hz: float) -> bool:
        """Whether this client's own rate wants a package in this period."""
        if not self.started or not self._names:
            return False
        self._credit += min(self._frequency / rate_hz, 1.0)
        if self._credit < 1.0 - 1e-6:
            return False
        self._credit -= 1.0
        return True

    def queue(self, values: Mapping[str, Value], due_s: float) -> None:
        flat: list[float | int] = [1]
        for name in self._names:
            value = values[name]
            if isinstance(value, float | int):
                flat.append(value)
            else:
                flat.extend(value)
        if self._waiting:
            due_s = max(due_s, self._waiting[-1][0])
        self._waiting.append((due_s, pack_message(MessageType.DATA, self._layout.pack(*flat))))

    def flush(self, now_s: float) -> None:
        with self._lock:
            while self._waiting and self._waiting[0][0] <= now_s:
                self._backlog += self._waiting.popleft()[1]
            self._send()
            if len(self._backlog) > _LARGEST_BACKLOG:
                self.cut()

    def cut(self) -> None:
        self.started = False
        with contextlib.suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)

    def _send(self) -> None:
        """Sends what fits without waiting: a client that does not read must not hold up the arm."""
        if not self._backlog:
            return
        try:
            sent = self._socket.send(self._backlog, socket.MSG_DONTWAIT)
        except BlockingIOError:
            return
        except OSError:  # the client went away; its receiving thread notices too
            self._backlog.clear()
            self.started = False
            return
        del self._backlog[:sent]


def _names(text: bytes) -> list[str]:
    return [name for name in text.decode().split(",") if name]
