"""The viewer: pictures that fit the session, files without a browser, a page that follows its slider."""

from __future__ import annotations

import shutil
import socket
import threading
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path

import cv2
import h5py
import numpy as np
import pytest
from numpy.typing import NDArray
from playwright.sync_api import Page, expect

from acquisition.web import Address, page_server
from dataset import SE3, CameraInfo, RawFrame, RobotTrace, SessionError
from dataset.bop import export_bop
from dataset.importers import import_bop
from dataset.pictures import intensity
from dataset.session import Session, SessionWriter, write_poses
from s2p3.cli import main
from s2p3.silhouettes import Silhouettes
from s2p3.viewer import save_pictures
from s2p3.viewer.charts import UNTIMED_HZ, charts_of, drawn, seconds_of
from s2p3.viewer.look import DOLP, OBJECT, PRIORS, S0, SessionLook
from s2p3.viewer.page import ViewerPage
from s2p3.viewer.world import world_of

FRAMES = 8
GOLDEN = Path(__file__).parents[1] / "dataset" / "golden" / "session-1.1.h5"
Images = Callable[[Page], list[NDArray[np.uint8]]]


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What a rig just recorded: frames at 10 Hz and the arm's trace, neither calibrated nor annotated."""
    path = tmp_path_factory.mktemp("recorded") / "recorded.h5"
    camera = CameraInfo("maker", "model", "1", "1.0", "Mono8", "mono", 64, 48, 8, 9000)
    rng = np.random.default_rng(4)
    with SessionWriter(path, "sequence", camera) as writer:
        for index in range(12):
            time_ns = 10**9 + index * 10**8
            pixels = rng.integers(20, 200, (48, 64)).astype(np.uint8)
            late_ns = int(rng.integers(0, 10**6))
            writer.add_frame(RawFrame(pixels, "Mono8", index, time_ns, time_ns + late_ns, 5e3, 0.0, 0))
        times = np.arange(0.8, 2.4, 0.008)
        q = np.outer(times, np.ones(6))
        host = np.rint(times * 1e9).astype(np.int64)
        writer.add_robot_trace(
            RobotTrace(host, times, q, np.zeros_like(q), np.ones(len(q), np.uint32)), np.zeros(6)
        )
        writer.fit_clocks()
    return path


def test_the_object_is_drawn_where_its_mask_is(cup_session: Path) -> None:
    with Session.open(cup_session) as session:
        look = SessionLook(session)
        assert look.names == (S0, DOLP, "AoLP", *PRIORS, OBJECT)
        for index in (0, 5):
            plain = np.dstack([intensity(session.stokes(index))] * 3)
            changed = (look.picture(OBJECT, index) != plain).any(axis=-1)
            mask = session.object_poses("cup").mask(index).astype(np.uint8)
            assert changed[mask > 0].mean() > 0.98
            around = cv2.dilate(mask, np.ones((5, 5), np.uint8))  # the outline lies on the edge
            assert not changed[around == 0].any()


def test_the_priors_are_those_of_the_object(cup_session: Path) -> None:
    with Session.open(cup_session) as session:
        look = SessionLook(session)
        assert look.refractive_index == session.object("cup").refractive_index
        # Where the cup reflects, blue says that the specular prior faces the camera.
        prior = look.picture(PRIORS[1], 0)[session.object_poses("cup").mask(0)]
        assert (prior[:, 0] > 127).mean() > 0.95


def test_a_session_without_calibration_is_shown_as_the_camera_saw_it(recorded: Path) -> None:
    with Session.open(recorded) as session:
        look = SessionLook(session)
        assert look.names == (S0, DOLP, "AoLP", *PRIORS)
        np.testing.assert_array_equal(
            look.picture(S0, 3)[..., 0], intensity(session.stokes(3, undistort=False))
        )
        assert world_of(session, look.objects) is None


def test_a_synthetic_session_is_drawn_around_its_object(cup_session: Path) -> None:
    with Session.open(cup_session) as session:
        world = world_of(session, ("cup",))
        assert world is not None
        assert (world.frame, world.q) == ("object", None)
        poses = session.object_poses("cup").T_cam_obj
        np.testing.assert_allclose(world.path, poses.inverse().translation)
        assert world.counts.sum() == FRAMES


