"""Procedural meshes of the four built-in objects: watertight, in metres, free of anyone's licence.

Every builder returns `(vertices (V, 3) float64, faces (F, 3) int32)` with outward faces. Two constructions
suffice: a *lathe* (a profile turned about z) and a *sheet* (a planform with a thickness). The shapes are our
choice; only their diameters follow the objects of PPP-Net's instance-level data (see `objects`).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator

Array = NDArray[np.float64]
Faces = NDArray[np.int32]
MeshArrays = tuple[Array, Faces]

_CUP_SECTIONS = 64
_BOTTLE_SECTIONS = 64
_HOLE = 4  # quads along each side of the square opening where the cup's handle meets its wall


def cup() -> MeshArrays:
    """A mug with walls of 3 mm and a handle along +x, standing along z."""
    outer = np.array([[0.0415, z] for z in np.linspace(0.006, 0.0905, 25)])
    profile = np.vstack(
        [
            [[0.0, 0.0], [0.013, 0.0], [0.026, 0.0], [0.0355, 0.0], [0.0395, 0.0018], [0.041, 0.0038]],
            outer,
            [[0.041, 0.0922], [0.0398, 0.093], [0.0386, 0.0922]],
            [[0.0381, z] for z in np.linspace(0.0905, 0.012, 12)],
            [[0.0372, 0.0085], [0.035, 0.006], [0.025, 0.005], [0.0125, 0.005], [0.0, 0.005]],
        ]
    )
    vertices, quads, caps = _lathe(profile, _CUP_SECTIONS)
    quads, (lower, upper) = _open_wall(quads, _CUP_SECTIONS, rows=(8, 22))
    vertices, handle = _handle(vertices, upper, lower)
    faces = np.vstack([_split(quads), caps, _split(handle)])
    used, compact = np.unique(faces, return_inverse=True)  # the openings' inner vertices are gone
    return vertices[used], compact.reshape(-1, 3).astype(np.int32)


def bottle() -> MeshArrays:
    """A hollow glass bottle, open at the neck, standing along z and symmetric about it."""
    body = [[0.0255, z] for z in np.linspace(0.006, 0.074, 12)]
    angle = np.linspace(0.0, np.pi, 13)[1:-1]
    shoulder = np.c_[0.0255 - 0.0075 * (1 - np.cos(angle)), 0.074 + 0.026 * angle / np.pi]
    neck = [[0.0105, z] for z in np.linspace(0.1, 0.122, 6)]
    lip = [
        [0.0122, 0.1232],
        [0.0128, 0.125],
        [0.0128, 0.13],
        [0.012, 0.132],
        [0.0105, 0.1325],
        [0.009, 0.1318],
    ]
    base = [[0.0, 0.002], [0.01, 0.0015], [0.017, 0.0002], [0.021, 0.0], [0.0242, 0.001], [0.0252, 0.003]]
    inner_neck = [[0.0082, z] for z in np.linspace(0.13, 0.1, 6)]
    inner_shoulder = shoulder[::-1] - [0.0023, 0.0]
    inner_body = [[0.0232, z] for z in np.linspace(0.074, 0.008, 8)]
    inner_base = [[0.022, 0.0056], [0.019, 0.0045], [0.01, 0.0045], [0.0, 0.0048]]
    profile = np.vstack([base, body, shoulder, neck, lip, inner_neck, inner_shoulder, inner_body, inner_base])
    vertices, quads, caps = _lathe(profile, _BOTTLE_SECTIONS)
    return vertices, np.vstack([_split(quads), caps]).astype(np.int32)


def fork() -> MeshArrays:
    """A dinner fork with four tines, lying along x with its thickness along z."""
    tine, gap, head = 0.0042, 0.00273, 0.0125  # metres: widths of a tine and a gap, half width of the head
    root, tip = 0.142, 0.19  # where the tines begin and end
    starts = -head + np.arange(4) * (tine + gap)
    within = starts[:, None] + tine * np.arange(4)[None] / 3
    columns = np.sort(np.r_[within.ravel(), starts[:3] + tine + gap / 2])
    stations = np.r_[np.linspace(0.0, 0.012, 7), np.linspace(0.016, root, 44), np.linspace(root, tip, 22)[1:]]
    width = _curve(
        [0.0, 0.003, 0.012, 0.05, 0.09, 0.112, 0.124, 0.134, root, tip],
        [0.006, 0.0085, 0.0105, 0.0075, 0.0042, 0.0036, 0.0068, 0.0118, head, head],
    )
    rise = _curve(
        [0.0, 0.05, 0.1, 0.125, root, 0.165, tip], [0.0, 0.004, 0.009, 0.004, -0.0015, -0.001, 0.005]
    )
    x, lateral = np.meshgrid(stations, columns, indexing="ij")
    centres = starts + tine / 2
    owner = centres[np.argmin(np.abs(lateral[..., None] - centres), axis=-1)]
    along = np.clip((x - root) / (tip - root), 0.0, 1.0)  # 0 on the handle and head, 1 at the tips
    y = width(x) / head * (owner + (lateral - owner) * (1.0 - 0.55 * along**2))
    on_rim = np.abs(np.abs(lateral - owner) - tine / 2) < 1e-9
    blend = np.clip(along * 6, 0.0, 1.0)
    rounding = (1 - blend) * (1.0 - 0.5 * (lateral / head) ** 2) + blend * np.where(on_rim, 0.5, 1.0)
    half = 0.0012 * (1 + 0.5 * np.exp(-(((x - 0.11) / 0.02) ** 2))) * (1 - 0.3 * along) * rounding
    dish = 7.0 * np.clip((x - 0.118) / 0.02, 0.0, 1.0) * y**2
    between = 0.5 * (lateral[:-1, :-1] + lateral[:-1, 1:])
    in_gap = np.abs(between[..., None] - centres).min(axis=-1) > tine / 2
    keep = ~(in_gap & (x[:-1, :-1] >= root - 1e-9))
    return _sheet(np.stack([x, y], axis=-1), rise(x) + dish, half, _grid_quads(*x.shape)[keep.ravel()])


def knife() -> MeshArrays:
    """A table knife, lying along x: handle, bolster, and a blade with its edge towards -y."""
    stations = np.r_[np.linspace(0.0, 0.01, 6), np.linspace(0.014, 0.2, 50), np.linspace(0.203, 0.231, 14)]
    spine = _curve(
        [0.0, 0.004, 0.02, 0.06, 0.1, 0.115, 0.13, 0.19, 0.215, 0.231],
        [0.006, 0.0085, 0.0098, 0.0088, 0.0078, 0.007, 0.0088, 0.0092, 0.0075, 0.0035],
    )
    edge = _curve(
        [0.0, 0.004, 0.02, 0.06, 0.1, 0.115, 0.13, 0.19, 0.215, 0.231],
        [-0.006, -0.0085, -0.0098, -0.0088, -0.0078, -0.007, -0.0102, -0.0112, -0.0085, 0.0],
    )
    x, v = np.meshgrid(stations, np.linspace(-1.0, 1.0, 13), indexing="ij")
    y = edge(x) + 0.5 * (v + 1.0) * (spine(x) - edge(x))
    blade = np.clip((x - 0.108) / 0.02, 0.0, 1.0)
    blade = blade * blade * (3 - 2 * blade)
    end = np.clip(x / 0.006, 0.35, 1.0)
    handle_half = 0.0042 * end * (0.12 + 0.88 * np.sqrt(np.clip(1.0 - v**2, 0.0, 1.0)))
    blade_half = 0.00015 + 0.00095 * (0.5 * (v + 1.0)) ** 0.6
    return _sheet(
        np.stack([x, y], axis=-1),
        np.zeros_like(x),
        (1 - blade) * handle_half + blade * blade_half,
        _grid_quads(*x.shape),
    )


def box(size_xyz: tuple[float, float, float]) -> MeshArrays:
    """A box of the given edge lengths, centred: clutter for synthetic scenes."""
    corners = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
    quads = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
    return corners * np.asarray(size_xyz, dtype=np.float64), _split(quads)


def ellipsoid(size_xyz: tuple[float, float, float]) -> MeshArrays:
    """An ellipsoid of the given axis lengths, centred: clutter for synthetic scenes."""
    angle = np.linspace(-np.pi / 2, np.pi / 2, 17)
    radius = np.cos(angle)
    radius[[0, -1]] = 0.0
    vertices, quads, caps = _lathe(np.c_[radius, np.sin(angle)] * 0.5, 24)
    return vertices * np.asarray(size_xyz, dtype=np.float64), np.vstack([_split(quads), caps]).astype(
        np.int32
    )


def _curve(x: list[float], y: list[float]) -> Callable[[Array], Array]:
    curve: Callable[[Array], Array] = PchipInterpolator(x, y)
    return curve


def _split(quads: NDArray[np.int64]) -> Faces:
    """Quads (Q, 4) -> triangles (2Q, 3), same winding."""
    return np.vstack([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]).astype(np.int32)


def _grid_quads(rows: int, columns: int) -> NDArray[np.int64]:
    """Quads of a (rows, columns) vertex grid, row-major, ((rows - 1) * (columns - 1), 4)."""
    index = np.arange(rows * columns).reshape(rows, columns)
    corners = (index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:])
    return np.stack(corners, axis=-1).reshape(-1, 4)


def _lathe(profile: Array, sections: int) -> tuple[Array, NDArray[np.int64], Faces]:
    """Turn a profile (k, 2) of (r, z) about z; it starts and ends on the axis, material on its left going up.

    Returns vertices (ring r, section s at index r * sections + s, then the two poles), the quads between
    rings and the two fans of triangles at the poles.
    """
    rings = profile[1:-1]
    angle = 2 * np.pi * np.arange(sections) / sections
    x, y = rings[:, :1] * np.cos(angle), rings[:, :1] * np.sin(angle)
    z = np.broadcast_to(rings[:, 1:], x.shape)
    poles = [[0.0, 0.0, profile[0, 1]], [0.0, 0.0, profile[-1, 1]]]
    vertices = np.vstack([np.stack([x, y, z], axis=-1).reshape(-1, 3), poles])
    here = np.arange(len(rings) * sections).reshape(len(rings), sections)
    beside = np.roll(here, -1, axis=1)
    quads = np.stack([here[:-1], beside[:-1], beside[1:], here[1:]], axis=-1).reshape(-1, 4)
    first, last = np.full(sections, here.size), np.full(sections, here.size + 1)
    caps = np.vstack([np.c_[first, beside[0], here[0]], np.c_[last, here[-1], beside[-1]]])
    return vertices, quads, caps.astype(np.int32)


def _open_wall(
    quads: NDArray[np.int64], sections: int, rows: tuple[int, int]
) -> tuple[NDArray[np.int64], list[NDArray[np.int64]]]:
    """Remove square patches of `_HOLE` x `_HOLE` quads around angle 0 and return the loops around them."""
    keep = np.ones(len(quads), dtype=bool)
    loops = []
    half = _HOLE // 2
    for row in rows:
        for r in range(row, row + _HOLE):
            keep[[r * sections + s % sections for s in range(-half, half)]] = False
        right = [(row + i, half) for i in range(_HOLE)]
        top = [(row + _HOLE, half - i) for i in range(_HOLE)]
        left = [(row + _HOLE - i, -half) for i in range(_HOLE)]
        bottom = [(row, -half + i) for i in range(_HOLE)]
        loops.append(np.array([r * sections + s % sections for r, s in right + top + left + bottom]))
    return quads[keep], loops


def _handle(
    vertices: Array, upper: NDArray[np.int64], lower: NDArray[np.int64]
) -> tuple[Array, NDArray[np.int64]]:
    """Bridge two openings of the wall by a bent tube: an ellipse swept along an arc in the x-z plane."""
    start, end = vertices[upper].mean(axis=0), vertices[lower].mean(axis=0)
    offset = vertices[upper] - start
    angle = np.arctan2(offset[:, 2], offset[:, 1])
    turn = np.linspace(0.0, np.pi, 28)[1:-1]
    middle, radius = 0.5 * (start[2] + end[2]), 0.5 * (start[2] - end[2])
    path = np.c_[
        start[0] - 0.001 + 0.031 * np.sin(turn) ** 0.8, np.zeros_like(turn), middle + radius * np.cos(turn)
    ]
    tangent = np.gradient(np.vstack([start, path, end]), axis=0)[1:-1]
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    across = np.c_[-tangent[:, 2], np.zeros_like(turn), tangent[:, 0]]
    flare = 1.0 + 0.35 * (np.exp(-turn / 0.25) + np.exp(-(np.pi - turn) / 0.25))
    rings = (
        path[:, None]
        + (0.0056 * flare)[:, None, None] * np.cos(angle)[None, :, None] * np.array([0.0, 1.0, 0.0])
        + (0.0044 * flare)[:, None, None] * np.sin(angle)[None, :, None] * across[:, None]
    )
    count = len(angle)
    index = len(vertices) + np.arange(len(turn) * count).reshape(len(turn), count)
    # The tube has turned by 180 degrees when it arrives: match the lower loop by its mirrored angle.
    arriving = vertices[lower] - end
    mirrored = np.arctan2(-arriving[:, 2], arriving[:, 1])
    order = np.argmin(np.abs(np.exp(1j * mirrored)[None] - np.exp(1j * angle)[:, None]), axis=1)
    index = np.vstack([upper, index, lower[order]])
    beside = np.roll(index, -1, axis=1)
    quads = np.stack([index[:-1], beside[:-1], beside[1:], index[1:]], axis=-1).reshape(-1, 4)
    return np.vstack([vertices, rings.reshape(-1, 3)]), quads


def _sheet(xy: Array, middle: Array, half: Array, quads: NDArray[np.int64]) -> MeshArrays:
    """Thicken a planform: xy (r, c, 2), mid-surface height and half thickness (r, c), and the quads to keep.

    Top and bottom copies are closed by a wall along every edge that belongs to one quad only.
    """
    flat = xy.reshape(-1, 2)
    count = len(flat)
    top, bottom = np.c_[flat, (middle + half).ravel()], np.c_[flat, (middle - half).ravel()]
    edges = np.stack([quads, np.roll(quads, -1, axis=1)], axis=-1).reshape(-1, 2)
    key = edges.min(axis=1) * count + edges.max(axis=1)
    _, inverse, uses = np.unique(key, return_inverse=True, return_counts=True)
    rim = edges[uses[inverse.ravel()] == 1]
    walls = np.c_[rim[:, 1], rim[:, 0], rim[:, 0] + count, rim[:, 1] + count]
    faces = _split(np.vstack([quads, quads[:, ::-1] + count, walls]))
    used, compact = np.unique(faces, return_inverse=True)
    return np.vstack([top, bottom])[used], compact.reshape(-1, 3).astype(np.int32)
