"""Checkpoints: weights in NAME.safetensors, and what they are in NAME.json beside it. No pickles."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal, TypeVar

import torch.distributed as dist
from safetensors import SafetensorError, safe_open
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from acquisition import typed_toml
from dataset.errors import ToolkitError
from dataset.symmetry import Symmetry
from dataset.whole_files import replacing
from s2p3.config import ExperimentConfig
from s2p3.objects import SAME_INDEX, SAME_SIZE, ObjectModel
from s2p3.provenance import toolkit_state
from s2p3.training.ranks import have_met, is_first
from s2p3.writable import check_folder

Kind = Literal["teacher", "student", "detector"]
Network = TypeVar("Network", bound=nn.Module)
FORMAT = "s2p3-checkpoint-1"
_DESCRIPTION = "s2p3"
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
        data: hashes of what it was trained and validated on, by session id; of a self-supervised student, of
            the "crops", and of the checkpoints of "teacher" and "student" that it came from.
        commit: of the toolkit.
        validation: None where the last weights were kept.
        classes: of a detector, its objects in the order of its masks.
        symmetry: of the object, as `Symmetry.to_json` says it; empty in checkpoints that do not say.
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
    symmetry: str = ""

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
            symmetry=model.symmetry.to_json(),
        )


def to_write(path: Path) -> Path:
    """`path`, where a training may leave its checkpoint, or goes on.

    Raises ToolkitError: a finished one has left its there, or its folder cannot be made.
    """
    check_folder(path.parent)
    if path.exists() and not path.with_suffix(RESUME).exists():
        raise ToolkitError(f"{path} is there already; delete it to train anew, or choose another folder")
    return path


def file_hash(path: Path) -> str:
    """A short hash of a file."""
    return hashlib.sha256(path.read_bytes()).hexdigest()[:16]


def save(path: Path, weights: dict[str, Tensor], info: CheckpointInfo) -> None:
    """Writes `path` (NAME.safetensors) and NAME.json, each atomically, the weights last; the weights' own
    metadata says the same as NAME.json, so that no others pass for these. Deletes the resume file.

    Of several processes that train together the first one writes, and the others wait for it.
    """
    if is_first():
        path.parent.mkdir(parents=True, exist_ok=True)
        description = {"format": FORMAT, **asdict(info), "config": typed_toml.dumps(info.config)}
        text = json.dumps(description, indent=1)
        save_text(path.with_suffix(".json"), text)
        save_tensors(path, weights, {_DESCRIPTION: text})
        path.with_suffix(RESUME).unlink(missing_ok=True)
    if have_met():
        dist.barrier()


def save_text(path: Path, text: str) -> None:
    """Writes a text file atomically: a reader sees the old file or the new one."""
    with replacing(path) as partial:
        partial.write_text(text, encoding="utf-8")


def save_tensors(path: Path, tensors: dict[str, Tensor], metadata: dict[str, str] | None = None) -> None:
    """Writes a safetensors file atomically: a reader sees the old file or the new one.

    Raises ToolkitError: it cannot be written.
    """
    try:
        with replacing(path) as partial:
            partial.touch()
            mode = partial.stat().st_mode
            whole = {name: tensor.detach().contiguous() for name, tensor in tensors.items()}
            save_file(whole, partial, metadata)
            partial.chmod(mode)  # safetensors writes for the owner only
    except (OSError, SafetensorError) as error:
        raise ToolkitError(
            f"{path}: cannot be written ({error}); check the disk's space and who may write there"
        ) from error


def read_info(
    path: Path, kind: Kind | None = None, wanted: str | ObjectModel | None = None
) -> CheckpointInfo:
    """Reads NAME.json of the checkpoint `path`, a network in NAME.safetensors or NAME.onnx.

    Args:
        wanted: the object, or its name.

    Raises ToolkitError: missing, damaged or foreign files; a network of another kind than `kind`, of another
        object than the one wanted, or of one of that name of another size, refractive index or symmetry.
    """
    if path.suffix not in (".safetensors", ".onnx"):
        raise ToolkitError(f"{path}: is no checkpoint; give NAME.safetensors, or NAME.onnx")
    description = path.with_suffix(".json")
    for needed in (path, description):
        if not needed.is_file():
            raise ToolkitError(
                f"{needed}: no such file; a checkpoint is NAME.safetensors with NAME.json beside it"
            )
    text = description.read_text(encoding="utf-8", errors="replace")
    info = _info(text, description)
    if path.suffix == ".safetensors" and _described(path) != text:
        raise ToolkitError(
            f"{path}: the weights are not those that {description} describes; restore both, or train again"
        )
    if kind is not None and info.kind != kind:
        raise ToolkitError(f"{path}: holds a {info.kind}, not a {kind}; give the {kind}'s checkpoint")
    name = wanted.name if isinstance(wanted, ObjectModel) else wanted
    if name is not None and name not in info.names:
        raise ToolkitError(
            f"{path}: was trained for {', '.join(map(repr, info.names))}, not {name!r}; "
            f"train a {info.kind} for {name!r}"
        )
    if isinstance(wanted, ObjectModel) and info.kind != "detector":
        _check_object(path, info, wanted)
    return info


def _check_object(path: Path, info: CheckpointInfo, wanted: ObjectModel) -> None:
    """Raises ToolkitError: the network was trained for another object of that name."""
    advice = "give the mesh and the material file it was trained with, or train again"
    trained, given = 1000 * info.diameter_m, 1000 * wanted.diameter
    if abs(trained - given) > SAME_SIZE * given:
        raise ToolkitError(
            f"{path}: was trained for a {wanted.name!r} of {trained:.1f} mm, and this one has {given:.1f} mm;"
            f" {advice}"
        )
    trained, given = info.refractive_index, wanted.refractive_index
    if abs(trained - given) > SAME_INDEX:
        raise ToolkitError(
            f"{path}: was trained for a {wanted.name!r} of refractive index {trained:g}, and this one has "
            f"{given:g}; {advice}"
        )
    symmetry = Symmetry.from_json(info.symmetry) if info.symmetry else wanted.symmetry
    if not (symmetry.covers(wanted.symmetry) and wanted.symmetry.covers(symmetry)):
        raise ToolkitError(
            f"{path}: was trained for a {wanted.name!r} of another symmetry than this one has; {advice}"
        )


def _info(text: str, description: Path) -> CheckpointInfo:
    try:
        values: dict[str, Any] = json.loads(text)
        known = isinstance(values, dict) and values.pop("format", None) == FORMAT
    except ValueError as error:
        raise ToolkitError(f"{description}: not JSON ({error}); train again or restore the file") from error
    if not known:
        raise ToolkitError(f"{description}: not a checkpoint this version reads ({FORMAT}); train again")
    config = values.get("config")
    if isinstance(config, str):
        values["config"] = typed_toml.loads(ExperimentConfig, config, source=str(description))
    values = {name: value for name, value in values.items() if value is not None}
    return typed_toml.from_table(CheckpointInfo, values, str(description))


def _described(path: Path) -> str | None:
    """What the weights' own metadata says they are. Raises ToolkitError: damaged weights."""
    try:
        with safe_open(path, "pt") as file:
            return (file.metadata() or {}).get(_DESCRIPTION)
    except (OSError, SafetensorError) as error:
        raise ToolkitError(f"{path}: damaged ({error}); restore the file, or train again") from error


def load_weights(network: Network, path: Path) -> Network:
    """Fills `network` with the weights at `path`, puts it in evaluation mode, and returns it.

    Raises ToolkitError: the weights are damaged, or do not fit the network.
    """
    try:
        network.load_state_dict(load_file(path))
    except (OSError, SafetensorError) as error:
        raise ToolkitError(f"{path}: damaged ({error}); restore the file, or train again") from error
    except RuntimeError as error:
        reason = str(error).splitlines()[-1].strip()
        raise ToolkitError(f"{path}: does not fit this network ({reason}); train again") from error
    return network.eval()
