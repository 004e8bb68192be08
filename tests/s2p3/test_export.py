"""Exported networks give what the checkpoints give, and files that do not are refused."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from dataset.errors import ToolkitError
from dataset.session import Session, mask_box
from s2p3.cli import main
from s2p3.evaluation import Estimator, Finder
from s2p3.networks import onnx_files
from s2p3.networks.detector import Detection
from s2p3.networks.onnx_files import OnnxNetwork, write_onnx
from s2p3.objects import ObjectModel

pytest.importorskip("onnxruntime", reason="ONNX Runtime is not installed")


class Doubled(nn.Module):
    """The smallest network there is."""

    def forward(self, x: Tensor) -> Tensor:
        return 2 * x


@pytest.fixture(scope="module")
def exported(networks: dict[str, Path]) -> Path:
    """The student, beside its checkpoint."""
    assert main(["export", str(networks["student"])]) == 0
    return networks["student"].with_suffix(".onnx")


def test_an_exported_student_estimates_what_the_checkpoint_does(
    exported: Path, networks: dict[str, Path], cup: ObjectModel, cup_session: Path
) -> None:
    with Session.open(cup_session) as session:
        mask = session.object_poses("cup").mask(0)
        detection = Detection(mask_box(mask), mask, 0.9)
        poses = [
            Estimator.load(path, "cup")(session.stokes(0).stack(), detection, session.working_intrinsics)
            for path in (networks["student"], exported)
        ]
    a, b = (pose.T_cam_obj.as_matrix() for pose in poses)
    np.testing.assert_allclose(a, b, atol=1e-4)


@pytest.mark.parametrize("name", ["", "student", "student.pt"])
def test_a_place_for_another_kind_of_file_is_refused_at_once(
    name: str, networks: dict[str, Path], tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    assert main(["export", str(networks["student"]), "--out", str(tmp_path / name)]) == 2
    assert "an exported network is a file NAME.onnx; name it so" in capfd.readouterr().err


def test_an_exported_file_keeps_to_its_description(
    exported: Path, tmp_path: Path, networks: dict[str, Path]
) -> None:
    moved = Path(shutil.copy(exported, tmp_path / "student.onnx"))
    with pytest.raises(ToolkitError, match=r"student\.json: no such file"):
        Estimator.load(moved)
    changed = json.loads(networks["student"].with_suffix(".json").read_text()) | {"step": 7}
    moved.with_suffix(".json").write_text(json.dumps(changed))
    with pytest.raises(ToolkitError, match=r"was not exported from what .* describes"):
        Estimator.load(moved)
    with pytest.raises(ToolkitError, match=r"holds a student, not a detector"):
        Finder.load(exported)
    with pytest.raises(ToolkitError, match="was trained for 'cup', not 'fork'"):
        Estimator.load(exported, "fork")


def test_a_file_that_differs_is_not_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "doubled.onnx"
    example = torch.ones(1, 2, 4, 4)
    assert write_onnx(Doubled(), [example], path, "two") == 0
    network = OnnxNetwork.load(path)
    assert network.description == "two"
    assert torch.equal(torch.as_tensor(network(example)), 2 * example)
    assert onnx_files.largest_difference(nn.Identity(), network, [example]) == pytest.approx(1)
    with pytest.raises(ToolkitError, match="takes 1x2x4x4, not 1x2x8x8; export it again"):
        network(torch.ones(1, 2, 8, 8))
    monkeypatch.setattr(onnx_files, "TOLERANCE", -1.0)
    with pytest.raises(ToolkitError, match="was not kept"):
        write_onnx(Doubled(), [example], tmp_path / "other.onnx", "")
    assert [file.name for file in tmp_path.iterdir()] == ["doubled.onnx"]


@pytest.mark.parametrize("content", [b"", b"no model"])
def test_what_is_no_model_is_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "broken.onnx"
    with pytest.raises(ToolkitError, match="no such file; write one with: s2p3 export"):
        OnnxNetwork.load(path)
    path.write_bytes(content)
    with pytest.raises(ToolkitError, match="export it again"):
        OnnxNetwork.load(path)
