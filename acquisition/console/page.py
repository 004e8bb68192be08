"""The console's page: pictures on the left, the arm in the middle, devices and recorder on the right."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from acquisition import stage
from acquisition.console import words
from acquisition.console.recording import Kind
from acquisition.console.station import VIEWS, Station
from acquisition.rig import Rig
from acquisition.web import Address, page_server
from dataset import pictures
from dataset.errors import ToolkitError
from dataset.frames import CameraInfo, RawFrame, RobotSample
from dataset.on_camera import decode_frame
from dataset.pictures import Picture
from dataset.polarimetry import DARK, Stokes
from dataset.transforms import SE3

if TYPE_CHECKING:
    import viser

_PERIOD_S = 0.12
"""Between two pictures (our choice: live to the eye, and a tenth of a core)."""
_RECORDING_PERIOD_S = 0.3
"""The same while recording, whose threads need the cores more."""
_CALM_PERIOD_S = 0.5
"""Between two changes of what need not be fluent, so that a slow browser keeps up with what must be."""
_VIEWS = ("S0", "DoLP", "AoLP")
_PAUSE, _RESUME = "❚❚ Pause", "▶ Resume"
_BINS = 40
_LEAST = 0.01
"""Percent at which the histogram's logarithmic scale begins."""
_SMALL_PX = 240
_TILES_RADIUS_M = 0.16
_LIVE_WIDTH_PX, _CONTROL_WIDTH_PX = 500, 370
_KINDS: tuple[Kind, ...] = ("sequence", "intrinsics", "hand_eye")


def serve_console(rig: Rig, out: Path, address: Address, ready: Callable[[str], object]) -> None:
    """Serves the console until Ctrl-C; a recording that goes on then is ended properly.

    Args:
        rig: whose devices; they may come and go.
        out: folder for recordings.
        address: where to listen.
        ready: called with the page's address once it is served.

    Raises:
        ToolkitError: viser is missing, or the port is taken.
    """
    with page_server(address, "S²P³ console") as server, Station(rig, out) as station:
        page = ConsolePage(server, station, rig)
        ready(address.url)
        with contextlib.suppress(KeyboardInterrupt):
            page.run(threading.Event())


