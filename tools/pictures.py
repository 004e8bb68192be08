"""Regenerates the pictures of the documentation from the toolkit itself: `python tools/pictures.py`.

`lab.png`: the simulated lab's cup as its camera measures it, 8 bit and noisy, with the physical priors and
the true normals beside it. `objects.jpg` and `objects-path-traced.jpg`: the four built-in objects in the same
scenes, drawn by either backend of the synthesis.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from acquisition.trajectories import look_at
from dataset import SE3, Intrinsics
from dataset.pictures import Picture, angle, degree, in_colour, intensity
from dataset.polarimetry import Stokes, decode, remap, superpixel
from s2p3 import objects, pictures
from s2p3.lab.rig import BOARD
from s2p3.lab.scene import LabScene
from s2p3.lab.truth import LabTruth, sample_truth
from s2p3.rendering import rasterize
from s2p3.synthesis import SYNTHETIC, Analytic, Backend, PathTraced, Recipe, session_camera
from s2p3.synthesis.frames import BITS

IMAGES = Path(__file__).parents[1] / "docs" / "images"

_SIDE, _GAP, _LINE = 150, 6, 28  # pixels of a tile, between tiles, of a line of text
_INK, _PAPER = (70, 70, 70), 255
_LAB_SEED = 0
_LAB_EYE_M = (0.17, 0.15, 0.20)
"""The camera in the cup's frame: a view that shows both handle and wall."""
_EXPOSURE = 2.0
"""Fraction of the white level that a white, well-lit surface reaches."""
_FRAMES = {"cup": 11, "bottle": 5, "fork": 5, "knife": 3}
"""Which frame of a set with seed 0 shows each object."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=IMAGES, help="folder for the pictures")
    out = parser.parse_args().out
    out.mkdir(parents=True, exist_ok=True)
    made = {
        "lab.png": lab_picture,
        "objects.jpg": lambda: objects_picture(Analytic()),
        "objects-path-traced.jpg": lambda: objects_picture(PathTraced.here()),
    }
    for name, picture in made.items():
        settings = (
            (cv2.IMWRITE_PNG_COMPRESSION, 9) if name.endswith("png") else (cv2.IMWRITE_JPEG_QUALITY, 88)
        )
        cv2.imwrite(str(out / name), picture(), settings)
        print(f"{out / name}: {(out / name).stat().st_size // 1000} kB")


def lab_picture() -> Picture:
    """The lab's cup, measured: intensity, DoLP, AoLP, two of the priors, and the true normals."""
    model = objects.build("cup")
    board = (BOARD.squares_x * BOARD.square_m, BOARD.squares_y * BOARD.square_m)
    truth = sample_truth(_LAB_SEED, model.name, model.refractive_index, board, model.resting)
    T_base_cam = look_at(truth.T_base_object.apply(_LAB_EYE_M), truth.T_base_object.translation)
    stokes, camera = measured(truth, T_base_cam)
    raster = rasterize(model.mesh, T_base_cam.inverse() @ truth.T_base_object, camera)
    diffuse, specular, _ = pictures.prior_normals(stokes, camera.K.copy(), model.refractive_index)
    tiles = {
        **polarization_tiles(stokes),
        "prior, diffuse": pictures.normals(diffuse, raster.mask),
        "prior, specular": pictures.normals(specular, raster.mask),
        "true normals": pictures.normals(raster.normals, raster.mask),
    }
    row = [tile(picture, raster.mask) for picture in tiles.values()]
    return np.vstack([line_of_text(list(tiles)), side_by_side(row)])


