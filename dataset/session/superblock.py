"""The first 48 bytes of an HDF5 file, as far as reading what an accident left needs them.

HDF5 refuses a file whose writer was killed, by a flag in its superblock, and a file shorter than its
superblock says. `HealedFile` shows HDF5 a superblock without the flag and with the true length; nothing on
the disk is touched. (Opening such a file in single-writer-multiple-readers mode works too, but HDF5 then
waits practically for ever on damaged metadata, expecting the dead writer to finish it.)

Source: HDF5 File Format Specification 3.0, section II.A (superblock version 3) and Jenkins' lookup3 checksum.
"""

from __future__ import annotations

import io
import struct
from pathlib import Path
from typing import Any

from dataset.errors import SessionError

_SIGNATURE = b"\x89HDF\r\n\x1a\n"
_VERSION = 3
_FLAGS_AT, _END_AT = 11, 28
_CHECKED = 44  # bytes before the checksum: offsets and lengths of 8 bytes, as every 64-bit file has them
_WORD = 0xFFFFFFFF


class HealedFile(io.FileIO):
    """A read-only file whose superblock reads as if its writer had closed it.

    Raises:
        SessionError: the superblock is not one this toolkit writes, or is itself damaged.
    """

    def __init__(self, path: Path) -> None:
        super().__init__(path, "rb")
        original = self.read(_CHECKED + 4)
        if len(original) < _CHECKED + 4 or original[:8] != _SIGNATURE or original[8] != _VERSION:
            self.close()
            raise SessionError(
                f"{path} does not begin like a session and cannot be repaired; use a copy of it"
            )
        head = bytearray(original[:_CHECKED])
        if lookup3(bytes(head)) != struct.unpack("<I", original[_CHECKED:])[0]:
            self.close()
            raise SessionError(
                f"{path}: its first bytes are damaged and cannot be repaired; use a copy of it"
            )
        head[_FLAGS_AT] = 0
        head[_END_AT : _END_AT + 8] = struct.pack("<Q", path.stat().st_size)
        self._head = bytes(head) + struct.pack("<I", lookup3(bytes(head)))

    def readinto(self, buffer: Any) -> int:
        """Reads into a writable buffer and returns the number of bytes read."""
        start = self.tell()
        count = super().readinto(buffer) or 0
        healed = self._head[start : start + count]
        memoryview(buffer).cast("B")[: len(healed)] = healed
        return count


def lookup3(data: bytes) -> int:
    """Bob Jenkins' lookup3 `hashlittle` with initial value 0, the checksum of HDF5 metadata."""
    a = b = c = (0xDEADBEEF + len(data)) & _WORD
    while len(data) > 12:
        x, y, z = struct.unpack("<III", data[:12])
        a, b, c = _mix((a + x) & _WORD, (b + y) & _WORD, (c + z) & _WORD)
        data = data[12:]
    if not data:
        return c
    x, y, z = struct.unpack("<III", data.ljust(12, b"\0"))
    return _final((a + x) & _WORD, (b + y) & _WORD, (c + z) & _WORD)


def _rotate(value: int, bits: int) -> int:
    return ((value << bits) | (value >> (32 - bits))) & _WORD


def _mix(a: int, b: int, c: int) -> tuple[int, int, int]:
    for first, second, third in ((4, 6, 8), (16, 19, 4)):
        a = ((a - c) & _WORD) ^ _rotate(c, first)
        c = (c + b) & _WORD
        b = ((b - a) & _WORD) ^ _rotate(a, second)
        a = (a + c) & _WORD
        c = ((c - b) & _WORD) ^ _rotate(b, third)
        b = (b + a) & _WORD
    return a, b, c


def _final(a: int, b: int, c: int) -> int:
    c = ((c ^ b) - _rotate(b, 14)) & _WORD
    a = ((a ^ c) - _rotate(c, 11)) & _WORD
    b = ((b ^ a) - _rotate(a, 25)) & _WORD
    c = ((c ^ b) - _rotate(b, 16)) & _WORD
    a = ((a ^ c) - _rotate(c, 4)) & _WORD
    b = ((b ^ a) - _rotate(a, 14)) & _WORD
    return ((c ^ b) - _rotate(b, 24)) & _WORD
