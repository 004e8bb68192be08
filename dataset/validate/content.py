"""Whether the numbers in a session make sense: the recording itself."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from dataset.polarimetry import white_level
from dataset.schema import FRAME_COLUMNS
from dataset.session.accounting import unexplained
from dataset.session.files import attribute
from dataset.validate.images import intact_images
from dataset.validate.problems import Problem, View, first_frames

_CLOCK_RATE_TOLERANCE = 1e-3
"""Quartz is good to 1e-4; ten times that is a wrong fit, not a clock (our choice)."""


def check_frame_columns(view: View) -> Iterator[Problem]:
    """Ids and clocks grow, exposures are real, no packet is missing."""
    columns = {name: view.read(f"camera/{name}") for name in FRAME_COLUMNS}
    columns = {name: None if _unknown(values) else values for name, values in columns.items()}
    anew = _begins_anew(view, "camera", "first_frame")
    for name, strict in (("frame_id", True), ("camera_time_ns", True), ("host_time_ns", False)):
        values = columns[name]
        if values is None:
            continue
        steps = np.diff(values)
        wrong = np.append(False, steps <= 0 if strict else steps < 0)
        if name == "camera_time_ns":
            wrong[anew[anew < len(wrong)]] = False
        if wrong.any():
            hint = "the camera restarted or its counter was not unwrapped; split the recording there"
            yield Problem(f"camera/{name}", f"does not increase at frame {first_frames(wrong)}", hint)
    exposure, gain, missing = columns["exposure_us"], columns["gain_db"], columns["missing_packets"]
    if exposure is not None and (wrong := ~(np.isfinite(exposure) & (exposure > 0))).any():
        hint = "the camera did not report it; fix the driver's feature name"
        yield Problem("camera/exposure_us", f"is not positive at frame {first_frames(wrong)}", hint)
    if gain is not None and (wrong := ~np.isfinite(gain)).any():
        hint = "the camera did not report it; fix the driver's feature name"
        yield Problem("camera/gain_db", f"is not finite at frame {first_frames(wrong)}", hint)
    if missing is not None and (wrong := missing != 0).any():
        hint = "such a frame belongs in the ledger; exclude it from every split"
        yield Problem("camera/missing_packets", f"packets are missing in frame {first_frames(wrong)}", hint)


def _begins_anew(view: View, device: str, first: str) -> NDArray[np.int64]:
    """Rows at which a device's clock may go back: a piece of its clock begins there, or a segment."""
    pieces, segments = view.read(f"clocks/{device}_pieces"), view.read("segments")
    rows = [np.empty(0) if pieces is None else pieces[:, 0], [] if segments is None else segments[first]]
    return np.unique(np.concatenate(rows)).astype(np.int64)


def _unknown(values: NDArray[np.generic] | None) -> bool:
    """Whether a column of an imported session says of every frame that nothing is known."""
    if values is None or len(values) == 0:
        return False
    return bool(np.isnan(values).all() if values.dtype.kind == "f" else (values == -1).all())


def check_ledger(view: View) -> Iterator[Problem]:
    """Every gap in the frame ids is explained by the ledger, and no ledgered frame is also stored."""
    ids, drops = view.read("camera/frame_id"), view.read("camera/drops")
    if ids is None or drops is None or len(ids) == 0:
        return
    dropped = np.unique(drops["frame_id"])
    both = np.isin(dropped, ids)
    if both.any():
        hint = "remove the entry, or the frame"
        yield Problem("camera/drops", f"frame id {dropped[both][0]} is in the ledger and stored", hint)
    silent = unexplained(ids, dropped, view.read("camera/pauses"))
    for index in np.flatnonzero(silent > 0):
        yield Problem(
            f"camera/frame_id[{index + 1}]",
            f"{silent[index]} frames between ids {ids[index]} and {ids[index + 1]} are neither stored nor "
            "ledgered",
            "treat the times between them as unknown; the recorder that wrote the file lost frames silently",
        )


def check_pixels(view: View) -> list[Problem]:
    """Every frame decompresses to the pixels it was stored with, within the camera's bits."""
    problems: list[Problem] = []
    bits = attribute(view.file["camera"], "bits")
    white = white_level(bits) if isinstance(bits, int) and 0 < bits <= 16 else None
    hint = f"copy the file again from its source, or run: s2p3 dataset repair {view.path}"
    for index, pixels in intact_images(view, "camera/raw", hint, problems):
        if white is not None and int(pixels.max()) > white:
            what = f"holds the value {int(pixels.max())}, more than {bits} bits"
            hint_bits = "check the camera's bits and pixel format"
            problems.append(Problem(f"camera/raw[{index}]", what, hint_bits))
    return problems


def check_depth(view: View) -> list[Problem]:
    """Every depth image decompresses to the pixels it was stored with."""
    problems: list[Problem] = []
    deque(intact_images(view, "depth", "copy the file again from its source", problems), maxlen=0)
    return problems


def check_robot(view: View) -> Iterator[Problem]:
    """The arm's trace is finite and its clocks grow."""
    times = (("robot_time_s", True), ("host_time_ns", False))
    for name, strict in times:
        values = view.read(f"robot/{name}")
        if values is None:
            continue
        steps = np.diff(values)
        wrong = np.append(False, ~(steps > 0) if strict else ~(steps >= 0))
        if name == "robot_time_s":
            anew = _begins_anew(view, "robot", "first_sample")
            wrong[anew[anew < len(wrong)]] = False
        if wrong.any():
            hint = "the controller restarted or samples were repeated; split the recording there"
            yield Problem(f"robot/{name}", f"does not increase at sample {first_frames(wrong)}", hint)
    for name in ("q", "pose"):
        values = view.read(f"robot/{name}")
        if values is not None and (wrong := ~np.isfinite(values).all(axis=-1)).any():
            hint = "leave these samples out"
            yield Problem(f"robot/{name}", f"is not finite at sample {first_frames(wrong)}", hint)
    offset = view.read("robot/tcp_offset")
    samples = view.dataset("robot/pose")
    if offset is not None and samples is not None and len(samples) and not np.isfinite(offset).all():
        hint = "poses of an unknown tool point cannot be used; record again with the offset"
        yield Problem("robot/tcp_offset", "is unknown although there is a trace", hint)


def check_clocks(view: View) -> Iterator[Problem]:
    """A fitted clock runs at about one second a second."""
    for name in ("camera", "robot"):
        line, pieces = view.read(f"clocks/{name}"), view.read(f"clocks/{name}_pieces")
        fits = [] if pieces is None else list(pieces[:, 1:])
        if line is not None and not np.isnan(line).all():
            fits.append(line)
        for fit in fits:
            _, rate, sigma = fit
            if np.isfinite(fit).all() and abs(rate - 1) < _CLOCK_RATE_TOLERANCE and sigma >= 0:
                continue
            hint = "fit the clocks again over a longer recording"
            yield Problem(f"clocks/{name}", f"a, b, sigma = {fit.tolist()} describe no clock", hint)
