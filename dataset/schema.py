"""The declaration of session.h5. The writer, the reader, the validator and the docs read it.

One HDF5 file per recording. Shapes use these letters: N frames, H x W the raw mosaic, h x w the polarization
image at one pixel per super-pixel, M robot samples, D ledgered drops, V vertices, F faces, n and k any count.
A `*` in a path stands for a name chosen by the user.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

FORMAT = "s2p3-session"
SUFFIXES = (".h5", ".hdf5")
"""What the names of session files end on."""

MAJOR, MINOR = 1, 1
VERSION = f"{MAJOR}.{MINOR}"

Kind = Literal["sequence", "intrinsics", "hand_eye", "tool_tip", "touches", "polarizer", "synthetic"]
KINDS: tuple[str, ...] = get_args(Kind)

DROP_DTYPE = [("frame_id", "<i8"), ("reason", "S64"), ("host_time_ns", "<i8")]
"""A row of the ledger. The reason has a fixed length because a file that is read while it grows may not hold
strings of variable length."""

PAUSE_DTYPE = [
    ("first_id", "<i8"),
    ("last_id", "<i8"),
    ("reason", "S64"),
    ("host_time_ns", "<i8"),
    ("resumed_ns", "<i8"),
]
"""A gap that somebody asked for: the frames that the camera took meanwhile, both ends included, and when."""

SEGMENT_DTYPE = [("first_frame", "<i8"), ("first_sample", "<i8"), ("begun_utc", "S32")]
"""An uninterrupted recording: the rows of its first frame and first robot sample, and when it began."""

TABLES = {"drop": DROP_DTYPE, "pause": PAUSE_DTYPE, "segment": SEGMENT_DTYPE}
"""Rows of the datasets that are tables, by the names they have in `Dataset.dtypes`."""


@dataclass(frozen=True)
class Attribute:
    """An HDF5 attribute: the group it sits on, its name and Python type, what it may hold, and the minor
    version that brought it."""

    group: str
    name: str
    type: type
    description: str
    choices: tuple[str, ...] = ()
    required: bool = True
    since: int = 0


@dataclass(frozen=True)
class Dataset:
    """An HDF5 dataset.

    Attributes:
        path: inside the file.
        dtypes: the numpy kinds it may have, such as ("u1", "u2"); a key of `TABLES`, or "text".
        shape: sizes and the letters of the module's docstring.
        units: SI, or what the name says; "1" for pure numbers.
        description: one sentence.
        required: whether every file has it, or every instance of its parent when the path holds a `*`.
        chunk: rows per HDF5 chunk of a dataset that grows frame by frame or sample by sample; 0 otherwise.
        compressed: whether chunks pass the Blosc2 filter (LZ4, bit shuffle): one chunk an image, with its
            checksum in the dataset named by `checksums_of`. All others carry the attribute `crc32`.
        since: the minor version that brought it; what 0 declared stays, later ones only add.
    """

    path: str
    dtypes: tuple[str, ...]
    shape: tuple[int | str, ...]
    units: str
    description: str
    required: bool = True
    chunk: int = 0
    compressed: bool = False
    since: int = 0


ATTRIBUTES: tuple[Attribute, ...] = (
    Attribute("/", "format", str, "What this file is", (FORMAT,)),
    Attribute("/", "schema", str, "Version of this declaration, MAJOR.MINOR"),
    Attribute("/", "session_id", str, "Random identifier, 32 hexadecimal digits"),
    Attribute("/", "kind", str, "What was recorded", KINDS),
    Attribute("/", "created_utc", str, "When recording began, ISO 8601"),
    Attribute("/", "toolkit", str, "Name and version of the program that wrote the file"),
    Attribute("/", "rig_toml", str, "The rig's description as it was used, or empty"),
    Attribute(
        "/",
        "host_boot_id",
        str,
        "Which start of the recording computer its clock counts from",
        required=False,
        since=1,
    ),
    Attribute("/", "complete", bool, "Whether the recording ended as intended"),
    Attribute("/", "repaired", str, "When and what a repair restored", required=False),
    Attribute(
        "/",
        "origin",
        str,
        "What the file was made from, where it is no recording of its own",
        required=False,
        since=1,
    ),
    Attribute("/camera", "vendor", str, "Camera vendor"),
    Attribute("/camera", "model", str, "Camera model"),
    Attribute("/camera", "serial", str, "Serial number"),
    Attribute("/camera", "firmware", str, "Firmware version"),
    Attribute("/camera", "pixel_format", str, "PFNC name on the wire"),
    Attribute("/camera", "mosaic", str, "Layout of polarizers and colours", ("mono", "colour")),
    Attribute("/camera", "width", int, "Mosaic width, pixels"),
    Attribute("/camera", "height", int, "Mosaic height, pixels"),
    Attribute("/camera", "bits", int, "Significant bits of a raw value"),
    Attribute("/camera", "packet_size", int, "GigE Vision packet size, bytes; 0 where there is none"),
    Attribute(
        "/camera",
        "clock",
        str,
        "Whose clock the camera time is on",
        ("camera", "host"),
        required=False,
        since=1,
    ),
    Attribute("/objects/*", "material", str, "Material name"),
    Attribute("/objects/*", "refractive_index", float, "Real part of the refractive index"),
    Attribute("/objects/*", "extinction", float, "Imaginary part of the refractive index"),
    Attribute("/objects/*", "symmetry", str, "Symmetries of the mesh, JSON"),
    Attribute("/objects/*", "diameter", float, "Largest distance between two vertices, metres"),
    Attribute("/objects/*", "sha256", str, "Of the vertices' bytes (float64) followed by the faces' (int32)"),
    Attribute(
        "/calibration", "sha256", str, "Of the text in /calibration/json, UTF-8, where it is", required=False
    ),
)

DATASETS: tuple[Dataset, ...] = (
    Dataset(
        "camera/raw",
        ("u1", "u2"),
        ("N", "H", "W"),
        "counts",
        "Raw polarization mosaic, one chunk a frame",
        chunk=1,
        compressed=True,
    ),
    Dataset(
        "camera/crc32", ("u4",), ("N",), "1", "CRC-32 of the frame's pixel bytes, row by row", chunk=1024
    ),
    Dataset("camera/frame_id", ("i8",), ("N",), "1", "The camera's frame counter, unwrapped", chunk=1024),
    Dataset(
        "camera/camera_time_ns",
        ("i8",),
        ("N",),
        "ns",
        "Exposure start, camera clock; all -1: unknown",
        chunk=1024,
    ),
    Dataset(
        "camera/host_time_ns",
        ("i8",),
        ("N",),
        "ns",
        "First packet seen, host monotonic clock; all -1: unknown",
        chunk=1024,
    ),
    Dataset("camera/exposure_us", ("f8",), ("N",), "us", "Exposure time; all NaN: unknown", chunk=1024),
    Dataset("camera/gain_db", ("f8",), ("N",), "dB", "Analogue gain; all NaN: unknown", chunk=1024),
    Dataset("camera/missing_packets", ("i4",), ("N",), "1", "Packets that never arrived", chunk=1024),
    Dataset("camera/drops", ("drop",), ("D",), "1", "Frames known to exist and not stored", chunk=1024),
    Dataset(
        "camera/pauses",
        ("pause",),
        ("n",),
        "1",
        "Gaps that were asked for; their frames count neither as stored nor as lost",
        required=False,
        chunk=64,
        since=1,
    ),
    Dataset(
        "robot/host_time_ns", ("i8",), ("M",), "ns", "Sample first seen, host monotonic clock", chunk=1024
    ),
    Dataset("robot/robot_time_s", ("f8",), ("M",), "s", "Controller clock", chunk=1024),
    Dataset("robot/q", ("f8",), ("M", 6), "rad", "Joint angles", chunk=1024),
    Dataset(
        "robot/pose", ("f8",), ("M", 6), "m, rad", "base<-tcp as x y z and a rotation vector", chunk=1024
    ),
    Dataset("robot/safety_bits", ("u4",), ("M",), "1", "Safety status word", chunk=1024),
    Dataset(
        "robot/tcp_offset",
        ("f8",),
        (6,),
        "m, rad",
        "flange<-tcp as x y z and a rotation vector; NaN: unknown",
    ),
    Dataset(
        "robot/payload",
        ("f8",),
        (4,),
        "kg, m",
        "What the arm reckoned with: mass, and its centre in the flange frame; NaN: not told",
        required=False,
        since=1,
    ),
    Dataset(
        "clocks/camera", ("f8",), (3,), "ns, 1, ns", "a, b, sigma of host = a + b camera; NaN: see pieces"
    ),
    Dataset("clocks/robot", ("f8",), (3,), "ns, 1, ns", "a, b, sigma of host = a + b robot; NaN: see pieces"),
    Dataset(
        "clocks/camera_pieces",
        ("f8",),
        ("n", 4),
        "1, ns, 1, ns",
        "Row of the first frame of each piece, then its a, b, sigma of host = a + b camera",
        required=False,
        chunk=64,
        since=1,
    ),
    Dataset(
        "clocks/robot_pieces",
        ("f8",),
        ("n", 4),
        "1, ns, 1, ns",
        "Row of the first sample of each piece, then its a, b, sigma of host = a + b robot",
        required=False,
        chunk=64,
        since=1,
    ),
    Dataset(
        "segments",
        ("segment",),
        ("n",),
        "1",
        "Uninterrupted recordings that the file is made of; one, unless more was appended",
        required=False,
        chunk=64,
        since=1,
    ),
    Dataset(
        "depth",
        ("u2",),
        ("N", "h", "w"),
        "mm",
        "Depth in the undistorted polarization image; 0: unknown",
        required=False,
        chunk=1,
        compressed=True,
    ),
    Dataset(
        "depth_crc32",
        ("u4",),
        ("N",),
        "1",
        "CRC-32 of the depth image's bytes, row by row",
        required=False,
        since=1,
    ),
    Dataset(
        "polarizer/angle",
        ("f8",),
        ("N",),
        "rad",
        "Dial of the polarizer before the lens, counter-clockwise as the image shows it; NaN: unknown",
        required=False,
        chunk=1024,
        since=1,
    ),
    Dataset("calibration/json", ("text",), (), "1", "calibration.json as it was applied", required=False),
    Dataset("calibration/K", ("f8",), (3, 3), "px", "Pinhole matrix at the mosaic's grid", required=False),
    Dataset(
        "calibration/distortion", ("f8",), ("n",), "1", "Lens distortion, OpenCV's order", required=False
    ),
    Dataset(
        "calibration/polarizer_response",
        ("f4",),
        ("H", "W", 3),
        "1",
        "Analysis vector a of every pixel, which reads a . (S0, S1, S2)",
        required=False,
        since=1,
    ),
    Dataset("objects/*/vertices", ("f8",), ("V", 3), "m", "Mesh vertices in the object frame"),
    Dataset("objects/*/faces", ("i4",), ("F", 3), "1", "Vertex indices, counter-clockwise seen from outside"),
    Dataset(
        "poses/T_base_cam",
        ("f8",),
        ("N", 4, 4),
        "m",
        "base<-camera at mid-exposure; NaN: unknown",
        required=False,
    ),
    Dataset("poses/sigma_t", ("f8",), ("N",), "m", "Standard deviation of the translation", required=False),
    Dataset("poses/sigma_r", ("f8",), ("N",), "rad", "Standard deviation of the rotation", required=False),
    Dataset("poses/objects/*/T_cam_obj", ("f8",), ("N", 4, 4), "m", "camera<-object; NaN: unknown"),
    Dataset(
        "poses/objects/*/visible_fraction", ("f8",), ("N",), "1", "Share of the silhouette that is visible"
    ),
    Dataset(
        "poses/objects/*/bbox_xywh",
        ("f8",),
        ("N", 4),
        "px",
        "Box of the visible mask, pixel-edge coordinates",
    ),
    Dataset(
        "poses/objects/*/mask",
        ("u1",),
        ("N", "h", "w"),
        "1",
        "Visible mask in the undistorted polarization image, 0 or 1",
        chunk=1,
        compressed=True,
    ),
    Dataset(
        "poses/objects/*/mask_crc32",
        ("u4",),
        ("N",),
        "1",
        "CRC-32 of the mask's bytes, row by row",
        required=False,
        since=1,
    ),
    Dataset("splits/*", ("i8",), ("k",), "1", "Frame indices of a split, increasing", required=False),
)

_BY_PATH = {dataset.path: dataset for dataset in DATASETS}

FRAME_COLUMNS: tuple[str, ...] = (
    "frame_id",
    "camera_time_ns",
    "host_time_ns",
    "exposure_us",
    "gain_db",
    "missing_packets",
)
"""Datasets of /camera that hold one number a frame, named as `RawFrame`'s fields."""