class ConsolePage:
    """The elements of the page and what they do.

    Args:
        server: new and empty.
        station: running.
        rig: for where things stand.
    """

    def __init__(self, server: viser.ViserServer, station: Station, rig: Rig) -> None:
        self._server = server
        self._station = station
        self._shown: RawFrame | None = None
        self._calm_until_s = 0.0
        self._arm_before: RobotSample | None = None
        self._refused = ""
        server.gui.configure_theme(dark_mode=True, show_share_button=False, brand_color=(74, 144, 217))
        self._lay_out_pictures()
        self._lay_out_controls()
        self._lay_out_scene(rig)

    def run(self, over: threading.Event) -> None:
        """Keeps the page up to date until `over` is set."""
        while not over.wait(_RECORDING_PERIOD_S if self._station.busy else _PERIOD_S):
            self.update()

    def update(self) -> None:
        """Shows how things are now."""
        calm = time.monotonic() < self._calm_until_s
        if not calm:
            self._calm_until_s = time.monotonic() + _CALM_PERIOD_S
            self._update_words()
        self._update_arm()
        latest, info = self._station.camera.latest, self._station.camera.info
        if latest is not None and info is not None and latest is not self._shown:
            self._shown = latest
            try:
                self._update_pictures(latest, info, calm)
            except ToolkitError as error:  # a format without an intensity
                self._refused = str(error)

    def _lay_out_pictures(self) -> None:
        gui = self._server.gui
        panel = gui.add_panel()
        with panel.add_tab("Live"):
            self._view = gui.add_button_group("Picture", _VIEWS)
            self._picture = gui.add_image(np.zeros((512, 612, 3), np.uint8), format="jpeg", jpeg_quality=85)
            self._legend = gui.add_html("")
            self._exposure_words = gui.add_html("")
            self._histogram = gui.add_uplot(
                (np.linspace(0, 1, _BINS), np.full(_BINS, _LEAST)),
                (
                    {"label": "DoLP"},
                    {"label": "%", "stroke": "#4a90d9", "fill": "rgba(74,144,217,.3)", "width": 2},
                ),
                title="DoLP, % of pixels",
                scales={
                    "x": {"time": False, "range": (0.0, 1.0)},
                    "y": {"distr": 3, "range": (_LEAST, 100.0)},
                },
                axes=(_axis(), _axis()),
                legend={"show": False},
                padding=(10, 24, 0, 0),
                height=190,
            )
        panel.dock_left()
        panel.set_width(_LIVE_WIDTH_PX)

    def _lay_out_controls(self) -> None:
        gui, station = self._server.gui, self._station
        self._device_words = gui.add_html("")
        with gui.add_folder("Record"):
            self._kind = gui.add_dropdown("Kind", _KINDS)
            self._name = gui.add_text("Name", self._free_name())
            self._record = gui.add_button("● Record", color="red")
            self._pause = gui.add_button(_PAUSE, disabled=True)
            self._stop = gui.add_button("■ Stop", disabled=True)
            self._recording_words = gui.add_html("")
        with gui.add_folder("Exposure"):
            camera = station.camera.rig.camera
            self._exposure = gui.add_number("Time (us)", camera.exposure_us, min=1.0, step=100.0)
            self._gain = gui.add_number("Gain (dB)", camera.gain_db, min=0.0, step=0.5)
            self._apply = gui.add_button("Apply")
        self._notice = gui.add_html("")
        gui.main_panel.dock_right()
        gui.main_panel.set_width(_CONTROL_WIDTH_PX)
        self._kind.on_update(lambda _: self._suggest_name())
        self._record.on_click(lambda _: self._do(lambda: station.record(self._name.value, self._kind.value)))
        self._pause.on_click(lambda _: self._do(station.pause))
        self._stop.on_click(lambda _: self._do(station.stop))
        self._apply.on_click(
            lambda _: self._do(lambda: station.configure(self._exposure.value, self._gain.value))
        )

    def _lay_out_scene(self, rig: Rig) -> None:
        server = self._server
        stage.light(server)
        stage.add_table(server)
        self._arm = stage.ArmModel(server)
        self._arm.show(False)
        height, width = 512, 612
        self._camera = stage.add_camera(
            server, "/camera", pictures.nominal_camera_matrix(height, width), height, width, 0.09
        )
        self._camera.visible = False
        centre = np.array(rig.frames.object_centre_guess)
        server.scene.add_icosphere("/object", radius=0.02, color=(240, 170, 40), position=centre)
        self._tiles = stage.ViewTiles(server, VIEWS, centre, _TILES_RADIUS_M)
        self._add_board(rig)
        server.initial_camera.position = centre + np.array([0.9, 0.75, 0.75])
        server.initial_camera.look_at = (0.6 * centre[0], 0.6 * centre[1], 0.25)

    def _add_board(self, rig: Rig) -> None:
        board = rig.board
        width, height = board.squares_x * board.square_m, board.squares_y * board.square_m
        T_base_board = SE3.from_pose6(np.array(rig.frames.T_base_board_guess))
        corners = T_base_board.apply(np.array([[0, 0, 0], [width, 0, 0], [width, height, 0], [0, height, 0]]))
        self._server.scene.add_mesh_simple(
            "/board", corners, np.array([[0, 1, 2], [0, 2, 3]]), color=(225, 225, 225), side="double"
        )

    def _update_pictures(self, frame: RawFrame, info: CameraInfo, calm: bool) -> None:
        stokes = decode_frame(frame.pixels, info)
        blown = pictures.saturated(stokes)
        view = self._view.value
        shown = stage.rgb(_drawn(stokes, blown, view))
        self._picture.image = shown
        if calm:
            return
        _say(self._legend, words.legend(view))
        _say(self._exposure_words, words.exposure(float(blown.mean()), float((stokes.s0 < DARK).mean())))
        usable = stokes.dolp[stokes.valid]
        counts, edges = np.histogram(usable, bins=_BINS, range=(0, 1))
        percent = np.maximum(100.0 * counts / max(1, len(usable)), _LEAST)
        self._histogram.data = (0.5 * (edges[1:] + edges[:-1]), percent)
        if self._camera.visible:
            small = max(1, shown.shape[1] // _SMALL_PX)
            self._camera.image = np.ascontiguousarray(shown[::small, ::small])

    def _update_arm(self) -> None:
        sample, pose = self._station.arm.latest, self._station.T_base_cam()
        self._arm.show(sample is not None)
        if self._camera.visible != (pose is not None):
            self._camera.visible = pose is not None
        if sample is not None and pose is not None:
            self._arm.move(sample.q)
            stage.place(self._camera, pose)

    def _update_words(self) -> None:
        station = self._station
        motion = words.motion(self._arm_before, station.arm.latest)
        self._arm_before = station.arm.latest
        _say(self._device_words, words.devices(station, motion))
        covered = int((station.coverage > 0).sum())
        _say(self._recording_words, words.recording(station.recording, covered, len(VIEWS)))
        _say(self._notice, words.notice(self._refused or station.camera.refused or ""))
        self._tiles.paint(station.coverage)
        if station.busy != self._record.disabled:
            self._lock(station.busy)
        paused = station.recording is not None and station.recording.state == "paused"
        if paused != (self._pause.label == _RESUME):
            self._pause.label = _RESUME if paused else _PAUSE

    def _lock(self, busy: bool) -> None:
        """While recording, all one can do is to pause and to end it."""
        for button in (self._record, self._apply):
            button.disabled = busy
        for field in (self._kind, self._name, self._exposure, self._gain):
            field.disabled = busy
        self._pause.disabled = self._stop.disabled = not busy
        if not busy:
            self._suggest_name()

    def _suggest_name(self) -> None:
        self._name.value = self._free_name()  # type: ignore[misc]

    def _free_name(self) -> str:
        """The kind and the first number for which no file exists."""
        number = 1
        while (self._station.out / f"{self._kind.value}-{number:03d}.h5").exists():
            number += 1
        return f"{self._kind.value}-{number:03d}"

    def _do(self, action: Callable[[], object]) -> None:
        """What a button does, in a thread of the server's; where it cannot be done, the page says why."""
        try:
            action()
            self._refused = ""
        except ToolkitError as error:
            self._refused = str(error)


def _drawn(stokes: Stokes, blown: NDArray[np.bool_], view: str) -> Picture:
    if view == "DoLP":
        return pictures.degree(stokes)
    if view == "AoLP":
        return pictures.angle(stokes)
    picture = pictures.in_colour(pictures.intensity(stokes))
    picture[blown] = pictures.SATURATED_BGR
    return picture


def _axis() -> Any:
    grid = {"stroke": "rgba(128,128,128,.25)", "width": 1}
    return {"stroke": "#a0a6b0", "grid": grid, "ticks": grid, "font": "11px sans-serif"}


def _say(element: viser.GuiHtmlHandle, text: str) -> None:
    """Sends it only where it is new."""
    if element.content != text:
        element.content = text
