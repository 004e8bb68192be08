"""The first 48 bytes of an HDF5 file, as far as saving a damaged one needs them.

HDF5 refuses a file whose writer was killed, by a flag in its superblock. Marking the file as "being written
for concurrent readers" lets it be read again, tail missing or not. Source: HDF5 File Format Specification
3.0, sections II.A (superblock version 2 and 3) and "Jenkins' lookup3 checksum".
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from dataset.errors import SessionError

_SIGNATURE = b"\x89HDF\r\n\x1a\n"
_VERSION = 3
_FLAGS_AT = 11
_CHECKED = 44  # bytes before the checksum: offsets and lengths of 8 bytes, as every 64-bit file has them
_OPEN_FOR_WRITING_AND_READERS = 0x05
_WORD = 0xFFFFFFFF


@contextmanager
def marked_as_growing(path: Path) -> Iterator[None]:
    """Sets the flag for as long as the block lasts, then puts the original bytes back.

    Raises:
        SessionError: the superblock is not one this toolkit writes, or is itself damaged.
    """
    with path.open("r+b") as stream:
        original = stream.read(_CHECKED + 4)
        if len(original) < _CHECKED + 4 or original[:8] != _SIGNATURE or original[8] != _VERSION:
            raise SessionError(
                f"{path} has no superblock of a session; it cannot be repaired, use a copy of it"
            )
        head = bytearray(original[:_CHECKED])
        if lookup3(bytes(head)) != struct.unpack("<I", original[_CHECKED:])[0]:
            raise SessionError(
                f"{path}: the first bytes are damaged; it cannot be repaired, use a copy of it"
            )
        head[_FLAGS_AT] = _OPEN_FOR_WRITING_AND_READERS
        _write_head(path, bytes(head) + struct.pack("<I", lookup3(bytes(head))))
    try:
        yield
    finally:
        _write_head(path, original)


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


def _write_head(path: Path, head: bytes) -> None:
    with path.open("r+b") as stream:
        stream.write(head)


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
