"""Universal Robots' Real-Time Data Exchange, protocol version 2: the wire, and a client that only reads.

Big-endian messages of a three-byte header (total length, type) and a payload. The client asks for a recipe of
named variables at a rate, and the controller streams packages of their values.
"""

from __future__ import annotations

import socket
import struct
from collections.abc import Iterator, Sequence
from enum import IntEnum
from types import TracebackType
from typing import TYPE_CHECKING

import numpy as np

from dataset.errors import DeviceError

if TYPE_CHECKING:
    from typing_extensions import Self

PORT = 30004
PROTOCOL_VERSION = 2
HEADER = struct.Struct(">HB")

_POLL_S = 0.02

# The variables' types: (struct code, numpy code).
TYPES = {
    "DOUBLE": ("d", ">f8"),
    "VECTOR3D": ("3d", "(3,)>f8"),
    "VECTOR6D": ("6d", "(6,)>f8"),
    "INT32": ("i", ">i4"),
    "UINT32": ("I", ">u4"),
    "UINT64": ("Q", ">u8"),
    "UINT8": ("B", ">u1"),
    "VECTOR6INT32": ("6i", "(6,)>i4"),
}


class MessageType(IntEnum):
    """The protocol's message types; each is the ASCII code of a letter."""

    PROTOCOL_VERSION = ord("V")
    CONTROLLER_VERSION = ord("v")
    OUTPUT_RECIPE = ord("O")
    INPUT_RECIPE = ord("I")
    START = ord("S")
    PAUSE = ord("P")
    DATA = ord("U")


def pack_message(kind: MessageType, payload: bytes = b"") -> bytes:
    """One message as it goes over the wire."""
    return HEADER.pack(HEADER.size + len(payload), kind) + payload


def take_messages(buffer: bytearray) -> Iterator[tuple[int, bytes]]:
    """Removes every complete message from the front of `buffer`, yielding (type, payload).

    Raises:
        DeviceError: a length no message can have; the stream is not RTDE.
    """
    start = 0
    try:
        while len(buffer) - start >= HEADER.size:
            length, kind = HEADER.unpack_from(buffer, start)
            if length < HEADER.size:
                raise DeviceError(
                    f"RTDE: a message claims a length of {length} bytes, which none can have; "
                    "check that the address is a Universal Robots controller"
                )
            if len(buffer) - start < length:
                return
            start += length
            yield kind, bytes(buffer[start - length + HEADER.size : start])
    finally:
        del buffer[:start]


