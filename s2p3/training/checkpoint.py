"""Checkpoints: weights in NAME.safetensors, and what they are in NAME.json beside it. No pickles."""

from __future__ import annotations

import json
import os
import shutil
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal, TypeVar

import torch.distributed as dist
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from acquisition import typed_toml
from dataset.errors import ToolkitError
from s2p3.config import ExperimentConfig
from s2p3.objects import ObjectModel
from s2p3.provenance import toolkit_state

Kind = Literal["teacher", "student", "detector"]
Network = TypeVar("Network", bound=nn.Module)
FORMAT = "s2p3-checkpoint-1"
RESUME = ".resume.safetensors"
"""What the file ends on from which the training of a checkpoint goes on."""


@dataclass(frozen=True)
class Validation:
    """How the weights of a checkpoint were chosen.

    Attributes:
        metric: what they scored highest by.
        value: of it.
        frames: on which it was measured, in words.
    """

    metric: str
    value: float
    frames: str


@dataclass(frozen=True)
class CheckpointInfo:
    """What a checkpoint holds besides weights.

    Attributes:
        kind: of network.
        stage: "pretrained", "supervised" (on annotated captured frames) or "self-supervised".
        object_name, diameter_m, refractive_index: of the object it was trained for; of a detector of several,
            of the first.
        step: optimizer steps after which the weights were these.
        config: the whole experiment.
        data: hashes of what it was trained on, by session id.
        commit: of the toolkit.
        validation: None where the last weights were kept.
        classes: of a detector, its objects in the order of its masks.
    """

    kind: Kind
    stage: str
    object_name: str
    diameter_m: float
    refractive_index: float
    step: int
    config: ExperimentConfig
    data: dict[str, str]
    commit: str = "unknown"
    validation: Validation | None = None
    classes: tuple[str, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        """Of all objects it was trained for."""
        return self.classes or (self.object_name,)

    @staticmethod
    def of(
        kind: Kind,
        stage: str,
        model: ObjectModel,
        step: int,
        config: ExperimentConfig,
        data: dict[str, str],
        validation: Validation | None = None,
    ) -> CheckpointInfo:
        """The info of a network trained for `model` by the toolkit that is running."""
        return CheckpointInfo(
            kind,
            stage,
            model.name,
            model.diameter,
            model.refractive_index,
            step,
            config,
            data,
            toolkit_state(),
            validation,
        )


def save(path: Path, weights: dict[str, Tensor], info: CheckpointInfo) -> None:
    """Writes `path` (NAME.safetensors) and NAME.json, the weights last and atomically; the weights' own
    metadata says the same as NAME.json. The resume file is done with.

    Of several processes that train together the first one writes, and the others wait for it.
    """
    together = dist.is_available() and dist.is_initialized()
    if not together or dist.get_rank() == 0:
        path.parent.mkdir(parents=True, exist_ok=True)
        description = {"format": FORMAT, **asdict(info), "config": typed_toml.dumps(info.config)}
        text = json.dumps(description, indent=1)
        path.with_suffix(".json").write_text(text, encoding="utf-8")
        save_tensors(path, weights, {"s2p3": text})
        shutil.copymode(path.with_suffix(".json"), path)  # safetensors writes for the owner only
        path.with_suffix(RESUME).unlink(missing_ok=True)
    if together:
        dist.barrier()


def save_tensors(path: Path, tensors: dict[str, Tensor], metadata: dict[str, str] | None = None) -> None:
    """Writes a safetensors file atomically: a reader sees the old file or the new one."""
    temporary = path.with_name(f"{path.name}.{os.getpid()}.part")  # several processes may write the same
    save_file({name: tensor.detach().contiguous() for name, tensor in tensors.items()}, temporary, metadata)
    temporary.replace(path)


def read_info(path: Path, kind: Kind | None = None, object_name: str | None = None) -> CheckpointInfo:
    """Reads NAME.json of the checkpoint `path`.

    Raises ToolkitError: missing or foreign files, a network of another kind than `kind`, of another object
    than `object_name`.
    """
    description = path.with_suffix(".json")
    for needed in (path, description):
        if not needed.is_file():
            raise ToolkitError(
                f"{needed}: no such file; a checkpoint is NAME.safetensors with NAME.json beside it"
            )
    try:
        values: dict[str, Any] = json.loads(description.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ToolkitError(f"{description}: not JSON ({error}); train again or restore the file") from error
    if values.pop("format", None) != FORMAT:
        raise ToolkitError(f"{description}: not a checkpoint this version reads ({FORMAT}); train again")
    try:
        config = typed_toml.loads(ExperimentConfig, values.pop("config"), source=str(description))
        validation = values.pop("validation", None)
        validation = None if validation is None else Validation(**validation)
        classes = tuple(values.pop("classes", ()))
        info = CheckpointInfo(config=config, validation=validation, classes=classes, **values)
    except (TypeError, KeyError) as error:
        raise ToolkitError(f"{description}: fields missing or unknown ({error}); train again") from error
    if kind is not None and info.kind != kind:
        raise ToolkitError(f"{path}: holds a {info.kind}, not a {kind}; give the {kind}'s checkpoint")
    if object_name is not None and object_name not in info.names:
        raise ToolkitError(
            f"{path}: was trained for {', '.join(map(repr, info.names))}, not {object_name!r}; "
            f"train a {info.kind} for {object_name!r}"
        )
    return info


def load_weights(network: Network, path: Path) -> Network:
    """Fills `network` with the weights at `path`, puts it in evaluation mode, and returns it.

    Raises ToolkitError: the weights do not fit the network.
    """
    try:
        network.load_state_dict(load_file(path))
    except RuntimeError as error:
        reason = str(error).splitlines()[-1].strip()
        raise ToolkitError(f"{path}: does not fit this network ({reason}); train again") from error
    return network.eval()
