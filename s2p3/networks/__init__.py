"""Teacher, student and detector: plain torch modules, each readable top to bottom."""

from s2p3.networks.build import build_student, build_teacher
from s2p3.networks.detector import Detection, Detector, detect
from s2p3.networks.student import Student
from s2p3.networks.teacher import Teacher, TeacherOutput, pose_of

__all__ = [
    "Detection",
    "Detector",
    "Student",
    "Teacher",
    "TeacherOutput",
    "build_student",
    "build_teacher",
    "detect",
    "pose_of",
]
