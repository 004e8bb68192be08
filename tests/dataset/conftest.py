"""Small sessions for the tests of this room."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from dataset import SE3, CameraInfo, ClockFit, Intrinsics, RawFrame, RobotTrace
from dataset.session import (
    ObjectPoses,
    ObjectRecord,
    SessionWriter,
    mask_box,
    write_calibration,
    write_object,
    write_poses,
    write_split,
)
from dataset.session.edit import write_depth

HEIGHT, WIDTH, FRAMES = 32, 48, 12


CAMERA = CameraInfo("Vendor", "Model", "42", "1.0", "BayerRG12p", "colour", WIDTH, HEIGHT, 12, 9000)
INTRINSICS = Intrinsics(
    np.array([[40.0, 0, 23.7], [0, 40.5, 15.1], [0, 0, 1]]),
    np.array([-0.1, 0.02, 0.001, -0.002]),
    HEIGHT,
    WIDTH,
)
TETRAHEDRON = ObjectRecord(
    name="tetra",
    vertices=0.1 * np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]]),
    faces=np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], dtype=np.int32),
    material="plastic",
    refractive_index=1.5,
    extinction=0.0,
    symmetry="[]",
    diameter=0.1 * np.sqrt(2),
)


@pytest.fixture
def camera() -> CameraInfo:
    return CAMERA


@pytest.fixture
def intrinsics() -> Intrinsics:
    return INTRINSICS


@pytest.fixture
def tetrahedron() -> ObjectRecord:
    return TETRAHEDRON


@pytest.fixture
def make_frame() -> Callable[..., RawFrame]:
    return frame


@pytest.fixture
def make_trace() -> Callable[..., RobotTrace]:
    return trace


@pytest.fixture
def make_poses() -> Callable[[], tuple[SE3, ObjectPoses]]:
    return poses


def frame(index: int, frame_id: int | None = None) -> RawFrame:
    """Frame `index` of a recording at 50 frames/s; its pixels are its own."""
    pixels = np.random.default_rng(index).integers(100, 3000, (HEIGHT, WIDTH)).astype(np.uint16)
    time = 7_000_000_000 + 20_000_000 * index
    frame_id = index if frame_id is None else frame_id
    return RawFrame(pixels, "BayerRG12p", frame_id, time, time - 6_000_000_000, 2000.0, 3.5, 0)


def trace(count: int, start: int = 0) -> RobotTrace:
    """A robot turning about its base at 500 Hz."""
    times = (start + np.arange(count)) / 500
    pose = np.zeros((count, 6))
    pose[:, 0], pose[:, 5] = 0.3 + 0.1 * times, times
    host = (1e9 * (1 + times)).astype(np.int64)
    return RobotTrace(host, 100 + times, np.tile(times[:, None], 6), pose, np.ones(count, np.uint32))


def poses() -> tuple[SE3, ObjectPoses]:
    """T_base_cam and one object's poses with a square mask that walks to the right."""
    T_base_cam = SE3.exp(np.random.default_rng(3).normal(size=(FRAMES, 6)))
    masks = np.zeros((FRAMES, HEIGHT // 4, WIDTH // 4), dtype=bool)
    for i in range(FRAMES):
        masks[i, 2:6, i % 8 : i % 8 + 4] = True
    boxes = np.stack([mask_box(mask) for mask in masks])
    return T_base_cam, ObjectPoses(T_base_cam.inverse(), np.full(FRAMES, 0.9), boxes, masks)


def depth(count: int) -> NDArray[np.uint16]:
    """Depth of so many frames, millimetres."""
    return np.random.default_rng(5).integers(0, 900, (count, HEIGHT // 4, WIDTH // 4)).astype(np.uint16)


@pytest.fixture
def make_depth() -> Callable[[int], NDArray[np.uint16]]:
    return depth


@pytest.fixture(scope="session")
def master(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A complete, calibrated, annotated session without a problem."""
    path = tmp_path_factory.mktemp("master") / "session.h5"
    with SessionWriter(path, "sequence", CAMERA, rig_toml="[camera]\n") as writer:
        for index in range(FRAMES):
            writer.add_frame(frame(index, index if index < 6 else index + 1))
        writer.add_drop(6, "queue full", 1_120_000_000)
        writer.add_robot_trace(trace(100), [0, 0, 0.1, 0, 0, 0])
        writer.add_robot_trace(trace(50, start=100), [0, 0, 0.1, 0, 0, 0])
        writer.set_clocks(camera=ClockFit(-6e9, 1.0, 300.0), robot=ClockFit(-99e9, 1.0, 400.0))
    write_calibration(path, '{"fx": 40}', INTRINSICS)
    write_object(path, TETRAHEDRON)
    T_base_cam, object_poses = poses()
    write_poses(path, T_base_cam, 1e-4, np.full(FRAMES, 2e-4), {"tetra": object_poses})
    write_depth(path, depth(FRAMES))
    write_split(path, "train", np.arange(9))
    write_split(path, "test", [9, 11, 10])
    return path


@pytest.fixture
def recorded(master: Path, tmp_path: Path) -> Path:
    """A copy of that session to do with as one likes."""
    return Path(shutil.copy(master, tmp_path / "session.h5"))
