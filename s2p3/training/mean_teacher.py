"""A teacher that follows its student: its weights are the moving average of the student's (Tarvainen &
Valpola 2017), as the text of Self6D++ has it. The paper's teacher is frozen, and so is ours by default.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

from s2p3.networks.teacher import Teacher, TeacherOutput
from s2p3.training.loop import update_average

if TYPE_CHECKING:
    from typing_extensions import Self


class MeanTeacher(nn.Module):
    """A student and its teacher, trained as one network; only the student has gradients.

    Args:
        student: of the teacher's architecture.
        teacher: where its average starts.
        decay: of the average, by step.
    """

    def __init__(self, student: Teacher, teacher: Teacher, decay: float) -> None:
        super().__init__()
        self.student, self.teacher, self.decay = student, teacher.requires_grad_(False), decay

    def train(self, mode: bool = True) -> Self:
        """The teacher answers in evaluation mode at all times."""
        super().train(mode)
        self.teacher.eval()
        return self

    def forward(self, polarization: Tensor, priors: Tensor) -> tuple[TeacherOutput, TeacherOutput]:
        """What the student and what the teacher says; in training mode the teacher takes a step first."""
        with torch.no_grad():
            if self.training:
                update_average(self.teacher, self.student, self.decay)
            said = self.teacher(polarization, priors)
        return self.student(polarization, priors), said