ROBOT_COLUMNS: tuple[str, ...] = ("host_time_ns", "robot_time_s", "q", "pose", "safety_bits")
"""Datasets of /robot that hold one row a sample, named as `RobotTrace`'s fields."""

CAMERA_ATTRIBUTES: tuple[Attribute, ...] = tuple(a for a in ATTRIBUTES if a.group == "/camera")
"""Attributes of /camera, named as `CameraInfo`'s fields."""


def declaration(path: str) -> Dataset:
    """The declaration of a dataset by its path, `*` included."""
    return _BY_PATH[path]


def checksums_of(images: str) -> str:
    """Path of the dataset with one CRC-32 an image, from that of the images."""
    return "camera/crc32" if images == "camera/raw" else f"{images}_crc32"


def matching(declared: str, path: str) -> bool:
    """Whether a path in a file is one that a declared path (with `*`) stands for."""
    pattern, parts = declared.strip("/").split("/"), path.strip("/").split("/")
    return len(pattern) == len(parts) and all(p in ("*", q) for p, q in zip(pattern, parts, strict=True))


def declared_at(path: str) -> Dataset | None:
    """The declaration of the dataset at a path in a file; None for what the schema does not know."""
    return next((dataset for dataset in DATASETS if matching(dataset.path, path)), None)
