"""`s2p3 calibrate ...`: each verb reads sessions, adds its result to calibration.json, and writes the report
beside it.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import tyro

from s2p3.commands.arguments import ObjectName, OptionalPath, at_least
from s2p3.console_output import counting, say

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from calibration import BoardSpec, IntrinsicsRecord
    from calibration.closed_forms import Mount
    from calibration.next_pose import Reachable
    from dataset.transforms import SE3

_FEWEST_PX_PER_SQUARE = 20
"""Two pixels a marker's cell, or nearly."""


def board(
    *,
    rig: Path,
    out: OptionalPath = None,
    pdf: OptionalPath = None,
    page: str = "A4",
    px_per_square: int = 300,
) -> None:
    """Draw the rig's board to print; measure the print afterwards.

    Args:
        rig: rig.toml with the [board] table.
        out: PNG to write.
        pdf: PDF to write: to scale, with a ruler to check the print.
        page: of the PDF: A4, A3, A2, or WIDTHxHEIGHT in millimetres.
        px_per_square: resolution of the PNG.
    """
    import cv2

    from calibration.board import draw
    from calibration.board_pdf import board_pdf
    from dataset.errors import ToolkitError

    at_least(_FEWEST_PX_PER_SQUARE, px_per_square=px_per_square)
    if out is None and pdf is None:
        raise ToolkitError("board: nothing to write; give --pdf board.pdf to print, or --out board.png")
    spec = board_of(rig)
    written: dict[Path, bytes] = {}
    if pdf is not None:
        written[pdf] = board_pdf(spec, page)
    if out is not None:
        _, picture = cv2.imencode(".png", draw(spec, px_per_square, margin_px=px_per_square // 2))
        written[out] = picture.tobytes()
    for path, content in written.items():
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
        say(f"{path}: print it at 100 %, then measure a square and correct [board] square_m in {rig}")


def intrinsics(
    session: tyro.conf.Positional[Path],
    *,
    rig: Path,
    calibration: Path = Path("calibration.json"),
    apply: tuple[Path, ...] = (),
) -> None:
    """Estimate K and lens distortion from stills of the board.

    Args:
        session: recorded with s2p3 capture intrinsics or hand-eye.
        rig: rig.toml with the [board] table.
        calibration: calibration.json to add the result to.
        apply: sessions to write the calibration into.
    """
    from calibration.steps import add_intrinsics

    with counting("detect the board") as report:
        done = add_intrinsics(session, board_of(rig), calibration, report)
    say(f"{_focal(done)}, reprojection {done.rms_px:.3f} px, held out {done.held_out_px:.3f} px")
    _warn(done.warnings)
    _apply(calibration, apply)


def hand_eye(
    session: tyro.conf.Positional[Path],
    *,
    rig: Path,
    calibration: Path = Path("calibration.json"),
    mount: Literal["eye-in-hand", "eye-to-hand"] = "eye-in-hand",
    refine_intrinsics: bool = False,
    apply: tuple[Path, ...] = (),
) -> None:
    """Estimate where the camera sits on the arm's tool, from stills of the board.

    Args:
        session: recorded with s2p3 capture hand-eye.
        rig: rig.toml with the [board] table.
        calibration: calibration.json that has the intrinsics; the result is added.
        mount: eye-to-hand: the camera stands beside the arm and the board is on the tool.
        refine_intrinsics: refine K and distortion with the transforms, from their covariance, and keep them.
        apply: sessions to write the calibration into.
    """
    from calibration.steps import add_hand_eye

    kind: Mount = "eye_in_hand" if mount == "eye-in-hand" else "eye_to_hand"
    with counting("detect the board") as report:
        reach = _reach(rig, session) if kind == "eye_in_hand" else None
        step = add_hand_eye(session, board_of(rig), calibration, report, kind, refine_intrinsics, reach)
    done, advice = step.record, step.advice
    say(
        f"hand-eye from {done.views} views: held out {done.held_out_mm:.3f} mm, {done.held_out_deg:.4f} deg;"
        f" 95 % within {step.intervals.half_mm.max():.3f} mm, {step.intervals.half_deg.max():.4f} deg an axis"
    )
    if step.refined is not None:
        say(f"intrinsics refined: {_focal(step.refined)}")
    _warn(done.warnings)
    if advice is None:
        say("next view: none that was tried shows the board within the arm's reach")
    else:
        pose = ", ".join(f"{value:.4f}" for value in advice.T_base_tcp.as_pose6())
        say(f"next view, the one that would tell most: {advice.reason}; tool at [{pose}] (m, rad)")
    _apply(calibration, apply)


def time_offset(
    session: tyro.conf.Positional[Path],
    *,
    rig: Path,
    calibration: Path = Path("calibration.json"),
    apply: tuple[Path, ...] = (),
) -> None:
    """Estimate the delay between the camera's and the arm's time, from the board filmed in motion.

    Args:
        session: recorded with s2p3 capture board-motion.
        rig: rig.toml with the [board] table.
        calibration: calibration.json that has intrinsics and hand-eye; the result is added.
        apply: sessions to write the calibration into.
    """
    from calibration.steps import add_time_offset

    with counting("detect the board") as report:
        done = add_time_offset(session, board_of(rig), calibration, report)
    say(f"time offset {1e3 * done.offset_s:.2f} +- {1e3 * done.sigma_s:.2f} ms")
    _apply(calibration, apply)


def tool_tip(
    session: tyro.conf.Positional[Path],
    *,
    calibration: Path = Path("calibration.json"),
    apply: tuple[Path, ...] = (),
) -> None:
    """Estimate where the measuring tip is on the tool, from tilting it about one point.

    Args:
        session: recorded with s2p3 capture tool-tip.
        calibration: calibration.json to add the result to.
        apply: sessions to write the calibration into.
    """
    from calibration.touch_steps import add_tool_tip

    done = add_tool_tip(session, calibration)
    x, y, z = 1e3 * done.tip_in_tcp
    sigma = 1e3 * float(done.covariance.trace()) ** 0.5
    slipped = f"; {done.slipped} slipped and left out" if done.slipped else ""
    say(
        f"tool tip at {x:.3f} {y:.3f} {z:.3f} mm +- {sigma:.3f} mm from {done.poses} poses, "
        f"{1e3 * done.rms_m:.3f} mm rms{slipped}"
    )
    _apply(calibration, apply)


def polarizer(
    session: tyro.conf.Positional[Path],
    *,
    calibration: Path = Path("calibration.json"),
    extinction_ratio: float = float("inf"),
    apply: tuple[Path, ...] = (),
) -> None:
    """Estimate gain, extinction and orientation of each pixel's polarizer, by turning one before the lens.

    Args:
        session: recorded with s2p3 capture polarizer.
        calibration: calibration.json to add the result to; the pixels go into a file beside it.
        extinction_ratio: of the polarizer that was turned, T_max / T_min, from its data sheet.
        apply: sessions to write the calibration into.
    """
    from calibration.polarizer_steps import add_polarizer

    with counting("read the frames") as report:
        done = add_polarizer(session, calibration, extinction_ratio, report)
    say(
        f"polarizers from {done.frames} frames: extinction {done.extinction_ratio[1]:.0f} (median), "
        f"orientation +- {math.degrees(done.orientation_sigma_rad):.2f} deg, "
        f"gain +- {100 * done.gain_sigma:.2f} %"
    )
    _warn(done.warnings)
    _apply(calibration, apply)


def object_pose(
    touches: tyro.conf.Positional[tuple[Path, ...]],
    *,
    object: ObjectName,
    rig: OptionalPath = None,
    mesh: OptionalPath = None,
    ball_radius: float = 0.0,
    calibration: Path = Path("calibration.json"),
    apply: tuple[Path, ...] = (),
) -> None:
    """Estimate where an object stands in the arm's base frame, from points touched on it.

    Args:
        touches: sessions of s2p3 capture touches, or text files of points in the base frame (x y z, metres);
            the poses that several give are fused.
        object: cup, fork, knife, bottle, or the name of the object in --mesh.
        rig: rig.toml with the tip's position; needed with a session while the tip is not calibrated.
        mesh: PLY, OBJ or STL of the object, metres.
        ball_radius: of the tip, metres; 0 for a pointed one.
        calibration: calibration.json to add the result to.
        apply: sessions to write the calibration into.
    """
    from acquisition.rig import Rig
    from calibration.touch_steps import add_object, known_tip
    from calibration.touches import KnownTip
    from dataset.errors import ToolkitError
    from dataset.schema import SUFFIXES
    from dataset.transforms import SE3
    from s2p3.objects import named_object

    if not touches:
        raise ToolkitError("no touches given: name a session of s2p3 capture touches, or a file of points")
    model = named_object(object, mesh)
    guess = None if rig is None else Rig.load(rig).frames.T_tcp_tip
    tip = KnownTip.exactly((0.0, 0.0, 0.0), ball_radius)  # a file of points was measured with it already
    if any(path.suffix in SUFFIXES for path in touches):
        tip = known_tip(calibration, guess, ball_radius)
    symmetry = model.symmetry
    turns = SE3.from_matrix(symmetry.transforms) if len(symmetry.transforms) else None
    done = add_object(
        touches, model.name, model.vertices, model.faces, calibration, symmetry.axis, tip, turns
    )
    say(f"{object} from {done.points} points: {1e3 * done.rms_m:.3f} mm from the surface")
    _warn(tuple(f"the points leave open: {words}" for words in done.unobservable))
    _apply(calibration, apply)


def _focal(record: IntrinsicsRecord) -> str:
    return f"fx {record.intrinsics.K[0, 0]:.2f} +- {record.covariance[0, 0] ** 0.5:.2f} px"


def _warn(warnings: tuple[str, ...]) -> None:
    for warning in warnings:
        say(f"warning: {warning}")


def _reach(rig: Path, session: Path) -> Reachable:
    """Which poses of a session's tool the rig's arm reaches with its camera, within its workspace."""
    import numpy as np

    from acquisition.planning import configurations
    from acquisition.rig import Rig
    from acquisition.routes import carried_camera
    from dataset.session import Session

    with Session.open(session) as opened:
        offset = opened.tcp_offset
    camera = carried_camera(Rig.load(rig), np.zeros(6) if offset is None else offset)

    def reachable(T_base_tcp: SE3) -> NDArray[np.bool_]:
        joints = configurations(T_base_tcp @ camera.T_tcp_cam, camera)
        return np.asarray(np.isfinite(joints).any(axis=(1, 2, 3)))

    return reachable


def _apply(calibration: Path, sessions: tuple[Path, ...]) -> None:
    """Writes the calibration into sessions, and says what each got."""
    from calibration import Calibration, apply_calibration

    for session in sessions:
        done = apply_calibration(session, Calibration.load(calibration))
        found = {"intrinsics": done.intrinsics, "polarizers": done.polarizer}
        parts = [name for name, there in found.items() if there]
        poses = f", the camera's pose in {done.poses} of {done.frames} frames" if done.poses else ""
        say(f"{session}: {' and '.join(parts)} applied{poses}")


def board_of(rig: Path) -> BoardSpec:
    """The board a rig file describes."""
    from acquisition.rig import Rig
    from s2p3.board import board_spec

    return board_spec(Rig.load(rig).board)
