"""Subsets, merges, conversion, export and import by the command line."""

from __future__ import annotations

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from dataset.session import Session
from s2p3.cli import main

GOLDEN = Path(__file__).parents[1] / "dataset" / "golden"


@pytest.fixture
def golden(tmp_path: Path) -> Path:
    return Path(shutil.copy(GOLDEN / "session-1.1.h5", tmp_path / "golden.h5"))


def frames(path: Path) -> int:
    with Session.open(path) as session:
        return len(session)


def test_a_session_is_divided_and_joined_again(golden: Path, tmp_path: Path) -> None:
    one, two, both = (tmp_path / name for name in ("one.h5", "two.h5", "both.h5"))
    assert main(["dataset", "subset", str(golden), "--frames", "0:3", "--out", str(one)]) == 0
    assert main(["dataset", "subset", str(golden), "--split", "test", "--out", str(two)]) == 0
    words = ["dataset", "merge", str(one), str(two), "--out", str(both)]
    assert main(words) == 2  # both hold the whole trace of the arm: they overlap
    assert main([*words, "--forget-clocks"]) == 0
    assert (frames(one), frames(two), frames(both)) == (3, 2, 5)
    assert main(["dataset", "validate", str(both)]) == 0


def test_an_old_session_is_converted(tmp_path: Path) -> None:
    out = tmp_path / "new.h5"
    assert main(["dataset", "convert", str(GOLDEN / "session-0.9.h5"), "--out", str(out)]) == 0
    assert main(["dataset", "validate", str(out)]) == 0


def test_a_session_goes_to_bop_and_back(golden: Path, tmp_path: Path) -> None:
    root, back = tmp_path / "bop", tmp_path / "back.h5"
    assert main(["dataset", "export-bop", str(golden), "--frames", "train", "--out", str(root)]) == 0
    assert main(["dataset", "import", "bop", str(root / "test" / "000000"), "--out", str(back)]) == 0
    assert frames(back) == 3


@pytest.mark.parametrize(
    ("layout", "option"),
    [("raw-folder", "--mosaic"), ("ppp-net", "--mesh-units"), ("housecat6d", "--mesh-units")],
)
def test_an_import_asks_for_what_it_cannot_know(
    layout: str, option: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((8, 8), np.uint8))
    assert main(["dataset", "import", layout, str(tmp_path), "--out", str(tmp_path / "s.h5")]) == 2
    (line,) = capfd.readouterr().err.splitlines()
    assert f"needs {option}" in line


@pytest.mark.parametrize(
    ("layout", "words", "option"),
    [
        ("raw-folder", ["--mosaic", "mono", "--mesh-units", "mm"], "--mesh-units"),
        ("bop", ["--pose-units", "m"], "--pose-units"),
        ("housecat6d", ["--mesh-units", "m", "--pose-units", "m", "--mesh", "cup.ply"], "--mesh"),
        ("ppp-net", ["--bits", "12"], "--bits"),
    ],
)
def test_an_option_of_another_layout_is_refused(
    layout: str, words: list[str], option: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "s.h5"
    assert main(["dataset", "import", layout, str(tmp_path), *words, "--out", str(out)]) == 2
    assert f"importing {layout} takes no {option}" in capfd.readouterr().err


def test_a_folder_of_mosaics_comes_in(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "a.png"), np.full((8, 8), 9, np.uint8))
    out = tmp_path / "s.h5"
    words = ["dataset", "import", "raw-folder", str(tmp_path), "--mosaic", "colour", "--out", str(out)]
    assert main(words) == 0
    assert frames(out) == 1
