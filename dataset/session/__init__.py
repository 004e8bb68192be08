"""session.h5: writing a recording, reading it, and adding to it what was computed."""

from dataset.compression import Chunk, compress
from dataset.session.edit import write_calibration, write_object, write_poses, write_split
from dataset.session.reader import Frame, Session
from dataset.session.records import Clocks, ObjectPoses, ObjectRecord, mask_box
from dataset.session.writer import SessionWriter

__all__ = [
    "Chunk",
    "Clocks",
    "Frame",
    "ObjectPoses",
    "ObjectRecord",
    "Session",
    "SessionWriter",
    "compress",
    "mask_box",
    "write_calibration",
    "write_object",
    "write_poses",
    "write_split",
]
