"""What is true in the simulated lab: drawn from a seed, known to the simulators, never told to the toolkit.

Only two readers exist: the simulated camera (which renders it) and the demo's last step (which compares what
was recovered).
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dataset.errors import ToolkitError
from dataset.intrinsics import Intrinsics
from dataset.transforms import SE3
from s2p3.lab.sensor import Sensor, made_sensor

MOSAIC_HEIGHT, MOSAIC_WIDTH = 2048, 2448


@dataclass(frozen=True)
class LabTruth:
    """The hidden state of one simulated lab. Poses are UR pose vectors (6,): metres and a rotation vector in
    radians.
    """

    seed: int
    object_name: str
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...]
    """OpenCV's k1 k2 p1 p2 k3."""
    tcp_cam: tuple[float, ...]
    base_board: tuple[float, ...]
    base_object: tuple[float, ...]
    tcp_tip: tuple[float, ...]
    """The tip's position in the flange frame, metres."""
    latency_s: float
    """From the start of an exposure to its first packet on the wire; rendering takes most of it."""
    exposure_offset_s: float
    """How long before the time the camera stamps the exposure really happened."""
    camera_drift_ppm: float
    """How much too fast the camera's clock runs."""
    arm_drift_ppm: float
    """How much too fast the arm controller's clock runs."""
    arm_error_m: float
    arm_error_rad: float
    """Amplitudes of the arm's own error: its links are not quite what its controller computes with."""
    refractive_index: float
    extinction_ratio: tuple[float, ...]
    """Range of the pixels' polarizers, T_max / T_min."""
    orientation_sigma_rad: float
    gain_sigma: float
    """Of the pixels' polarizers, about the nominal."""
    read_noise: float
    full_well: float
    pivot_noise_m: float
    """Standard deviation of the tip's place in the hole it is tilted in, an axis."""
    touch_noise_m: float
    """Standard deviation of a touched point along the surface normal: the tip's ball, the operator's hand."""

    @property
    def intrinsics(self) -> Intrinsics:
        K = np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1.0]])
        return Intrinsics(K, np.array(self.distortion), MOSAIC_HEIGHT, MOSAIC_WIDTH)

    @property
    def sensor(self) -> Sensor:
        """The camera's sensor, pixel by pixel."""
        low, high = self.extinction_ratio
        made = made_sensor(
            MOSAIC_HEIGHT,
            MOSAIC_WIDTH,
            (low, high),
            self.orientation_sigma_rad,
            self.gain_sigma,
            np.random.default_rng(self.seed + 5),
        )
        return Sensor(self.full_well, self.read_noise, made)

    @property
    def T_tcp_cam(self) -> SE3:
        return SE3.from_pose6(np.array(self.tcp_cam))

    @property
    def T_base_board(self) -> SE3:
        return SE3.from_pose6(np.array(self.base_board))

    @property
    def T_base_object(self) -> SE3:
        return SE3.from_pose6(np.array(self.base_object))

    def T_base_flange(self, reported: SE3) -> SE3:
        """Where the flange really is when the controller reports a pose: a little off, smoothly varying."""
        wave = np.sin(2 * np.pi / _ARM_ERROR_PERIOD_M * reported.translation)
        return reported @ SE3.exp(
            np.concatenate([self.arm_error_m * wave, self.arm_error_rad * wave[[1, 2, 0]]])
        )

    @property
    def time_offset_s(self) -> float:
        """What has to be added to a frame's time on the host to find the arm's pose at its exposure."""
        return -(self.latency_s + self.exposure_offset_s)

    def save(self, path: Path) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(asdict(self), indent=1), encoding="utf-8")

    @staticmethod
    def load(path: Path) -> LabTruth:
        try:
            values: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
            fields: dict[str, Any] = {
                name: tuple(v) if isinstance(v, list) else v for name, v in values.items()
            }
            return LabTruth(**fields)
        except (OSError, ValueError, TypeError, AttributeError) as error:
            raise ToolkitError(
                f"{path} is not the truth of a simulated lab ({error}); start the lab afresh in a new folder."
            ) from error


