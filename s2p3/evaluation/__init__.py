"""How good the poses are: prediction, metrics, per-frame records, and the report's pictures."""

from s2p3.evaluation.evaluate import Evaluation, Record, evaluate, find_objects
from s2p3.evaluation.metrics import Summary
from s2p3.evaluation.predict import Estimator, Finder, PoseEstimate

__all__ = [
    "Estimator",
    "Evaluation",
    "Finder",
    "PoseEstimate",
    "Record",
    "Summary",
    "evaluate",
    "find_objects",
]
