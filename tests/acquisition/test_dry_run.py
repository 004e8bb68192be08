"""Routes of captures, and the pages that show them before anything moves."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from acquisition.clearance import CarriedCamera, is_clear
from acquisition.drawing import Canvas
from acquisition.dry_run import NOMINAL_SIZE, dry_run, outlook, stance
from acquisition.kinematics import READY
from acquisition.rig import EXAMPLE, Rig
from acquisition.robots.limits import MotionLimits
from acquisition.routes import Route, board_stills, board_sweep, carried_camera, object_sweeps
from acquisition.simulation.robot import SimulatedRobot
from dataset.errors import ToolkitError

RIG = replace(Rig.load(EXAMPLE), robot=replace(Rig.load(EXAMPLE).robot, host="127.0.0.37"))
CARRIED = carried_camera(RIG, np.zeros(6))


@pytest.fixture(scope="module")
def sweeps() -> Route:
    return object_sweeps(RIG, CARRIED, READY)


def test_route_of_the_board() -> None:
    route = board_stills(RIG, CARRIED, READY, NOMINAL_SIZE, 24)
    assert route.reached == 24
    assert is_clear(route.q, CARRIED).all()
    figures = outlook(route, RIG)
    assert figures.rotation_spread_deg > 60
    assert 24 * 0.8 < figures.duration_s < 200


def test_route_about_the_board_is_short() -> None:
    route = board_sweep(RIG, CARRIED, READY, NOMINAL_SIZE)
    assert not route.stills
    assert outlook(route, RIG).duration_s < 60


def test_route_of_the_object_tells_its_coverage(sweeps: Route) -> None:
    figures = outlook(sweeps, RIG)
    assert len(sweeps.plans) == 3
    assert 0.4 < figures.coverage < 0.7  # from 30 degrees up there are half of the cells and a few
    assert figures.reached < figures.views == sweeps.wished
    assert is_clear(sweeps.q, CARRIED).all()


def test_duration_follows_the_limits(sweeps: Route) -> None:
    slow = replace(RIG.robot, speed=0.1, joint_speed=0.2)
    seconds = [
        sweeps.duration_s(MotionLimits(c, np.zeros(6)), c.joint_acceleration) for c in (RIG.robot, slow)
    ]
    assert seconds[1] > 2 * seconds[0]


def test_a_route_that_the_arm_would_refuse_is_refused_before(sweeps: Route) -> None:
    tight = replace(RIG, robot=replace(RIG.robot, workspace=((0.3, -0.5, 0.2), (0.5, 0.5, 0.5))))
    with pytest.raises(ToolkitError, match="outside the workspace"):
        outlook(sweeps, tight)


def test_page_is_whole_and_needs_nothing_else(tmp_path: Path, sweeps: Route) -> None:
    page = tmp_path / "new" / "page.html"
    figures = dry_run(RIG, page, lambda carried, q: sweeps)
    text = page.read_text(encoding="utf-8")
    assert not re.search(r"(src|href)=|url\(|@import", text)
    pictures = re.findall(r"<svg.*?</svg>", text, re.DOTALL)
    assert len(pictures) == 3
    for picture in pictures:
        drawn = list(ET.fromstring(picture))
        assert len(drawn) > 50
    assert f"{100 * figures.coverage:.0f} % of the upper hemisphere" in text
    assert f"{figures.reached} of {figures.views} within reach" in text
    assert "an assumed stance" in text


def test_without_an_arm_a_stance_is_assumed() -> None:
    here = stance(RIG)
    assert not here.known
    np.testing.assert_array_equal(here.q, READY)


def test_a_page_that_cannot_be_written(tmp_path: Path, sweeps: Route) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(ToolkitError, match=r"cannot be written .*; name a folder"):
        dry_run(RIG, tmp_path / "file" / "page.html", lambda carried, q: sweeps)


@pytest.mark.devices
def test_with_an_arm_its_stance_and_tool_are_read_and_nothing_else(tmp_path: Path) -> None:
    rig = replace(RIG, robot=replace(RIG.robot, host="127.0.0.38", silence_s=1.0))
    seen: list[tuple[CarriedCamera, np.ndarray]] = []

    def plan(carried: CarriedCamera, q: np.ndarray) -> Route:
        seen.append((carried, q))
        return board_stills(rig, carried, q, NOMINAL_SIZE, 6)

    with SimulatedRobot(rig.robot.host) as arm:
        arm.command("local")  # reading is all it needs
        arm.command("tcp 0 0 0.05 0 0 0")
        dry_run(rig, tmp_path / "page.html", plan)
        assert "control_connections=0" in arm.command("state")
    ((carried, q),) = seen
    np.testing.assert_allclose(carried.T_flange_tcp.translation, [0, 0, 0.05])
    np.testing.assert_allclose(q, READY)
    assert "where the arm stands now" in (tmp_path / "page.html").read_text(encoding="utf-8")


@pytest.mark.devices
@pytest.mark.parametrize("software", [(5, 12, 4), (5, 4, 0)])
def test_the_tool_is_the_one_that_a_capture_would_set(software: tuple[int, int, int]) -> None:
    tool = (0.0, 0.0, 0.1, 0.0, 0.0, 0.0)
    rig = replace(RIG, robot=replace(RIG.robot, host="127.0.0.39", silence_s=1.0, tcp_offset=tool))
    with SimulatedRobot(rig.robot.host, software=software) as arm:
        if software < (5, 5, 1):  # which cannot be read with another tool
            arm.command("tcp 0 0 0.1 0 0 0")
        here = stance(rig)
    assert here.known
    np.testing.assert_allclose(here.tcp_offset, tool)


def test_points_land_where_they_are_seen() -> None:
    canvas = Canvas((200, 100), (0, -1, 0), (1, 0, 0), (1.0, 0.0, 0.0), 100.0)  # from above, x up
    canvas.dot([1.0, 0.0, 5.0], "red")
    canvas.dot([1.2, -0.5, 0.0], "red")
    centres = [(c.get("cx"), c.get("cy")) for c in ET.fromstring(canvas.svg())]
    assert centres == [("100.0", "50.0"), ("150.0", "30.0")]
