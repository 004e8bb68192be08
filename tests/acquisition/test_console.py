"""The console in a real browser, with simulated devices behind it: what is shown and what is recorded."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from playwright.sync_api import Page, expect

from acquisition.console import Station
from acquisition.console.page import ConsolePage
from acquisition.console.station import VIEWS, viewing_cell
from acquisition.rig import CameraTable, Rig, RobotTable
from acquisition.robots.ur import UrRobot
from acquisition.simulation.camera import SimulatedCamera
from acquisition.simulation.robot import SimulatedRobot
from acquisition.trajectories import look_at
from acquisition.web import Address, page_server
from dataset.errors import ToolkitError
from dataset.session import Session
from dataset.validate import validate
from dataset.view_sphere import OUTSIDE

pytestmark = pytest.mark.devices

ROOT = Path(__file__).parents[2]
ARM = "127.0.0.81"
ADDRESS = Address(port=8093)
RIG = Rig(
    CameraTable("127.0.0.1", exposure_us=5_000.0, frame_rate=20.0, timeout_s=1.0),
    RobotTable(
        ARM, frequency_hz=125.0, silence_s=1.0, tcp_offset=(0.0,) * 6, joint_speed=1.5, joint_acceleration=5.0
    ),
)
Live = Callable[[], NDArray[np.uint8]]
Images = Callable[[Page], list[NDArray[np.uint8]]]
HOME = np.array([0.0, -1.57, 1.57, -1.57, -1.57, 0.0])


@pytest.fixture(scope="module")
def arm() -> Iterator[UrRobot]:
    """The simulated arm, at the hands of somebody who is not the console."""
    with SimulatedRobot(ARM, rate_hz=125.0), UrRobot(RIG.robot) as robot:
        robot.move_joints(HOME)
        yield robot


@pytest.fixture(scope="module")
def camera(arm: UrRobot) -> Iterator[SimulatedCamera]:
    """A camera that sees where the arm's base joint points."""
    del arm
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(ROOT)  # where the camera's process finds its source
        camera = SimulatedCamera(
            source="tests.acquisition.arm_pattern:ArmPattern",
            source_args={"host": ARM},
            width=320,
            height=256,
            frame_rate=20,
            latency_s=0.005,
        )
        with camera:
            yield camera


@pytest.fixture(scope="module")
def station(camera: SimulatedCamera, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Station]:
    del camera
    with Station(RIG, tmp_path_factory.mktemp("recordings")) as station:
        yield station


@pytest.fixture(scope="module")
def page(station: Station, browser_page: Page) -> Iterator[Page]:
    """The console in the browser, with a picture in it."""
    over = threading.Event()
    with page_server(ADDRESS, "console") as server:
        console = ConsolePage(server, station, RIG)
        thread = threading.Thread(target=console.run, args=(over,))
        thread.start()
        try:
            browser_page.goto(ADDRESS.url)
            expect(browser_page.get_by_text("exposure good")).to_be_visible()
            yield browser_page
        finally:
            over.set()
            thread.join()


def until(condition: Callable[[], object], seconds: float = 120.0) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.05)


@pytest.fixture
def live(page: Page, shown_images: Images) -> Live:
    """(h, w, 3) BGR: the live picture as the browser has it."""
    return lambda: shown_images(page)[0]


def square_at(shown: NDArray[np.uint8]) -> float:
    """Where in a picture the bright square stands, 0 at its left edge and 1 at its right."""
    bright = np.flatnonzero((shown.min(axis=-1) > 200).sum(axis=0) > 5)
    return float(bright.mean() / shown.shape[1]) if len(bright) else np.nan


def test_the_picture_changes_when_the_arm_moves(live: Live, arm: UrRobot) -> None:
    until(lambda: abs(square_at(live()) - 0.5) < 0.02)
    np.testing.assert_array_equal(live(), live())
    arm.move_joints(HOME + np.array([0.6, 0, 0, 0, 0, 0]))
    until(lambda: abs(square_at(live()) - (0.5 + 0.5 * np.sin(0.6))) < 0.03)
    arm.move_joints(HOME)
    until(lambda: abs(square_at(live()) - 0.5) < 0.02)


def test_the_arm_in_the_scene_follows_the_arm(page: Page, station: Station, arm: UrRobot) -> None:
    x, y, _ = arm.sample().T_base_tcp.translation
    expect(page.get_by_text(f"tool at {x:.3f} {y:.3f}")).to_be_visible()
    pose = station.T_base_cam()
    assert pose is not None
    np.testing.assert_allclose(pose.translation[:2], (x, y), atol=1e-3)
    canvas = page.locator("canvas").first
    before = canvas.screenshot()
    arm.move_joints(HOME + np.array([0, 0.5, -0.5, 0, 0, 0]))
    until(lambda: canvas.screenshot() != before)
    arm.move_joints(HOME)


def test_the_picture_can_be_chosen(page: Page, live: Live) -> None:
    def spread() -> float:
        """Between the mean blue, green and red: 0 for a grey picture."""
        return float(np.ptp(live().mean(axis=(0, 1))))

    assert spread() < 3
    page.get_by_text("DoLP", exact=True).first.click()
    expect(page.get_by_text("1 fully polarized")).to_be_visible()
    until(lambda: spread() > 20)
    page.get_by_text("S0", exact=True).first.click()
    until(lambda: spread() < 3)


