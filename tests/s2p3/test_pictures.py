"""Pictures of polarization: raw mosaics in, pictures a person can read out."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from dataset.errors import ToolkitError
from dataset.frames import Mosaic
from dataset.polarimetry import Stokes, encode
from s2p3 import pictures
from s2p3.cli import main

REAL = Path(__file__).parents[3] / "shared" / "data" / "camera_IMX250MZR.png"
NAMES = {"s0", "dolp", "aolp", "normals_diffuse", "normals_specular_1", "normals_specular_2"}


def uniform(dolp: float, aolp_deg: float, shape: tuple[int, int] = (16, 24)) -> Stokes:
    s0 = np.full(shape, 0.8, np.float32)
    doubled = 2 * np.radians(aolp_deg)
    s1, s2 = s0 * dolp * np.cos(doubled), s0 * dolp * np.sin(doubled)
    return Stokes(s0, s1.astype(np.float32), s2.astype(np.float32), np.ones(shape, bool))


@pytest.mark.parametrize("layout", ["mono", "colour"])
@pytest.mark.parametrize("bits", [8, 12, 16])
def test_decode_writes_the_pictures_of_a_tiny_mosaic(tmp_path: Path, layout: Mosaic, bits: int) -> None:
    raw = tmp_path / "raw.png"
    size = 2 if layout == "mono" else 4
    cv2.imwrite(str(raw), encode(uniform(0.4, 30.0, (16 // size, 24 // size)), layout, bits))
    out = tmp_path / "out"
    assert main(["decode", str(raw), "--layout", layout, "--out", str(out)]) == 0
    assert {path.stem for path in out.iterdir()} == NAMES
    dolp = cv2.imread(str(out / "dolp.png"))
    assert dolp.shape == (16 // size, 24 // size, 3)
    np.testing.assert_allclose(dolp, pictures.degree(uniform(0.4, 0.0, dolp.shape[:2])), atol=6)
    hue = cv2.cvtColor(cv2.imread(str(out / "aolp.png")), cv2.COLOR_BGR2HSV)[..., 0]
    np.testing.assert_allclose(hue.astype(int), 30, atol=2)


@pytest.mark.skipif(not REAL.exists(), reason="needs the pictures of a real sensor")
def test_decode_reads_a_real_sensors_picture(tmp_path: Path) -> None:
    assert main(["decode", str(REAL), "--layout", "mono", "--out", str(tmp_path)]) == 0
    raw = cv2.imread(str(REAL), cv2.IMREAD_UNCHANGED)
    shown = {path.stem: cv2.imread(str(path)) for path in tmp_path.iterdir()}
    assert shown.keys() == NAMES
    assert all(picture.shape == (raw.shape[0] // 2, raw.shape[1] // 2, 3) for picture in shown.values())
    # S0 looks like the raw picture, made smaller; a wrong layout would leave DoLP high everywhere.
    small = cv2.resize(raw, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA).astype(float)
    grey = (shown["s0"][..., 0].astype(float) / 255) ** 2.2
    assert np.corrcoef(small.ravel(), grey.ravel())[0, 1] > 0.95


@pytest.mark.parametrize(
    ("pixels", "words", "message"),
    [
        (np.zeros((8, 8, 3), np.uint8), "mono", "8 x 8 x 3 uint8"),
        (np.zeros((7, 8), np.uint8), "mono", "7"),
        (np.zeros((8, 10), np.uint8), "colour", "10"),
    ],
)
def test_what_is_no_mosaic_is_named(tmp_path: Path, pixels: np.ndarray, words: Mosaic, message: str) -> None:
    raw = tmp_path / "raw.png"
    cv2.imwrite(str(raw), pixels)
    with pytest.raises(ToolkitError, match=message):
        pictures.decode_picture(raw, words, tmp_path / "out", 1.5)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("content", [b"", b"no picture"])
def test_what_is_no_picture_is_named(tmp_path: Path, content: bytes) -> None:
    raw = tmp_path / "raw.png"
    raw.write_bytes(content)
    with pytest.raises(ToolkitError, match="is not an image"):
        pictures.decode_picture(raw, "mono", tmp_path / "out", 1.5)
    with pytest.raises(ToolkitError, match=r"no\.png cannot be read"):
        pictures.decode_picture(tmp_path / "no.png", "mono", tmp_path / "out", 1.5)


@pytest.mark.parametrize("index", [1.0, 0.5, float("nan"), float("inf")])
def test_an_impossible_index_is_refused(tmp_path: Path, index: float) -> None:
    raw = tmp_path / "raw.png"
    cv2.imwrite(str(raw), np.full((8, 8), 90, np.uint8))
    with pytest.raises(ToolkitError, match="refractive index"):
        pictures.decode_picture(raw, "mono", tmp_path / "out", index)


def test_angles_that_are_alike_look_alike() -> None:
    apart = pictures.angle(uniform(0.5, 1.0)).astype(int) - pictures.angle(uniform(0.5, 179.0))
    assert np.abs(apart).max() < 20
    turned = pictures.angle(uniform(0.5, 1.0)).astype(int) - pictures.angle(uniform(0.5, 91.0))
    assert np.abs(turned).max() > 100


def test_unpolarized_light_is_dark_in_both_pictures() -> None:
    assert pictures.angle(uniform(0.0, 0.0)).max() == 0
    assert pictures.degree(uniform(0.0, 0.0)).max() < 90
    assert pictures.degree(uniform(1.0, 0.0)).max() > 200


def test_a_normal_towards_the_camera_is_blue_and_outside_the_mask_it_is_black() -> None:
    directions = np.zeros((2, 2, 3))
    directions[..., 2] = -1.0
    mask = np.array([[True, False], [True, True]])
    picture = pictures.normals(directions, mask)
    np.testing.assert_array_equal(picture[0, 0], [255, 128, 128])
    np.testing.assert_array_equal(picture[0, 1], [0, 0, 0])


def test_a_black_frame_makes_a_black_picture() -> None:
    dark = Stokes(*np.zeros((3, 4, 4), np.float32), np.zeros((4, 4), bool))
    assert pictures.intensity(dark).max() == 0
