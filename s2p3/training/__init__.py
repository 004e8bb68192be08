"""Training: sessions to crops, crops to batches, batches to checkpoints."""

from s2p3.training.crops import Crops, LabelledCrops, captured_crops, labelled_crops
from s2p3.training.detection import train_detector
from s2p3.training.self6d import self_supervise_rgbd
from s2p3.training.self_supervised import self_supervise
from s2p3.training.supervised import supervise

__all__ = [
    "Crops",
    "LabelledCrops",
    "captured_crops",
    "labelled_crops",
    "self_supervise",
    "self_supervise_rgbd",
    "supervise",
    "train_detector",
]