def objects_picture(backend: Backend) -> Picture:
    """An object a row, one frame of a training set: all of it, then intensity, DoLP, AoLP, the diffuse prior,
    the nearest of the specular ones and the true normals around the object."""
    rows, titles = [], []
    camera = session_camera()
    for name, index in _FRAMES.items():
        model = objects.build(name)
        recipe = Recipe(model, camera, SYNTHETIC, backend, 0)
        image, raw = recipe.render(recipe.draw(index))
        stokes = decode(raw, "mono", BITS)
        normals = np.zeros((*stokes.shape, 3), np.float32)
        normals[image.raster.window] = image.raster.normals
        diffuse, *specular = pictures.prior_normals(stokes, camera.K.copy(), model.refractive_index)
        tiles = {
            **polarization_tiles(stokes),
            "prior, diffuse": pictures.normals(diffuse, image.mask),
            "prior, specular": pictures.normals(nearest(specular, normals), image.mask),
            "true normals": pictures.normals(normals, image.mask),
        }
        whole = np.dstack([pictures.intensity(stokes)] * 3)
        side = min(whole.shape[:2])
        left = min(max(int(np.nonzero(image.mask)[1].mean()) - side // 2, 0), whole.shape[1] - side)
        scene = cv2.resize(whole[:side, left : left + side], (_SIDE, _SIDE), interpolation=cv2.INTER_AREA)
        rows.append([np.asarray(scene, np.uint8), *(tile(picture, image.mask) for picture in tiles.values())])
        titles = ["scene", *tiles]
    gap = np.full((_GAP, len(titles) * (_SIDE + _GAP) - _GAP, 3), _PAPER, np.uint8)
    drawn = [strip for row in rows for strip in (side_by_side(row), gap)]
    return np.vstack([line_of_text(titles), *drawn[:-1]])


def nearest(candidates: Sequence[NDArray[np.float32]], true: NDArray[np.float32]) -> NDArray[np.float32]:
    """At each pixel the candidate normal, in either of its azimuths, that is nearest to the true one."""
    turned = [*candidates, *(candidate * np.float32([-1, -1, 1]) for candidate in candidates)]
    cosine = np.stack([(candidate * true).sum(axis=-1) for candidate in turned])
    chosen = np.argmax(cosine, axis=0)
    return np.take_along_axis(np.stack(turned), chosen[None, ..., None], axis=0)[0]


def measured(truth: LabTruth, T_base_cam: SE3) -> tuple[Stokes, Intrinsics]:
    """What the lab's camera measures from a pose: the undistorted working image, and its pinhole camera."""
    sensor = truth.sensor
    radiance = LabScene(truth).render(T_base_cam)
    mosaic = sensor.expose(radiance, _EXPOSURE, 8, True, np.random.default_rng(_LAB_SEED))
    camera = truth.intrinsics.at(superpixel("colour"))
    seen = decode(mosaic.astype(np.uint8), "colour", 8)
    return remap(seen, *camera.undistort_map()), camera.pinhole


def polarization_tiles(stokes: Stokes) -> dict[str, Picture]:
    """Intensity, degree and angle of polarization."""
    return {
        "intensity": in_colour(intensity(stokes)),
        "degree (DoLP)": degree(stokes),
        "angle (AoLP)": angle(stokes),
    }


def tile(picture: Picture, mask: NDArray[np.bool_]) -> Picture:
    """A square of a picture around a mask, at the size of a tile."""
    rows, columns = np.nonzero(mask)
    half = int(0.62 * max(np.ptp(rows), np.ptp(columns)))
    y, x = (int(axis.min() + axis.max()) // 2 for axis in (rows, columns))
    framed = cv2.copyMakeBorder(picture, half, half, half, half, cv2.BORDER_REPLICATE)
    square = framed[y : y + 2 * half, x : x + 2 * half]
    method = cv2.INTER_AREA if 2 * half > _SIDE else cv2.INTER_CUBIC
    return np.asarray(cv2.resize(square, (_SIDE, _SIDE), interpolation=method), np.uint8)


def side_by_side(tiles: Sequence[Picture]) -> Picture:
    """A row of tiles with gaps between them."""
    gap = np.full((_SIDE, _GAP, 3), _PAPER, np.uint8)
    return np.hstack([part for one in tiles for part in (one, gap)][:-1])


def line_of_text(titles: Sequence[str]) -> Picture:
    """A line with a title above each tile."""
    line = np.full((_LINE, len(titles) * (_SIDE + _GAP) - _GAP, 3), _PAPER, np.uint8)
    for column, title in enumerate(titles):
        (width, _), _ = cv2.getTextSize(title, cv2.FONT_HERSHEY_SIMPLEX, 0.5, 1)
        at = (column * (_SIDE + _GAP) + (_SIDE - width) // 2, _LINE - 10)
        cv2.putText(line, title, at, cv2.FONT_HERSHEY_SIMPLEX, 0.5, _INK, 1, cv2.LINE_AA)
    return line


if __name__ == "__main__":
    main()
