"""What recording at the camera's full rate costs, and that no frame goes missing in silence.

    python tools/bench/recorder.py --seconds 60 --bits 8 --json
    python tools/bench/recorder.py --seconds 600 --soak --json

The simulated camera sends 2448x2048 frames at 22 a second over GigE Vision on the loopback network; this
process receives them with Aravis, compresses and stores them. The pictures are a ring of rendered mosaics
with the shot noise of a 10,500-electron pixel. The frames are counted from the finished file alone: the
camera's counter against the stored frames and the ledger.

    fps             rate at which frames were offered, by the camera's own clock
    offered, stored, ledgered, silent_loss   frames; offered = stored + ledgered + silent_loss
    cpu_cores       CPU time of this process over the time it recorded; the simulator is another process
    latency_ms_*    from a frame's first packet to its being in the file, flushed
    raw_write_ratio pictures per second through compression and the session's writer, over those of a plain
                    `file.write` of the same uncompressed bytes; both end with fsync, in turns, same folder

`--soak` adds this process' resident memory after the first tenth, in the middle and at the end (MB), the
frames that the simulator sent and how many of them late, and the size of the file (GB).
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import shutil
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acquisition.camera import CameraConfig
from acquisition.cameras.aravis import AravisCamera
from acquisition.recorder import Progress, Recorder
from acquisition.simulation.camera import SimulatedCamera
from acquisition.simulation.patterns import MovingPattern
from dataset.errors import ToolkitError
from dataset.frames import CameraInfo, RawFrame
from dataset.pixel_formats import pixel_format
from dataset.session import Session, SessionWriter, compress
from dataset.session.accounting import account

HEIGHT, WIDTH, RATE_HZ, SEED = 2048, 2448, 22.0, 0
FORMATS = {8: "BayerRG8", 12: "BayerRG12p"}
PICTURES = 8
FULL_WELL = 10_500.0  # electrons
WRITE_ROUNDS, WRITE_FRAMES = 3, 48

Pixels = NDArray[np.uint8] | NDArray[np.uint16]


class Ring:
    """A source for the simulated camera that costs it nothing: pictures made beforehand, over and over."""

    def __init__(self, format_name: str, seed: int) -> None:
        self._pictures = pictures(format_name, seed)
        self._next = 0

    def frame(
        self, pixel_format: str, height: int, width: int, exposure_us: float, gain_db: float, time_ns: int
    ) -> Pixels:
        """See `acquisition.simulation.patterns.FrameSource`."""
        del pixel_format, height, width, exposure_us, gain_db, time_ns
        self._next += 1
        return self._pictures[self._next % PICTURES]


def pictures(format_name: str, seed: int) -> list[Pixels]:
    """`PICTURES` mosaics (H, W) of a moving pattern, each with its own shot noise."""
    random = np.random.default_rng(seed)
    pattern, white = MovingPattern(), 2 ** pixel_format(format_name).bits - 1
    made = []
    for index in range(PICTURES):
        clean = pattern.frame(format_name, HEIGHT, WIDTH, 8_000.0, 0.0, index * 45_000_000)
        electrons = clean.astype(np.float32) * np.float32(FULL_WELL / white)
        noisy = electrons + np.sqrt(electrons) * random.standard_normal(clean.shape, dtype=np.float32)
        counts = np.clip(np.rint(noisy * np.float32(white / FULL_WELL)), 0, white)
        made.append(counts.astype(clean.dtype))
    return made


def measure(bits: int, seconds: float, folder: Path, address: str, soak: bool) -> dict[str, Any]:
    """Records, counts, and compares with a plain write. Returns the figures of this module's docstring."""
    os.environ["PYTHONPATH"] = os.pathsep.join([str(Path(__file__).parent), os.environ.get("PYTHONPATH", "")])
    arguments = {"format_name": FORMATS[bits], "seed": SEED}
    path = folder / f"recorder-{bits}.h5"
    memory: list[tuple[float, float]] = []

    def watch(progress: Progress) -> None:
        if progress.done is not None:
            memory.append((progress.done, resident_mb()))

    with SimulatedCamera(
        address,
        source="recorder:Ring",
        source_args=arguments,
        width=WIDTH,
        height=HEIGHT,
        frame_rate=RATE_HZ,
        pixel_format=FORMATS[bits],
    ) as simulator:
        config = CameraConfig(address, pixel_format=FORMATS[bits], frame_rate=RATE_HZ)
        with AravisCamera(config) as camera, SessionWriter(path, "sequence", camera.info) as writer:
            with Recorder(camera, None, writer, duration_s=seconds, on_progress=watch) as recorder:
                began, before_s = time.monotonic(), cpu_s()
                recorder.wait()
                cores = (cpu_s() - before_s) / (time.monotonic() - began)
            info = camera.info
        sent = simulator.command("statistics")
    with Session.open(path) as session:
        counted = account(session)
        span_s = 1e-9 * float(np.ptp(session.camera_time_ns))
    latency = np.percentile(recorder.latencies_ms, [50, 99])
    figures: dict[str, Any] = {
        "fps": round((counted.offered - 1) / span_s, 2),
        "offered": counted.offered,
        "stored": counted.stored,
        "ledgered": counted.ledgered,
        "silent_loss": counted.silent,
        "cpu_cores": round(cores, 3),
        "latency_ms_p50": round(float(latency[0]), 1),
        "latency_ms_p99": round(float(latency[1]), 1),
    }
    if soak:
        for name, at in (("start", 0.1), ("middle", 0.5), ("end", 1.0)):
            figures[f"rss_mb_{name}"] = round(min(memory, key=lambda row: abs(row[0] - at))[1])
        figures["simulator"] = sent
        figures["file_gb"] = round(path.stat().st_size / 1e9, 2)
    path.unlink()
    figures["raw_write_ratio"] = round(write_ratio(info, folder), 2)
    return figures


