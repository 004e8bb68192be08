"""How well the camera's pose is known at mid-exposure while the arm moves, beside the nearest-sample method.

    python tools/bench/time_alignment.py --json              # on the wire, simulated camera and arm
    python tools/bench/time_alignment.py --virtual --json    # the same in virtual time: deterministic

Frames reach the host 30 ms after the exposure began, the camera's clock runs 80 ppm fast, the arm's 50 ppm
slow, and its packages come with jitter; the arm swings at up to 0.25 m/s. One recording calibrates the delay
from the corners of a board, another one is the test. No picture is looked at: the corners are predicted from
the truth, with a noise of 0.1 pixel of a picture 2448 wide. The truth is what the simulators, or the formulas
of the virtual ones, know.

    unknown                  frames without a pose: the arm's trace has a hole there
    ours_mm, ours_deg        largest error of `calibration.camera_poses`, as an annotation computes them
    nearest_mm, nearest_deg  of the arm's sample whose arrival is nearest to the frame's arrival
    offset_ms, sigma_ms      the delay as calibrated, with its sigma; the median sigma of an exposure's time
    speed_m_s                of the camera, largest
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibration import BoardSpec, Calibration, camera_poses
from calibration.detection import Detection
from calibration.records import HandEyeRecord, IntrinsicsRecord, TimeOffsetRecord
from calibration.sessions import time_offset_from_session
from dataset.errors import ToolkitError
from dataset.frames import CameraInfo, RawFrame, RobotTrace
from dataset.intrinsics import Intrinsics
from dataset.session import Session, SessionWriter
from dataset.transforms import SE3, interpolate_poses, rotation_error_deg, translation_error_mm

Floats = NDArray[np.float64]

LATENCY_S, CAMERA_PPM, ARM_PPM, JITTER_S = 0.030, 80.0, -50.0, 0.002
RATE_HZ, ARM_HZ, EXPOSURE_US = 22.0, 500.0, 4000.0
WIDTH, HEIGHT = 256, 192
SCALE = WIDTH / 2448  # to the pixels of the paper's camera, in which lens and noise are given
CORNER_PX = 0.1 * SCALE
TCP = (0.0, 0.0, 0.1, 0.0, 0.0, 0.0)
SPEED_M_S = 0.25
BOARD = BoardSpec(11, 8, 0.035, 0.026, "DICT_5X5_100")
FOCAL_PX = 1740.0 * SCALE
LENS = Intrinsics(
    np.array([[FOCAL_PX, 0, WIDTH / 2], [0, FOCAL_PX, HEIGHT / 2], [0, 0, 1]]), np.zeros(0), HEIGHT, WIDTH
)


@dataclass(frozen=True)
class Recording:
    """A session, and where the camera truly was at each of its N exposures."""

    path: Path
    truth: SE3


def compare(record: Callable[[Path, int], Recording], folder: Path, seed: int) -> dict[str, Any]:
    """The figures of this module's docstring, from two recordings of the same rig."""
    random = np.random.default_rng(seed)
    calibrating, test = record(folder / "calibrate.h5", seed), record(folder / "test.h5", seed + 1)
    intrinsics = IntrinsicsRecord(LENS, np.zeros((4, 4)), 0.1, 0.1, 20, ())
    hand_eye = HandEyeRecord(
        SE3.identity(), board_pose(calibrating.truth), np.zeros((12, 12)), 0.1, 0.0, 0.0, 0.0, 0.0, 20, ()
    )
    with Session.open(calibrating.path) as session:
        seen = corners(calibrating.truth, hand_eye.T_base_board, random)
        offset = time_offset_from_session(session, BOARD, intrinsics, hand_eye, list(enumerate(seen)))
    known = Calibration(
        intrinsics=intrinsics,
        hand_eye=hand_eye,
        time_offset=TimeOffsetRecord(offset.offset_s, offset.sigma_s, offset.rms_px, ()),
    )
    with Session.open(test.path) as session:
        ours, nearest = camera_poses(session, known).T_base_cam, nearest_sample(session)
        at_s = 1e-9 * session.camera_time_ns
        sigma_ms = 1e3 * float(np.median(session.time_sigma_s))
    speed = np.linalg.norm(np.diff(test.truth.translation, axis=0), axis=1) / np.diff(at_s)
    return {
        "frames": len(at_s),
        "speed_m_s": round(float(speed.max()), 3),
        "offset_ms": round(1e3 * offset.offset_s, 3),
        "offset_sigma_ms": round(1e3 * offset.sigma_s, 3),
        "sigma_ms": round(sigma_ms, 3),
        "unknown": int((~ours.finite).sum()),
        "ours_mm": round(float(np.nanmax(translation_error_mm(ours, test.truth))), 4),
        "ours_deg": round(float(np.nanmax(rotation_error_deg(ours, test.truth))), 5),
        "nearest_mm": round(float(translation_error_mm(nearest, test.truth).max()), 3),
        "nearest_deg": round(float(rotation_error_deg(nearest, test.truth).max()), 4),
    }