# The furniture that a rig file knows roughly, as one knows it with a tape measure.
NOMINAL_TCP_CAM = (0.0, -0.075, 0.045, 0.0, 0.0, float(np.pi))
NOMINAL_BOARD_CENTRE = (0.45, -0.22, 0.0)
NOMINAL_OBJECT_CENTRE = (0.45, 0.20, 0.0)
TCP_TIP = (0.0, 0.0, 0.18)
TIP_PLAY_M = 2e-3
"""How far from that the tip is, an axis at most: it was screwed on by hand."""
_ARM_ERROR_PERIOD_M = 0.4
NOMINAL_FOCAL_PX = 1739.0
"""A 6 mm lens on 3.45 um pixels."""


def sample_truth(
    seed: int, object_name: str, nominal_index: float, board_size_m: tuple[float, float], T_table_object: SE3
) -> LabTruth:
    """Draw one lab.

    Args:
        seed: the same seed, the same lab.
        object_name: the object that lies on the table.
        nominal_index: the refractive index the object's model file states; the real one is a few percent off.
        board_size_m: width and height of the board, metres.
        T_table_object: how the object rests on a table whose normal is +z.
    """
    rng = np.random.default_rng(seed)
    focal = NOMINAL_FOCAL_PX * rng.uniform(0.97, 1.03)
    tcp_cam = SE3.from_pose6(np.array(NOMINAL_TCP_CAM)) @ _small_motion(
        rng, translation_m=0.006, rotation_rad=0.06
    )
    yaw = rng.uniform(-0.25, 0.25)
    # OpenCV's board frame starts at a corner, z into the board: down, for a board on a table.
    flat = SE3.from_rotvec(np.array([np.pi, 0.0, 0.0]), np.zeros(3))
    centre = SE3.from_rotvec(np.zeros(3), -np.array([*board_size_m, 0.0]) / 2)
    T_base_board = _on_table(rng, NOMINAL_BOARD_CENTRE, yaw) @ flat @ centre
    T_base_object = _on_table(rng, NOMINAL_OBJECT_CENTRE, rng.uniform(-np.pi, np.pi)) @ T_table_object
    return LabTruth(
        seed=seed,
        object_name=object_name,
        fx=focal,
        fy=focal * rng.uniform(0.999, 1.001),
        cx=(MOSAIC_WIDTH - 1) / 2 + rng.uniform(-25, 25),
        cy=(MOSAIC_HEIGHT - 1) / 2 + rng.uniform(-25, 25),
        distortion=(
            rng.uniform(-0.11, -0.07),
            rng.uniform(0.05, 0.09),
            rng.uniform(-4e-4, 4e-4),
            rng.uniform(-4e-4, 4e-4),
            0.0,
        ),
        tcp_cam=_tuple(tcp_cam),
        base_board=_tuple(T_base_board),
        base_object=_tuple(T_base_object),
        latency_s=rng.uniform(0.0, 0.03),
        exposure_offset_s=rng.uniform(0.020, 0.040),
        camera_drift_ppm=rng.uniform(-60, 60),
        arm_drift_ppm=rng.uniform(-60, 60),
        arm_error_m=5e-5,
        arm_error_rad=1e-4,
        refractive_index=nominal_index * rng.uniform(1.03, 1.08),
        extinction_ratio=(50.0, 300.0),
        orientation_sigma_rad=float(np.radians(1.0)),
        gain_sigma=0.02,
        read_noise=2.5,
        full_well=10_000.0,
        pivot_noise_m=3e-5,
        touch_noise_m=1e-4,
        tcp_tip=tuple(float(c) for c in np.array(TCP_TIP) + rng.uniform(-TIP_PLAY_M, TIP_PLAY_M, 3)),
    )


def _small_motion(rng: np.random.Generator, translation_m: float, rotation_rad: float) -> SE3:
    return SE3.from_rotvec(
        rng.uniform(-rotation_rad, rotation_rad, 3), rng.uniform(-translation_m, translation_m, 3)
    )


def _on_table(rng: np.random.Generator, centre: tuple[float, float, float], yaw: float) -> SE3:
    jitter = np.array([*rng.uniform(-0.02, 0.02, 2), 0.0])
    return SE3.from_rotvec(np.array([0.0, 0.0, yaw]), np.array(centre) + jitter)


def _tuple(pose: SE3) -> tuple[float, ...]:
    return tuple(float(value) for value in pose.as_pose6())
