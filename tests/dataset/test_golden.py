"""Files that are never made anew: whatever changes here, they open, with plain h5py and with the reader."""

from __future__ import annotations

import hashlib
import json
import shutil
from pathlib import Path

import h5py
import hdf5plugin  # noqa: F401  registers the Blosc2 filter with plain h5py
import numpy as np
import pytest

from dataset import SessionError
from dataset.convert import convert
from dataset.schema import ATTRIBUTES, DATASETS, MINOR, VERSION
from dataset.session import Session
from dataset.session.seals import leave_open, seal
from dataset.validate import info, validate

GOLDEN = Path(__file__).with_name("golden")
CURRENT = ("1.0", "1.1")
RAW_SHA256 = "5bb673226bf4017a1daf58b0aaafccc87014ce016ca86cf7902436d739b34b52"
"""Of all mosaics of the golden recording, frame after frame."""


def golden(version: str) -> Path:
    return GOLDEN / f"session-{version}.h5"


@pytest.mark.parametrize("version", [*CURRENT, "0.9"])
def test_plain_h5py_reads_it(version: str) -> None:
    with h5py.File(golden(version)) as file:
        assert file.attrs["format"] == "s2p3-session"
        assert file.attrs["schema"] == version
        raw = file["camera/raw"]
        assert raw.shape == (8, 64, 96)
        assert hashlib.sha256(b"".join(frame.tobytes() for frame in raw)).hexdigest() == RAW_SHA256
        assert file["robot/pose"].attrs["units"] == "m, rad"
        assert file["poses/objects/tetra/mask"][3].sum() == 54


@pytest.mark.parametrize("version", CURRENT)
def test_the_reader_reads_it(version: str) -> None:
    assert validate(golden(version)) == []
    with Session.open(golden(version)) as session:
        check_content(session)
    assert info(golden(version)).schema == version


def check_content(session: Session) -> None:
    assert (len(session), session.complete, session.kind) == (8, True, "sequence")
    assert session.camera.pixel_format == "BayerRG12p"
    mosaics = b"".join(session.raw(index).tobytes() for index in range(8))
    assert hashlib.sha256(mosaics).hexdigest() == RAW_SHA256
    assert session.frame_ids.tolist() == [0, 1, 2, 3, 4, 6, 7, 8]
    assert session.drops["frame_id"].tolist() == [5]
    assert session.camera_time_ns[3] == 7_060_000_000
    assert session.mid_exposure_host_ns[3] == 1_061_000_000
    assert session.robot is not None
    assert session.robot.pose[-1].tolist() == pytest.approx([0.3118, 0, 0, 0, 0, 0.118])
    assert session.working_intrinsics.K[0].tolist() == pytest.approx([20, 0, 11.475])
    poses = session.object_poses("tetra")
    assert poses.T_cam_obj[7].as_rotvec().tolist() == pytest.approx([0.3, -0.2, 1.0])
    assert poses.bbox_xywh[2].tolist() == [2, 4, 9, 6]
    assert [int(poses.mask(index).sum()) for index in range(8)] == [54] * 8
    assert session.object("tetra").refractive_index == 1.5
    assert session.stokes(0).s0.mean() == pytest.approx(0.72, abs=0.08)
    assert {name: indices.tolist() for name, indices in session.splits.items()} == {
        "train": [0, 1, 4],
        "test": [6, 7],
    }


def test_what_1_0_declared_is_frozen() -> None:
    frozen = json.loads((GOLDEN / "schema-1.0.json").read_text())
    now = {d.path: d for d in DATASETS}
    for old in frozen["datasets"]:
        new = now.pop(old["path"])
        same = (list(new.dtypes), list(new.shape), new.units, new.required)
        assert same == (old["dtypes"], old["shape"], old["units"], old["required"]), new.path
        assert new.since == 0
    attributes = {(a.group, a.name): a for a in ATTRIBUTES}
    for old in frozen["attributes"]:
        attribute = attributes.pop((old["group"], old["name"]))
        assert (attribute.type.__name__, attribute.required) == (old["type"], old["required"])
        assert set(attribute.choices) >= set(old["choices"])
        assert attribute.since == 0
    assert all(
        0 < added.since <= MINOR and not added.required for added in [*now.values(), *attributes.values()]
    )


def test_a_newer_minor_version_may_hold_more(tmp_path: Path) -> None:
    path = Path(shutil.copy(golden("1.1"), tmp_path / "newer.h5"))
    with h5py.File(path, "r+") as file:
        file.attrs["schema"] = "1.42"
        file.attrs["operator"] = "somebody"
        file["camera/temperature_K"] = np.full(8, 300.0)
        file.create_group("lidar")["points"] = np.zeros((4, 3))
        leave_open(file)
        seal(file)
    assert validate(path) == []
    with Session.open(path) as session:
        check_content(session)


def test_an_older_major_version_is_converted(tmp_path: Path) -> None:
    with pytest.raises(SessionError, match=r"schema 0\.9.*s2p3 dataset convert"):
        Session.open(golden("0.9"))
    out = tmp_path / "new.h5"
    before = golden("0.9").read_bytes()
    assert convert(golden("0.9"), out) == "0.9"
    assert golden("0.9").read_bytes() == before
    assert validate(out) == []
    with Session.open(out) as session:
        check_content(session)
    assert info(out).schema == VERSION


def test_a_newer_major_version_is_refused(tmp_path: Path) -> None:
    path = Path(shutil.copy(golden("1.1"), tmp_path / "future.h5"))
    with h5py.File(path, "r+") as file:
        file.attrs["schema"] = "2.0"
    for attempt in (lambda: Session.open(path), lambda: validate(path)):
        with pytest.raises(SessionError, match=r"upgrade the toolkit.*convert"):
            attempt()
    with pytest.raises(SessionError, match=r"converters from 0\.9"):
        convert(path, tmp_path / "out.h5")


def test_what_needs_no_converter_says_so(tmp_path: Path) -> None:
    with pytest.raises(SessionError, match="nothing to convert"):
        convert(golden("1.0"), tmp_path / "out.h5")
    assert list(tmp_path.iterdir()) == []