class RtdeReader:
    """Subscribes to a controller's variables and reads every package it sends; a context manager.

    Args:
        host: address of the controller.
        variables: names of RTDE output variables.
        frequency_hz: rate of the packages, at most the controller's own.
        timeout_s: for connecting and for every answer.
        optional: more variables, each left out where the controller's software does not know it.

    Attributes:
        dtype: one record of what was granted.
        silent_s: for how long nothing has come, as found by looking, not by the clock: a reader that the
            host did not let run has not been left in silence.

    Raises:
        DeviceError: nothing answers there, the protocol is refused, or a variable is unknown to it.
    """

    def __init__(
        self,
        host: str,
        variables: Sequence[str],
        frequency_hz: float,
        timeout_s: float = 2.0,
        optional: Sequence[str] = (),
    ) -> None:
        self.host = host
        self.silent_s = 0.0
        self._timeout_s = timeout_s
        self._buffer = bytearray()
        self._data: list[bytes] = []
        try:
            self._socket = socket.create_connection((host, PORT), timeout=timeout_s)
        except (OSError, UnicodeError) as error:  # the latter of "192.168.0..20"
            raise DeviceError(
                f"no arm answers at {host}:{PORT} ({error}); check that the controller is on, its address in "
                "the rig file, the network cable, and that RTDE is enabled (Settings > Security > Services)"
            ) from error
        try:
            self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._socket.settimeout(min(_POLL_S, timeout_s))
            self._negotiate(variables, optional, frequency_hz)
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()

    def packages(self) -> list[bytes]:
        """Waits a moment for data and returns the values of every package that is complete, oldest first.

        Each is one record of `dtype`. The list is empty where nothing, or only a part of a package, came.

        Raises:
            DeviceError: silence for longer than the time-out, or the connection is gone.
        """
        if not self._data:
            self._receive()
        arrived, self._data = self._data, []
        return arrived

    def close(self) -> None:
        """Closes the connection; another thread's waiting read ends with a DeviceError. Idempotent."""
        try:
            self._socket.shutdown(socket.SHUT_RDWR)
        except OSError:  # the other side closed first
            return
        finally:
            self._socket.close()

    def _negotiate(self, variables: Sequence[str], optional: Sequence[str], frequency_hz: float) -> None:
        accepted = self._ask(MessageType.PROTOCOL_VERSION, struct.pack(">H", PROTOCOL_VERSION))
        if accepted != b"\x01":
            raise DeviceError(
                f"the controller at {self.host} refuses RTDE version {PROTOCOL_VERSION}; "
                "update its software to PolyScope 3.10 / 5.4 or newer"
            )
        version = struct.unpack(">IIII", self._ask(MessageType.CONTROLLER_VERSION))
        self.controller_version: tuple[int, int, int, int] = version
        wished = [*variables, *optional]
        types = self._subscribe(wished, frequency_hz)
        granted = [name for name in wished if types.get(name) in TYPES]
        unknown = [name for name in variables if name not in granted]
        if unknown:
            raise DeviceError(
                f"the controller at {self.host} (software {'.'.join(map(str, version))}) does not offer "
                f"{', '.join(unknown)} over RTDE; update its software"
            )
        if len(granted) < len(wished):
            types = self._subscribe(granted, frequency_hz)
        self.dtype = np.dtype([("recipe", "u1"), *((name, TYPES[types[name]][1]) for name in granted)])
        if self._ask(MessageType.START) != b"\x01":
            raise DeviceError(
                f"the controller at {self.host} does not start its RTDE stream; another client may hold it: "
                "close other programs that use RTDE, or restart the controller"
            )

    def _subscribe(self, variables: Sequence[str], frequency_hz: float) -> dict[str, str]:
        """Asks for a recipe; the type that the controller names for each variable."""
        recipe = struct.pack(">d", frequency_hz) + ",".join(variables).encode()
        types = self._ask(MessageType.OUTPUT_RECIPE, recipe)[1:].decode().split(",")
        return dict(zip(variables, types, strict=False))

    def _ask(self, kind: MessageType, payload: bytes = b"") -> bytes:
        try:
            self._socket.sendall(pack_message(kind, payload))
        except OSError as error:
            raise self._lost(str(error)) from error
        while True:
            answer = self._receive(kind)
            if answer is not None:
                return answer

    def _receive(self, expected: MessageType | None = None) -> bytes | None:
        """Reads once from the socket; returns the payload of the message of the expected type, if it came."""
        try:
            chunk = self._socket.recv(65536)
        except TimeoutError:
            self.silent_s += _POLL_S
            if self.silent_s > self._timeout_s:
                raise self._lost(f"silent for {self._timeout_s:g} s") from None
            return None
        except OSError as error:
            raise self._lost(str(error)) from error
        if not chunk:
            raise self._lost("it closed the connection")
        self.silent_s = 0.0
        self._buffer += chunk
        answer = None
        for kind, payload in take_messages(self._buffer):
            if kind == MessageType.DATA:
                self._data.append(payload)
            elif kind == expected:
                answer = payload
        return answer

    def _lost(self, reason: str) -> DeviceError:
        return DeviceError(
            f"lost the arm at {self.host}:{PORT} ({reason}); check its power and the network, "
            "then connect again"
        )
