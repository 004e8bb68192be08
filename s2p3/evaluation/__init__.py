"""How good the poses are: prediction, metrics, per-frame records, and the report's pictures."""

from s2p3.evaluation.evaluate import Evaluation, evaluate, find_objects
from s2p3.evaluation.predict import Estimator, Finder, PoseEstimate
from s2p3.evaluation.records import Record, Subject
from s2p3.evaluation.summary import Difference, Summary

__all__ = [
    "Difference",
    "Estimator",
    "Evaluation",
    "Finder",
    "PoseEstimate",
    "Record",
    "Subject",
    "Summary",
    "evaluate",
    "find_objects",
]