def test_charts_tell_time_and_lateness(recorded: Path) -> None:
    with Session.open(recorded) as session:
        charts = {chart.title: chart for chart in charts_of(session, ())}
        np.testing.assert_allclose(charts["Time between frames, ms"].values, 100.0)
        late = charts["Camera: arrival after its clock's fit, ms"].values
        assert -1e-3 < late.min() < 0.3
        assert late.max() < 1.2
        assert np.abs(charts["Arm: arrival after its clock's fit, ms"].values).max() < 0.05
        for chart in charts.values():
            assert (drawn(chart, 300, 100) < 200).any(axis=-1).sum() > 100


def test_times_that_nobody_measured_are_not_made_up(cup_session: Path, tmp_path: Path) -> None:
    """The session as it comes out of a BOP data set, which has no times."""
    bop = export_bop([cup_session], tmp_path / "bop", Silhouettes())
    import_bop(bop / "test" / "000000", tmp_path / "untimed.h5")
    with Session.open(tmp_path / "untimed.h5") as session:
        assert seconds_of(session) is None
        (chart,) = charts_of(session, ("cup",))
        assert (chart.title, chart.unit) == ("cup: share in view", "")
        assert chart.at.tolist() == list(range(FRAMES))
    save_pictures(tmp_path / "untimed.h5", tmp_path / "out")
    film = cv2.VideoCapture(str(tmp_path / "out" / "untimed.mp4"))
    assert film.get(cv2.CAP_PROP_FPS) == UNTIMED_HZ
    with Session.open(cup_session) as session:
        timed = charts_of(session, ("cup",))
        assert {chart.unit for chart in timed} == {"s"}
        assert timed[0].at.tolist() == pytest.approx([0.01 * index for index in range(1, FRAMES)])


def test_save_writes_a_film_and_pictures(cup_session: Path, tmp_path: Path) -> None:
    told: list[tuple[int, int]] = []
    written = save_pictures(cup_session, tmp_path / "out", every=2, on_progress=lambda *n: told.append(n))
    assert sorted(path.name for path in written) == sorted(path.name for path in (tmp_path / "out").iterdir())
    assert {"cup.mp4", "coverage.png", "clocks.png", "frame-000000.png", "frame-000007.png"} <= {
        path.name for path in written
    }
    assert told == [(1, 4), (2, 4), (3, 4), (4, 4)]
    film = cv2.VideoCapture(str(tmp_path / "out" / "cup.mp4"))
    frames = []
    while (read := film.read())[0]:
        frames.append(read[1].astype(int))
    assert len(frames) == 4
    assert all(np.abs(a - b).mean() > 1 for a, b in pairwise(frames))
    for path in written[1:]:
        assert cv2.imread(str(path)).std() > 5


def test_save_works_without_a_calibration(recorded: Path, tmp_path: Path) -> None:
    names = {path.name for path in save_pictures(recorded, tmp_path)}
    assert "coverage.png" not in names
    assert {"recorded.mp4", "clocks.png"} <= names


def bad_files(folder: Path, session: Path) -> Iterator[tuple[Path, str]]:
    """Files that cannot be shown, and what is said about each."""
    yield folder / "missing.h5", "missing.h5"
    (folder / "text.h5").write_text("no HDF5")
    yield folder / "text.h5", "text.h5"
    with SessionWriter(
        folder / "empty.h5", "sequence", CameraInfo("", "", "", "", "Mono8", "mono", 4, 4, 8, 0)
    ):
        pass
    yield folder / "empty.h5", "holds no frames"
    damaged = Path(shutil.copy(session, folder / "damaged.h5"))
    with h5py.File(damaged, "r+") as file:
        file["camera/crc32"][:] += 1
    yield damaged, "damaged"


