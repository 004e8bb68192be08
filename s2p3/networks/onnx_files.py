"""Networks as ONNX files: written, checked against the network they came from, and run by ONNX Runtime.

A file takes and gives what the network's `forward` does, for one image, and carries a description (text) in
its metadata. Batch normalization is folded into the convolutions when it is loaded, which is most of why it
is quicker on a CPU.
"""

from __future__ import annotations

import logging
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from dataset.errors import ToolkitError
from dataset.whole_files import replacing
from s2p3.networks.teacher import TeacherOutput, pose_of

TOLERANCE = 1e-4
"""Largest difference between the file's outputs and the network's that is accepted, relative to the largest
output; our choice, some ten times what reordered sums of float32 give."""

_DESCRIPTION = "s2p3"
_INSTALL = "pip install 's2p3[train]'"


@dataclass(frozen=True, eq=False)
class OnnxNetwork:
    """A network in an ONNX file, on one thread of the CPU; called like the network itself.

    Attributes:
        description: the text that was given to `write_onnx`.
    """

    description: str
    _session: Any

    @staticmethod
    def load(path: Path) -> OnnxNetwork:
        """Reads a file. Raises ToolkitError: missing, unreadable or foreign, or no ONNX Runtime."""
        try:
            import onnxruntime  # type: ignore[import-untyped]
        except ImportError as error:
            raise ToolkitError(f"{path} needs ONNX Runtime, which is missing; {_INSTALL}") from error
        if not path.is_file():
            raise ToolkitError(f"{path}: no such file; write one with: s2p3 export")
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        options.log_severity_level = 3
        try:
            session = onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])
        except Exception as error:  # the runtime raises classes of its own for whatever is wrong with a file
            reason = str(error).splitlines()[0]
            raise ToolkitError(f"{path}: cannot be read as ONNX ({reason}); export it again") from error
        description = session.get_modelmeta().custom_metadata_map.get(_DESCRIPTION)
        if description is None:
            raise ToolkitError(f"{path}: is ONNX, but was not written by s2p3 export; export it again")
        return OnnxNetwork(description, session)

    def __call__(self, *images: Tensor) -> Tensor | tuple[Tensor, ...]:
        """One tensor or more, each of one image.

        Raises ToolkitError: of another size than the network was exported for.
        """
        inputs = self._session.get_inputs()
        for wanted, given in zip(inputs, images, strict=True):
            if list(given.shape) != list(wanted.shape):
                raise ToolkitError(
                    f"{wanted.name}: the ONNX file takes {_size(wanted.shape)}, not {_size(given.shape)}; "
                    "export it again for images of this size"
                )
        feed = {
            one.name: np.ascontiguousarray(image.numpy()) for one, image in zip(inputs, images, strict=True)
        }
        outputs = tuple(torch.from_numpy(output) for output in self._session.run(None, feed))
        return outputs[0] if len(outputs) == 1 else outputs


def write_onnx(network: nn.Module, examples: Sequence[Tensor], path: Path, description: str) -> float:
    """Exports a network in evaluation mode and checks the file against it on the examples and on noise.

    Args:
        examples: one for each input, of one image; their sizes become the file's.
        description: kept in the file, see `OnnxNetwork`.

    Returns:
        The largest relative difference between the file's outputs and the network's.

    Raises ToolkitError: they differ by more than `TOLERANCE` (no file is left), or the exporter is missing.
    """
    try:
        import onnx
        import onnxscript  # noqa: F401  (torch.onnx needs it, and says so in many lines)
    except ImportError as error:
        raise ToolkitError(f"export needs {error.name}, which is missing; {_INSTALL}") from error
    plain = _OutputTensors(network).eval()
    inputs = tuple(example.contiguous() for example in examples)
    with _quiet(), torch.no_grad():
        program: Any = torch.onnx.export(plain, inputs, dynamo=True, verbose=False)
    model = program.model_proto
    model.metadata_props.append(onnx.StringStringEntryProto(key=_DESCRIPTION, value=description))
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as partial:
        onnx.save(model, partial)
        worst = largest_difference(plain, OnnxNetwork.load(partial), inputs)
        if not worst <= TOLERANCE:
            raise ToolkitError(
                f"{path}: the exported network differs by {worst:.1e} of the largest output (at most "
                f"{TOLERANCE:.0e} is accepted), so it was not kept; use the checkpoint itself"
            )
    return worst


@torch.no_grad()
def largest_difference(network: nn.Module, exported: OnnxNetwork, examples: Sequence[Tensor]) -> float:
    """The largest difference of any output, relative to the largest value of that output, on the examples and
    on normal noise."""
    generator = torch.Generator().manual_seed(0)
    worst = 0.0
    for images in (examples, [torch.randn(example.shape, generator=generator) for example in examples]):
        for wanted, found in zip(_listed(network(*images)), _listed(exported(*images)), strict=True):
            scale = wanted.abs().max().clamp_min(1e-12)
            worst = max(worst, float((found - wanted).abs().max() / scale))
    return worst


class _OutputTensors(nn.Module):
    """The same network; of a teacher's outputs only the pose, which is all that is used of it."""

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network

    def forward(self, *images: Tensor) -> Tensor | tuple[Tensor, ...]:
        output: Tensor | tuple[Tensor, ...] | TeacherOutput = self.network(*images)
        return output if isinstance(output, tuple) else pose_of(output)


@contextmanager
def _quiet() -> Iterator[None]:
    """The exporter warns of its own deprecations and of operators that are not used here."""
    before = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logging.disable(before)


def _listed(output: Tensor | tuple[Tensor, ...]) -> tuple[Tensor, ...]:
    return output if isinstance(output, tuple) else (output,)


def _size(shape: Sequence[int]) -> str:
    return "x".join(map(str, shape))
