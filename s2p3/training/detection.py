"""Trains the detector on labelled sessions, at the down-sampled image the detector sees."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from dataset.errors import ToolkitError
from dataset.session import Session
from s2p3.config import ExperimentConfig
from s2p3.inputs import rotate_stokes
from s2p3.networks.detector import CELL, Detector, detector_input, downsample
from s2p3.networks.lite0 import channels_last
from s2p3.objects import ObjectModel
from s2p3.progress import Report, quiet
from s2p3.training import checkpoint
from s2p3.training.checkpoint import CheckpointInfo
from s2p3.training.crops import content_hashes, once
from s2p3.training.examples import MOST_HELD_OUT
from s2p3.training.loop import Forward, Losses, Run, Score, optimize

# Ranges of the augmentation, our choice: wide, because the captured domain is not known.
_SCALE = (0.75, 1.35)
_ROTATION_DEG = 20.0
_SHIFT = 0.15
_GAIN = 0.5
_DOLP = 0.3
_NOISE = 0.02
_SHADE = 0.5
_BACKGROUND_POLARIZATION = 0.15
_COARSE = 4  # side of the random fields of shade and background polarization, before they are smoothed


@dataclass(frozen=True)
class SmallFrames:
    """N whole images, down-sampled.

    Attributes:
        stokes: (N, 3, h, w) float16.
        masks: (N, classes, h, w) float16, 0 to 1; a session that lacks an object shows nothing of it.
    """

    stokes: Tensor
    masks: Tensor

    def __len__(self) -> int:
        return len(self.stokes)

    def take(self, rows: Tensor) -> SmallFrames:
        """Some of the images."""
        return SmallFrames(self.stokes[rows], self.masks[rows])


def small_frames(
    paths: Sequence[Path], names: Sequence[str], level: int, report: Report = quiet
) -> SmallFrames:
    """Every frame of `paths`, down-sampled by `level`, with a class for the visible mask of each object.

    Raises ToolkitError: no frames; a session that shows none of the objects, an object that is in none.
    """
    stokes, masks, found = [], [], set[str]()
    label = f"frames with {', '.join(names)}"
    for path in paths:
        with Session.open(path) as session:
            here = [name for name in names if session.contents.has(f"poses/objects/{name}")]
            # a session without any of them says itself what it lacks
            poses = {name: session.object_poses(name) for name in here or names[:1]}
            found |= set(here)
            for index in range(len(session)):
                image = torch.from_numpy(session.stokes(index).stack())
                mask = torch.zeros(len(names), *image.shape[1:])
                for name, one in poses.items():
                    mask[names.index(name)] = torch.from_numpy(one.mask(index))
                stokes.append(downsample(image[None], level)[0].half())
                masks.append(downsample(mask[None], level)[0].half())
                report(label, index + 1, len(session), {})
    if missing := [name for name in names if name not in found]:
        raise ToolkitError(f"no session shows {', '.join(missing)}; synthesize some that do, or leave it out")
    if not stokes:
        raise ToolkitError(f"{', '.join(map(str, paths))}: no frames; synthesize or record some first")
    return SmallFrames(torch.stack(stokes), torch.stack(masks))


def train_detector(
    sessions: Sequence[Path],
    models: ObjectModel | Sequence[ObjectModel],
    config: ExperimentConfig,
    out: Path,
    *,
    workers: int = 0,
    report: Report = quiet,
) -> Path:
    """Trains a detector of one object or several and writes `out`/detector.safetensors, which is returned.

    Args:
        sessions: with poses and masks of the objects, usually synthetic; each shows one of them at least.
        models: a class each, in this order.
        workers, report: see `loop.Run`.

    Raises ToolkitError: a session shows none of the objects; see also `loop.optimize`.
    """
    models = [models] if isinstance(models, ObjectModel) else list(models)
    names, settings = [model.name for model in models], config.detector
    if len(set(names)) < len(names):
        raise ToolkitError(f"{', '.join(names)}: an object is named twice; name each one once")
    path = checkpoint.to_write(out / "detector.safetensors")
    hashes = _hashes(sessions, models)
    frames = small_frames(sessions, names, settings.level, report)
    order = torch.randperm(len(frames), generator=torch.Generator().manual_seed(settings.seed))
    count = min(int(settings.holdout * len(frames)), MOST_HELD_OUT) if settings.validations else 0
    data, score = FrameData(frames, order[count:].sort().values), None
    if count:
        scorer = MaskScorer(frames.take(order[:count]))
        score = Score("mask_iou", scorer, settings.validations, f"{count} of {len(frames)} frames")
    torch.manual_seed(settings.seed)
    network = channels_last(Detector(frames.masks.shape[1], config.network.imagenet))
    run = Run("detector", path, f"{hashes} {names}", workers, report)
    trained = optimize(network, data, detector_objective, settings, run, score)
    info = CheckpointInfo.of(
        "detector", "pretrained", models[0], trained.step, config, hashes, trained.validation
    )
    checkpoint.save(path, trained.network.state_dict(), replace(info, classes=tuple(names)))
    return path


@dataclass(frozen=True)
class FrameData:
    """Augmented batches of whole images, see `loader.Data`: what the detector sees of them, and the masks."""

    frames: SmallFrames
    rows: Tensor

    def __len__(self) -> int:
        return len(self.rows)

    def __call__(self, rows: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        stokes, masks = augment_frames(self.frames, self.rows[rows], generator)
        return detector_input(stokes), masks


def detector_objective(forward: Forward, batch: tuple[Tensor, Tensor]) -> Losses:
    """The losses of one batch of `FrameData`."""
    images, masks = batch
    logits, distances = forward(images)
    return detector_losses(logits, distances, masks)


@dataclass(frozen=True)
class MaskScorer:
    """Mean intersection over union of predicted and true masks, percent, without augmentation."""

    frames: SmallFrames

    @torch.no_grad()
    def __call__(self, network: nn.Module) -> float:
        device, shares = next(network.parameters()).device, []
        for stokes, masks in zip(
            self.frames.stokes.split(8), self.frames.masks.float().split(8), strict=True
        ):
            logits, _ = network(detector_input(stokes.float()).to(device))
            fine = F.interpolate(logits.cpu(), scale_factor=float(CELL), mode="bilinear")
            found, true = fine[..., : masks.shape[2], : masks.shape[3]] > 0, masks > 0.5
            both, either = (found & true).sum((1, 2, 3)), (found | true).sum((1, 2, 3))
            shares.append(torch.where(either > 0, both / either.clamp_min(1), 1.0))  # nothing, and rightly so
        return 100 * float(torch.cat(shares).mean())


def load_detector(path: Path, object_name: str | None = None) -> tuple[Detector, CheckpointInfo]:
    """Reads a detector. Raises ToolkitError as `checkpoint.read_info` and `checkpoint.load_weights`."""
    info = checkpoint.read_info(path, "detector", object_name)
    network = checkpoint.load_weights(Detector(len(info.names), imagenet=False), path)
    return channels_last(network), info


def _hashes(sessions: Sequence[Path], models: Sequence[ObjectModel]) -> dict[str, str]:
    """The hashes of the sessions, see `content_hashes`, of all the objects that each shows."""
    hashes: dict[str, str] = {}
    for path in sessions:
        with Session.open(path) as session:
            here = [one for one in models if session.contents.has(f"poses/objects/{one.name}")]
            hashes[once(session, hashes)] = "".join(
                digest for model in here for digest in content_hashes([path], model).values()
            )
    return hashes


def detector_losses(logits: Tensor, distances: Tensor, masks: Tensor) -> Losses:
    """Binary cross entropy and soft Dice of the masks, and the L1 of the box distances, in box sides, over
    mask cells.

    Args:
        logits: (B, classes, h/2, w/2), distances: (B, 4, h/2, w/2), of a possibly padded image.
        masks: (B, classes, h, w); a cell's distances are to the box of the class that it shows.
    """
    height, width = logits.shape[2:]
    padded = F.pad(masks, (0, width * CELL - masks.shape[3], 0, height * CELL - masks.shape[2]))
    target = F.avg_pool2d(padded, CELL)
    entropy = F.binary_cross_entropy_with_logits(logits, target)
    probability = logits.sigmoid()
    overlap = 2 * (probability * target).sum((2, 3)) + 1
    dice = (1 - overlap / (probability.sum((2, 3)) + target.sum((2, 3)) + 1)).mean()
    inside, errors = (target > 0.5).float(), []
    for shown in padded.unbind(1):
        true_distances, side = box_distances(shown > 0.5, (height, width))
        errors.append((distances - true_distances).abs().mean(1) / side[:, None, None])
    box = (torch.stack(errors, dim=1) * inside).sum() / (inside.sum() + 1)
    return {"total": 4 * entropy + dice + 5 * box, "entropy": entropy, "dice": dice, "box": box}


def box_distances(mask: Tensor, cells: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """Distances (B, 4, *cells) from every cell's centre to the left, top, right and bottom of the mask's box,
    and the longer side of the box (B,), all in pixels of the mask (B, h, w); an empty mask gives a box of the
    whole image."""
    _, height, width = mask.shape
    columns, rows = mask.any(1), mask.any(2)
    empty = ~columns.any(1)
    columns, rows = columns | empty[:, None], rows | empty[:, None]
    left, right = columns.int().argmax(1), width - columns.flip(1).int().argmax(1)
    top, bottom = rows.int().argmax(1), height - rows.flip(1).int().argmax(1)
    y = (CELL * (torch.arange(cells[0]) + 0.5)).view(1, -1, 1).expand(len(mask), -1, cells[1])
    x = (CELL * (torch.arange(cells[1]) + 0.5)).view(1, 1, -1).expand(len(mask), cells[0], -1)
    edges = [edge.view(-1, 1, 1).float() for edge in (left, top, right, bottom)]
    distances = torch.stack([x - edges[0], y - edges[1], edges[2] - x, edges[3] - y], dim=1)
    return distances, torch.maximum(right - left, bottom - top).float().clamp_min(1)


def augment_frames(frames: SmallFrames, indices: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Random scale, rotation and shift of whole images, with shading, exposure, DoLP, noise, and a polarized
    background.

    Returns Stokes images (B, 3, h, w) and masks (B, classes, h, w).
    """
    batch = len(indices)

    def uniform(low: float, high: float, *shape: int) -> Tensor:
        return low + (high - low) * torch.rand(batch, *shape, generator=generator)

    stokes, masks = frames.stokes[indices].float(), frames.masks[indices].float()
    height, width = stokes.shape[2:]
    angle = uniform(-1, 1) * math.radians(_ROTATION_DEG)
    scale, shift = uniform(*_SCALE), uniform(-_SHIFT, _SHIFT, 2)
    cos, sin, aspect = angle.cos() / scale, angle.sin() / scale, width / height
    rows = [cos, sin / aspect, shift[:, 0], -sin * aspect, cos, shift[:, 1]]
    grid = F.affine_grid(torch.stack(rows, dim=1).view(-1, 2, 3), list(stokes.shape), align_corners=False)
    stokes = F.grid_sample(stokes, grid, padding_mode="reflection", align_corners=False)
    masks = F.grid_sample(masks, grid, padding_mode="zeros", align_corners=False)
    stokes = rotate_stokes(stokes, angle)

    def field(channels: int, amplitude: float) -> Tensor:
        coarse = uniform(-amplitude, amplitude, channels, _COARSE, _COARSE)
        return F.interpolate(coarse, (height, width), mode="bicubic", align_corners=False)

    background = (1 - masks.amax(1, keepdim=True)) * uniform(0, 1, 1, 1, 1)
    s0 = stokes[:, :1]
    polarized = stokes[:, 1:] * uniform(1 - _DOLP, 1 + _DOLP, 1, 1, 1)
    polarized = polarized + background * s0 * field(2, _BACKGROUND_POLARIZATION)
    stokes = torch.cat([s0, polarized], dim=1) * (field(1, _SHADE) * uniform(0, 1, 1, 1, 1)).exp()
    stokes = stokes * uniform(1 - _GAIN, 1 + _GAIN, 1, 1, 1)
    noise = torch.randn(stokes.shape, generator=generator) * s0.clamp_min(0).sqrt()
    return stokes + uniform(0, _NOISE, 1, 1, 1) * noise, masks
