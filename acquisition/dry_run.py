"""A capture without the capture: its route as a page to look at, before anything moves."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from html import escape
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from acquisition.clearance import CarriedCamera, skeleton
from acquisition.drawing import Canvas
from acquisition.kinematics import JOINT_LIMIT, READY, forward
from acquisition.rig import Rig, open_pose_source
from acquisition.robots.limits import MotionLimits
from acquisition.routes import Route, carried_camera
from acquisition.trajectories import rotation_spread_deg, seen_cells
from dataset.errors import ToolkitError
from dataset.transforms import SE3
from dataset.view_sphere import ViewSphere

Floats = NDArray[np.float64]

NOMINAL_SIZE = (2448, 2048)
"""(width, height) of the mosaic, where no camera is asked: the paper's."""

_WIDTH, _HEIGHT, _SCALE = 620, 470, 330.0
_OVERHEAD = 300.0  # pixels per metre of the view from above
_LOOKS_FROM_DEG = (35.0, 25.0)  # azimuth and elevation of the slanted view
_ARMS_DRAWN = 7
_FRUSTUM_M = 0.05
_ARM, _GHOST, _WAY, _CAMERA, _SUBJECT = "#37474f", "#90a4ae", "#1565c0", "#ef6c00", "#2e7d32"
_STYLE = (
    "body{font:15px/1.5 system-ui,sans-serif;margin:2em auto;max-width:1300px;color:#222;background:#fff}"
    "svg{background:#fafafa;border:1px solid #ddd;margin:4px}svg text{font:12px sans-serif;fill:#555}"
    "figure{display:inline-block;margin:0}figcaption{color:#555;text-align:center}"
    "td{padding:2px 14px 2px 0}.bad{color:#b71c1c;font-weight:bold}"
)


@dataclass(frozen=True, eq=False)
class Stance:
    """Where the arm stands before a route.

    Attributes:
        q: (6,) joint angles, radians.
        tcp_offset: (6,) the tool.
        known: whether the arm told so, or it is assumed.
    """

    q: Floats
    tcp_offset: Floats
    known: bool


def stance(rig: Rig) -> Stance:
    """Asks the arm where it stands, only reading it; where none answers, takes a bent arm above the table.

    The tool is the rig's, as a capture would set it, whatever is active now.
    """
    any_tool = replace(rig, robot=replace(rig.robot, tcp_offset=None))
    for readable in (any_tool, rig):  # the second for software that does not tell its tool
        with contextlib.suppress(ToolkitError), open_pose_source(readable) as source:
            tool = rig.robot.tcp_offset or source.tcp_offset
            return Stance(source.sample().q, np.array(tool, dtype=np.float64), known=True)
    tool = rig.robot.tcp_offset or (0.0,) * 6
    return Stance(np.array(READY), np.array(tool, dtype=np.float64), known=False)


@dataclass(frozen=True)
class Outlook:
    """What a route promises.

    Attributes:
        views, reached: how many were wished for, and how many the arm reaches.
        coverage: share of the upper hemisphere's cells that pictures are taken from.
        rotation_spread_deg: largest rotation between two pictures.
        duration_s: of the route once, roughly.
        joint_travel_rad: of the fastest joint.
    """

    views: int
    reached: int
    coverage: float
    rotation_spread_deg: float
    duration_s: float
    joint_travel_rad: float


def outlook(route: Route, rig: Rig) -> Outlook:
    """The route's figures.

    Raises ToolkitError where the route leaves the workspace of the rig file: the arm would refuse it.
    """
    limits = MotionLimits(rig.robot, route.carried.T_flange_tcp.as_pose6())
    limits.check_joint_path(route.q_start, route.q)
    way = np.vstack([route.q_start, route.q])
    return Outlook(
        views=route.wished,
        reached=route.reached,
        coverage=float(seen_cells(route.pictures_from(), route.subject.mean(axis=0), ViewSphere()).mean()),
        rotation_spread_deg=rotation_spread_deg(route.T_base_cam(route.q)),
        duration_s=route.duration_s(limits, rig.robot.joint_acceleration),
        joint_travel_rad=float(np.abs(np.diff(way, axis=0)).max(axis=1).sum()),
    )


