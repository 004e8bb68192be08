"""Hand-eye calibration against the reference solvers of KinHEC, a published benchmark of pose sequences.

    pip install --no-deps -r tools/bench/peers.txt
    python tools/bench/hand_eye.py --json

Generates KinHEC's smoke tier (or another), runs its reference solvers by its own protocol and this
toolkit's solvers on the same measurements, and prints, a track, the median error of the hand-eye transform
in degrees and millimetres. The toolkit is given what a user of the track would have: pairs of poses; where
poses come from corners, the camera and the target, too; where clocks differ, the two streams with their
times, never the true offset; and for visual odometry the fact that its scale is unknown. A reference is the
best of all solvers in each number, on the sequences the toolkit did not refuse, with the true clock offset
where that is better.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import sys
import tempfile
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np

from calibration.robot_world import RobotWorldResult, pose_covariance, solve_robot_world
from calibration.streams import solve_streams
from dataset.errors import CalibrationError
from dataset.intrinsics import Intrinsics
from dataset.transforms import SE3, rotation_error_deg, translation_error_mm

try:
    import kinhec
    from kinhec.benchmark import SOLVERS, evaluate_sequence
    from kinhec.camera import CAMERAS, TARGETS
    from kinhec.pipeline import generate_dataset
except ImportError as missing:
    sys.exit(f"{missing}; install the peers: pip install --no-deps -r tools/bench/peers.txt")

DEGENERATE = 1e-6
"""KinHEC's scatter of rotation axes below which its documentation calls a motion degenerate."""


def solve(sequence: kinhec.Sequence) -> RobotWorldResult:
    """The toolkit's answer from what was measured."""
    measured = sequence.camera.has_measurement
    T_cam_target = SE3.from_matrix(sequence.camera.T_cam_target_meas[measured])
    T_base_tcp = SE3.from_matrix(sequence.robot.T_base_ee_meas)
    mount = sequence.manifest["configuration"]
    if not sequence.synchronous:
        times = sequence.robot.t, sequence.camera.t[measured]
        return solve_streams(times[0], T_base_tcp, times[1], T_cam_target, mount)
    return solve_robot_world(
        T_base_tcp[measured],
        T_cam_target,
        mount,
        camera_covariance=covariance(sequence, T_cam_target),
        scale_known=sequence.manifest["world_frame"] == "target",
    )


def covariance(sequence: kinhec.Sequence, T_cam_target: SE3) -> np.ndarray | None:
    """Of the camera's poses, where they report a reprojection error: then they were fitted to corners."""
    rmse = sequence.camera.reproj_rmse_px[sequence.camera.has_measurement]
    if not np.isfinite(rmse).all():
        return None
    camera, target = CAMERAS[sequence.manifest["camera"]], TARGETS[sequence.manifest["target"]]
    intrinsics = Intrinsics(camera.K, np.zeros(0), camera.height, camera.width)
    freedom = 2 * len(target.points) - 6
    sigma = float(np.sqrt(np.mean(rmse**2) * len(target.points) / freedom))
    return pose_covariance(T_cam_target, target.points, intrinsics, sigma)


def errors(sequence: kinhec.Sequence, result: RobotWorldResult) -> tuple[float, float]:
    """Degrees and millimetres of KinHEC's X: the camera on the flange, or the marker on it."""
    found = result.T_mount_cam if sequence.eye_in_hand else result.T_fixture_board
    truth = SE3.from_matrix(sequence.X)
    return float(rotation_error_deg(found, truth)), float(translation_error_mm(found, truth))


def reference_errors(sequence: kinhec.Sequence) -> dict[str, tuple[float, float]]:
    """Every reference solver's errors by name, infinite where it fails."""
    found: dict[str, tuple[float, float]] = {}
    for sync in ["oracle"] if sequence.synchronous else ["oracle", "estimated"]:
        for row in evaluate_sequence(sequence, list(SOLVERS), sync, np.random.default_rng(0)):
            failed = not row["ok"]
            found[f"{row['solver']} {sync}"] = (
                (np.inf, np.inf) if failed else (row["X_rot_err_deg"], row["X_trans_err_mm"])
            )
    return found


def compare(data: Path) -> dict[str, Any]:
    """Medians a track over a generated tier."""
    ours: dict[str, list[tuple[float, float]]] = defaultdict(list)
    references: dict[str, dict[str, list[tuple[float, float]]]] = defaultdict(lambda: defaultdict(list))
    refused: dict[str, int] = {}
    fooled: dict[str, int] = {}
    for sequence in kinhec.iter_sequences(data):
        track = sequence.manifest["track"]
        refused.setdefault(track, 0)
        fooled.setdefault(track, 0)
        try:
            result = solve(sequence)
        except CalibrationError as reason:
            refused[track] += 1
            print(f"{sequence.id}: {reason}", file=sys.stderr)
            continue
        fooled[track] += int(sequence.manifest["axis_scatter_lambda2"] < DEGENERATE)
        ours[track].append(errors(sequence, result))
        for name, error in reference_errors(sequence).items():
            references[track][name].append(error)
    return {
        track: {
            **_medians("ours", [ours[track]]),
            **_medians("best_reference", list(references[track].values())),
            "refused": count,
            "accepted_degenerate": fooled[track],
        }
        for track, count in refused.items()
    }


def _medians(whose: str, solvers: list[list[tuple[float, float]]]) -> dict[str, float | None]:
    """The best of the solvers' medians in each number; None where every sequence was refused."""
    medians = [np.median(errors, axis=0) for errors in solvers if errors]
    if not medians:
        return {f"{whose}_deg": None, f"{whose}_mm": None}
    degrees, millimetres = np.min(medians, axis=0)
    return {f"{whose}_deg": round(float(degrees), 4), f"{whose}_mm": round(float(millimetres), 3)}


def main() -> None:
    """Generate, solve, compare, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--tier", default="smoke", help="KinHEC's tier, or a YAML file of its structure")
    parser.add_argument("--tracks", nargs="*", help="only these")
    parser.add_argument("--data", type=Path, help="a tier generated before, instead of generating one")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        data = arguments.data or generate(arguments.tier, arguments.tracks, Path(folder))
        found = compare(data)
    if arguments.json:
        print(json.dumps(found))
        return
    for track, row in found.items():
        print(
            f"{track:12} ours {row['ours_deg']} deg {row['ours_mm']} mm, best reference"
            f" {row['best_reference_deg']} deg {row['best_reference_mm']} mm, refused {row['refused']},"
            f" degenerate accepted {row['accepted_degenerate']}"
        )


def generate(tier: str, tracks: list[str] | None, folder: Path) -> Path:
    """A tier's sequences in a folder; what the generator prints goes to standard error."""
    with contextlib.redirect_stdout(sys.stderr):
        return generate_dataset(tier, folder / "data", tracks=tracks, work_dir=folder, write_card=False)


if __name__ == "__main__":
    main()
