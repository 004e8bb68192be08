"""Whole training sets: scenes rendered by several processes, written as one session of kind "synthetic".

A frame depends on the seed and its index alone, so that it is the same however many processes share the
work. Until the set is complete its frames lie in a folder beside the session; a set that was interrupted
goes on there.
"""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from importlib import metadata
from multiprocessing import get_context
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dataset import SE3, CameraInfo, Intrinsics, RawFrame, SessionError, ToolkitError
from dataset.polarimetry import decode
from dataset.session import Chunk, ObjectPoses, SessionWriter, compress, mask_box, write_object, write_poses
from s2p3.objects import ObjectModel
from s2p3.synthesis.domain import SYNTHETIC, Domain, draw_scene, draw_view
from s2p3.synthesis.informativeness import Informativeness, measure
from s2p3.synthesis.scene import SceneImage, SceneParameters, expose, render_scene

BITS = 12
_MEASURED = 64  # images whose informativeness is measured
_ATTEMPTS = 30  # drawings of one scene until the object is visible enough
_SMALLEST_PX = 60  # visible pixels of an object worth training on

PAPER_CAMERA = Intrinsics(
    np.array([[351.450, 0.0, 303.646], [0.0, 351.477, 251.423], [0.0, 0.0, 1.0]]), np.zeros(0), 512, 612
)
"""The working image of the camera behind PPP-Net's data: a 6 mm lens, 612x512 pixels."""


def session_camera(calibration: str | Path | None = None) -> Intrinsics:
    """The working image (the colour super-pixel, without distortion) of a calibrated camera.

    Args:
        calibration: calibration.json; the camera behind the paper's data when None.

    Raises:
        ToolkitError: the file cannot be read, or holds no intrinsics.
    """
    if calibration is None:
        return PAPER_CAMERA
    from calibration.result import Calibration

    record = Calibration.load(calibration).intrinsics
    if record is None:
        raise ToolkitError(f"{calibration} holds no intrinsics; run: s2p3 calibrate intrinsics")
    return record.intrinsics.at(4).pinhole


@dataclass(frozen=True, eq=False)
class _Job:
    """What all frames of a set share."""

    model: ObjectModel
    intrinsics: Intrinsics
    domain: Domain
    seed: int
    folder: Path

    def part(self, index: int) -> Path:
        return self.folder / f"{index:06d}.npz"


@dataclass(frozen=True, eq=False)
class _Masks:
    """Visible masks (n, h, w), packed to bits."""

    packed: Sequence[NDArray[np.uint8]]
    shape: tuple[int, int]

    def __len__(self) -> int:
        return len(self.packed)

    def __getitem__(self, index: int, /) -> NDArray[np.bool_]:
        bits = np.unpackbits(self.packed[index], count=self.shape[0] * self.shape[1])
        return bits.reshape(self.shape).astype(bool)


def synthesize(
    model: ObjectModel,
    count: int,
    intrinsics: Intrinsics,
    seed: int,
    out: str | Path,
    workers: int = 1,
    on_progress: Callable[[int, int], None] | None = None,
    domain: Domain = SYNTHETIC,
) -> Informativeness:
    """Render a training set and write it as a session; its camera is at the base frame's origin.

    Args:
        model: the object; it rests on the table.
        count: frames.
        intrinsics: of the working image, a pinhole such as `session_camera` gives.
        seed: the same seed, the same frames.
        out: session file to write.
        workers: processes.
        on_progress: called with (frames done, count).
        domain: what scenes are drawn from.

    Returns:
        How much the set says about shape, measured on its first frames.

    Raises:
        ToolkitError: `out` exists, or the object cannot be seen in these views.
    """
    out = Path(out)
    if out.exists():
        raise SessionError(f"{out} exists; remove it or choose another name")
    if count < 1:
        raise ToolkitError(f"{out}: a set needs at least one frame, not {count}")
    job = _Job(model, intrinsics.pinhole, domain, seed, out.with_name(out.name + ".parts"))
    _prepare(job)
    missing = [index for index in range(count) if not job.part(index).exists()]
    for done, _ in enumerate(_run(job, missing, workers), start=count - len(missing) + 1):
        if on_progress is not None:
            on_progress(done, count)
    figures = _assemble(job, count, out)
    shutil.rmtree(job.folder)
    return figures


def draw_frame(
    model: ObjectModel, intrinsics: Intrinsics, domain: Domain, seed: int, index: int
) -> tuple[SE3, SceneParameters, SceneImage, np.random.Generator]:
    """Frame `index` of a set: its pose, parameters and picture, and the generator its noise comes from.

    Raises:
        ToolkitError: the object stayed hidden or out of the picture in every attempt.
    """
    rng = np.random.default_rng([seed, index])
    rays = intrinsics.rays().astype(np.float32)
    for _ in range(_ATTEMPTS):
        T_cam_obj = draw_view(domain.views, model, intrinsics, rng)
        parameters = draw_scene(domain, model, T_cam_obj, rng)
        image = render_scene(model, T_cam_obj, intrinsics, parameters, rays)
        if image.visible_fraction >= domain.smallest_visible_fraction and image.mask.sum() >= _SMALLEST_PX:
            return T_cam_obj, parameters, image, rng
    raise ToolkitError(
        f"{model.name}: hardly visible in {_ATTEMPTS} drawn views at {domain.views.distance_m} m; check the "
        "mesh's unit and the range of distances"
    )


