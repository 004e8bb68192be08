"""Writes a small session that holds everything a session can: `python tools/golden_session.py OUT.h5`.

Its result was committed once for each minor version of the schema (tests/dataset/golden); those files are
never made anew: they stand for what users have on their disks.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

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

HEIGHT, WIDTH, FRAMES, SAMPLES = 64, 96, 8, 60


def write(path: Path) -> None:
    """Eight frames of a colour sensor around a tetrahedron, one of which was dropped."""
    camera = CameraInfo("Vendor", "Model", "42", "1.0", "BayerRG12p", "colour", WIDTH, HEIGHT, 12, 9000)
    matrix = np.array([[80.0, 0, 47.4], [0, 81.0, 30.9], [0, 0, 1]])
    intrinsics = Intrinsics(matrix, np.array([-0.1, 0.02, 0.001, -0.002]), HEIGHT, WIDTH)
    rng = np.random.default_rng(7)
    with SessionWriter(path, "sequence", camera, rig_toml="[camera]\n") as writer:
        for index in range(FRAMES):
            y, x = np.mgrid[:HEIGHT, :WIDTH]
            pixels = (1000 + 8 * x + 5 * y + 90 * index + rng.integers(0, 16, x.shape)).astype(np.uint16)
            time = 7_000_000_000 + 20_000_000 * index
            frame_id = index if index < 5 else index + 1
            writer.add_frame(RawFrame(pixels, "BayerRG12p", frame_id, time, time - 6 * 10**9, 2000.0, 3.5, 0))
        writer.add_drop(5, "queue full", 1_100_000_000)
        times = np.arange(SAMPLES) / 500
        pose = np.zeros((SAMPLES, 6))
        pose[:, 0], pose[:, 5] = 0.3 + 0.1 * times, times
        host = (1e9 * (1 + times)).astype(np.int64)
        joints, safety = np.tile(times[:, None], 6), np.ones(SAMPLES, np.uint32)
        writer.add_robot_trace(RobotTrace(host, 100 + times, joints, pose, safety), [0, 0, 0.1, 0, 0, 0])
        writer.set_clocks(camera=ClockFit(-6e9, 1.0, 300.0), robot=ClockFit(-99e9, 1.0, 400.0))
    write_calibration(path, '{"version": 1}', intrinsics)
    vertices = 0.1 * np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]])
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], dtype=np.int32)
    symmetry = '{"symmetries_discrete": [], "symmetries_continuous": []}'
    record = ObjectRecord("tetra", vertices, faces, "plastic", 1.5, 0.0, symmetry, 0.1 * np.sqrt(2))
    write_object(path, record)
    turns = np.linspace(0, 1, FRAMES)[:, None] * [0.3, -0.2, 1.0]
    T_cam_obj = SE3.from_rotvec(turns, np.tile([0.0, 0.01, 0.5], (FRAMES, 1)))
    masks = np.zeros((FRAMES, HEIGHT // 4, WIDTH // 4), dtype=bool)
    for index in range(FRAMES):
        masks[index, 4:10, index : index + 9] = True
    boxes = np.stack([mask_box(mask) for mask in masks])
    poses = ObjectPoses(T_cam_obj, np.linspace(0.5, 1, FRAMES), boxes, masks)
    write_poses(path, SE3.identity((FRAMES,)), 1e-4, 2e-4, {"tetra": poses})
    write_split(path, "train", [0, 1, 4])
    write_split(path, "test", [6, 7])


if __name__ == "__main__":
    write(Path(sys.argv[1]))
