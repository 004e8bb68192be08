"""Opening and summarising a session costs the same however long it is: counted in bytes read, not in
seconds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from dataset import CameraInfo, RawFrame
from dataset.session import Session, SessionWriter
from dataset.session.continuing import GROWING
from dataset.session.seals import reopen, seal
from dataset.validate import info

LONG, SHORT = 50_000, 500


@pytest.fixture(scope="module")
def lengthen(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Path]:
    """A session of many tiny frames, all alike but for their ids and times."""

    def make(camera: CameraInfo, frame: RawFrame, count: int) -> Path:
        path = tmp_path_factory.mktemp("long") / f"{count}.h5"
        with SessionWriter(path, "sequence", replace(camera, width=8, height=8)) as writer:
            writer.add_frame(replace(frame, pixels=frame.pixels[:8, :8].copy()))
        with h5py.File(path, "r+") as file:
            raw = file["camera/raw"]
            mask, chunk = raw.id.read_direct_chunk((0, 0, 0))
            raw.resize(count, axis=0)
            for index in range(1, count):
                raw.id.write_direct_chunk((index, 0, 0), chunk, mask)
            steps = {"camera/frame_id": 1, "camera/camera_time_ns": 10**7, "camera/host_time_ns": 10**7}
            for name in [n for n in GROWING if n.startswith("camera/") and len(file[n]) == 1]:
                reopen(file[name])
                first = file[name][0]
                file[name].resize(count, axis=0)
                file[name][:] = first + np.arange(count) * steps.get(name, 0)
            seal(file)
        return path

    return make


def bytes_read(work: Callable[[], Any]) -> int:
    """What this process asks the kernel for while it works."""

    def asked() -> int:
        counters = Path("/proc/self/io").read_text().split()
        return int(counters[counters.index("rchar:") + 1])

    work()  # what is loaded once is loaded now
    start = asked()
    own = asked() - start
    start = asked()
    work()
    return asked() - start - own


def test_info_reads_no_more_of_a_long_session(
    lengthen: Callable[..., Path], camera: CameraInfo, make_frame: Callable[..., RawFrame]
) -> None:
    short, long = (lengthen(camera, make_frame(0), count) for count in (SHORT, LONG))
    assert info(long).frames == LONG
    assert info(long).duration_s == pytest.approx((LONG - 1) * 0.01)
    few, many = bytes_read(lambda: info(short)), bytes_read(lambda: info(long))
    assert many < 1.5 * few + 65536
    assert long.stat().st_size > 20 * many
    with Session.open(long) as session:
        np.testing.assert_array_equal(session.raw(LONG - 1), session.raw(0))
        assert len(session.frame_ids) == LONG
