"""A camera's intrinsics at one pixel grid, and the grids derived from it.

OpenCV camera frame (x right, y down, z forward); pixel centres at integer coordinates; lens distortion in
OpenCV's order (k1 k2 p1 p2 [k3 [k4 k5 k6]]).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dataset.errors import CalibrationError

Floats = NDArray[np.float64]

_COEFFICIENT_COUNTS = (0, 4, 5, 8)
_NEWTON_STEPS = 20
_NEWTON_TOLERANCE = 1e-10  # of a focal length: under a millionth of a pixel


@dataclass(frozen=True, eq=False)
class Intrinsics:
    """Pinhole matrix, lens distortion and image size, all at ONE pixel grid.

    Attributes:
        K: (3, 3) float64, pixels: [[fx 0 cx] [0 fy cy] [0 0 1]].
        distortion: (n,) float64 OpenCV coefficients, n in 0, 4, 5, 8.
        height, width: of the image, pixels.

    Raises:
        CalibrationError: shapes or values that describe no camera.
    """

    K: Floats
    distortion: Floats
    height: int
    width: int

    def __post_init__(self) -> None:
        matrix = np.array(self.K, dtype=np.float64)
        distortion = np.array(self.distortion, dtype=np.float64).ravel()
        if matrix.shape != (3, 3):
            raise CalibrationError(f"Intrinsics: K has shape {matrix.shape}, expected (3, 3)")
        if not (np.isfinite(matrix).all() and matrix[0, 0] > 0 and matrix[1, 1] > 0):
            raise CalibrationError(f"Intrinsics: K is not a pinhole matrix: {matrix.tolist()}")
        if matrix[0, 1] != 0 or not np.array_equal(matrix[[1, 2, 2, 2], [0, 0, 1, 2]], [0, 0, 0, 1]):
            raise CalibrationError("Intrinsics: K must be [[fx 0 cx] [0 fy cy] [0 0 1]], without skew")
        if len(distortion) not in _COEFFICIENT_COUNTS or not np.isfinite(distortion).all():
            raise CalibrationError(
                f"Intrinsics: {len(distortion)} distortion coefficients; OpenCV's models have 0, 4, 5 or 8 "
                "finite ones"
            )
        if self.height <= 0 or self.width <= 0:
            raise CalibrationError(f"Intrinsics: image size {self.height}x{self.width} is empty")
        matrix.flags.writeable = False
        distortion.flags.writeable = False
        object.__setattr__(self, "K", matrix)
        object.__setattr__(self, "distortion", distortion)
        object.__setattr__(self, "height", int(self.height))
        object.__setattr__(self, "width", int(self.width))

    @property
    def pinhole(self) -> Intrinsics:
        """The same grid without lens distortion: the camera of the undistorted image."""
        return replace(self, distortion=np.zeros(0))

    def at(self, level: int) -> Intrinsics:
        """The grid whose pixel is the mean of a level x level block of this one.

        Called on the mosaic's intrinsics: 2 is the polarization image, 4 the colour super-pixel. The centre
        of block pixel 0 sits at (level - 1) / 2 of this grid, hence the half-pixel shift of cx, cy.

        Raises:
            CalibrationError: level < 1 or larger than the image.
        """
        if level < 1 or level > min(self.height, self.width):
            raise CalibrationError(
                f"Intrinsics.at: level {level} is impossible for {self.height}x{self.width}"
            )
        matrix = self.K.copy()
        matrix[:2, 2] -= (level - 1) / 2
        matrix[:2] /= level
        return Intrinsics(matrix, self.distortion, self.height // level, self.width // level)

    @property
    def surrounded(self) -> Intrinsics:
        """The same camera with a margin of its own size on every side, (3H, 3W): what is drawn there lies
        outside the image; see `middle`."""
        shift = np.array([[0, 0, self.width], [0, 0, self.height], [0, 0, 0]])
        return Intrinsics(self.K + shift, self.distortion, 3 * self.height, 3 * self.width)

    @property
    def middle(self) -> tuple[slice, slice]:
        """Rows and columns of the image in one of `surrounded`."""
        return slice(self.height, 2 * self.height), slice(self.width, 2 * self.width)

    def crop(self, box_xywh: ArrayLike, size: tuple[int, int] | int) -> Intrinsics:
        """The grid of a box cut out and resized.

        Args:
            box_xywh: (4,) left, top, width, height in pixel-edge coordinates: pixel 0 spans 0 to 1, so the
                whole image is (0, 0, width, height). May be fractional and reach beyond the image.
            size: (height, width) of the resized crop, or its side.

        The centre of crop pixel 0 lies at `x + w / (2 * width) - 0.5` of this grid's integer-centred pixels.

        Raises:
            CalibrationError: the box or the size is empty.
        """
        x, y, w, h = np.asarray(box_xywh, dtype=np.float64)
        height, width = (size, size) if isinstance(size, int) else size
        if not (w > 0 and h > 0):
            raise CalibrationError(f"Intrinsics.crop: the box {[float(v) for v in (x, y, w, h)]} is empty")
        scale = np.array([width / w, height / h])
        matrix = self.K.copy()
        matrix[:2, 2] = (matrix[:2, 2] + 0.5 - [x, y]) * scale - 0.5
        matrix[0, 0] *= scale[0]
        matrix[1, 1] *= scale[1]
        return Intrinsics(matrix, self.distortion, height, width)

    def project(self, points_cam: ArrayLike) -> Floats:
        """Points (..., 3) in the camera frame, metres, to pixels (..., 2); NaN for points not in front."""
        points = np.asarray(points_cam, dtype=np.float64)
        depth = np.where(points[..., 2:] > 0, points[..., 2:], np.nan)
        return self._to_pixels(self._distort(points[..., :2] / depth))

    def rays(self, pixels: ArrayLike | None = None) -> Floats:
        """Unit viewing rays (..., 3) through pixels (..., 2); of the whole grid, (H, W, 3), when None.

        Raises:
            CalibrationError: a pixel no ray reaches under this distortion model.
        """
        if pixels is None:
            pixels = np.stack(np.meshgrid(np.arange(self.width), np.arange(self.height)), axis=-1)
        pixels = np.asarray(pixels, dtype=np.float64)
        focal = np.array([self.K[0, 0], self.K[1, 1]])
        plane = self._undistort((pixels - self.K[:2, 2]) / focal)
        rays = np.concatenate([plane, np.ones_like(plane[..., :1])], axis=-1)
        return rays / np.linalg.norm(rays, axis=-1, keepdims=True)

    def undistort_map(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """(map_x, map_y), each (H, W) float32, for `cv2.remap`: where in this image each pixel of the
        `pinhole` image comes from."""
        rays = self.pinhole.rays()
        source = self._to_pixels(self._distort(rays[..., :2] / rays[..., 2:]))
        return source[..., 0].astype(np.float32), source[..., 1].astype(np.float32)

    def _to_pixels(self, plane: Floats) -> Floats:
        return plane * [self.K[0, 0], self.K[1, 1]] + self.K[:2, 2]

    def _distort(self, plane: Floats) -> Floats:
        """OpenCV's model: rational radial (k1 k2 k3 k4 k5 k6) and tangential (p1 p2) distortion."""
        if not self.distortion.any():
            return plane
        k1, k2, p1, p2, k3, k4, k5, k6 = np.pad(self.distortion, (0, 8 - len(self.distortion)))
        x, y = plane[..., 0], plane[..., 1]
        r2 = x * x + y * y
        radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
        return np.stack(
            [
                x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
                y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
            ],
            axis=-1,
        )

    def _undistort(self, target: Floats) -> Floats:
        """Newton's method on `_distort`, with a numerical Jacobian: exact where the fixed-point iteration
        commonly used stalls (strong distortion towards the corners)."""
        if not self.distortion.any():
            return target
        plane = target.copy()
        for _ in range(_NEWTON_STEPS):
            residual = self._distort(plane) - target
            (a, c), (b, d) = self._jacobian(plane)
            determinant = a * d - b * c
            if np.all((np.abs(residual) < _NEWTON_TOLERANCE).all(axis=-1) | np.isnan(target).any(axis=-1)):
                folded = (determinant <= 0) | (a + d <= 0)
                if folded.any():
                    break
                return plane
            u, v = residual[..., 0], residual[..., 1]
            plane = plane - np.stack([d * u - b * v, a * v - c * u], axis=-1) / determinant[..., None]
        raise CalibrationError(
            "Intrinsics.rays: the distortion model cannot be inverted at some pixel "
            f"(coefficients {np.round(self.distortion, 4).tolist()}); recalibrate with fewer coefficients or "
            "with views that reach the image corners"
        )

    def _jacobian(self, plane: Floats) -> tuple[tuple[Floats, Floats], tuple[Floats, Floats]]:
        """Central differences of `_distort`: ((dx'/dx, dy'/dx), (dx'/dy, dy'/dy)). The model is turned inside
        out where the determinant or the trace is not positive."""
        step = 1e-6
        x, y = np.array([step, 0.0]), np.array([0.0, step])
        by_x = (self._distort(plane + x) - self._distort(plane - x)) / (2 * step)
        by_y = (self._distort(plane + y) - self._distort(plane - y)) / (2 * step)
        return (by_x[..., 0], by_x[..., 1]), (by_y[..., 0], by_y[..., 1])
