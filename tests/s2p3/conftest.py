"""A small labelled session of a cup, shaded by the Fresnel model, for the tests that need frames."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from dataset import SE3, CameraInfo, Intrinsics, RawFrame
from dataset.polarimetry import Stokes, encode
from dataset.session import ObjectPoses, ObjectRecord, SessionWriter, write_poses
from s2p3 import objects, physics
from s2p3.objects import ObjectModel
from s2p3.rendering import rasterize
from tests.s2p3.untrained import eager_detector_config, save_untrained

FRAMES = 8
HEIGHT, WIDTH = 256, 320  # of the raw mosaic; the polarization image is half as large


@pytest.fixture(autouse=True, scope="session")
def _one_thread() -> None:
    torch.set_num_threads(1)


@pytest.fixture(scope="session")
def cup() -> ObjectModel:
    return objects.build("cup")


@pytest.fixture(scope="module")
def networks(tmp_path_factory: pytest.TempPathFactory, cup: ObjectModel) -> dict[str, Path]:
    """Checkpoints of untrained networks: teacher, student, and a detector that sees the cup everywhere."""
    return save_untrained(tmp_path_factory.mktemp("networks"), cup, eager_detector_config())


@pytest.fixture(scope="session")
def cup_session(tmp_path_factory: pytest.TempPathFactory, cup: ObjectModel) -> Path:
    """Eight frames with poses, boxes and masks."""
    path = tmp_path_factory.mktemp("cup") / "cup.h5"
    write_cup_session(path, cup)
    return path


def write_cup_session(path: Path, cup: ObjectModel, seed: int = 0) -> None:
    rng = np.random.default_rng(seed)
    mosaic = Intrinsics(np.array([[400.0, 0, 161], [0, 402.0, 126], [0, 0, 1]]), np.zeros(0), HEIGHT, WIDTH)
    camera = CameraInfo("maker", "model", "1", "1.0", "Mono12", "mono", WIDTH, HEIGHT, 12, 0)
    poses, masks = [], []
    with SessionWriter(path, "synthetic", camera, intrinsics=mosaic) as writer:
        writer.add_object(cup_record(cup))
        for index in range(FRAMES):
            turn = SE3.from_rotvec([1.9, 0.0, 0.0], np.zeros(3)) @ SE3.from_rotvec(
                [0.0, 0.0, rng.uniform(-3, 3)], np.zeros(3)
            )
            place = SE3(np.eye(3), np.array([*rng.uniform(-0.05, 0.05, 2), rng.uniform(0.38, 0.5)]))
            pose = place @ turn
            stokes, mask = shade(cup, pose, mosaic.at(2), rng)
            raw = encode(Stokes(*stokes, np.ones_like(mask)), "mono", 12)
            writer.add_frame(RawFrame(raw, "Mono12", index, index * 10**7, index * 10**7, 5000.0, 0.0, 0))
            poses.append(pose)
            masks.append(mask)
    boxes = np.array([box_of(mask) for mask in masks])
    record = ObjectPoses(SE3.stack(poses), np.ones(FRAMES), boxes, masks)
    write_poses(path, SE3.identity((FRAMES,)), 0.0, 0.0, {cup.name: record})


def cup_record(cup: ObjectModel) -> ObjectRecord:
    return ObjectRecord(
        cup.name,
        cup.vertices,
        cup.faces,
        cup.material,
        cup.refractive_index,
        0.0,
        cup.symmetry.to_json(),
        cup.diameter,
    )


def shade(
    cup: ObjectModel, pose: SE3, intrinsics: Intrinsics, rng: np.random.Generator
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Stokes image (3, h, w) of a specular cup under a uniform sky, and its mask; the table is noise."""
    raster = rasterize(cup.mesh, pose, intrinsics)
    normals = torch.from_numpy(np.moveaxis(raster.normals, -1, 0))[None]
    rays = torch.from_numpy(np.moveaxis(intrinsics.rays(), -1, 0)).float()[None]
    _, specular = physics.analytic_dolp(normals, rays, cup.refractive_index)
    direction = -physics.doubled_azimuth(normals, rays)[0].numpy()
    inside = raster.mask
    light = np.where(inside, 0.5, rng.uniform(0.3, 0.7, inside.shape))
    polarized = np.where(inside, light * specular[0].numpy(), 0.0) * direction
    return np.concatenate([light[None], polarized]).astype(np.float32), inside


def box_of(mask: NDArray[np.bool_]) -> list[float]:
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    left, top = columns[0], rows[0]
    return [left, top, columns[-1] + 1 - left, rows[-1] + 1 - top]
