"""Renders the lab's table and the board that lies on it, as Stokes images, fast enough for a live camera."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numba
import numpy as np
from numpy.typing import NDArray

from dataset.transforms import SE3

Image = NDArray[np.float32]

TABLE_SIZE_M = 3.0
_SUBSAMPLES = 3
"""Samples per pixel and axis: the board's corners are calibrated to a tenth of a pixel, so its edges must not
alias.
"""


@dataclass(frozen=True)
class Table:
    """A textured plane z = 0 of the base frame, and a printed board on it."""

    texture: Image
    """(T, T) albedo over TABLE_SIZE_M x TABLE_SIZE_M, centred on the base."""
    board: Image
    """(h, w) albedo of the print."""
    board_size_m: tuple[float, float]
    T_base_board: SE3
    refractive_index: float = 1.5
    gloss: float = 0.25
    """Specular reflection of the table's varnish, relative to a mirror: a table that does not polarize would
    give the object away.
    """
    ambient: float = 0.55
    environment: float = 0.9


def wood_texture(rng: np.random.Generator, size: int = 2048) -> Image:
    """A table top of (size, size) albedos: grain along one direction, blotches, no repetition."""
    blotches = _smooth_noise(rng, size, 24)
    bend = _smooth_noise(rng, size, 6)
    rows = np.linspace(0, 1, size, dtype=np.float32)[:, None]
    grain = 0.5 + 0.5 * np.sin(2 * np.pi * (60 * rows + 5 * bend))
    fine = cv2.resize(
        rng.random((size, size // 16), dtype=np.float32), (size, size), interpolation=cv2.INTER_LINEAR
    )
    return (0.22 + 0.12 * grain + 0.16 * blotches + 0.06 * fine).astype(np.float32)


def _smooth_noise(rng: np.random.Generator, size: int, cells: int) -> Image:
    coarse = rng.random((cells, cells), dtype=np.float32)
    return np.asarray(cv2.resize(coarse, (size, size), interpolation=cv2.INTER_CUBIC), np.float32)


def render_table(table: Table, rays: Image, T_base_cam: SE3) -> Image:
    """Stokes images of the table as a camera sees it.

    Args:
        rays: (h, w, 3) unit viewing rays in the camera frame, lens distortion included.
        T_base_cam: where the camera is.

    Returns:
        (3, h, w) float32: S0, S1, S2 of diffuse light (unpolarized) plus the varnish's specular light,
        polarized perpendicularly to the plane of incidence (Fresnel). Rays that miss the table see a dim
        unpolarized room.
    """
    T_board_cam = table.T_base_board.inverse() @ T_base_cam
    out = np.empty((3, *rays.shape[:2]), np.float32)
    _render(
        rays,
        T_base_cam.rotation.astype(np.float32),
        T_base_cam.translation.astype(np.float32),
        T_board_cam.rotation.astype(np.float32),
        T_board_cam.translation.astype(np.float32),
        table.texture,
        table.board,
        np.array(table.board_size_m, np.float32),
        np.float32(table.refractive_index),
        np.float32(table.gloss),
        np.float32(table.ambient),
        np.float32(table.environment),
        out,
    )
    return out


@numba.njit(cache=True, fastmath=True)
def _bilinear(image: Image, x: float, y: float) -> float:  # pragma: no cover - compiled
    height, width = image.shape
    x = min(max(x, 0.0), width - 1.001)
    y = min(max(y, 0.0), height - 1.001)
    i, j = int(y), int(x)
    a, b = y - i, x - j
    top = image[i, j] * (1 - b) + image[i, j + 1] * b
    bottom = image[i + 1, j] * (1 - b) + image[i + 1, j + 1] * b
    return top * (1 - a) + bottom * a


@numba.njit(cache=True, fastmath=True, parallel=True)
def _render(  # pragma: no cover - compiled
    rays: Image,
    R_base: Image,
    t_base: Image,
    R_board: Image,
    t_board: Image,
    texture: Image,
    board: Image,
    board_size: Image,
    index: float,
    gloss: float,
    ambient: float,
    environment: float,
    out: Image,
) -> None:
    height, width = rays.shape[:2]
    # The table's normal (+z of the base) in the camera frame is the last row of R_base_cam.
    nx, ny, nz = R_base[2, 0], R_base[2, 1], R_base[2, 2]
    texels = texture.shape[0] / TABLE_SIZE_M
    board_x = board.shape[1] / board_size[0]
    board_y = board.shape[0] / board_size[1]
    step = 1.0 / _SUBSAMPLES
    for i in numba.prange(height):
        for j in range(width):
            dx, dy, dz = rays[i, j, 0], rays[i, j, 1], rays[i, j, 2]
            cosine = -(nx * dx + ny * dy + nz * dz)
            if cosine < 1e-3:
                out[0, i, j] = 0.12
                out[1, i, j] = 0.0
                out[2, i, j] = 0.0
                continue
            u = R_board[0, 0] * dx + R_board[0, 1] * dy + R_board[0, 2] * dz
            v = R_board[1, 0] * dx + R_board[1, 1] * dy + R_board[1, 2] * dz
            w = R_board[2, 0] * dx + R_board[2, 1] * dy + R_board[2, 2] * dz
            depth = -t_board[2] / w
            bx, by = t_board[0] + depth * u, t_board[1] + depth * v
            on_board = -0.002 < bx < board_size[0] + 0.002 and -0.002 < by < board_size[1] + 0.002
            if on_board and 0 < i < height - 1 and 0 < j < width - 1:
                albedo = 0.0
                for a in range(_SUBSAMPLES):
                    for b in range(_SUBSAMPLES):
                        fy, fx = (a + 0.5) * step - 0.5, (b + 0.5) * step - 0.5
                        sx = (
                            dx
                            + 0.5 * fx * (rays[i, j + 1, 0] - rays[i, j - 1, 0])
                            + 0.5 * fy * (rays[i + 1, j, 0] - rays[i - 1, j, 0])
                        )
                        sy = (
                            dy
                            + 0.5 * fx * (rays[i, j + 1, 1] - rays[i, j - 1, 1])
                            + 0.5 * fy * (rays[i + 1, j, 1] - rays[i - 1, j, 1])
                        )
                        sz = (
                            dz
                            + 0.5 * fx * (rays[i, j + 1, 2] - rays[i, j - 1, 2])
                            + 0.5 * fy * (rays[i + 1, j, 2] - rays[i - 1, j, 2])
                        )
                        su = R_board[0, 0] * sx + R_board[0, 1] * sy + R_board[0, 2] * sz
                        sv = R_board[1, 0] * sx + R_board[1, 1] * sy + R_board[1, 2] * sz
                        sw = R_board[2, 0] * sx + R_board[2, 1] * sy + R_board[2, 2] * sz
                        sd = -t_board[2] / sw
                        px, py = t_board[0] + sd * su, t_board[1] + sd * sv
                        if 0.0 <= px <= board_size[0] and 0.0 <= py <= board_size[1]:
                            albedo += _bilinear(board, px * board_x - 0.5, py * board_y - 0.5)
                        else:
                            albedo += 0.3
                albedo *= step * step
                shine = 0.15 * gloss
            else:
                reach = t_base[2] / cosine
                wx = t_base[0] + reach * (R_base[0, 0] * dx + R_base[0, 1] * dy + R_base[0, 2] * dz)
                wy = t_base[1] + reach * (R_base[1, 0] * dx + R_base[1, 1] * dy + R_base[1, 2] * dz)
                albedo = _bilinear(
                    texture, (wx + 0.5 * TABLE_SIZE_M) * texels, (wy + 0.5 * TABLE_SIZE_M) * texels
                )
                shine = gloss
            root = math.sqrt(index * index - 1.0 + cosine * cosine)
            r_s = ((cosine - root) / (cosine + root)) ** 2
            r_p = ((index * index * cosine - root) / (index * index * cosine + root)) ** 2
            diffuse = albedo * (ambient + 0.45 * cosine) * (1.0 - 0.5 * (r_s + r_p))
            specular = shine * environment * 0.5 * (r_s + r_p)
            polarized = shine * environment * 0.5 * (r_s - r_p)
            # Azimuth of the normal in the ray's basis: the optical axis turned the shortest way, y up.
            along = nz + (dx * nx + dy * ny) / (1.0 + dz)
            ax, ay = nx - dx * along, -(ny - dy * along)
            length = ax * ax + ay * ay + 1e-12
            out[0, i, j] = diffuse + specular
            # Specular light is polarized across the plane of incidence: phi + 90 deg, so the sign turns.
            out[1, i, j] = -polarized * (ax * ax - ay * ay) / length
            out[2, i, j] = -polarized * 2.0 * ax * ay / length
