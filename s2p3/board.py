"""The board that a rig file describes, as calibration knows it."""

from __future__ import annotations

from dataclasses import asdict

from acquisition.rig import BoardTable
from calibration.board import BoardSpec


def board_spec(board: BoardTable) -> BoardSpec:
    """Raises CalibrationError: no such board."""
    return BoardSpec(**asdict(board))