def _prepare(job: _Job) -> None:
    """Keep an interrupted set's frames only if they are of this very set."""
    request = json.dumps(
        {
            "toolkit": metadata.version("s2p3"),
            "object": job.model.to_record().sha256,
            "material": [job.model.material, job.model.refractive_index, job.model.extinction],
            "camera": [job.intrinsics.K.tolist(), job.intrinsics.height, job.intrinsics.width],
            "domain": asdict(job.domain),
            "seed": job.seed,
        },
        indent=1,
    )
    manifest = job.folder / "request.json"
    if manifest.exists() and manifest.read_text() == request:
        return
    shutil.rmtree(job.folder, ignore_errors=True)
    job.folder.mkdir(parents=True)
    manifest.write_text(request)


def _run(job: _Job, indices: list[int], workers: int) -> Iterator[None]:
    if workers <= 1 or len(indices) <= 1:
        for index in indices:
            _render_part(job, index)
            yield
        return
    # A forked child would inherit the threads of torch and OpenCV half alive.
    with ProcessPoolExecutor(workers, get_context("spawn"), _start_worker, (job,)) as pool:
        yield from pool.map(_render_in_worker, indices)


_worker_job: list[_Job] = []  # of a worker process: the mesh travels once, not with every frame


def _start_worker(job: _Job) -> None:
    import cv2
    import torch

    cv2.setNumThreads(1)
    torch.set_num_threads(1)
    _worker_job[:] = [job]


def _render_in_worker(index: int) -> None:
    _render_part(_worker_job[0], index)


def _render_part(job: _Job, index: int) -> None:
    """Render one frame into the set's folder."""
    T_cam_obj, parameters, image, rng = draw_frame(job.model, job.intrinsics, job.domain, job.seed, index)
    raw = expose(image.stokes, parameters, BITS, rng)
    chunk = compress(raw)
    figures = _measure(job, image, raw, index) if index < _MEASURED else None
    unfinished = job.part(index).with_suffix(".tmp")
    with unfinished.open("wb") as file:
        np.savez(
            file,
            chunk=np.frombuffer(chunk.data, np.uint8),
            crc32=chunk.crc32,
            T_cam_obj=T_cam_obj.as_matrix(),
            visible_fraction=image.visible_fraction,
            bbox_xywh=mask_box(image.mask),
            mask=np.packbits(image.mask),
            figures=np.array([] if figures is None else figures.values()),
        )
    unfinished.rename(job.part(index))


def _measure(job: _Job, image: SceneImage, raw: NDArray[np.uint16], index: int) -> Informativeness | None:
    """Informativeness of the object's block of a frame, as the sensor read it."""
    window = image.raster.window
    x, y, _, _ = image.raster.region
    K = job.intrinsics.K.copy()
    K[:2, 2] -= [x, y]
    stokes = decode(raw, "mono", BITS)
    visible = image.mask[window] & stokes.valid[window]
    return measure(
        stokes.stack()[:, window[0], window[1]],
        image.raster.normals,
        visible,
        K,
        job.model.refractive_index,
        seed=index,
    )


def _assemble(job: _Job, count: int, out: Path) -> Informativeness:
    """Write the session from its parts, under another name until it is complete."""
    height, width = 2 * job.intrinsics.height, 2 * job.intrinsics.width
    matrix = job.intrinsics.K.copy()
    matrix[:2] *= 2
    matrix[:2, 2] += 0.5  # the working pixel's centre lies between the four pixels of its cell
    camera = CameraInfo("s2p3", "analytic", f"seed {job.seed}", "", "Mono12", "mono", width, height, BITS, 0)
    unfinished = job.folder / "session.h5"
    unfinished.unlink(missing_ok=True)
    poses, visible, boxes, masks, figures = [], [], [], [], []
    pixels = np.broadcast_to(np.zeros((), np.uint16), (height, width))
    mosaic = Intrinsics(matrix, np.zeros(0), height, width)
    with SessionWriter(unfinished, "synthetic", camera, intrinsics=mosaic) as writer:
        for index in range(count):
            with np.load(job.part(index), allow_pickle=False) as part:
                now = time.monotonic_ns()
                frame = RawFrame(pixels, "Mono12", index, now, now, 1.0, 0.0, 0)
                writer.add_frame(frame, Chunk(part["chunk"].tobytes(), int(part["crc32"])))
                poses.append(SE3.from_matrix(part["T_cam_obj"]))
                visible.append(float(part["visible_fraction"]))
                boxes.append(part["bbox_xywh"])
                masks.append(part["mask"])
                if part["figures"].size:
                    figures.append(Informativeness(*part["figures"].tolist()))
    write_object(unfinished, job.model.to_record())
    shape = (job.intrinsics.height, job.intrinsics.width)
    truth = ObjectPoses(SE3.stack(poses), np.array(visible), np.array(boxes), _Masks(masks, shape))
    write_poses(unfinished, SE3.identity((count,)), 0.0, 0.0, {job.model.name: truth})
    unfinished.rename(out)
    return Informativeness.mean(figures)