def test_what_cannot_be_shown_costs_one_line(
    cup_session: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for path, said in bad_files(tmp_path, cup_session):
        assert main(["dataset", "view", str(path), "--save", str(tmp_path / "out")]) == 2
        error = capsys.readouterr().err.strip()
        assert error.count("\n") == 0
        assert said in error
    with pytest.raises(SessionError, match="damaged"), Session.open(tmp_path / "damaged.h5") as session:
        SessionLook(session).picture(S0, 0)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["console", "--rig", "rig.toml", "--host", "0.0.0.0"], "give a --token"),
        (["console", "--rig", "missing.toml"], "missing.toml"),
        (["dataset", "view", "s.h5", "--host", "192.168.0.9"], "give a --token"),
        (["dataset", "view", "s.h5", "--token", "easy"], "16 characters"),
        (["dataset", "view", "s.h5", "--every", "0"], "--every 0 is too small"),
        (["dataset", "view", str(GOLDEN), "--host", "no where", "--token", "a" * 16], "is no address"),
        (["dataset", "view", str(GOLDEN), "--host", "192.168..1", "--token", "a" * 16], "is no address"),
    ],
)
def test_a_page_that_cannot_be_served_costs_one_line(
    words: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(words) == 2
    error = capsys.readouterr().err.strip()
    assert error.count("\n") == 0
    assert said in error


@pytest.fixture
def viewer(cup_session: Path, browser_page: Page) -> Iterator[Page]:
    """The synthetic session's page, open in the browser."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        address = Address(port=probe.getsockname()[1])
    over = threading.Event()

    def serve() -> None:
        with Session.open(cup_session) as session, page_server(address, "cup.h5") as server:
            page = ViewerPage(server, SessionLook(session))
            ready.set()
            page.run(over)

    ready = threading.Event()
    thread = threading.Thread(target=serve)
    thread.start()
    try:
        assert ready.wait(60)
        browser_page.goto(address.url)
        yield browser_page
    finally:
        over.set()
        thread.join()


def test_the_slider_changes_the_pictures(viewer: Page, cup_session: Path, shown_images: Images) -> None:
    with Session.open(cup_session) as session:
        look = SessionLook(session)
        expected = [[look.picture(name, index) for name in (OBJECT, DOLP)] for index in range(FRAMES)]

    def shows(index: int) -> bool:
        """Whether both pictures are frame `index`'s, and no other frame's: as JPEG lets one tell."""
        shown = shown_images(viewer)
        if len(shown) != 2:
            return False
        for place, picture in enumerate(shown):
            step = picture.shape[1] // expected[0][place].shape[1]
            small = picture[step // 2 :: step, step // 2 :: step].astype(int)
            apart = [np.abs(small - frame[place]).mean() for frame in expected]
            if int(np.argmin(apart)) != index or apart[index] > 20:
                return False
        return True

    expect(viewer.get_by_text("before the camera, 100 % in view")).to_be_visible()
    assert wait_for(lambda: shows(0))
    slider = viewer.get_by_role("slider").first
    slider.focus()
    for _ in range(3):
        slider.press("ArrowRight")
    assert wait_for(lambda: shows(3))
    slider.press("ArrowLeft")
    assert wait_for(lambda: shows(2))


def wait_for(condition: Callable[[], bool], rounds: int = 200) -> bool:
    """Whether the condition comes to hold, with patience for software WebGL."""
    pause = threading.Event()
    return any(condition() or pause.wait(0.2) for _ in range(rounds))


def test_poses_of_an_arm_are_drawn_in_its_base(recorded: Path, tmp_path: Path) -> None:
    path = Path(shutil.copy(recorded, tmp_path / "posed.h5"))
    way = np.stack([np.linspace(0, 0.3, 12), np.zeros(12), np.full(12, 0.4)], axis=1)
    write_poses(path, SE3(np.broadcast_to(np.eye(3), (12, 3, 3)), way), 1e-3, 1e-3, {})
    with Session.open(path) as session:
        world = world_of(session, ())
        assert world is not None
        assert world.frame == "base"
        np.testing.assert_allclose(world.path, way)
        assert world.q is not None
        np.testing.assert_allclose(world.q[:, 0], session.host_time_ns * 1e-9, atol=1e-6)
        assert "Camera pose, sigma of position, mm" in {chart.title for chart in charts_of(session, ())}
