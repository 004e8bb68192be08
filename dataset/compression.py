"""A frame as one compressed HDF5 chunk, made outside HDF5 so that its lock is not held meanwhile.

The bytes are what the Blosc2 filter of HDF5 (id 32026) stores: any h5py with hdf5plugin reads them back.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass

import blosc2
import hdf5plugin
import numpy as np
from numpy.typing import NDArray

blosc2.set_releasegil(True)  # off by default, and then a recorder's threads would compress one after another

LEVEL = 5
"""Of LZ4 behind bit shuffle: a 2448x2048 mosaic takes 8-10 ms on one core, higher levels gain nothing."""


@dataclass(frozen=True)
class Chunk:
    """A compressed frame.

    Attributes:
        data: the Blosc2 frame.
        crc32: of the pixels' bytes before compression.
    """

    data: bytes
    crc32: int


def compress(pixels: NDArray[np.uint8] | NDArray[np.uint16]) -> Chunk:
    """Compresses one frame, (H, W). Releases the GIL: several threads may compress at once."""
    schunk = blosc2.SChunk(
        chunksize=pixels.nbytes,
        cparams={
            "codec": blosc2.Codec.LZ4,
            "clevel": LEVEL,
            "typesize": pixels.itemsize,
            "filters": [blosc2.Filter.BITSHUFFLE],
            "nthreads": 1,
        },
    )
    schunk.append_data(np.ascontiguousarray(pixels))
    return Chunk(schunk.to_cframe(), checksum(pixels))


def checksum(pixels: NDArray[np.uint8] | NDArray[np.uint16]) -> int:
    """CRC-32 of the pixels' bytes, row by row."""
    return zlib.crc32(np.ascontiguousarray(pixels).data)


def filter_options() -> dict[str, object]:
    """The matching arguments of `h5py.Group.create_dataset`."""
    return dict(hdf5plugin.Blosc2(cname="lz4", clevel=LEVEL, filters=hdf5plugin.Blosc2.BITSHUFFLE))