def dry_run(rig: Rig, page: Path, plan: Callable[[CarriedCamera, Floats], Route]) -> Outlook:
    """Plans a route from where the arm stands and draws it on a self-contained HTML page.

    Args:
        rig: whose limits hold; its arm is read at most.
        page: where to write; overwritten.
        plan: makes the route of what the arm carries and its joint angles (6,).

    Returns:
        The route's figures.

    Raises:
        ToolkitError: nothing is within reach, the route leaves the workspace, or the page cannot be written.
    """
    here = stance(rig)
    route = plan(carried_camera(rig, here.tcp_offset), here.q)
    figures = outlook(route, rig)
    try:
        page.parent.mkdir(parents=True, exist_ok=True)
        page.write_text(_page(route, rig, here.known, figures), encoding="utf-8")
    except OSError as error:
        raise ToolkitError(
            f"{page} cannot be written ({error.strerror}); name a folder you may write to"
        ) from error
    return figures


def _page(route: Route, rig: Rig, known: bool, figures: Outlook) -> str:
    azimuth, elevation = np.deg2rad(_LOOKS_FROM_DEG)
    right = (-np.sin(azimuth), np.cos(azimuth), 0.0)
    up = (
        -np.sin(elevation) * np.cos(azimuth),
        -np.sin(elevation) * np.sin(azimuth),
        np.cos(elevation),
    )
    slanted = Canvas((_WIDTH, _HEIGHT), right, up, (0.25, 0.0, 0.35), _SCALE)
    above = Canvas((_WIDTH, _HEIGHT), (0, -1, 0), (1, 0, 0), (0.35, 0.0, 0.0), _OVERHEAD)
    for canvas in (slanted, above):
        _draw_scene(canvas, route, rig)
    start = "where the arm stands now" if known else "an assumed stance, as no arm answered"
    largest = np.rad2deg(np.abs(route.q).max())
    lowest = route.pictures_from().translation[:, 2].min()
    rows = {
        "views": f"{figures.reached} of {figures.views} within reach"
        if figures.reached >= figures.views
        else f'<span class="bad">{figures.reached} of {figures.views} within reach</span>',
        "coverage": f"{100 * figures.coverage:.0f} % of the upper hemisphere, in cells of about 10 degrees",
        "rotation between views": f"up to {figures.rotation_spread_deg:.0f} degrees",
        "duration": f"about {figures.duration_s:.0f} s, once through",
        "way of the joints": f"{figures.joint_travel_rad:.1f} rad of the fastest one",
        "largest joint angle": f"{largest:.0f} of {np.rad2deg(JOINT_LIMIT):.0f} degrees",
        "lowest camera": f"{lowest:.3f} m above the base plane",
        "limits": f"{rig.robot.speed:g} m/s, {rig.robot.joint_speed:g} rad/s",
        "starts from": start,
    }
    table = "".join(f"<tr><td>{name}</td><td>{value}</td></tr>" for name, value in rows.items())
    figures_html = "".join(
        f"<figure>{svg}<figcaption>{caption}</figcaption></figure>"
        for svg, caption in (
            (slanted.svg(), "from the side"),
            (above.svg(), "from above, x up"),
            (_sphere(route), "viewing directions, from above: blue seen, grey not"),
        )
    )
    title = f"Dry run: {escape(route.title)}"
    return (
        f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{title}</title><style>{_STYLE}</style>'
        f"<h1>{title}</h1><p>Nothing has moved. The arm is drawn at the start (dark) and at some of "
        f"{len(route.q)} waypoints; its way is that of the camera. Walls, cables and the object are not "
        f"known to the planner.</p><table>{table}</table>{figures_html}</html>\n"
    )


