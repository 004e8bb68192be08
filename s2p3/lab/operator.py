"""The person in the simulated lab who guides the arm by hand: tilts it about its tip, touches the object with
the tip; and who turns a polarizer before the lens.

A process of its own: it knows where the object is, as eyes do; the toolkit only reads the arm meanwhile.
"""

from __future__ import annotations

import argparse
import threading
import time
from _thread import interrupt_main
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from itertools import count
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from acquisition.process import ChildProcess, die_with_parent, serve_commands
from acquisition.rig import Rig, RobotTable
from acquisition.robots.ur import UrRobot
from dataset.errors import ToolkitError
from dataset.transforms import SE3
from s2p3 import objects
from s2p3.lab.polarizer import HandHeldPolarizer
from s2p3.lab.truth import NOMINAL_OBJECT_CENTRE, LabTruth

_CANDIDATES = 600
_HOLD_S = 0.9
"""How long the tip rests on a point; the recorder wants 0.6 s."""
PIVOT_POINT = (NOMINAL_OBJECT_CENTRE[0], 0.0, 0.06)
"""A punched hole on a block between board and object."""
_RETREAT_M = 0.04
_NORMAL_WEIGHT = 0.25
"""Of a difference in normals against one in position, in diameters, when touches are spread."""
_CLEARANCE_M = 0.002
"""Points lower above the table than this are not touched: the tip has a body."""


class Operator(ChildProcess):
    """Starts the operator, who is then asked for one thing after the other."""

    def __init__(self, truth_path: Path, rig_path: Path) -> None:
        arguments = ("--truth", str(truth_path), "--rig", str(rig_path))
        super().__init__("s2p3.lab.operator", arguments, ready_timeout_s=60.0)

    @contextmanager
    def touching(self, count: int) -> Iterator[None]:
        """Touches so many points in the background for the length of the `with` block, at whose end a failure
        is raised.

        Raises:
            DeviceError: the operator could not reach a point.
        """
        with self._repeating("touch", count):
            yield

    @contextmanager
    def pivoting(self, count: int) -> Iterator[None]:
        """The same, tilting the tool about its tip, which stays in one point."""
        with self._repeating("pivot", count):
            yield

    def turning(self, angles_rad: Iterable[float]) -> Iterator[float]:
        """Holds the polarizer before the lens, and yields each angle as soon as it stands there; takes it
        away in the end."""
        try:
            for angle in angles_rad:
                self.command(f"turn {np.degrees(angle)}", timeout_s=10.0)
                yield angle
        finally:
            self.command("clear", timeout_s=10.0)

    @contextmanager
    def _repeating(self, word: str, count: int) -> Iterator[None]:
        leaving = threading.Event()

        def repeat() -> None:
            for _ in range(count):
                if leaving.is_set():
                    return
                self.command(word, timeout_s=60.0)

        with ThreadPoolExecutor(1, "operator") as pool:
            work = pool.submit(repeat)
            # A recorder would wait for ever for a point that is not going to be touched.
            work.add_done_callback(lambda done: interrupt_main() if done.exception() else None)
            try:
                yield
            finally:
                leaving.set()
                if work.done():
                    work.result()


def pivot(truth: LabTruth, rig: Rig) -> Generator[int, None, None]:
    """Tilts the tool about its tip from one pose to the next, for ever, and yields how many it has held."""
    T_tip_tcp = SE3.from_rotvec(np.zeros(3), -np.array(truth.tcp_tip))
    rng = np.random.default_rng(truth.seed + 4)
    with UrRobot(_by_hand(rig)) as arm:
        held, q = 0, arm.sample().q
        for tilt in tilts(rng):
            slip = rng.normal(0, truth.pivot_noise_m, 3)
            q_next = arm.inverse_kinematics(SE3(tilt, np.array(PIVOT_POINT) + slip) @ T_tip_tcp, q)
            if q_next is None or np.abs(q_next - q).max() > np.pi:
                continue
            arm.follow(q_next[None])
            time.sleep(_HOLD_S)
            held, q = held + 1, q_next
            yield held


def tilts(rng: np.random.Generator) -> Iterator[NDArray[np.float64]]:
    """Rotations of a tool that points down, tilted to all sides in turn and turned about itself, for ever."""
    down = np.diag([1.0, -1.0, -1.0])
    for index in count():
        azimuth = index * np.pi * (3 - np.sqrt(5))
        tilt = np.radians(rng.uniform(18, 32)) * np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
        turn = np.array([0.0, 0.0, rng.uniform(-0.6, 0.6)])
        rotation = SE3.from_rotvec(np.stack([tilt, turn]), np.zeros((2, 3))).rotation
        yield rotation[0] @ down @ rotation[1]


def _by_hand(rig: Rig) -> RobotTable:
    """The arm as one guides it: faster than it would go by itself."""
    return replace(rig.robot, speed=0.6, acceleration=2.0, joint_speed=2.0, joint_acceleration=5.0)


def touch(truth: LabTruth, rig: Rig) -> Generator[int, None, None]:
    """Touches points spread over the object, one at a time, for ever, and yields how many it has touched."""
    T_tip_tcp = SE3.from_rotvec(np.zeros(3), -np.array(truth.tcp_tip))
    with UrRobot(_by_hand(rig)) as arm:
        q = arm.sample().q
        touched = 0
        while True:
            before = touched
            for point, normal in contacts(truth, _CANDIDATES):
                contact = tip_pose(point, normal) @ T_tip_tcp
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
            if touched == before:
                raise ToolkitError("the operator reaches no point of the object; try another --seed")


def contacts(truth: LabTruth, candidates: int) -> Iterator[tuple[NDArray[np.float64], NDArray[np.float64]]]:
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


def tip_pose(point: NDArray[np.float64], normal: NDArray[np.float64]) -> SE3:
    """The tip at a point, its axis mostly downwards and a little against the surface."""
    axis = np.array([0.0, 0.0, -1.0]) - 0.35 * normal
    z = axis / np.linalg.norm(axis)
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    return SE3(np.stack([x, np.cross(z, x), z], axis=1), point)


def main() -> None:
    """Does what it is told, line by line; the process ends with its parent."""
    die_with_parent()
    parser = argparse.ArgumentParser(description="Touches, tilts and turns things in a simulated lab.")
    parser.add_argument("--truth", type=Path, required=True)
    parser.add_argument("--rig", type=Path, required=True)
    options = parser.parse_args()
    truth, rig = LabTruth.load(options.truth), Rig.load(options.rig)
    polarizer = HandHeldPolarizer(options.truth)
    at_work: dict[str, Generator[int, None, None]] = {}

    def handle(line: str) -> str:
        word, *angle = line.split()
        if word == "turn" and len(angle) == 1:
            polarizer.turn_to(np.radians(float(angle[0])))
            return angle[0]
        if word == "clear":
            polarizer.take_away()
            return "clear"
        if word not in _HANDIWORK:
            raise ValueError(f"unknown command '{line}'; use touch, pivot, turn DEGREES or clear")
        if word not in at_work:
            for other in at_work.values():
                other.close()  # lets go of the arm
            at_work.clear()
            at_work[word] = _HANDIWORK[word](truth, rig)
        return str(next(at_work[word]))

    serve_commands(handle)


_HANDIWORK: dict[str, Callable[[LabTruth, Rig], Generator[int, None, None]]] = {
    "touch": touch,
    "pivot": pivot,
}


if __name__ == "__main__":
    main()