def test_record_produces_a_valid_file(page: Page, station: Station, arm: UrRobot) -> None:
    page.get_by_role("button", name="Record").click()
    expect(page.get_by_text("● recording")).to_be_visible()
    recording = station.recording
    assert recording is not None
    expect(page.get_by_role("button", name="Apply")).to_be_disabled()
    expect(page.get_by_label("Time (us)")).to_be_disabled()
    with pytest.raises(ToolkitError, match="locked while recording"):
        station.configure(4_000.0, 0.0)
    with pytest.raises(ToolkitError, match="stop it first"):
        station.record("another")
    arm.move_joints(HOME + np.array([0.4, 0, 0, 0, 0, 0]))
    page.get_by_role("button", name="Pause").click()
    expect(page.get_by_text("● paused")).to_be_visible()
    time.sleep(0.5)  # for what was under way
    paused_at = recording.stored
    time.sleep(0.5)
    assert recording.stored == paused_at
    page.get_by_role("button", name="Resume").click()
    expect(page.get_by_text("● recording")).to_be_visible()
    arm.move_joints(HOME)
    page.get_by_role("button", name="Stop").click()
    expect(page.get_by_text("● complete")).to_be_visible()
    assert validate(recording.path) == []
    with Session.open(recording.path) as session:
        assert session.complete
        assert session.kind == "sequence"
        assert (len(session), len(session.drops)) == (recording.stored, recording.dropped)
        assert len(session) > 20
        assert len(session.pauses) == 1
        assert session.robot is not None
        assert np.ptp(session.robot.q[:, 0]) > 0.35
        assert "exposure_us = 5000.0" in session.rig_toml
        columns = [session.stokes(i, undistort=False).s0.max(axis=0).argmax() for i in range(len(session))]
        assert len(set(columns)) > 2
    expect(page.get_by_text(f"{recording.stored}", exact=True)).to_be_visible()
    fields = "[...document.querySelectorAll('input')].map(field => field.value)"
    until(lambda: "sequence-002" in page.evaluate(fields))


def test_exposure_is_set_and_what_the_camera_refuses_is_said(page: Page, station: Station) -> None:
    page.get_by_label("Time (us)").fill("20000")
    page.get_by_label("Time (us)").press("Enter")
    page.get_by_role("button", name="Apply").click()
    until(lambda: station.camera.latest is not None and station.camera.latest.exposure_us == 20_000.0)
    expect(page.get_by_text("saturated (red)")).to_be_visible()
    page.get_by_label("Time (us)").fill("1000000000")
    page.get_by_label("Time (us)").press("Enter")
    page.get_by_role("button", name="Apply").click()
    expect(page.get_by_text("cannot take exposure_us")).to_be_visible()
    assert station.camera.rig.camera.exposure_us == 20_000.0
    station.configure(5_000.0, 0.0)
    expect(page.get_by_text("exposure good")).to_be_visible()


@pytest.mark.parametrize("name", ["", "../escape", "a/b", ".hidden", "a b"])
def test_a_recording_stays_in_its_folder(station: Station, name: str) -> None:
    with pytest.raises(ToolkitError, match="is no file name"):
        station.record(name)


def test_a_recording_is_never_overwritten(station: Station) -> None:
    station.out.mkdir(exist_ok=True)
    (station.out / "mine.h5").write_text("mine")
    with pytest.raises(ToolkitError, match=r"exists, and recordings are never overwritten"):
        station.record("mine.h5")


def test_a_lost_camera_is_shown_and_comes_back(
    page: Page, live: Live, station: Station, camera: SimulatedCamera
) -> None:
    camera.stop()
    until(lambda: station.camera.problem is not None)
    expect(page.get_by_text("127.0.0.1", exact=False).first).to_be_visible()
    with pytest.raises(ToolkitError, match="the camera is not ready"):
        station.record("without-camera")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(ROOT)
        camera.start()
    until(lambda: station.camera.problem is None and station.camera.rate > 10)
    until(lambda: abs(square_at(live()) - 0.5) < 0.02)


def test_without_any_device_the_console_says_what_is_missing(tmp_path: Path) -> None:
    nowhere = Rig(CameraTable("127.0.0.97"), RobotTable("127.0.0.97", tcp_offset=(0.0,) * 6))
    with Station(nowhere, tmp_path) as station:
        until(
            lambda: "127.0.0.97" in str(station.camera.problem) and "127.0.0.97" in str(station.arm.problem)
        )
        with pytest.raises(ToolkitError, match="the arm is not ready"):
            station.record("nothing")
    assert list(tmp_path.iterdir()) == []


def test_a_view_is_counted_where_the_camera_looks_at_the_object() -> None:
    centre = np.array([0.4, 0.1, 0.05])
    for cell in range(0, len(VIEWS), 17):
        eye = centre + 0.35 * VIEWS.directions[cell]
        assert viewing_cell(look_at(eye, centre), centre) == cell
        assert viewing_cell(look_at(eye, 2 * eye - centre), centre) == OUTSIDE
