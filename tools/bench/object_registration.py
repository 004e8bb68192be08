"""Touched points to a mesh: this toolkit's registration against Open3D's point-to-plane ICP.

    python tools/bench/object_registration.py --seeds 3 --json

The points are those that the simulated lab's operator would touch, 0.1 mm noise along the normal, on each of
the lab's objects. Open3D gets the same number of random starts, 20 000 points with normals sampled from the
mesh, and two rounds of ICP (a tenth of the object's size, then 3 mm), and keeps the fit with the smallest
distances. Rotation errors are up to the object's symmetry. Prints medians and the worst, and how many seconds
a registration takes.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from itertools import islice
from typing import Any

import numpy as np
import open3d
import trimesh
from scipy.spatial.transform import Rotation

from calibration.object_pose import register_points
from dataset.transforms import SE3, translation_error_mm
from s2p3 import objects
from s2p3.board import board_spec
from s2p3.lab.operator import contacts
from s2p3.lab.rig import BOARD
from s2p3.lab.truth import sample_truth
from s2p3.metrics import rotation_error_deg

TOUCHES, STARTS, SAMPLES = 40, 240, 20_000


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--seeds", type=int, default=3, help="labs an object")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    solvers: dict[str, Callable[..., SE3]] = {"ours": ours, "open3d": with_open3d}
    found: dict[str, list[tuple[float, float, float]]] = {name: [] for name in solvers}
    for name in objects.NAMES:
        model = objects.build(name)
        for seed in range(options.seeds):
            truth = sample_truth(seed, name, 1.5, board_spec(BOARD).size_m, model.resting)
            points = np.array([point for point, _ in islice(contacts(truth, 600), TOUCHES)])
            for solver, solve in solvers.items():
                started = time.perf_counter()
                pose = solve(points, model)
                seconds = time.perf_counter() - started
                off_deg = rotation_error_deg(
                    SE3.stack([pose]), SE3.stack([truth.T_base_object]), model.symmetry
                )
                off_mm = translation_error_mm(pose, truth.T_base_object)
                found[solver].append((float(off_mm), float(off_deg[0]), seconds))
    result: dict[str, Any] = {solver: summary(np.array(rows)) for solver, rows in found.items()}
    print(json.dumps(result, indent=None if options.json else 1))


def ours(points: np.ndarray, model: objects.ObjectModel) -> SE3:
    return register_points(points, model.vertices, model.faces, symmetry_axis=model.symmetry.axis).T_base_obj


def with_open3d(points: np.ndarray, model: objects.ObjectModel) -> SE3:
    mesh = trimesh.Trimesh(model.vertices, model.faces, process=False)
    sampled, face = trimesh.sample.sample_surface(mesh, SAMPLES, seed=0)
    registration = open3d.pipelines.registration
    surface, touched = open3d.geometry.PointCloud(), open3d.geometry.PointCloud()
    surface.points = open3d.utility.Vector3dVector(np.asarray(sampled))
    surface.normals = open3d.utility.Vector3dVector(mesh.face_normals[face])
    touched.points = open3d.utility.Vector3dVector(points)
    to_plane = registration.TransformationEstimationPointToPlane()
    middle, centre = 0.5 * (points.min(axis=0) + points.max(axis=0)), mesh.bounds.mean(axis=0)
    best, best_rms = np.eye(4), np.inf
    for turn in Rotation.random(STARTS, rng=np.random.default_rng(0)).as_matrix():
        T_obj_base = np.eye(4)
        T_obj_base[:3, :3], T_obj_base[:3, 3] = turn, centre - turn @ middle
        for reach in (0.1 * model.diameter, 3e-3):
            fit = registration.registration_icp(touched, surface, reach, T_obj_base, to_plane)
            T_obj_base = fit.transformation
        distance = np.asarray(touched.transform(T_obj_base).compute_point_cloud_distance(surface))
        touched.transform(np.linalg.inv(T_obj_base))
        rms = float(np.sqrt(np.mean(distance**2)))
        if rms < best_rms:
            best, best_rms = np.linalg.inv(T_obj_base), rms
    return SE3.from_matrix(best)


def summary(rows: np.ndarray) -> dict[str, float]:
    return {
        "median_mm": round(float(np.median(rows[:, 0])), 3),
        "worst_mm": round(float(rows[:, 0].max()), 3),
        "median_deg": round(float(np.median(rows[:, 1])), 3),
        "worst_deg": round(float(rows[:, 1].max()), 3),
        "median_s": round(float(np.median(rows[:, 2])), 2),
    }


if __name__ == "__main__":
    main()
