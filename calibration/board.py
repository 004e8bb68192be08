"""The calibration target, described once and drawn, printed or detected from the same description.

Three kinds: a ChArUco board (a chessboard with markers in its white squares, which may be seen in part), a
plain chessboard (which must be seen whole), and an AprilGrid (tags with small black squares between their
corners).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from dataset.errors import CalibrationError

DICTIONARIES: tuple[str, ...] = tuple(
    sorted({name.upper() for name in dir(cv2.aruco) if name.startswith("DICT_")})
)


Kind = Literal["charuco", "checkerboard", "aprilgrid"]

_TAG_MODULES = 8  # of an AprilTag 36h11 and its black border, along a side


def dictionary(name: str) -> cv2.aruco.Dictionary:
    """The ArUco dictionary called ``name`` ("DICT_5X5_100" or "5X5_100").

    Raises:
        CalibrationError: OpenCV has no such dictionary.
    """
    full_name = name.upper() if name.upper().startswith("DICT_") else f"DICT_{name.upper()}"
    if full_name not in DICTIONARIES:
        raise CalibrationError(f"board: unknown dictionary {name!r}; choose one of {', '.join(DICTIONARIES)}")
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, full_name))


@dataclass(frozen=True)
class BoardSpec:
    """A board of ``squares_x`` by ``squares_y`` squares; of an AprilGrid, of cells with a tag in each.

    The board's frame has its origin at the outer corner of the top-left square, x to the right, y down the
    board, z into the board (away from a viewer in front of it). Lengths are in metres.

    Attributes:
        squares_x, squares_y: squares (cells) a side.
        square_m: side of a square; of an AprilGrid, from one tag to the next.
        marker_m: side of a marker or tag; unused by a chessboard.
        dictionary: OpenCV's name of the markers' dictionary; unused by a chessboard.
        kind: of board.

    Raises:
        CalibrationError: fewer than 3 squares a side, lengths that are not positive, a marker that does not
            fit its square, an unknown dictionary or one with too few markers for the board, a chessboard that
            looks the same upside down.
    """

    squares_x: int
    squares_y: int
    square_m: float
    marker_m: float
    dictionary: str
    kind: Kind = "charuco"

    def __post_init__(self) -> None:
        if min(self.squares_x, self.squares_y) < (2 if self.kind == "aprilgrid" else 3):
            raise CalibrationError(
                f"board: {self.squares_x}x{self.squares_y} squares; at least 3 squares a side are needed"
                " (of an AprilGrid, 2 tags)"
            )
        if not 0 < self.square_m <= 1.0:
            raise CalibrationError(
                f"board: square_m is {self.square_m:g} m; lengths are in metres, 30 mm is 0.030"
            )
        if self.kind == "checkerboard":
            if (self.squares_x + self.squares_y) % 2 == 0:
                raise CalibrationError(
                    f"board: a chessboard of {self.squares_x}x{self.squares_y} squares looks the same upside"
                    " down; use one with an odd number of squares one way and an even number the other"
                )
            return
        if not 0 < self.marker_m < self.square_m:
            raise CalibrationError(
                f"board: marker_m ({self.marker_m:g}) must be positive and smaller than square_m"
                f" ({self.square_m:g}); measure both on the printed board, in metres"
            )
        available = len(dictionary(self.dictionary).bytesList)
        if self.kind == "aprilgrid" and "APRILTAG_36H11" not in self.dictionary.upper():
            raise CalibrationError(
                f"board: an AprilGrid is made of DICT_APRILTAG_36H11 tags, not {self.dictionary}; correct"
                " [board] dictionary"
            )
        if self.marker_count > available:
            raise CalibrationError(
                f"board: {self.squares_x}x{self.squares_y} squares need {self.marker_count} markers,"
                f" {self.dictionary} has {available}; use a larger dictionary"
            )

    @property
    def marker_count(self) -> int:
        """How many markers the board carries."""
        if self.kind == "checkerboard":
            return 0
        cells = self.squares_x * self.squares_y
        return cells if self.kind == "aprilgrid" else cells // 2

    @property
    def corner_count(self) -> int:
        """How many corners the board has; their ids are 0 .. corner_count - 1: inner corners row by row, of
        an AprilGrid the four of each tag, clockwise from the top left."""
        if self.kind == "aprilgrid":
            return 4 * self.marker_count
        return (self.squares_x - 1) * (self.squares_y - 1)

    @property
    def plain_m(self) -> tuple[float, float]:
        """(square_m, marker_m) of the chessboard that the picture near a corner looks like."""
        if self.kind == "aprilgrid":
            return min(self.square_m - self.marker_m, self.marker_m / _TAG_MODULES), 0.0
        return self.square_m, self.marker_m if self.kind == "charuco" else 0.0

    @property
    def size_m(self) -> tuple[float, float]:
        """Width and height of the printed squares, in metres."""
        return self.squares_x * self.square_m, self.squares_y * self.square_m

    @cached_property
    def aruco(self) -> cv2.aruco.CharucoBoard:
        """OpenCV's description of the same board."""
        return cv2.aruco.CharucoBoard(
            (self.squares_x, self.squares_y), self.square_m, self.marker_m, dictionary(self.dictionary)
        )

    def object_points(self, ids: NDArray[np.integer]) -> NDArray[np.float64]:
        """Corners ``ids`` (n,) in the board's frame: (n, 3), metres.

        Raises:
            CalibrationError: an id the board does not have.
        """
        ids = np.asarray(ids)
        if ids.size and (ids.min() < 0 or ids.max() >= self.corner_count):
            raise CalibrationError(
                f"board: corner id {int(ids.max())} does not exist on a {self.squares_x}x{self.squares_y}"
                f" board with {self.corner_count} corners; check squares_x and squares_y"
            )
        if self.kind == "aprilgrid":
            tags, corner = np.divmod(ids, 4)
            rows, columns = np.divmod(tags, self.squares_x)
            gap = 0.5 * (self.square_m - self.marker_m)
            x = columns * self.square_m + gap + self.marker_m * np.isin(corner, (1, 2))
            y = rows * self.square_m + gap + self.marker_m * np.isin(corner, (2, 3))
        else:
            rows, columns = np.divmod(ids, self.squares_x - 1)
            x, y = (columns + 1) * self.square_m, (rows + 1) * self.square_m
        return np.stack([x, y, np.zeros(x.shape)], axis=-1).astype(np.float64)

    def __str__(self) -> str:
        size = f"{self.squares_x} x {self.squares_y}"
        if self.kind == "checkerboard":
            return f"chessboard of {size} squares of {1e3 * self.square_m:g} mm"
        if self.kind == "aprilgrid":
            return (
                f"AprilGrid of {size} tags of {1e3 * self.marker_m:g} mm every {1e3 * self.square_m:g} mm,"
                f" {self.dictionary}"
            )
        return (
            f"ChArUco board of {size} squares of {1e3 * self.square_m:g} mm, markers of"
            f" {1e3 * self.marker_m:g} mm, {self.dictionary}"
        )


