"""A linear polarizer that the lab's operator holds before the lens, with an even lamp behind it.

Where it stands is a small file beside the lab's truth: the operator writes it, the camera sees it. In a real
lab this wire is light.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dataset.whole_files import replacing

_LAMP = 0.36
"""Radiance in the middle: 80 % of white at the rig's exposure for the pixel that sees most."""
_FALLOFF = 0.25
"""How much darker the lamp is in the corners: no diffuser is perfect."""


class HandHeldPolarizer:
    """The polarizer of a lab whose truth lies at a path."""

    def __init__(self, truth_path: Path) -> None:
        self._path = truth_path.with_name("polarizer.json")

    def turn_to(self, angle: float) -> None:
        """Holds it before the lens: radians counter-clockwise as the image shows it."""
        with replacing(self._path) as partial:
            partial.write_text(json.dumps({"angle": angle}), encoding="utf-8")

    def take_away(self) -> None:
        """Clears the view."""
        self._path.unlink(missing_ok=True)

    def angle(self) -> float | None:
        """Where it stands, radians; None while the view is clear."""
        try:
            return float(json.loads(self._path.read_text(encoding="utf-8"))["angle"])
        except FileNotFoundError:
            return None


def lamp_through(angle: float, height: int, width: int) -> NDArray[np.float32]:
    """(3, height, width) radiance of the lamp behind an ideal polarizer."""
    y, x = np.linspace(-1, 1, height)[:, None], np.linspace(-1, 1, width)[None]
    level = (_LAMP * (1 - 0.5 * _FALLOFF * (x**2 + y**2))).astype(np.float32)
    return level * np.array([1.0, np.cos(2 * angle), np.sin(2 * angle)], np.float32)[:, None, None]
