"""rig.toml: the example loads, what is saved is read back, every mistake is named."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from acquisition.camera import Camera
from acquisition.rig import (
    EXAMPLE,
    BoardTable,
    CameraTable,
    FramesTable,
    Rig,
    RobotTable,
    open_camera,
    open_pose_source,
    open_robot,
)
from acquisition.robot import PoseSource
from dataset.errors import DeviceError, ToolkitError

MINIMAL = """
[camera]
address = "127.0.0.1"
[robot]
host = "127.0.0.2"
"""


def load(tmp_path: Path, text: str) -> Rig:
    path = tmp_path / "rig.toml"
    path.write_text(text)
    return Rig.load(path)


def test_example_loads_and_says_what_the_defaults_do_not() -> None:
    rig = Rig.load(EXAMPLE)
    assert rig.camera.address.startswith("192.168.")
    assert rig.camera.frame_rate == 22.0
    assert rig.robot.workspace[1] == (0.9, 0.6, 0.9)
    assert rig.frames.T_tcp_cam_guess[1] == -0.06


def test_example_names_every_field() -> None:
    text = EXAMPLE.read_text()
    for table in (CameraTable, RobotTable, BoardTable, FramesTable):
        for name in table.__dataclass_fields__:
            # The recorder chooses the trigger; the file need not.
            assert f"{name} = " in text or name == "trigger", name


def test_two_addresses_make_a_rig(tmp_path: Path) -> None:
    rig = load(tmp_path, MINIMAL)
    assert rig == Rig(CameraTable("127.0.0.1"), RobotTable("127.0.0.2"))


def test_round_trip(tmp_path: Path) -> None:
    rig = Rig.load(EXAMPLE)
    changed = replace(
        rig,
        camera=replace(rig.camera, packet_size=9000, frame_rate=None),
        robot=replace(rig.robot, tcp_offset=(0.0, 0.01, 0.2, 0.0, 1e-9, 3.0)),
    )
    changed.save(tmp_path / "rig.toml")
    assert Rig.load(tmp_path / "rig.toml") == changed


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        (MINIMAL.replace("host", "adress"), ["[robot]", "'adress'", "did you mean"]),
        (MINIMAL.replace("[robot]", "exposure = 3\n[robot]"), ["[camera]", "'exposure'", "'exposure_us'"]),
        (MINIMAL.replace("[robot]", "[robto]"), ["table 'robto'", "did you mean 'robot'"]),
        (MINIMAL + "speed = 'slow'", ["robot.speed", "number", "'slow'"]),
        (MINIMAL + "speed = 5", ["[robot] speed = 5", "(0, 3]"]),
        (MINIMAL + "driver = 'kuka'", ["robot.driver", "'ur'", "'kuka'"]),
        (MINIMAL + "tcp_offset = [1, 2]", ["[robot] tcp_offset", "six"]),
        (MINIMAL + "workspace = [[0, 0, 0], [1, 1]]", ["robot.workspace[1]", "3 entries, not 2"]),
        (MINIMAL + "workspace = [[0, 0, 0], [1, 1, 0]]", ["[robot] workspace", "lower corner"]),
        (MINIMAL.replace("[robot]", "exposure_us = 0\n[robot]"), ["[camera] exposure_us", "positive"]),
        (MINIMAL.replace("[robot]", "pixel_format = 'Bayer'\n[robot]"), ["[camera]", "Bayer"]),
        (MINIMAL + "[board]\nsquares_x = 2", ["[board] squares_x", "at least 3"]),
        (MINIMAL + "[board]\nsquare_m = 35\nmarker_m = 26", ["[board] marker_m", "in metres"]),
        (MINIMAL + "[board]\nsquares_x = 7.0", ["board.squares_x", "whole number"]),
        (MINIMAL + "[frames]\nT_tcp_cam_guess = [0, 0, 0]", ["frames.T_tcp_cam_guess", "6 entries, not 3"]),
        (MINIMAL.replace('"127.0.0.1"', "127.0.0.1"), ["line 3"]),
        ("[camera]\naddress = '127.0.0.1'", ["lacks the table 'robot'"]),
    ],
)
def test_mistakes_are_named(tmp_path: Path, text: str, parts: list[str]) -> None:
    with pytest.raises(ToolkitError) as caught:
        load(tmp_path, text)
    message = str(caught.value)
    assert message.startswith(str(tmp_path / "rig.toml"))
    assert "\n" not in message
    for part in parts:
        assert part in message


def test_missing_file_points_to_the_example(tmp_path: Path) -> None:
    with pytest.raises(ToolkitError, match=r"no-rig\.toml: no such file; copy .*rig\.example\.toml"):
        Rig.load(tmp_path / "no-rig.toml")


@pytest.mark.parametrize("open_device", [open_camera, open_robot, open_pose_source])
def test_a_device_that_does_not_answer_is_named_with_what_to_check(
    open_device: Callable[[Rig], Camera | PoseSource],
) -> None:
    address = "127.0.0.51"
    robot = RobotTable(address, tcp_offset=(0.0, 0.0, 0.0, 0.0, 0.0, 0.0))
    with pytest.raises(DeviceError, match=f"{address}.*check"):
        open_device(Rig(CameraTable(address), robot))
