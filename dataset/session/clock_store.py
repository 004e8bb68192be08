"""The devices' clocks as a session file holds them: fitted to its own arrival times, at any time again."""

from __future__ import annotations

import h5py
import numpy as np
from numpy.typing import NDArray

from dataset.clocks import ARRIVAL_SIGMA_NS, DeviceClock, fit_clock
from dataset.errors import ToolkitError
from dataset.frames import ClockFit
from dataset.schema import declaration
from dataset.session.files import make_dataset
from dataset.session.records import Clocks
from dataset.session.seals import reopen

Times = NDArray[np.int64]


def fit_stored(file: h5py.File) -> Clocks:
    """Fits both clocks to all arrivals in an open file, segment by segment, and stores them there.

    A clock that no line describes stays as it was, and is None in what is returned, which says why. Where
    the camera has no clock of its own its times are arrivals, each as late as it happened to be.
    """
    found: dict[str, DeviceClock] = {}
    problems = []
    for name, first in (("camera", "first_frame"), ("robot", "first_sample")):
        device, host = _arrivals(file, name)
        starts = [int(row) for row in file["segments"][first]] if "segments" in file else [0]
        if len(device) == 0:
            continue
        try:
            found[name] = fit_clock(device, host, starts)
        except ToolkitError as error:
            problems.append(f"the {name}'s clock is not known: {error}")
            continue
        if name == "camera" and file["camera"].attrs.get("clock") == "host":
            found[name] = DeviceClock((0,), (ClockFit(0.0, 1.0, ARRIVAL_SIGMA_NS),))
        store(file, name, found[name])
    if not np.isfinite(file["camera/exposure_us"][:]).all():
        problems.append(
            "the camera does not tell how long it exposes: the middle of an exposure is not known"
        )
    return Clocks(found.get("camera"), found.get("robot"), tuple(problems))


def store(file: h5py.File, name: str, clock: DeviceClock) -> None:
    """Writes the clock of "camera" or "robot" into an open file, replacing an earlier one."""
    rows = [(row, fit.a_ns, fit.b, fit.sigma_ns) for row, fit in zip(clock.first, clock.fits, strict=True)]
    path = f"clocks/{name}_pieces"
    if path not in file:
        make_dataset(file, declaration(path), path, None, (0, 4), np.float64)
    for node in (file[path], file[f"clocks/{name}"]):
        reopen(node)
    file[path].resize(len(rows), axis=0)
    file[path][:] = rows
    line = clock.fits[0] if len(clock.fits) == 1 else ClockFit(np.nan, np.nan, np.nan)
    file[f"clocks/{name}"][:] = [line.a_ns, line.b, line.sigma_ns]


def _arrivals(file: h5py.File, name: str) -> tuple[Times, Times]:
    """Times of all samples on the device's clock and on the host's, as far as both are there."""
    if name == "camera":
        device, host = file["camera/camera_time_ns"][:], file["camera/host_time_ns"][:]
    else:
        device = np.rint(1e9 * file["robot/robot_time_s"][:]).astype(np.int64)
        host = file["robot/host_time_ns"][:]
    count = min(len(device), len(host))
    return device[:count], host[:count]
