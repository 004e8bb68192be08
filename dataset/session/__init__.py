"""session.h5: writing a recording, reading it, and adding to it what was computed."""

from dataset.compression import Chunk, compress
from dataset.session.edit import check_name, write_calibration, write_object, write_poses, write_split
from dataset.session.frame import Frame
from dataset.session.reader import Session
from dataset.session.records import Clocks, ObjectPoses, ObjectRecord, PackedMasks, mask_box
from dataset.session.writer import SessionWriter

__all__ = [
    "Chunk",
    "Clocks",
    "Frame",
    "ObjectPoses",
    "ObjectRecord",
    "PackedMasks",
    "Session",
    "SessionWriter",
    "check_name",
    "compress",
    "mask_box",
    "write_calibration",
    "write_object",
    "write_poses",
    "write_split",
]
