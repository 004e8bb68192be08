"""What a training writes down as it goes: JSON lines for scripts, event files for TensorBoard."""

from __future__ import annotations

import json
import math
import shutil
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING

from dataset.errors import ToolkitError

if TYPE_CHECKING:
    from torch.utils.tensorboard import SummaryWriter
    from typing_extensions import Self


class RunLog:
    """NAME.log.jsonl and the folder tensorboard/NAME beside a checkpoint; nothing is touched before the first
    line.

    Args:
        path: of the checkpoint.
        first: the step a training goes on from: later lines, of its interrupted run, are dropped.
    """

    def __init__(self, path: Path, first: int) -> None:
        self.path = path.with_suffix(".log.jsonl")
        self.events = path.parent / "tensorboard" / path.stem
        self.first = first
        self._writer: SummaryWriter | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._writer is not None:
            self._writer.close()

    def write(self, values: dict[str, float]) -> None:
        """A line; its "step" is an axis of the charts.

        Raises ToolkitError: tensorboard is not installed.
        """
        if self._writer is None:
            self._writer = self._begin()
        with self.path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(values) + "\n")
        for name, value in values.items():
            if name != "step":
                self._writer.add_scalar(name, value, int(values["step"]))

    def _begin(self) -> SummaryWriter:
        try:
            from torch.utils.tensorboard import SummaryWriter
        except ImportError as error:
            raise ToolkitError(
                f"training needs the package tensorboard ({error}); "
                "install it with: pip install 's2p3[train]'"
            ) from error
        lines = self.path.read_text(encoding="utf-8").splitlines() if self.path.exists() else []
        kept = [line for line in lines if _step_of(line) <= self.first]
        self.path.write_text("".join(line + "\n" for line in kept), encoding="utf-8")
        if not self.first:
            shutil.rmtree(self.events, ignore_errors=True)
        return SummaryWriter(str(self.events), purge_step=self.first + 1 if self.first else None)


def _step_of(line: str) -> float:
    """The step of a line; after all others where it was cut short."""
    try:
        return float(json.loads(line)["step"])
    except ValueError:
        return math.inf
