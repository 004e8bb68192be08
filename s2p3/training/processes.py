"""The processes that train one network together, by accelerate: one on a desk, many on a cluster."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import torch
from torch import nn

from dataset.errors import ToolkitError
from s2p3.training.loader import Share
from s2p3.training.ranks import is_first
from s2p3.training.trees import map_tensors

if TYPE_CHECKING:
    from accelerate import Accelerator


@dataclass(frozen=True)
class Processes:
    """This process among those that `accelerate launch` or `torchrun` started; alone where neither did."""

    accelerator: Accelerator
    half_precision: bool = False

    @staticmethod
    def start() -> Processes:
        """Meets the other processes and takes this one's device: a GPU where there is one.

        Mixed precision (bfloat16) is for GPUs that compute in it: CPUs lose by it.

        Raises ToolkitError: accelerate is not installed.
        """
        try:
            from accelerate import Accelerator
        except ImportError as error:
            raise ToolkitError(
                f"training needs the package accelerate ({error}); install it with: pip install 's2p3[train]'"
            ) from error
        gpu = torch.cuda.is_available()
        half = gpu and torch.cuda.is_bf16_supported(including_emulation=False)
        # left to itself, accelerate does not meet other processes without a GPU
        return Processes(Accelerator(cpu=not gpu, mixed_precision="no"), half)

    @property
    def device(self) -> torch.device:
        """Where the network is."""
        return self.accelerator.device

    @property
    def first(self) -> bool:
        """Whether this is the process that writes files and speaks."""
        return is_first()

    @property
    def share(self) -> Share:
        """Of every batch."""
        return Share(self.accelerator.process_index, self.accelerator.num_processes)

    @property
    def suffix(self) -> str:
        """For files that every process writes."""
        return "" if self.first else f"-{self.accelerator.process_index}"

    def prepare(self, network: nn.Module) -> Callable[..., Any]:
        """The network as a function whose gradients are averaged over all processes. It computes in half
        precision where that is on; what it returns is float32, and so is all that is made of it."""
        prepared = self.accelerator.prepare_model(network)

        def forward(*inputs: torch.Tensor) -> Any:
            with torch.autocast(self.device.type, torch.bfloat16, enabled=self.half_precision):
                output = prepared(*inputs)
            return map_tensors(output, torch.Tensor.float)

        return forward

    def common_step(self, step: int) -> int:
        """The step all processes go on from. Raises ToolkitError: they do not agree."""
        from accelerate.utils import gather_object

        steps = set(gather_object([step]))
        if len(steps) > 1:
            raise ToolkitError(
                f"the processes would go on from different steps ({sorted(steps)}): they must see the same "
                "files; choose an output folder that all machines share"
            )
        return step

    def broadcast(self, network: nn.Module) -> None:
        """Gives all processes the first one's weights."""
        from accelerate.utils import broadcast

        if self.accelerator.num_processes > 1:
            network.load_state_dict(broadcast(network.state_dict()))
