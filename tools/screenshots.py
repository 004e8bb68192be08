"""Regenerates the documentation's pictures of the pages in the browser: `python tools/screenshots.py`.

A simulated lab is started, its arm sweeps over the cup, and the console records that, steered through the
page; `console.jpg` is taken meanwhile. The recording is annotated with the lab's truth, and `viewer.jpg` is
what the viewer shows of it. Needs chromium.
"""

from __future__ import annotations

import argparse
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from playwright.sync_api import Page, sync_playwright

from acquisition.console import Station
from acquisition.console.page import ConsolePage
from acquisition.planning import CarriedCamera, plan_path
from acquisition.rig import Rig, open_robot
from acquisition.robot import MotionStopped
from acquisition.trajectories import hemisphere_path
from acquisition.web import Address, page_server
from dataset.session import Session, write_calibration, write_object, write_poses
from dataset.transforms import SE3, interpolate_poses
from s2p3 import objects
from s2p3.annotation import render_poses
from s2p3.lab import LabTruth, found_lab, running_lab
from s2p3.viewer.look import SessionLook
from s2p3.viewer.page import ViewerPage

IMAGES = Path(__file__).parents[1] / "docs" / "images"

_CHROMIUM = "/usr/bin/chromium"
_SOFTWARE_WEBGL = ("--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
_SIZE = {"width": 1500, "height": 880}
_SECONDS = 60.0
"""How long the arm is filmed; where the machine draws slowly, frames come slowly."""
_SETTLE_S = 8.0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=IMAGES, help="folder for the pictures")
    parser.add_argument("--port", type=int, default=8091, help="for the pages")
    options = parser.parse_args()
    address = Address(port=options.port)
    with tempfile.TemporaryDirectory() as folder:
        truth_path, rig_path = found_lab(Path(folder), "cup", 3)
        recording = film_console(truth_path, Rig.load(rig_path), address, options.out / "console.jpg")
        annotate(recording, LabTruth.load(truth_path))
        film_viewer(recording, address, options.out / "viewer.jpg")


def film_console(truth: Path, rig: Rig, address: Address, picture: Path) -> Path:
    """Records a sweep through the page; returns the session."""
    with (
        running_lab(truth, rig),
        page_server(address, "S²P³ console") as server,
        Station(rig, truth.parent / "recordings") as station,
        up_to_date(ConsolePage(server, station, rig)),
        browser_page(address) as page,
        sweeping(rig),
    ):
        page.get_by_role("button", name="Record").click()
        time.sleep(_SECONDS)
        page.screenshot(path=picture, type="jpeg", quality=88)
        page.get_by_role("button", name="Stop").click()
        while station.busy:
            time.sleep(0.1)
        assert station.recording is not None
        print(f"{picture}: {picture.stat().st_size // 1000} kB, {station.recording.stored} frames")
        return station.recording.path


def film_viewer(recording: Path, address: Address, picture: Path) -> None:
    """The middle of the session, with the object drawn over it."""
    with (
        Session.open(recording) as session,
        page_server(address, recording.name) as server,
    ):
        viewer = ViewerPage(server, SessionLook(session))
        viewer.show(len(session) // 2)
        with up_to_date(viewer), browser_page(address) as page:
            time.sleep(_SETTLE_S)
            page.screenshot(path=picture, type="jpeg", quality=88)
    print(f"{picture}: {picture.stat().st_size // 1000} kB")


def annotate(recording: Path, truth: LabTruth) -> None:
    """Writes the poses that a perfect calibration would give."""
    model = objects.build(truth.object_name)
    write_calibration(recording, "{}", truth.intrinsics)
    write_object(recording, model.to_record())
    with Session.open(recording) as session:
        trace, clock = session.robot, session.clocks.robot
        assert trace is not None
        assert clock is not None
        sampled_s = 1e-9 * clock.to_host(np.rint(1e9 * trace.robot_time_s).astype(np.int64))
        exposed_s = 1e-9 * session.mid_exposure_host_ns + truth.time_offset_s
        T_base_tcp = interpolate_poses(sampled_s, trace.poses, np.clip(exposed_s, *sampled_s[[0, -1]]))
        T_base_cam = T_base_tcp @ truth.T_tcp_cam
        poses = render_poses(session, T_base_cam.inverse() @ truth.T_base_object, model.mesh)
    write_poses(recording, T_base_cam, 0.0, 0.0, {model.name: poses})


@contextmanager
def sweeping(rig: Rig) -> Iterator[None]:
    """The arm on a hemisphere over the object, for the length of a `with` block."""
    views = hemisphere_path(np.array(rig.frames.object_centre_guess), (0.38, 0.34), (30.0, 80.0), rows=4)
    with open_robot(rig) as robot:
        carried = CarriedCamera(
            SE3.from_pose6(robot.tcp_offset), SE3.from_pose6(np.array(rig.frames.T_tcp_cam_guess))
        )
        plan = plan_path(views, carried, robot.sample().q)
        robot.move_joints(plan.q[0])
        over = threading.Event()

        def sweep() -> None:
            while not over.is_set():
                try:
                    robot.follow(plan.q)
                    robot.follow(plan.q[::-1])
                except MotionStopped:
                    return

        thread = threading.Thread(target=sweep)
        thread.start()
        try:
            yield
        finally:
            over.set()
            robot.stop()
            thread.join()


@contextmanager
def up_to_date(page: ConsolePage | ViewerPage) -> Iterator[None]:
    """Runs a page in a thread."""
    over = threading.Event()
    thread = threading.Thread(target=page.run, args=(over,))
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


@contextmanager
def browser_page(address: Address) -> Iterator[Page]:
    """The page in a browser without a window, its notice of software rendering put away."""
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=_CHROMIUM, args=list(_SOFTWARE_WEBGL))
        page = browser.new_page(viewport=_SIZE)
        page.set_default_timeout(180_000)  # WebGL in software, beside a lab on the same machine
        page.goto(address.url)
        notice = page.locator(".mantine-Notification-closeButton")
        notice.first.click(timeout=60_000)
        yield page
        browser.close()


if __name__ == "__main__":
    main()
