"""From one polarization image to one pose: detect, crop, estimate. The way every evaluated frame takes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from dataset import SE3, Intrinsics
from dataset.errors import ToolkitError
from s2p3.config import DetectorConfig, ExperimentConfig
from s2p3.inputs import View
from s2p3.networks.detector import Detection, DetectorNetwork, detect
from s2p3.networks.onnx_files import OnnxNetwork
from s2p3.networks.pose_head import decode_pose
from s2p3.networks.teacher import TeacherOutput, pose_of
from s2p3.objects import ObjectModel
from s2p3.training import checkpoint
from s2p3.training.batches import form_input
from s2p3.training.checkpoint import CheckpointInfo
from s2p3.training.crops import single_crop
from s2p3.training.detection import load_detector
from s2p3.training.supervised import load_student, load_teacher

PoseNetwork = Callable[[Tensor, Tensor], Tensor | TeacherOutput]
"""A teacher or student: polarization and priors to the head's nine numbers, or to all a teacher predicts."""


@dataclass(frozen=True, eq=False)
class PoseEstimate:
    """A pose and what it came from.

    Attributes:
        T_cam_obj: one pose.
        score: the detection's, 0 to 1.
        detection: box and mask it was estimated in.
    """

    T_cam_obj: SE3
    score: float
    detection: Detection


@dataclass(frozen=True, eq=False)
class Finder:
    """A trained detector with its settings: Stokes image to `Detection` of one of its objects."""

    network: DetectorNetwork
    settings: DetectorConfig
    class_index: int = 0

    @staticmethod
    def load(path: Path, object_name: str | None = None) -> Finder:
        """Reads a checkpoint, or the ONNX file of one; without a name it finds the detector's first object.

        Raises ToolkitError as `checkpoint.read_info`.
        """
        network: DetectorNetwork
        if path.suffix == ".onnx":
            info = checkpoint.read_info(path, "detector", object_name)
            network = cast(DetectorNetwork, _exported(path))
        else:
            network, info = load_detector(path, object_name)
        index = 0 if object_name is None else info.names.index(object_name)
        return Finder(network, info.config.detector, index)

    def __call__(self, stokes: NDArray[np.float32]) -> Detection | None:
        """`stokes` (3, H, W), undistorted."""
        settings = self.settings
        limits = (settings.level, settings.threshold, settings.minimum_score)
        return detect(self.network, stokes, *limits, self.class_index)


@dataclass(frozen=True, eq=False)
class Estimator:
    """A trained teacher or student: Stokes image and detection to pose."""

    network: PoseNetwork
    info: CheckpointInfo

    @staticmethod
    def load(path: Path, wanted: str | ObjectModel | None = None) -> Estimator:
        """Reads a teacher's or a student's checkpoint, or the ONNX file of one.

        Raises ToolkitError as `checkpoint.read_info`.
        """
        info = checkpoint.read_info(path, None, wanted)
        if info.kind == "detector":
            raise ToolkitError(f"{path}: holds a detector, not a teacher or student; give one of theirs")
        if path.suffix == ".onnx":
            return Estimator(cast(PoseNetwork, _exported(path)), info)
        load = load_teacher if info.kind == "teacher" else load_student
        return Estimator(*load(path, wanted))

    @torch.no_grad()
    def __call__(
        self,
        stokes: NDArray[np.float32],
        detection: Detection,
        intrinsics: Intrinsics,
        depth: NDArray[np.float32] | None = None,
    ) -> PoseEstimate:
        """Estimates the pose of what was detected.

        Args:
            stokes: (3, H, W), undistorted.
            intrinsics: of that image, a pinhole.
            depth: (H, W) metres, 0 unknown, where there is one.

        Raises ToolkitError: a network that sees depth, and there is none.
        """
        config: ExperimentConfig = self.info.config
        if config.input.modality == "rgbd" and depth is None:
            raise ToolkitError(
                "this network sees depth, and the images come without; give a session with depth, or a "
                "network of another input.modality"
            )
        crop = single_crop(stokes, detection, intrinsics, config.input, depth)
        view = View.centred(1, config.input.zoom)
        seen = form_input(crop, torch.tensor([0]), view, self.info.refractive_index, config)
        pose = pose_of(self.network(seen.polarization, seen.priors))
        rotation, translation, _ = decode_pose(pose, seen.K, seen.size, self.info.diameter_m)
        T_cam_obj = SE3(rotation[0].double().numpy(), translation[0].double().numpy())
        return PoseEstimate(T_cam_obj, detection.score, detection)


def _exported(path: Path) -> OnnxNetwork:
    """The network in an ONNX file. Raises ToolkitError: it is not of the description beside it."""
    network = OnnxNetwork.load(path)
    description = path.with_suffix(".json")
    if network.description != description.read_text(encoding="utf-8"):
        raise ToolkitError(f"{path}: was not exported from what {description} describes; export it again")
    return network
