"""From an experiment to the networks it describes."""

from __future__ import annotations

from s2p3.config import ExperimentConfig
from s2p3.inputs import channel_counts
from s2p3.networks.lite0 import channels_last
from s2p3.networks.student import Student
from s2p3.networks.teacher import Teacher


def build_teacher(config: ExperimentConfig, imagenet: bool = False) -> Teacher:
    """The teacher, its encoders with ImageNet weights where both `imagenet` and the experiment say so."""
    network = config.network
    teacher = Teacher(
        channel_counts(config.input),
        config.input.size,
        network.total_stride,
        network.decoder_channels,
        imagenet and network.imagenet,
    )
    return channels_last(teacher)


def build_student(config: ExperimentConfig, imagenet: bool = False) -> Student | Teacher:
    """The student, or in its place the teacher's network where the experiment asks for the large student."""
    network = config.network
    if network.student == "large":
        return build_teacher(config, imagenet)
    student = Student(
        channel_counts(config.input),
        config.input.size,
        network.total_stride,
        network.head_channels,
        network.head_hidden,
        imagenet and network.imagenet,
    )
    return channels_last(student)
