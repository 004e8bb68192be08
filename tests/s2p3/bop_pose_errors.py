"""A thousand wrong poses, their errors by the BOP toolkit's own code, and how bop_pose_errors.json was made:
`PYTHONPATH=<its clone>:. python tests/s2p3/bop_pose_errors.py <its commit>`."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from s2p3.metrics import SYMMETRY_STEPS
from s2p3.objects import Symmetry

HERE = Path(__file__).parent
STORED = HERE / "bop_pose_errors.json"
CASES, POINTS = 1000, 30

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Case:
    """One estimate: rotations (3, 3), translations (3,) and points (P, 3) in millimetres."""

    R_estimated: Floats
    t_estimated: Floats
    R_true: Floats
    t_true: Floats
    K: Floats
    points: Floats
    symmetry: Symmetry

    @property
    def symmetries(self) -> Floats:
        return self.symmetry.sampled(SYMMETRY_STEPS)


def cases() -> Iterator[Case]:
    """The same everywhere: numpy promises the stream of the legacy generator, not that of the new one."""
    random = np.random.RandomState(20240607)
    for index in range(CASES):
        R_true = Rotation.from_rotvec(random.normal(size=3)).as_matrix()
        t_true = np.array([*random.uniform(-80, 80, 2), random.uniform(300, 900)])
        axis = random.normal(size=3)
        size = 10 ** random.uniform(-3, 0.5)  # from hardly wrong to hopeless
        turn = Rotation.from_rotvec(size * random.normal(size=3)).as_matrix()
        shift = size * random.normal(scale=30, size=3)
        K = np.array([[random.uniform(400, 1200), 0, 306], [0, random.uniform(400, 1200), 256], [0, 0, 1]])
        points = random.uniform(-60, 60, (POINTS, 3))
        yield Case(turn @ R_true, t_true + shift, R_true, t_true, K, points, symmetry(index, axis))


def symmetry(index: int, axis: Floats) -> Symmetry:
    """None, a half turn, three quarter turns, or any turn about an axis."""
    axis = axis / np.linalg.norm(axis)
    angles = {1: [np.pi], 2: [np.pi / 2, np.pi, 3 * np.pi / 2]}.get(index % 4, [])
    transforms = np.tile(np.eye(4), (len(angles), 1, 1))
    transforms[:, :3, :3] = Rotation.from_rotvec(np.outer(angles, axis)).as_matrix()
    return Symmetry(transforms, axis if index % 4 == 3 else None)


def errors() -> dict[str, list[float]]:
    """ADD, ADI and MSSD in millimetres, MSPD in pixels of every case, by the BOP toolkit."""
    from bop_toolkit_lib import misc, pose_error

    found: dict[str, list[float]] = {"add": [], "adi": [], "mssd": [], "mspd": []}
    for case in cases():
        info = json.loads(case.symmetry.to_json())
        turns = misc.get_symmetry_transformations(info, 0.01)
        t_estimated, t_true = case.t_estimated[:, None], case.t_true[:, None]
        poses = (case.R_estimated, t_estimated, case.R_true, t_true)
        found["add"].append(pose_error.add(*poses, case.points))
        found["adi"].append(pose_error.adi(*poses, case.points))
        found["mssd"].append(pose_error.mssd(*poses, case.points, turns))
        found["mspd"].append(pose_error.mspd(*poses, case.K, case.points, turns))
    return found


if __name__ == "__main__":
    made = "ADD, ADI, MSSD (mm) and MSPD (px) by bop_toolkit_lib at commit " + sys.argv[1]
    rows = {name: [round(float(value), 9) for value in values] for name, values in errors().items()}
    STORED.write_text(json.dumps({"made": made, **rows}) + "\n", encoding="utf-8")
