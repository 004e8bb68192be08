"""`s2p3 calibrate ...`: each verb reads sessions, adds its result to calibration.json, and writes the report
beside it.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import tyro

from s2p3.commands.arguments import ObjectName, OptionalPath, at_least
from s2p3.commands.output import counting, say

if TYPE_CHECKING:
    from calibration import BoardSpec

_FEWEST_PX_PER_SQUARE = 20
"""Two pixels a marker's cell, or nearly."""


def board(*, rig: Path, out: Path, px_per_square: int = 300) -> None:
    """Draw the rig's ChArUco board as a PNG to print; measure the print afterwards.

    Args:
        rig: rig.toml with the [board] table.
        out: PNG to write.
        px_per_square: resolution of the picture.
    """
    import cv2

    from calibration.board import draw

    at_least(_FEWEST_PX_PER_SQUARE, px_per_square=px_per_square)
    _, picture = cv2.imencode(".png", draw(board_of(rig), px_per_square, margin_px=px_per_square // 2))
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_bytes(picture.tobytes())
    say(f"{out}: print it to scale, then measure a square and correct [board] square_m in {rig}")


def intrinsics(
    session: tyro.conf.Positional[Path], *, rig: Path, calibration: Path = Path("calibration.json")
) -> None:
    """Estimate K and lens distortion from stills of the board.

    Args:
        session: recorded with s2p3 capture intrinsics or hand-eye.
        rig: rig.toml with the [board] table.
        calibration: calibration.json to add the result to.
    """
    from calibration.steps import add_intrinsics

    with counting("detect the board") as report:
        done = add_intrinsics(session, board_of(rig), calibration, report)
    fx = done.intrinsics.K[0, 0]
    say(
        f"fx {fx:.2f} +- {done.covariance[0, 0] ** 0.5:.2f} px, "
        f"reprojection {done.rms_px:.3f} px, held out {done.held_out_px:.3f} px"
    )


def hand_eye(
    session: tyro.conf.Positional[Path], *, rig: Path, calibration: Path = Path("calibration.json")
) -> None:
    """Estimate where the camera sits on the arm's tool, from stills of the board.

    Args:
        session: recorded with s2p3 capture hand-eye.
        rig: rig.toml with the [board] table.
        calibration: calibration.json that has the intrinsics; the result is added.
    """
    from calibration.steps import add_hand_eye

    with counting("detect the board") as report:
        done = add_hand_eye(session, board_of(rig), calibration, report)
    say(f"hand-eye from {done.views} views: held out {done.held_out_mm:.3f} mm, {done.held_out_deg:.4f} deg")


def time_offset(
    session: tyro.conf.Positional[Path], *, rig: Path, calibration: Path = Path("calibration.json")
) -> None:
    """Estimate the delay between the camera's and the arm's time, from the board filmed in motion.

    Args:
        session: recorded with s2p3 capture board-motion.
        rig: rig.toml with the [board] table.
        calibration: calibration.json that has intrinsics and hand-eye; the result is added.
    """
    from calibration.steps import add_time_offset

    with counting("detect the board") as report:
        done = add_time_offset(session, board_of(rig), calibration, report)
    say(f"time offset {1e3 * done.offset_s:.2f} +- {1e3 * done.sigma_s:.2f} ms")


def object_pose(
    touches: tyro.conf.Positional[Path],
    *,
    object: ObjectName,
    rig: OptionalPath = None,
    mesh: OptionalPath = None,
    calibration: Path = Path("calibration.json"),
) -> None:
    """Estimate where an object stands in the arm's base frame, from points touched on it.

    Args:
        touches: session of s2p3 capture tool-tip, or a text file of points in the base frame (x y z, metres).
        object: cup, fork, knife, bottle, or the name of the object in --mesh.
        rig: rig.toml with the tip's position; needed with a session.
        mesh: PLY, OBJ or STL of the object, metres.
        calibration: calibration.json to add the result to.
    """
    from calibration.steps import add_object
    from s2p3.objects import named_object

    model = named_object(object, mesh)
    tip = _tip(touches, rig)
    done = add_object(touches, tip, model.name, model.vertices, model.faces, calibration, model.symmetry.axis)
    blind = f"; not observable: {', '.join(done.unobservable)}" if done.unobservable else ""
    say(f"{object} from {done.points} points: {1e3 * done.rms_m:.3f} mm from the surface{blind}")


def _tip(touches: Path, rig: Path | None) -> tuple[float, float, float]:
    """The measuring tip in the tool's frame; a file of points was measured with it already."""
    from acquisition.rig import Rig
    from dataset.errors import ToolkitError

    if rig is not None:
        return Rig.load(rig).frames.T_tcp_tip
    if touches.suffix in (".h5", ".hdf5"):
        raise ToolkitError(
            f"{touches} is a session: give --rig, whose [frames] T_tcp_tip says where the tip is"
        )
    return (0.0, 0.0, 0.0)


def board_of(rig: Path) -> BoardSpec:
    """The board a rig file describes."""
    from dataclasses import asdict

    from acquisition.rig import Rig
    from calibration import BoardSpec

    return BoardSpec(**asdict(Rig.load(rig).board))
