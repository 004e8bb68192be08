"""The simulated lab: a scene with a hidden truth, served through the simulated devices' real protocols."""

from s2p3.lab.founding import found_lab
from s2p3.lab.operator import Operator
from s2p3.lab.processes import RunningLab, running_lab
from s2p3.lab.truth import LabTruth

__all__ = ["LabTruth", "Operator", "RunningLab", "found_lab", "running_lab"]