def write_ratio(info: CameraInfo, folder: Path) -> float:
    """Our writing rate over that of a plain write of the same bytes, as the median of rounds in turns."""
    ring = pictures(info.pixel_format, SEED)
    frames = [ring[index % PICTURES] for index in range(WRITE_FRAMES)]
    ratios = []
    for _ in range(WRITE_ROUNDS):
        ratios.append(plain_write_s(frames, folder) / session_write_s(frames, info, folder))
    return median(ratios)


def plain_write_s(frames: list[Pixels], folder: Path) -> float:
    """Seconds for a plain write of the pixels to a file, until they are on the disk."""
    path = folder / "plain.raw"
    began = time.perf_counter()
    with path.open("wb") as file:
        for pixels in frames:
            file.write(pixels.data)
        file.flush()
        os.fsync(file.fileno())
    seconds = time.perf_counter() - began
    path.unlink()
    return seconds


def session_write_s(frames: list[Pixels], info: CameraInfo, folder: Path) -> float:
    """The same through two compression threads and the session's writer."""
    path = folder / "session.h5"
    began = time.perf_counter()
    with SessionWriter(path, "sequence", info) as writer, ThreadPoolExecutor(2) as pool:
        for index, chunk in enumerate(pool.map(compress, frames)):
            now = index + 1
            writer.add_frame(RawFrame(frames[index], info.pixel_format, now, now, now, 1.0, 0.0, 0), chunk)
    with path.open("rb") as file:
        os.fsync(file.fileno())
    seconds = time.perf_counter() - began
    path.unlink()
    return seconds


def cpu_s() -> float:
    """CPU seconds of this process so far, all threads."""
    usage = resource.getrusage(resource.RUSAGE_SELF)
    return usage.ru_utime + usage.ru_stime


def resident_mb() -> float:
    """Resident memory of this process."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 1e6


def main() -> None:
    """Prints the figures."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seconds", type=float, default=60.0, help="how long to record")
    parser.add_argument("--bits", type=int, choices=sorted(FORMATS), default=8, help="of a pixel on the wire")
    parser.add_argument("--soak", action="store_true", help="print memory and the simulator's counts, too")
    parser.add_argument("--folder", type=Path, default=Path(), help="where to write; needs 80 MB a second")
    parser.add_argument("--address", default="127.0.0.1", help="of the simulated camera")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    options = parser.parse_args()
    needed = 1.05 * options.seconds * RATE_HZ * HEIGHT * WIDTH * (1 if options.bits == 8 else 2)
    try:
        free = shutil.disk_usage(options.folder).free
        if free < 0.75 * needed:
            raise ToolkitError(
                f"{options.folder.resolve()}: {free / 1e9:.0f} GB are free, {options.seconds:g} s take up to "
                f"{needed / 1e9:.0f}; name another --folder or fewer --seconds"
            )
        with tempfile.TemporaryDirectory(dir=options.folder) as folder:
            figures = measure(options.bits, options.seconds, Path(folder), options.address, options.soak)
    except (ToolkitError, OSError) as error:
        sys.exit(f"recorder: {error}")
    if options.json:
        print(json.dumps(figures))
        return
    for name, value in figures.items():
        print(f"{name:18} {value}")


if __name__ == "__main__":
    main()
