"""A rig: which camera, arm and board, and roughly where things stand, as people write it in rig.toml.

Metres, radians, seconds; a number in another unit carries it in its name. A pose is [x y z rx ry rz]: metres,
then a rotation vector in radians. `rig.example.toml` beside this file shows every table.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from acquisition import typed_toml
from acquisition.camera import Camera, CameraConfig
from acquisition.robot import PoseSource, Robot, RobotConfig
from dataset.errors import ToolkitError

Vector3 = tuple[float, float, float]
Pose6 = tuple[float, float, float, float, float, float]

CameraDriver = Literal["aravis", "harvesters"]
RobotDriver = Literal["ur"]

EXAMPLE = Path(__file__).with_name("rig.example.toml")
"""A commented rig file for a laboratory, to copy and edit."""


@dataclass(frozen=True)
class CameraTable(CameraConfig):
    """[camera]: the fields of `CameraConfig`, and the driver that opens it."""

    driver: CameraDriver = "aravis"
    """`aravis`: GigE Vision through the Aravis library; `harvesters`: the GenTL producer of the maker."""


@dataclass(frozen=True)
class RobotTable(RobotConfig):
    """[robot]: the fields of `RobotConfig`, and the driver that reaches it."""

    driver: RobotDriver = "ur"
    """`ur`: Universal Robots over RTDE."""


@dataclass(frozen=True)
class BoardTable:
    """[board]: the board used to calibrate. Measure the print: printers scale."""

    squares_x: int = 11
    """Squares along the board's x axis."""
    squares_y: int = 8
    """Squares along the board's y axis."""
    square_m: float = 0.035
    """Side of a square, metres."""
    marker_m: float = 0.026
    """Side of a marker, metres."""
    dictionary: str = "DICT_5X5_100"
    """OpenCV's name of the ArUco dictionary; unused by a chessboard."""
    kind: Literal["charuco", "checkerboard", "aprilgrid"] = "charuco"
    """`charuco`, `checkerboard` (seen whole only), or `aprilgrid`: squares are then cells with a tag each."""

    def __post_init__(self) -> None:
        if min(self.squares_x, self.squares_y) < (2 if self.kind == "aprilgrid" else 3):
            raise ToolkitError(
                f"squares_x and squares_y are {self.squares_x} and {self.squares_y}; a board needs at least "
                "3 squares a side: count those of the print"
            )
        if self.kind == "checkerboard" and 0 < self.square_m < 1:
            return
        if not 0 < self.marker_m < self.square_m < 1:
            raise ToolkitError(
                f"marker_m = {self.marker_m:g} and square_m = {self.square_m:g} must satisfy "
                "0 < marker_m < square_m < 1; measure both on the print, in metres"
            )


@dataclass(frozen=True)
class FramesTable:
    """[frames]: guesses, to about 5 cm and 20 degrees, that planning starts from and calibration replaces."""

    T_tcp_cam_guess: Pose6 = (0.0, 0.0, 0.05, 0.0, 0.0, 0.0)
    """The camera (x right, y down, z along the view) in the tool frame."""
    T_base_board_guess: Pose6 = (0.4, 0.0, 0.0, math.pi, 0.0, 0.0)
    """The board (x right, y down the print, z into it: face up, z points down) in the base frame."""
    object_centre_guess: Vector3 = (0.4, 0.0, 0.05)
    """Centre of the object in the base frame, metres."""
    T_tcp_tip: Vector3 = (0.0, 0.0, 0.1)
    """The measuring tip in the tool frame, metres: a point, so a translation is all."""


@dataclass(frozen=True)
class Rig:
    """The tree of rig.toml."""

    camera: CameraTable
    robot: RobotTable
    board: BoardTable = field(default_factory=BoardTable)
    frames: FramesTable = field(default_factory=FramesTable)

    @staticmethod
    def load(path: str | Path) -> Rig:
        """Reads a rig file.

        Raises ToolkitError, naming file, table and field: no such file, TOML syntax (with the line), an
        unknown table or field (with the nearest valid name), a missing field, a wrong type, a value out of
        range.
        """
        return typed_toml.load(Rig, path, hint=f"copy {EXAMPLE} there and edit it")

    def to_toml(self) -> str:
        """The whole rig as TOML, defaults included: what every session stores."""
        return typed_toml.dumps(self)

    def save(self, path: str | Path) -> None:
        """Writes `to_toml()` to a file that `load` reads back equal."""
        Path(path).write_text(self.to_toml(), encoding="utf-8")


def open_camera(rig: Rig) -> Camera:
    """Opens the rig's camera. Raises DeviceError, saying what to check, when it does not answer."""
    return _CAMERAS[rig.camera.driver](rig.camera)


def open_robot(rig: Rig) -> Robot:
    """Opens the rig's arm, to read and to move. Raises DeviceError, saying what to check."""
    return _ROBOTS[rig.robot.driver](rig.robot)


def open_pose_source(rig: Rig) -> PoseSource:
    """Opens the rig's arm only to read it, while a hand or the pendant moves it.

    Raises DeviceError, saying what to check.
    """
    return _POSE_SOURCES[rig.robot.driver](rig.robot)


def _aravis(config: CameraConfig) -> Camera:
    from acquisition.cameras.aravis import AravisCamera

    return AravisCamera(config)


def _harvesters(config: CameraConfig) -> Camera:
    from acquisition.cameras.harvesters import HarvestersCamera

    return HarvestersCamera(config)


def _ur(config: RobotConfig) -> Robot:
    from acquisition.robots.ur import UrRobot

    return UrRobot(config)


def _ur_poses(config: RobotConfig) -> PoseSource:
    from acquisition.robots.ur_receiver import UrReceiver

    return UrReceiver(config)


_CAMERAS: dict[CameraDriver, Callable[[CameraConfig], Camera]] = {
    "aravis": _aravis,
    "harvesters": _harvesters,
}
_ROBOTS: dict[RobotDriver, Callable[[RobotConfig], Robot]] = {"ur": _ur}
_POSE_SOURCES: dict[RobotDriver, Callable[[RobotConfig], PoseSource]] = {"ur": _ur_poses}
