"""The calibration target: a ChArUco board, described once and drawn or detected from the same description."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from dataset.errors import CalibrationError

DICTIONARIES: tuple[str, ...] = tuple(
    sorted({name.upper() for name in dir(cv2.aruco) if name.startswith("DICT_")})
)


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
    """A ChArUco board of ``squares_x`` by ``squares_y`` squares.

    The board's frame has its origin at the outer corner of the top-left square, x to the right, y down the
    board, z into the board (away from a viewer in front of it). Lengths are in metres.

    Raises:
        CalibrationError: fewer than 3 squares a side, lengths that are not positive, a marker that does not
            fit its square, an unknown dictionary or one with too few markers for the board.
    """

    squares_x: int
    squares_y: int
    square_m: float
    marker_m: float
    dictionary: str

    def __post_init__(self) -> None:
        if min(self.squares_x, self.squares_y) < 3:
            raise CalibrationError(
                f"board: {self.squares_x}x{self.squares_y} squares; at least 3 squares a side are needed"
            )
        if not 0 < self.marker_m < self.square_m:
            raise CalibrationError(
                f"board: marker_m ({self.marker_m:g}) must be positive and smaller than square_m"
                f" ({self.square_m:g}); measure both on the printed board, in metres"
            )
        if self.square_m > 1.0:
            raise CalibrationError(
                f"board: square_m is {self.square_m:g} m; lengths are in metres, 30 mm is 0.030"
            )
        available = len(dictionary(self.dictionary).bytesList)
        if self.marker_count > available:
            raise CalibrationError(
                f"board: {self.squares_x}x{self.squares_y} squares need {self.marker_count} markers,"
                f" {self.dictionary} has {available}; use a larger dictionary"
            )

    @property
    def marker_count(self) -> int:
        """How many markers the board carries: one in every other square."""
        return self.squares_x * self.squares_y // 2

    @property
    def corner_count(self) -> int:
        """How many inner corners the board has; their ids are 0 .. corner_count - 1, row by row."""
        return (self.squares_x - 1) * (self.squares_y - 1)

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
                " board"
                f" with {self.corner_count} corners; check squares_x and squares_y"
            )
        rows, columns = np.divmod(ids, self.squares_x - 1)
        x, y = (columns + 1) * self.square_m, (rows + 1) * self.square_m
        return np.stack([x, y, np.zeros(x.shape)], axis=-1).astype(np.float64)


def draw(spec: BoardSpec, px_per_square: int, margin_px: int = 0) -> NDArray[np.uint8]:
    """The board as printed: (H, W) u8, black on white, ``px_per_square`` pixels a square, a white margin
    around.

    The point (x, y) of the board's frame lies at pixel ``margin_px + x / square_m * px_per_square - 0.5``
    (pixel centres at integer coordinates), and likewise in y.
    """
    size = (spec.squares_x * px_per_square + 2 * margin_px, spec.squares_y * px_per_square + 2 * margin_px)
    return np.asarray(spec.aruco.generateImage(size, marginSize=margin_px, borderBits=1), np.uint8)
