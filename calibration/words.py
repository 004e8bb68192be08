"""How messages name directions."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def axis_name(axis: NDArray[np.float64]) -> str:
    """x, y or z where a direction (3,) is within 10 degrees of it, else its components."""
    axis = axis / max(float(np.linalg.norm(axis)), 1e-12)
    largest = int(np.argmax(np.abs(axis)))
    if abs(axis[largest]) > np.cos(np.radians(10.0)):
        return "xyz"[largest]
    axis = axis * np.sign(axis[largest])
    return f"[{axis[0]:.2f} {axis[1]:.2f} {axis[2]:.2f}]"
