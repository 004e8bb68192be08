"""A short word with a GigE Vision camera before a driver is let loose on it.

Vendor libraries wait long and say little when a camera does not answer. One register, read with our own
socket (GigE Vision's READREG command), tells in a second whether the camera is there and who controls it.
"""

from __future__ import annotations

import socket
import struct
import time
from dataclasses import dataclass

from dataset.errors import DeviceError

PORT = 3956
_IP_MTU = 14  # linux/in.h; not in Python's socket module
_READREG, _READREG_ACK = 0x0080, 0x0081
_KEY, _ACKNOWLEDGE = 0x42, 0x01
_CONTROL_PRIVILEGE = 0x0A00
_EXCLUSIVE_OR_CONTROL = 0b11
_TRIES, _WAIT_S = 3, 0.5
_HEARTBEAT_S = 3.2  # the usual time-out of 3 s after which a camera gives up a client that died


@dataclass(frozen=True)
class Presence:
    """A camera that answered: its IPv4 address, and whether a client holds control of it."""

    ip: str
    controlled: bool


def probe(address: str) -> Presence:
    """Asks the camera at an address or host name who controls it; takes at most 1.5 s.

    Raises DeviceError, saying what to check, when no camera answers.
    """
    ip, privilege = _read(address, _CONTROL_PRIVILEGE)
    return Presence(ip, privilege & _EXCLUSIVE_OR_CONTROL != 0)


def read_register(address: str, register: int) -> int:
    """A 32-bit register of a camera, as anybody may read it. Raises like `probe`."""
    return _read(address, register)[1]


def path_mtu(ip: str) -> int:
    """Bytes of the largest packet that this computer's card on the way to an address lets through."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as link:
        link.connect((ip, PORT))
        return link.getsockopt(socket.IPPROTO_IP, _IP_MTU)


def wait_for_control(address: str) -> Presence:
    """Like `probe`, and waits out a client that died without letting go; takes at most 5 s.

    Raises DeviceError naming the cause when a live client keeps control.
    """
    presence = probe(address)
    if presence.controlled:
        # Not polled: some cameras take any look at the privilege for a sign of life of the client.
        time.sleep(_HEARTBEAT_S)
        presence = probe(address)
    if presence.controlled:
        raise DeviceError(
            f"another program controls the camera at {address}; close it (a viewer, a recording, a second "
            "session of the toolkit), then try again"
        )
    return presence


def _read(address: str, register: int) -> tuple[str, int]:
    """The camera's IPv4 address, and what its register holds."""
    try:
        ip = socket.getaddrinfo(address, PORT, socket.AF_INET, socket.SOCK_DGRAM)[0][4][0]
    except (OSError, UnicodeError) as error:  # the latter of "192.168.0..20"
        raise DeviceError(
            f"the camera's address '{address}' is neither an IPv4 address nor a known host name; correct "
            "`address` under [camera] in the rig file"
        ) from error
    refused = False
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as link:
        try:
            link.connect((ip, PORT))
            for request_id in range(1, _TRIES + 1):
                try:
                    return str(ip), _exchange(link, register, request_id)
                except ConnectionRefusedError:
                    refused = True
                    time.sleep(_WAIT_S / 2)
                except TimeoutError:
                    refused = False
        except OSError as error:
            raise DeviceError(
                f"no way to the camera at {address} ({error.strerror}); check that this computer's network "
                "card is up and has an address in the camera's subnet"
            ) from error
    if refused:
        raise DeviceError(
            f"{address} answers, but no camera listens there on UDP port {PORT}; check the address, and that "
            "the camera (or the simulated one) is running"
        )
    raise DeviceError(
        f"no camera answers at {address} (UDP port {PORT}); check the address (s2p3 doctor lists the cameras "
        "in sight), power and cable, that this computer is in the same subnet, and that the firewall lets "
        "UDP through"
    )


def _exchange(link: socket.socket, register: int, request_id: int) -> int:
    """Reads one register. Raises TimeoutError without an answer."""
    link.send(struct.pack(">BBHHHI", _KEY, _ACKNOWLEDGE, _READREG, 4, request_id, register))
    deadline = time.monotonic() + _WAIT_S
    while (remaining_s := deadline - time.monotonic()) > 0:
        link.settimeout(remaining_s)
        answer = link.recv(64)
        if len(answer) == 12:
            _, command, _, answered_id, value = struct.unpack(">HHHHI", answer)
            if (command, answered_id) == (_READREG_ACK, request_id):
                return int(value)
    raise TimeoutError