@dataclass(frozen=True)
class Patch:
    """A rectangle of ink or paper: left, top, width, height in the board's frame, metres."""

    x: float
    y: float
    width: float
    height: float
    black: bool


def patches(spec: BoardSpec) -> list[Patch]:
    """The board as rectangles, to be painted in this order: a later one covers an earlier one."""
    side = spec.square_m
    cells = [(row, column) for row in range(spec.squares_y) for column in range(spec.squares_x)]
    if spec.kind == "aprilgrid":
        gap = side - spec.marker_m
        nodes = [(row, column) for row in range(spec.squares_y + 1) for column in range(spec.squares_x + 1)]
        painted = [
            Patch(column * side - gap / 2, row * side - gap / 2, gap, gap, True) for row, column in nodes
        ]
        marked = cells
    else:
        painted = [
            Patch(column * side, row * side, side, side, True)
            for row, column in cells
            if (row + column) % 2 == 0
        ]
        marked = [cell for cell in cells if sum(cell) % 2] if spec.kind == "charuco" else []
    inset = 0.5 * (side - spec.marker_m)
    for number, (row, column) in enumerate(marked):
        painted += _marker(spec, number, column * side + inset, row * side + inset)
    return painted


def _marker(spec: BoardSpec, number: int, x: float, y: float) -> list[Patch]:
    """A black square, and its white modules on top: no seams between the black ones."""
    words = dictionary(spec.dictionary)
    count = words.markerSize + 2
    modules = cv2.aruco.generateImageMarker(words, number, count, borderBits=1)
    module = spec.marker_m / count
    white = [
        Patch(x + column * module, y + row * module, module, module, False)
        for row, column in np.argwhere(modules > 0).tolist()
    ]
    return [Patch(x, y, spec.marker_m, spec.marker_m, True), *white]


def draw(spec: BoardSpec, px_per_square: int, margin_px: int = 0) -> NDArray[np.uint8]:
    """The board as printed: (H, W) u8, black on white, ``px_per_square`` pixels a square, a white margin
    around (of an AprilGrid it should hold the outer black squares: half a gap).

    The point (x, y) of the board's frame lies at pixel ``margin_px + x / square_m * px_per_square - 0.5``
    (pixel centres at integer coordinates), and likewise in y.
    """
    size = (spec.squares_y * px_per_square + 2 * margin_px, spec.squares_x * px_per_square + 2 * margin_px)
    picture = np.full(size, 255, np.uint8)
    scale = px_per_square / spec.square_m
    for patch in patches(spec):
        left, right = np.round(margin_px + scale * np.array([patch.x, patch.x + patch.width])).astype(int)
        top, bottom = np.round(margin_px + scale * np.array([patch.y, patch.y + patch.height])).astype(int)
        picture[max(top, 0) : max(bottom, 0), max(left, 0) : max(right, 0)] = 0 if patch.black else 255
    return picture
