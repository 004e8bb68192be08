"""Which of many views to calibrate from: those that differ most."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from calibration.board import BoardSpec
from calibration.detection import Detection
from calibration.finders import board_homography

MOST_VIEWS = 60
"""More views of one board cost time and add little (our choice)."""


def select_views(detections: list[Detection], spec: BoardSpec, count: int = MOST_VIEWS) -> NDArray[np.intp]:
    """Indices, ascending, of up to ``count`` views that differ most in where the board's outline lies.

    Farthest-point sampling (Gonzalez 1985) on the pixels of the board's four outer corners, which hold its
    place, distance, tilt and turn. It starts with the view that shows the most corners.
    """
    if len(detections) <= count:
        return np.arange(len(detections))
    width, height = spec.size_m
    outline = np.array([[0, 0, 1], [width, 0, 1], [width, height, 1], [0, height, 1]])
    places = np.full((len(detections), 8), np.nan)
    for index, detection in enumerate(detections):
        H = board_homography(detection, spec)
        if H is not None:
            projected = outline @ H.T
            places[index] = (projected[:, :2] / projected[:, 2:]).ravel()
    usable = np.isfinite(places).all(axis=1)
    shown = np.array([len(d) for d in detections]) * usable
    chosen = [int(np.argmax(shown))]
    nearest = np.where(usable, np.linalg.norm(places - places[chosen[0]], axis=1), -1.0)
    while len(chosen) < min(count, int(usable.sum())):
        chosen.append(int(np.argmax(nearest)))
        apart = np.where(usable, np.linalg.norm(places - places[chosen[-1]], axis=1), -1.0)
        nearest = np.minimum(nearest, apart)
    return np.sort(np.array(chosen, np.intp))