def board_pose(truth: SE3) -> SE3:
    """T_base_board: 0.4 m before the camera in the middle of a recording, its middle on the optical axis."""
    middle = truth[len(truth.translation) // 2]
    half = 0.5 * BOARD.square_m * np.array([BOARD.squares_x, BOARD.squares_y, 0.0])
    return middle @ SE3.from_rotvec(np.zeros(3), np.array([0.0, 0.0, 0.4]) - half)


def corners(truth: SE3, T_base_board: SE3, random: np.random.Generator) -> list[Detection]:
    """What a detector would find in each picture, by the true pose at its exposure."""
    board = T_base_board.apply(BOARD.object_points(np.arange(BOARD.corner_count)))
    found = []
    for pose in truth:
        pixels = LENS.project(pose.inverse().apply(board))
        found.append(Detection(np.arange(len(board)), pixels + CORNER_PX * random.normal(size=pixels.shape)))
    return found


def nearest_sample(session: Session) -> SE3:
    """The arm's sample that arrived nearest to each frame's arrival."""
    trace = session.robot
    assert trace is not None
    after = np.clip(np.searchsorted(trace.host_time_ns, session.host_time_ns), 1, len(trace) - 1)
    early = session.host_time_ns - trace.host_time_ns[after - 1]
    late = trace.host_time_ns[after] - session.host_time_ns
    return trace.poses[np.where(early < late, after - 1, after)]


def virtual(path: Path, seed: int, seconds: float) -> Recording:
    """A session of devices that exist as formulas only."""
    random = np.random.default_rng(seed)
    epoch_ns, latest_s = 9_000_000_000_000, seconds + 1.0

    def arm(at_s: Floats) -> SE3:
        """A swing about the base at half a metre, up to 0.25 m/s, nodding a little."""
        angle, nod = np.sin(at_s), 0.1 * np.sin(2.3 * at_s)
        turn = SE3.from_rotvec(np.outer(angle, [0.0, 0.0, 0.5]), np.zeros((len(at_s), 3)))
        tilt = SE3.from_rotvec(np.outer(nod, [1.0, 0.0, 0.0]), np.tile([0.0, 0.5, 0.4], (len(at_s), 1)))
        return turn @ tilt @ SE3.from_rotvec(np.array([np.pi, 0.0, 0.0]), np.zeros(3))

    def arrival(at_s: Floats, delay_s: float) -> NDArray[np.int64]:
        late = random.exponential(5e-4, len(at_s)) + (random.random(len(at_s)) < 0.05) * random.uniform(
            0, 0.04, len(at_s)
        )
        return np.maximum.accumulate(epoch_ns + np.rint(1e9 * (at_s + delay_s + late)).astype(np.int64))

    info = CameraInfo("virtual", "virtual", "0", "0", "Mono8", "mono", WIDTH, HEIGHT, 8, 0)
    exposed = 0.5 + np.arange(round(seconds * RATE_HZ)) / RATE_HZ
    seen_ns = arrival(exposed, LATENCY_S)
    with SessionWriter(path, "sequence", info) as writer:
        for index, (at_s, host_ns) in enumerate(zip(exposed, seen_ns, strict=True)):
            camera_ns = 77_000_000_000 + round(1e9 * at_s * (1 + 1e-6 * CAMERA_PPM))
            black = np.zeros((HEIGHT, WIDTH), np.uint8)
            writer.add_frame(RawFrame(black, "Mono8", index, camera_ns, int(host_ns), EXPOSURE_US, 0.0, 0))
        times = np.arange(0.0, latest_s, 1 / ARM_HZ)
        robot_s = 500.0 + times * (1 + 1e-6 * ARM_PPM)
        bits = np.ones(len(times), np.uint32)
        trace = RobotTrace(
            arrival(times, 0.0), robot_s, np.zeros((len(times), 6)), arm(times).as_pose6(), bits
        )
        writer.add_robot_trace(trace, np.zeros(6))
        writer.fit_clocks()
    return Recording(path, arm(exposed + 5e-7 * EXPOSURE_US))


def on_the_wire(path: Path, seed: int, seconds: float, camera_address: str, host: str) -> Recording:
    """A session from the simulated devices over their real protocols."""
    from acquisition.camera import CameraConfig
    from acquisition.cameras.aravis import AravisCamera
    from acquisition.recorder import record_stream
    from acquisition.robot import RobotConfig
    from acquisition.robots.rtde import RtdeReader
    from acquisition.robots.ur import UrRobot
    from acquisition.simulation.camera import SimulatedCamera
    from acquisition.simulation.robot import SimulatedRobot

    del seed
    home = np.array([3.14, -1.57, 1.9, -1.9, -1.57, 0.0])
    swing = np.tile([home, home + np.array([0.5, 0.1, -0.1, 0.1, 0.1, 0.2])], (round(seconds), 1))
    with (
        SimulatedCamera(
            camera_address,
            width=WIDTH,
            height=HEIGHT,
            frame_rate=RATE_HZ,
            latency_s=LATENCY_S,
            drift_ppm=CAMERA_PPM,
        ) as simulated,
        SimulatedRobot(host, ARM_HZ, drift_ppm=ARM_PPM) as simulated_arm,
    ):
        simulated_arm.command(f"slow {JITTER_S}")
        camera_config = CameraConfig(camera_address, exposure_us=EXPOSURE_US, frame_rate=RATE_HZ)
        arm_config = RobotConfig(host, ARM_HZ, tcp_offset=TCP, joint_speed=0.5, joint_acceleration=1.0)
        with AravisCamera(camera_config) as camera, UrRobot(arm_config) as robot:
            robot.move_joints(home)
            with SessionWriter(path, "sequence", camera.info) as writer:
                record_stream(camera, robot, writer, motion=lambda: robot.follow(swing), duration_s=seconds)
        clock = simulated.clock()
        with RtdeReader(host, ["timestamp", "output_double_register_46"], ARM_HZ) as reader:
            now = np.frombuffer(reader.packages()[-1], reader.dtype)[0]
    with Session.open(path) as session:
        trace = session.robot
        assert trace is not None
        camera_s = 1e-9 * session.camera_time_ns + 5e-7 * session.exposures_us
        exposed = 1e-9 * clock.origin_ns + camera_s / (1 + 1e-6 * clock.drift_ppm)
        elapsed_s = (trace.robot_time_s - now["timestamp"]) / (1 + 1e-6 * ARM_PPM)
        true_s = now["output_double_register_46"] + elapsed_s
        return Recording(path, interpolate_poses(true_s, trace.poses, exposed))


def main() -> None:
    """Prints the figures."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--virtual", action="store_true", help="devices as formulas, deterministic")
    parser.add_argument("--seconds", type=float, default=14.0, help="length of each of the two recordings")
    parser.add_argument("--seed", type=int, default=0, help="of jitter and corner noise")
    parser.add_argument("--address", default="127.0.0.1", help="of the simulated camera")
    parser.add_argument("--host", default="127.0.0.35", help="of the simulated arm")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    options = parser.parse_args()

    def record(path: Path, seed: int) -> Recording:
        if options.virtual:
            return virtual(path, seed, options.seconds)
        return on_the_wire(path, seed, options.seconds, options.address, options.host)

    try:
        with tempfile.TemporaryDirectory() as folder:
            figures = compare(record, Path(folder), options.seed)
    except ToolkitError as error:
        sys.exit(f"time_alignment: {error}")
    if options.json:
        print(json.dumps(figures))
        return
    for name, value in figures.items():
        print(f"{name:16} {value}")


if __name__ == "__main__":
    main()