def _draw_scene(canvas: Canvas, route: Route, rig: Rig) -> None:
    side = 0.1 * np.arange(-8, 9)
    for x in side:
        canvas.line([[x + 0.3, -0.8, 0], [x + 0.3, 0.8, 0]], "#e0e0e0")
        canvas.line([[-0.5, x, 0], [1.1, x, 0]], "#e0e0e0")
    for end, name in (((0.2, 0, 0), "x"), ((0, 0.2, 0), "y"), ((0, 0, 0.2), "z")):
        canvas.line([(0, 0, 0), end], "#999", 1.5)
        canvas.label(end, name)
    low, high = np.array(rig.robot.workspace)
    corners = np.array([low[:2], (high[0], low[1]), high[:2], (low[0], high[1])])
    canvas.line(np.column_stack([np.vstack([corners, corners[:1]]), np.zeros(5)]), "#c62828", 1.0, 0.5)
    if len(route.subject) > 1:
        canvas.area(route.subject, "#a5d6a7", _SUBJECT, 0.8)
    for point in route.subject:
        canvas.dot(point, _SUBJECT, 4.0 if len(route.subject) == 1 else 1.5)
    drawn = np.unique(np.linspace(0, len(route.q) - 1, _ARMS_DRAWN).astype(int))
    for q in route.q[drawn]:
        _draw_arm(canvas, q, _GHOST, 4.0, 0.35, route)
    _draw_arm(canvas, route.q_start, _ARM, 6.0, 0.9, route)
    canvas.line(route.pictures_from().translation, _WAY, 1.0, 0.55)
    for view in route.T_base_cam(route.q[:: max(1, len(route.q) // 60)]):
        _draw_camera(canvas, view)


def _draw_arm(canvas: Canvas, q: Floats, colour: str, width: float, opacity: float, route: Route) -> None:
    lines = skeleton(q)
    canvas.line(lines, colour, width, opacity)
    body, _ = route.carried.body()
    behind, ahead = forward(q).apply(body[:2])
    canvas.line([lines[-1], 0.5 * (behind + ahead)], colour, 1.5, opacity)
    canvas.line([behind, ahead], colour, 2.0 * width, opacity)


def _draw_camera(canvas: Canvas, T_base_cam: SE3) -> None:
    half = 0.5 * _FRUSTUM_M
    corners = [[-half, -half, _FRUSTUM_M], [half, -half, _FRUSTUM_M], [half, half, _FRUSTUM_M]]
    outline = T_base_cam.apply([*corners, [-half, half, _FRUSTUM_M]])
    for corner in outline:
        canvas.line([T_base_cam.translation, corner], _CAMERA, 0.6, 0.7)
    canvas.area(outline, _CAMERA, _CAMERA, 0.25)


def _sphere(route: Route) -> str:
    """The upper hemisphere of viewing directions from above: height goes inwards, azimuth as in the plan."""
    sphere = ViewSphere()
    seen = seen_cells(route.pictures_from(), route.subject.mean(axis=0), sphere)
    canvas = Canvas((_WIDTH // 2 + 90, _HEIGHT), (0, -1, 0), (1, 0, 0), (0, 0, 0), 185.0)
    elevation = np.arcsin(sphere.directions[:, 2])
    azimuth = np.arctan2(sphere.directions[:, 1], sphere.directions[:, 0])
    for cell in range(len(sphere)):
        width, height = sphere.sizes[cell]
        turn = width / max(np.cos(elevation[cell]), 1e-9)
        edge = np.linspace(-0.5, 0.5, 5) * turn + azimuth[cell]
        radii = 1 - np.clip(elevation[cell] + np.array([-0.5, 0.5]) * height, 0, np.pi / 2) / (np.pi / 2)
        ring = np.concatenate([np.full(5, radii[0]), np.full(5, radii[1])])
        around = np.concatenate([edge, edge[::-1]])
        points = np.stack([ring * np.cos(around), ring * np.sin(around), np.zeros(10)], axis=1)
        canvas.area(points, "#1e88e5" if seen[cell] else "#eceff1", "#fff")
    return canvas.svg()
