"""A board, a camera, an arm: ground truth for the solvers, analytic or, where it must be, rendered."""

from dataclasses import dataclass

import cv2
import numpy as np
import pytest

from calibration.board import BoardSpec, draw
from calibration.detection import Detection
from dataset.frames import CameraInfo, ClockFit, RawFrame, RobotTrace
from dataset.intrinsics import Intrinsics
from dataset.polarimetry import Stokes, quantize, sample_mosaic
from dataset.session import SessionWriter
from dataset.transforms import SE3

_TEXTURE_PX = 64
_MARGIN_PX = 64
_SUPERSAMPLE = 2
_TABLE = 90.0
_BLOCK = 8


@dataclass(frozen=True, eq=False)
class World:
    """A rig whose truth is known, and what it would record."""

    spec: BoardSpec
    intrinsics: Intrinsics
    T_tcp_cam: SE3
    T_base_board: SE3

    def views(self, count: int, rng: np.random.Generator, tilt: float = 0.3) -> SE3:
        """T_cam_board of random views that show at least 30 corners."""
        centre = SE3(np.eye(3), -0.5 * np.array([*self.spec.size_m, 0.0]))
        found: list[SE3] = []
        while len(found) < count:
            turn = rng.normal(0, [tilt, tilt, 0.5])
            place = [rng.uniform(-0.1, 0.1), rng.uniform(-0.08, 0.08), rng.uniform(0.4, 0.65)]
            pose = SE3.from_rotvec(turn, place) @ centre
            if len(self.detection(pose, rng, 0.0)) >= 30:
                found.append(pose)
        return SE3.stack(found)

    def detection(self, T_cam_board: SE3, rng: np.random.Generator, noise_px: float = 0.1) -> Detection:
        """The corners inside the picture, with Gaussian noise."""
        ids = np.arange(self.spec.corner_count)
        pixels = self.intrinsics.project(T_cam_board.apply(self.spec.object_points(ids)))
        size = [self.intrinsics.width, self.intrinsics.height]
        inside = np.all((pixels > 5) & (pixels < np.array(size) - 6), axis=1)
        noise = rng.normal(0, noise_px, (int(inside.sum()), 2))
        return Detection(ids[inside], pixels[inside] + noise)

    def arm(self, T_cam_board: SE3) -> SE3:
        """T_base_tcp that shows the camera the board so."""
        return self.T_base_board @ T_cam_board.inverse() @ self.T_tcp_cam.inverse()

    def mosaic(self, T_cam_board: SE3, rng: np.random.Generator) -> np.ndarray:
        """A noisy 8-bit colour mosaic: the board, weakly polarized, on a brownish table, anti-aliased."""
        camera = self.intrinsics
        texture = draw(self.spec, _TEXTURE_PX, _MARGIN_PX).astype(np.float32)
        to_board = np.linalg.inv(np.column_stack([T_cam_board.rotation[:, :2], T_cam_board.translation]))
        light = np.full((camera.height, camera.width), _TABLE, np.float32)
        rows, columns = self._where_board_is(T_cam_board)
        light[rows, columns] = 0
        for dy, dx in np.ndindex(_SUPERSAMPLE, _SUPERSAMPLE):
            shift = (np.array([dx, dy]) - (_SUPERSAMPLE - 1) / 2) / _SUPERSAMPLE
            xy = self._plane(rows, columns, shift)
            board = np.concatenate([xy, np.ones_like(xy[..., :1])], -1) @ to_board.T.astype(np.float32)
            uv = board[..., :2] / board[..., 2:] / self.spec.square_m * _TEXTURE_PX + _MARGIN_PX - 0.5
            seen = cv2.remap(
                texture, uv[..., 0], uv[..., 1], cv2.INTER_LINEAR, None, cv2.BORDER_CONSTANT, _TABLE
            )
            light[rows, columns] += seen / _SUPERSAMPLE**2
        s0 = 1.5 * (0.03 + 0.55 * light / 255)
        stokes = Stokes(s0, 0.06 * s0, -0.04 * s0, np.ones(s0.shape, bool))
        ideal = sample_mosaic(stokes, "colour", light.shape, colour_gains=(0.75, 1.0, 0.6))
        noise = rng.standard_normal(ideal.shape, np.float32) * np.sqrt(1e-4 * ideal + 1e-5)
        return quantize((ideal + noise).astype(np.float32), 8)

    def _where_board_is(self, T_cam_board: SE3) -> tuple[slice, slice]:
        width, height = self.spec.size_m
        edge = self.spec.square_m
        corners = [[x, y, 0] for x in (-edge, width + edge) for y in (-edge, height + edge)]
        pixels = self.intrinsics.project(T_cam_board.apply(corners))
        low = np.maximum(pixels.min(axis=0) // _BLOCK * _BLOCK, 0).astype(int)
        high = np.minimum(pixels.max(axis=0), [self.intrinsics.width, self.intrinsics.height]).astype(int)
        return slice(low[1], high[1]), slice(low[0], high[0])

    def _plane(self, rows: slice, columns: slice, shift: np.ndarray) -> np.ndarray:
        """Undistorted image-plane coordinates (h, w, 2) f32 of a window's pixels, moved by a sub-pixel shift.

        Rays at the centres of 8x8 blocks, interpolated linearly: lens distortion is smooth. By
        cv2.resize, since cv2.remap rounds positions to 1/32 of a coarse pixel and OpenCV's cubic does not
        reproduce a ramp.
        """
        height, width = rows.stop - rows.start, columns.stop - columns.start
        blocks_y, blocks_x = -(-height // _BLOCK) + 4, -(-width // _BLOCK) + 4
        grid = np.stack(np.meshgrid(np.arange(blocks_x), np.arange(blocks_y)), -1) - 2.0
        centres = grid * _BLOCK + (_BLOCK - 1) / 2 + shift + [columns.start, rows.start]
        rays = self.intrinsics.rays(centres)
        coarse = (rays[..., :2] / rays[..., 2:]).astype(np.float32)
        fine = cv2.resize(coarse, (blocks_x * _BLOCK, blocks_y * _BLOCK), interpolation=cv2.INTER_LINEAR)
        return fine[2 * _BLOCK :, 2 * _BLOCK :][:height, :width]


@pytest.fixture(scope="session")
def world() -> World:
    return World(
        BoardSpec(8, 11, 0.030, 0.022, "DICT_5X5_100"),
        Intrinsics(
            np.array([[1405.8, 0, 1216.0], [0, 1406.2, 1007.0], [0, 0, 1]]),
            np.array([-0.09, 0.07, 0.0007, -0.0005, 0.0]),
            2048,
            2448,
        ),
        SE3.from_rotvec([0.02, -0.03, 1.55], [0.03, -0.06, 0.05]),
        SE3.from_rotvec([0.01, 0.02, 0.3], [0.4, -0.2, 0.01]),
    )


@pytest.fixture(scope="session")
def stills(world: World, tmp_path_factory: pytest.TempPathFactory):
    """A session of rendered stills as a recorder leaves it, and the arm poses it was rendered for."""
    rng = np.random.default_rng(5)
    views = world.views(7, rng)
    true_arm = world.arm(views)
    noise = SE3.exp(rng.normal(0, 1, (len(views), 6)) * ([3e-5] * 3 + [3e-5] * 3))
    path = tmp_path_factory.mktemp("stills") / "board.h5"
    size = world.intrinsics
    info = CameraInfo("LUCID", "PHX050S-Q", "1", "1", "BayerRG8", "colour", size.width, size.height, 8, 9000)
    origin, camera_epoch = 5_000_000_000_000, 77_000_000_000
    with SessionWriter(path, "hand_eye", info) as writer:
        for i, view in enumerate(views):
            start = int((2.0 * i + 1.0) * 1e9)
            # The picture reports 60 ms after its exposure began: a latency the fit cannot see.
            writer.add_frame(
                RawFrame(
                    world.mosaic(view, rng),
                    "BayerRG8",
                    i,
                    camera_epoch + start,
                    origin + start + 60_000_000,
                    5000.0,
                    0.0,
                    0,
                )
            )
        writer.add_robot_trace(_stop_and_go(true_arm @ noise, origin, rng), np.zeros(6))
        writer.set_clocks(
            camera=ClockFit(origin - camera_epoch + 60_000_000, 1.0, 1e5), robot=ClockFit(origin, 1.0, 1e5)
        )
    return path, true_arm


def _stop_and_go(stops: SE3, origin: int, rng: np.random.Generator) -> RobotTrace:
    """At rest from 0.6 s into each 2 s slot until just after the exposure, in motion otherwise; 125 Hz."""
    times = np.arange(0, 2 * len(stops), 0.008)
    slot = np.minimum((times // 2).astype(int), len(stops) - 1)
    moving = np.clip((times - 2 * slot - 1.07) / 0.9, 0, 1)
    following = np.minimum(slot + 1, len(stops) - 1)
    poses = stops[slot].interpolate(stops[following], moving)
    host = origin + (times * 1e9).astype(np.int64) + rng.integers(0, 2_000_000, len(times))
    return RobotTrace(
        host, times, np.zeros((len(times), 6)), poses.as_pose6(), np.ones(len(times), np.uint32)
    )
