"""The person in the simulated lab who guides the arm by hand and touches the object with the measuring tip.

A process of its own: it knows where the object is, as eyes do; the toolkit only reads the arm meanwhile.
"""

from __future__ import annotations

import argparse
import threading
import time
from _thread import interrupt_main
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from acquisition.process import ChildProcess, die_with_parent, serve_commands
from acquisition.rig import Rig
from acquisition.robots.ur import UrRobot
from dataset.errors import ToolkitError
from dataset.transforms import SE3
from s2p3 import objects
from s2p3.lab.truth import LabTruth

_CANDIDATES = 600
_HOLD_S = 0.9
"""How long the tip rests on a point; the recorder wants 0.6 s."""
_RETREAT_M = 0.04
_NORMAL_WEIGHT = 0.25
"""Of a difference in normals against one in position, in diameters, when touches are spread."""
_CLEARANCE_M = 0.002
"""Points lower above the table than this are not touched: the tip has a body."""


class Operator(ChildProcess):
    """Starts the operator; from then on touches point after point until it has touched `count`."""

    def __init__(self, truth_path: Path, rig_path: Path, count: int) -> None:
        arguments = ("--truth", str(truth_path), "--rig", str(rig_path), "--count", str(count))
        super().__init__("s2p3.lab.operator", arguments, ready_timeout_s=60.0)
        self._count = count
        self._leaving = threading.Event()

    @contextmanager
    def touching(self) -> Iterator[None]:
        """Touches in the background for the length of the `with` block, at whose end a failure is raised.

        Raises:
            DeviceError: the operator could not reach a point.
        """
        with ThreadPoolExecutor(1, "operator") as pool:
            work = pool.submit(self._touch_all)
            # A recorder would wait for ever for a point that is not going to be touched.
            work.add_done_callback(lambda done: interrupt_main() if done.exception() else None)
            try:
                yield
            finally:
                self._leaving.set()
                if work.done():
                    work.result()

    def _touch_all(self) -> None:
        for _ in range(self._count):
            if self._leaving.is_set():
                return
            self.command("touch", timeout_s=60.0)


def touch(truth: LabTruth, rig: Rig, count: int) -> Iterator[int]:
    """Touches `count` points spread over the object, one at a time, and yields how many it has touched."""
    T_tip_tcp = SE3.from_rotvec(np.zeros(3), -np.array(truth.tcp_tip))
    by_hand = replace(rig.robot, speed=0.6, acceleration=2.0, joint_speed=2.0, joint_acceleration=5.0)
    with UrRobot(by_hand) as arm:
        q = arm.sample().q
        touched = 0
        while touched < count:
            before = touched
            for point, normal in _contacts(truth, _CANDIDATES):
                contact = _tip_pose(point, normal) @ T_tip_tcp
                retreat = SE3(contact.rotation, contact.translation - _RETREAT_M * contact.rotation[:, 2])
                q_contact = arm.inverse_kinematics(contact, q)
                q_retreat = None if q_contact is None else arm.inverse_kinematics(retreat, q_contact)
                if q_contact is None or q_retreat is None or np.abs(q_contact - q).max() > np.pi:
                    continue
                arm.follow(np.stack([q_retreat, q_contact]), blend=0.01)
                time.sleep(_HOLD_S)
                arm.follow(q_retreat[None])
                q = q_retreat
                touched += 1
                yield touched
                if touched == count:
                    return
            if touched == before:
                raise ToolkitError("the operator reaches no point of the object; try another --seed")


def _contacts(truth: LabTruth, candidates: int) -> Iterator[tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Points and outward normals in the base frame that a tip from above can reach, each far from those
    before it: a person feels for the handle as well as for the wall."""
    rng = np.random.default_rng(truth.seed + 3)
    mesh = objects.build(truth.object_name)
    corners = mesh.vertices[mesh.faces]
    crosses = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    areas = np.linalg.norm(crosses, axis=1)
    chosen = rng.choice(len(areas), size=candidates, p=areas / areas.sum())
    weights = rng.dirichlet((1.0, 1.0, 1.0), size=candidates)
    points = truth.T_base_object.apply((weights[:, :, None] * corners[chosen]).sum(axis=1))
    normals = (crosses[chosen] / areas[chosen, None]) @ truth.T_base_object.rotation.T
    reachable = (
        (points[:, 2] > _CLEARANCE_M) & (normals[:, 2] > -0.3) & _faces_outwards(points, normals, truth)
    )
    points, normals = points[reachable], normals[reachable]
    for index in _farthest_first(np.hstack([points / mesh.diameter, _NORMAL_WEIGHT * normals])):
        yield points[index] + normals[index] * rng.normal(0, truth.touch_noise_m), normals[index]


def _farthest_first(features: NDArray[np.float64]) -> Iterator[int]:
    """Indices of (n, d) points, each the farthest from those before it."""
    nearest = np.full(len(features), np.inf)
    index = 0
    for _ in range(len(features)):
        yield index
        nearest = np.minimum(nearest, np.linalg.norm(features - features[index], axis=1))
        index = int(nearest.argmax())


def _faces_outwards(
    points: NDArray[np.float64], normals: NDArray[np.float64], truth: LabTruth
) -> NDArray[np.bool_]:
    """Not the inside of a cup: the wall faces away from the object's axis, or it faces up."""
    away = points - truth.T_base_object.translation
    return (np.einsum("ij,ij->i", away[:, :2], normals[:, :2]) > 0) | (normals[:, 2] > 0.8)


def _tip_pose(point: NDArray[np.float64], normal: NDArray[np.float64]) -> SE3:
    """The tip at a point, its axis mostly downwards and a little against the surface."""
    axis = np.array([0.0, 0.0, -1.0]) - 0.35 * normal
    z = axis / np.linalg.norm(axis)
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    return SE3(np.stack([x, np.cross(z, x), z], axis=1), point)


def main() -> None:
    """Touches until done; the process then waits for its parent to end it."""
    die_with_parent()
    parser = argparse.ArgumentParser(description="Touches the object of a simulated lab with the arm's tip.")
    parser.add_argument("--truth", type=Path, required=True)
    parser.add_argument("--rig", type=Path, required=True)
    parser.add_argument("--count", type=int, required=True)
    options = parser.parse_args()
    touches = touch(LabTruth.load(options.truth), Rig.load(options.rig), options.count)

    def handle(line: str) -> str:
        if line != "touch":
            raise ValueError(f"unknown command '{line}'; use touch")
        return str(next(touches, options.count))

    serve_commands(handle)


if __name__ == "__main__":
    main()
