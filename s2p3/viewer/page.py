"""The viewer's page: two pictures of one frame, the camera's way in 3-D, charts, and a slider over time."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from acquisition import stage
from acquisition.web import Address, page_server
from dataset.errors import ToolkitError
from dataset.session import Session
from s2p3.viewer.charts import UNTIMED_HZ, Chart, charts_of, seconds_of
from s2p3.viewer.look import DOLP, OBJECT, S0, SessionLook
from s2p3.viewer.world import World, world_of

if TYPE_CHECKING:
    import viser

_PERIOD_S = 0.03
_PICTURE_PX = 200
_LIVE_WIDTH_PX, _CONTROL_WIDTH_PX = 440, 380
_CHART_HEIGHT_PX = 115
_FRUSTA = 40
"""Of the cameras on the way, how many are drawn."""
_TILES_RADIUS = 0.45
"""Of the view sphere, in median distances of the camera."""


def serve_viewer(path: Path, address: Address, ready: Callable[[str], object]) -> None:
    """Serves a session's page until Ctrl-C.

    Args:
        path: of the session.
        address: where to listen.
        ready: called with the page's address once it is served.

    Raises:
        SessionError: no session, or one without frames.
        ToolkitError: viser is missing, or the port is taken.
    """
    with Session.open(path) as session:
        look = SessionLook(session)
        with page_server(address, path.name) as server:
            page = ViewerPage(server, look)
            ready(address.url)
            with contextlib.suppress(KeyboardInterrupt):
                page.run(threading.Event())


class ViewerPage:
    """The elements of the page.

    Args:
        server: new and empty.
        look: at the session; used by the thread that calls `run` or `update` alone.
    """

    def __init__(self, server: viser.ViserServer, look: SessionLook) -> None:
        self._server = server
        self._look = look
        self._world = world_of(look.session, look.objects)
        known = seconds_of(look.session)
        self._seconds = np.arange(len(look.session)) / UNTIMED_HZ if known is None else known
        """When each frame is played."""
        self._shown: tuple[Any, ...] = ()
        self._played_s, self._behind_s = time.monotonic(), 0.0
        server.gui.configure_theme(dark_mode=True, show_share_button=False, brand_color=(74, 144, 217))
        self._lay_out_pictures()
        self._lay_out_controls()
        stage.light(server)
        if self._world is None:
            stage.add_table(server)
        else:
            self._lay_out_world(self._world)

    def run(self, over: threading.Event) -> None:
        """Keeps the page up to date until `over` is set."""
        while not over.wait(_PERIOD_S):
            self.update()

    def show(self, index: int) -> None:
        """Moves the slider to a frame."""
        self._slider.value = index  # type: ignore[misc]

    def update(self) -> None:
        """Shows what slider and menus ask for."""
        self._play()
        wanted = (self._slider.value, self._upper_name.value, self._lower_name.value)
        if wanted == self._shown:
            return
        self._shown = wanted
        index = wanted[0]
        try:
            self._upper.image = stage.rgb(self._look.picture(wanted[1], index))
            self._lower.image = stage.rgb(self._look.picture(wanted[2], index))
            self._words.content = self._describe(index)
        except ToolkitError as error:
            self._words.content = _box(f'<span style="color:#f03e3e">{escape(str(error))}</span>')
        if self._world is not None:
            self._update_world(self._world, index)

    def _lay_out_pictures(self) -> None:
        gui, look = self._server.gui, self._look
        blank = np.zeros((look.camera.height, look.camera.width, 3), np.uint8)
        panel = gui.add_panel()
        with panel.add_tab("Frame"):
            first = OBJECT if look.objects else S0
            self._upper_name = gui.add_dropdown("Above", look.names, initial_value=first)
            self._upper = gui.add_image(blank, format="jpeg", jpeg_quality=88)
            self._lower_name = gui.add_dropdown("Below", look.names, initial_value=DOLP)
            self._lower = gui.add_image(blank, format="jpeg", jpeg_quality=88)
        panel.dock_left()
        panel.set_width(_LIVE_WIDTH_PX)

    def _lay_out_controls(self) -> None:
        gui, session = self._server.gui, self._look.session
        gui.add_html(_summary(self._look, self._world))
        self._slider = gui.add_slider("Frame", 0, max(1, len(session) - 1), 1, 0, disabled=len(session) < 2)
        self._playing = gui.add_checkbox("Play", False)
        self._words = gui.add_html("")
        with gui.add_folder("Clocks and residuals"):
            for chart in charts_of(session, self._look.objects):
                self._add_chart(chart)
        gui.main_panel.dock_right()
        gui.main_panel.set_width(_CONTROL_WIDTH_PX)

    def _add_chart(self, chart: Chart) -> None:
        grid = {"stroke": "rgba(128,128,128,.25)", "width": 1}
        axis: Any = {"stroke": "#a0a6b0", "grid": grid, "ticks": grid, "font": "11px sans-serif"}
        self._server.gui.add_uplot(
            (chart.at, chart.values),
            ({"label": chart.unit or "frame"}, {"label": chart.title, "stroke": "#4a90d9", "width": 1}),
            title=chart.title,
            scales={"x": {"time": False}},
            axes=(axis, axis),
            legend={"show": False},
            padding=(14, 24, 0, 0),
            height=_CHART_HEIGHT_PX,
        )

    def _lay_out_world(self, world: World) -> None:
        server, path = self._server, world.path
        camera = self._look.camera
        if world.frame == "base":
            stage.add_table(server)
        if len(path) > 1:
            segments = np.stack([path[:-1], path[1:]], axis=1)
            server.scene.add_line_segments(
                "/path", segments, (74, 144, 217), thickness=2.0, thickness_units="screen"
            )
        distance = _distance(world)
        known = np.flatnonzero(world.T_world_cam.finite)
        for index in known[:: max(1, len(known) // _FRUSTA)]:
            frustum = stage.add_camera(
                server, f"/way/{index}", camera.K, camera.height, camera.width, 0.06 * distance
            )
            frustum.color = (110, 116, 126)
            stage.place(frustum, world.T_world_cam[int(index)])
        self._camera = stage.add_camera(
            server, "/camera", camera.K, camera.height, camera.width, 0.25 * distance
        )
        self._arm = stage.ArmModel(server) if world.q is not None else None
        if world.T_world_obj is not None:
            record = self._look.session.object(self._look.objects[0])
            self._object = server.scene.add_mesh_simple(
                "/object", record.vertices, record.faces, color=(240, 170, 40), side="double"
            )
        target = world.centre if world.centre is not None else path.mean(axis=0) if len(path) else np.zeros(3)
        if world.views is not None:
            tiles = stage.ViewTiles(server, world.views, target, _TILES_RADIUS * distance)
            tiles.paint(world.counts)
        reach = max(1.9 * distance, 0.9 if self._arm is not None else 0.0)
        server.initial_camera.position = target + reach * np.array([0.75, 0.6, 0.6])
        server.initial_camera.look_at = target if self._arm is None else 0.6 * target + [0.0, 0.0, 0.15]

    def _update_world(self, world: World, index: int) -> None:
        pose = world.T_world_cam[index]
        self._camera.visible = bool(pose.finite)
        if pose.finite:
            stage.place(self._camera, pose)
            small = max(1, self._upper.image.shape[1] // _PICTURE_PX)
            self._camera.image = np.ascontiguousarray(self._upper.image[::small, ::small])
        if self._arm is not None and world.q is not None:
            self._arm.move(world.q[index])
        if world.T_world_obj is not None:
            T_world_obj = world.T_world_obj[index]
            self._object.visible = bool(T_world_obj.finite)
            if T_world_obj.finite:
                stage.place(self._object, T_world_obj)

    def _play(self) -> None:
        """On to the frame that was recorded as long after the last one as the clock has gone on."""
        now_s = time.monotonic()
        elapsed_s, self._played_s = now_s - self._played_s, now_s
        if not self._playing.value:
            self._behind_s = 0.0
            return
        times, index = self._seconds, self._slider.value
        self._behind_s += elapsed_s
        while index + 1 < len(times) and (step_s := times[index + 1] - times[index]) <= self._behind_s:
            self._behind_s -= step_s
            index += 1
        if index + 1 == len(times):
            self._playing.value = False  # type: ignore[misc]
        if index != self._slider.value:
            self.show(index)

    def _describe(self, index: int) -> str:
        """A line on the frame, and one on each object in it."""
        session = self._look.session
        seconds, exposure_us = seconds_of(session), session.exposures_us[index]
        parts = [] if seconds is None else [f"<b>{seconds[index]:.3f} s</b>"]
        parts.append(f"id {session.frame_ids[index]}")
        parts += [f"exposure {exposure_us:.0f} us"] if np.isfinite(exposure_us) else []
        parts.append(f"{100 * float(self._look.stokes(index).valid.mean()):.1f} % of pixels usable")
        lines = [", ".join(parts)]
        for name in self._look.objects:
            poses = session.object_poses(name)
            pose = poses.T_cam_obj[index]
            if not pose.finite:
                lines.append(f"{escape(name)}: pose unknown")
                continue
            x, y, z = 1e3 * pose.translation
            share = 100 * poses.visible_fraction[index]
            lines.append(
                f"{escape(name)}: {x:.1f}  {y:.1f}  {z:.1f} mm before the camera, {share:.0f} % in view"
            )
        return _box("<br>".join(lines))


def _summary(look: SessionLook, world: World | None) -> str:
    session = look.session
    seconds = seconds_of(session)
    span = "" if seconds is None else f" in {seconds[-1]:.1f} s"
    camera = session.camera
    parts = [
        f"<b>{escape(session.kind)}</b>, {len(session)} frames{span}, {len(session.drops)} dropped",
        f"{escape(camera.vendor)} {escape(camera.model)}, {escape(camera.pixel_format)}",
    ]
    if session.origin:
        parts.append(escape(session.origin))
    if not session.complete:
        parts.append('<span style="color:#f59f00">incomplete: the recording was interrupted</span>')
    if not look.calibrated:
        parts.append('<span style="color:#f59f00">not calibrated: pictures are distorted, no poses</span>')
    if world is not None and world.views is not None:
        parts.append(f"seen from {int((world.counts > 0).sum())} of {len(world.counts)} directions")
    return _box("<br>".join(parts))


def _distance(world: World) -> float:
    """The camera's typical distance from what it looked at, or the size of its path, metres."""
    path = world.path
    if len(path) == 0:
        return 0.4
    if world.centre is None:
        return max(float(np.ptp(path, axis=0).max()), 0.1)
    return float(np.median(np.linalg.norm(path - world.centre, axis=1)))


def _box(inner: str) -> str:
    return f'<div style="padding:.2em .9em .5em;font-size:.82em;line-height:1.4">{inner}</div>'
