"""The decoded cache holds what the session says, and goes when the session says otherwise."""

from __future__ import annotations

import resource
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

from dataset import Intrinsics, SessionError
from dataset.session import Session, compress, write_calibration, write_split
from dataset.session.seals import reopen, seal
from dataset.stokes_cache import cached_stokes


def caches(path: Path) -> list[Path]:
    return sorted(path.parent.glob(f".{path.name}.*"))


def test_the_cache_holds_the_undistorted_images(recorded: Path) -> None:
    found = cached_stokes(recorded)
    assert (found.shape, found.dtype) == ((12, 8, 12, 3), np.float16)
    assert not found.flags.writeable
    with Session.open(recorded) as session:
        for index in range(12):
            expected = np.moveaxis(session.stokes(index).stack(), 0, -1)
            np.testing.assert_allclose(found[index], expected, rtol=1e-3, atol=1e-6)


def test_it_is_made_once(recorded: Path) -> None:
    cached_stokes(recorded)
    (path,) = caches(recorded)
    made = path.stat().st_mtime_ns
    write_split(recorded, "again", [1])
    cached_stokes(recorded)
    assert caches(recorded) == [path]
    assert path.stat().st_mtime_ns == made


def test_a_new_calibration_makes_a_new_one(recorded: Path, intrinsics: Intrinsics) -> None:
    before = cached_stokes(recorded)[0].copy()
    old = caches(recorded)
    write_calibration(recorded, "{}", replace(intrinsics, distortion=np.zeros(4)))
    assert not np.array_equal(cached_stokes(recorded)[0], before)
    assert len(caches(recorded)) == 1
    assert caches(recorded) != old


def test_other_pixels_make_a_new_one(recorded: Path) -> None:
    before = cached_stokes(recorded)[4].copy()
    with h5py.File(recorded, "r+") as file:
        chunk = compress(file["camera/raw"][4] // 2)
        file["camera/raw"].id.write_direct_chunk((4, 0, 0), chunk.data)
        reopen(file["camera/crc32"])
        file["camera/crc32"][4] = chunk.crc32
        seal(file)
    assert not np.array_equal(cached_stokes(recorded)[4], before)


def test_one_that_was_cut_short_is_made_again(recorded: Path) -> None:
    whole = cached_stokes(recorded).copy()
    (path,) = caches(recorded)
    path.write_bytes(path.read_bytes()[:-100])
    np.testing.assert_array_equal(cached_stokes(recorded), whole)


def test_a_disk_that_refuses_is_an_error(recorded: Path) -> None:
    unlimited = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, unlimited[1]))
    try:
        with pytest.raises(SessionError, match="cannot be written beside it"):
            cached_stokes(recorded)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, unlimited)
    assert caches(recorded) == []


def test_a_damaged_session_leaves_no_cache(recorded: Path) -> None:
    with h5py.File(recorded, "r+") as file:
        file["camera/raw"].id.write_direct_chunk((4, 0, 0), b"\0" * 40)
    with pytest.raises(SessionError, match="damaged"):
        cached_stokes(recorded)
    assert caches(recorded) == []
