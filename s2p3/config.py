"""What an experiment is: one tree of frozen dataclasses, read from and written to experiment.toml.

The defaults are those of the preset `fast`, see `s2p3.presets`. A table raises ToolkitError where a number is
out of range, whether it comes from a file, an option or code.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

from acquisition import typed_toml
from dataset.errors import ToolkitError
from s2p3.ranges import BELOW_ONE, COUNT, NOT_NEGATIVE, ODD, POSITIVE, SHARE, at_least, between, check

Schedule = Literal["cosine", "halving", "flat"]
PhysicsVariant = Literal["dolp", "stokes", "aolp", "dolp-gain", "none"]
Switch = tyro.conf.FlagConversionOff[bool]
"""On the command line `--name True` or `--name False`, so that the help of both reads right."""


@dataclass(frozen=True)
class InputConfig:
    """What the networks see of a frame."""

    modality: Literal["polarization", "rgb", "rgbd"] = "polarization"
    """`polarization`: intensities, DoLP, AoLP and the priors (the paper). Baselines: `rgb` sees intensities
    without a polarizer, `rgbd` the depth image, too. Colours are averaged, as everywhere here."""
    size: int = 64
    """Side of the square network input, pixels."""
    zoom: float = 1.4
    """Side of the square region cropped, in units of the longer side of the detected box."""
    canonical_size: int = 96
    """Side of the crops kept in memory, from which the network inputs are resampled, pixels."""
    canonical_zoom: float = 1.9
    """Region those crops cover, in units of the box: leaves room for zoom, shift and rotation."""
    aolp: Literal["double_angle", "angle"] = "double_angle"
    """Angle of polarization as sqrt(DoLP) (cos 2phi, sin 2phi) (our choice), or as the wrapped angle
    (PPP-Net)."""
    background: Literal["keep", "mask"] = "keep"
    """Whether polarization and prior channels outside the predicted mask are zeroed (`mask`: the paper)."""

    def __post_init__(self) -> None:
        check(
            self,
            zoom=POSITIVE,
            canonical_size=at_least(32),  # half the smallest input: less would be enlarged beyond use
            canonical_zoom=at_least(self.zoom, "zoom"),
        )


@dataclass(frozen=True)
class AugmentationConfig:
    """Augmentation of a crop, in Stokes space, so that the result obeys Malus' law (our choice
    throughout)."""

    zoom_min: float = 1.2
    """Smallest region cropped, in units of the box."""
    zoom_max: float = 1.6
    """Largest region cropped, in units of the box."""
    shift: float = 0.12
    """Largest shift of the region along x and y, in units of the box."""
    rotation_deg: float = 30.0
    """Largest in-plane rotation."""
    noise: float = 0.008
    """Standard deviation of the added noise at unit intensity; it grows with the root of the intensity."""
    gain: float = 0.3
    """Largest relative change of the exposure."""
    dolp: float = 0.1
    """Largest relative change of the degree of polarization."""
    blur: float = 0.5
    """Probability of a 3x3 blur."""

    def __post_init__(self) -> None:
        check(
            self,
            zoom_min=POSITIVE,
            zoom_max=at_least(self.zoom_min, "zoom_min"),
            shift=NOT_NEGATIVE,
            rotation_deg=between(0, 180),
            noise=NOT_NEGATIVE,
            gain=BELOW_ONE,
            dolp=SHARE,
            blur=SHARE,
        )


@dataclass(frozen=True)
class NetworkConfig:
    """Sizes of teacher and student."""

    total_stride: Literal[16, 32] = 16
    """Stride of the encoders: 32 as published; 16 keeps the layout of small inputs (our choice)."""
    decoder_channels: int = 64
    """Width of the teacher's decoder."""
    student: Literal["direct", "large"] = "direct"
    """`direct`: pose head on the encoders' features (the paper's student); `large`: the teacher's network, of
    the paper's ablation."""
    head_channels: int = 96
    """Width of the student's pose head."""
    head_hidden: int = 96
    """Hidden units of the student's pose head."""
    imagenet: Switch = True
    """Whether encoders start from ImageNet weights (the paper)."""

    def __post_init__(self) -> None:
        check(self, decoder_channels=at_least(2), head_channels=COUNT, head_hidden=COUNT)


@dataclass(frozen=True)
class StageConfig:
    """How any stage optimizes."""

    steps: int = 1150
    """Optimizer steps; with `epochs`, ignored."""
    epochs: int = 0
    """Passes through the data; 0: use `steps`."""
    batch: int = 16
    """Images a step, shared out among the processes where there are several."""
    learning_rate: float = 1e-3
    """The peak of the schedule."""
    schedule: Schedule = "cosine"
    """`cosine` with 8 % warm-up (our choice), `halving` at every quarter (the paper: every 25 of 100 epochs),
    or `flat` for 72 % and then a cosine (Self6D++)."""
    weight_decay: float = 1e-2
    """Of AdamW; 0 is Adam (the paper)."""
    clip_norm: float = 5.0
    """Gradients longer than this are scaled down to it (our choice)."""
    ema: float = 0.98
    """Decay of the averaged weights, which are the ones kept; 0 keeps the trained weights themselves."""
    seed: int = 0
    """Of the first weights, the order of the data and the augmentation."""
    checkpoint_every: int = 200
    """Steps between two states from which an interrupted training goes on."""

    def __post_init__(self) -> None:
        check(
            self,
            steps=NOT_NEGATIVE,
            epochs=NOT_NEGATIVE,
            batch=COUNT,
            learning_rate=NOT_NEGATIVE,
            weight_decay=NOT_NEGATIVE,
            clip_norm=POSITIVE,
            ema=BELOW_ONE,
            checkpoint_every=COUNT,
        )

    def steps_over(self, samples: int) -> int:
        """Optimizer steps: `steps`, or those of `epochs` passes through `samples` where that is given."""
        return max(1, self.epochs * samples // self.batch) if self.epochs else self.steps


@dataclass(frozen=True)
class SupervisedConfig(StageConfig):
    """A stage that knows the truth, and so can tell which of its weights are the best."""

    validations: int = 10
    """How often, at equal distances, the averaged weights are scored on frames kept from the training; the
    best are the ones saved. 0: never, the last are saved."""
    holdout: float = 0.1
    """Share of the frames kept for that, where no others are named."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check(self, validations=NOT_NEGATIVE, holdout=BELOW_ONE)


@dataclass(frozen=True)
class PretrainConfig(SupervisedConfig):
    """Supervised training on synthetic sessions."""

    dense_weight: float = 1.0
    """Weight of the dense losses (mask, coordinates, normals) of a network with a decoder, the teacher or the
    large student, our choice; 0: pose supervision only."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check(self, dense_weight=NOT_NEGATIVE)


@dataclass(frozen=True)
class DetectorConfig(SupervisedConfig):
    """The detector: mask and box on a small polarization image (our choice throughout)."""

    steps: int = 300
    batch: int = 8
    learning_rate: float = 2e-3
    ema: float = 0.97
    checkpoint_every: int = 100
    level: int = 4
    """Down-sampling of the polarization image the detector sees, 1 to 32."""
    threshold: float = 0.5
    """Mask probability above which a pixel belongs to the object."""
    minimum_score: float = 0.5
    """Mean mask probability below which nothing is reported; it can only matter above `threshold`."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check(self, level=between(1, 32), threshold=SHARE, minimum_score=SHARE)


@dataclass(frozen=True)
class SelfSupervisionConfig(StageConfig):
    """Self-supervised training of the student on captured frames without poses."""

    steps: int = 400
    learning_rate: float = 3e-4
    weight_decay: float = 0.0
    clip_norm: float = 2.0
    checkpoint_every: int = 150
    pose_weight: float = 0.3
    """Weight of L_pose, in diameters."""
    mask_weight: float = 20.0
    """Weight of L_mask."""
    normals_weight: float = 2.0
    """Weight of L_normals."""
    physics_weight: float = 2.0
    """Weight of L_physics."""
    physics: PhysicsVariant = "dolp"
    """`dolp` (the paper's L_physics), `none`, or one of our extensions: `stokes` (DoLP and AoLP), `aolp`,
    `dolp-gain` (DoLP, specular reflection diluted by a factor fitted to each image)."""
    depth: Literal["none", "chamfer", "pixel"] = "none"
    """A loss on measured depth: the paper's ablation, where it replaces the physics; needs recorded depth."""
    depth_weight: float = 1.0
    """Weight of the loss on depth, in diameters."""
    smoothing: int = 3
    """Side of the box over which Stokes values are averaged before L_physics: less noise bias; 1 for thin
    objects."""
    threshold: float = 0.0
    """The paper's r: teacher maps are taken as rendered where delta <= r, as predicted elsewhere; 0:
    `threshold_quantile`."""
    threshold_quantile: float = 0.08
    """Sets r to this quantile of delta over the training frames (our choice: the paper does not state r)."""
    teacher: Literal["frozen", "ema"] = "frozen"
    """`frozen` (the paper), or `ema`: the teacher's weights follow the student's, which must be `large`."""
    teacher_decay: float = 0.999
    """Of the moving average that an `ema` teacher is, by step."""
    adapt_batches: int = 25
    """Batches of captured frames on which BatchNorm statistics are re-estimated first (AdaBN); 0: not at
    all."""
    adapt_teacher: Switch = True
    """Whether the teacher's BatchNorm statistics are re-estimated too."""
    freeze_norms: Switch = False
    """Whether the student's BatchNorm statistics stay as pre-trained while it learns: they also encode how
    large the object appears in its box, a cue to its distance."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check(
            self,
            pose_weight=NOT_NEGATIVE,
            mask_weight=NOT_NEGATIVE,
            normals_weight=NOT_NEGATIVE,
            physics_weight=NOT_NEGATIVE,
            depth_weight=NOT_NEGATIVE,
            smoothing=ODD,
            threshold=SHARE,
            threshold_quantile=SHARE,
            teacher_decay=BELOW_ONE,
            adapt_batches=NOT_NEGATIVE,
        )


@dataclass(frozen=True)
class Self6DConfig(StageConfig):
    """The RGB-D baseline: self-supervision after Self6D++, with its published weights."""

    steps: int = 400
    learning_rate: float = 3e-4
    weight_decay: float = 0.0
    clip_norm: float = 1.0
    checkpoint_every: int = 150
    schedule: Schedule = "flat"
    pose_weight: float = 10.0
    """Weight of the distance to the teacher's pose, in diameters."""
    mask_weight: float = 1.0
    """Weight of the mask's re-weighted cross entropy."""
    chamfer_weight: float = 100.0
    """Weight of the Chamfer distance to the measured depth."""
    chamfer_limit_m: float = 0.5
    """Points further from the other surface than this do not count."""
    colour_weight: float = 0.2
    """Weight of the distance in a and b of LAB, which is 0 for grey images."""
    structure_weight: float = 1.0
    """Weight of MS-SSIM."""
    perceptual_weight: float = 0.15
    """Weight of LPIPS."""
    lpips_weights: str = ""
    """File of LPIPS' weights, see `s2p3.networks.perceptual`; without one the term is left out."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check(
            self,
            pose_weight=NOT_NEGATIVE,
            mask_weight=NOT_NEGATIVE,
            chamfer_weight=NOT_NEGATIVE,
            chamfer_limit_m=POSITIVE,
            colour_weight=NOT_NEGATIVE,
            structure_weight=NOT_NEGATIVE,
            perceptual_weight=NOT_NEGATIVE,
        )


_OptionalName = Annotated[
    str | None,
    tyro.conf.arg(
        metavar="NAME",
        help_behavior_hint=lambda value: "(optional)" if value == "None" else f"(default: {value})",
    ),
]


@dataclass(frozen=True)
class FrameSource:
    """Which frames a supervised training sees, and how they reach it."""

    split: _OptionalName = None
    """Train on this split of the sessions only."""
    validation: _OptionalName = None
    """What the weights to keep are chosen on: a session, or a split, which is then not trained on; by
    default a tenth of the frames (holdout)."""
    storage: Literal["memory", "disk"] = "memory"
    """Whether crops are kept in memory, or made anew from the disk where they do not fit."""
    workers: int = 0
    """Processes that augment, a thread each; 0: the training does it itself."""


@dataclass(frozen=True)
class ExperimentConfig:
    """Everything that decides what a training does, besides its data."""

    input: InputConfig = field(default_factory=InputConfig)
    augmentation: AugmentationConfig = field(default_factory=AugmentationConfig)
    network: NetworkConfig = field(default_factory=NetworkConfig)
    detector: DetectorConfig = field(default_factory=DetectorConfig)
    teacher: PretrainConfig = field(default_factory=PretrainConfig)
    student: PretrainConfig = field(default_factory=PretrainConfig)
    self_supervision: SelfSupervisionConfig = field(default_factory=SelfSupervisionConfig)
    self6d: Self6DConfig = field(default_factory=Self6DConfig)

    def __post_init__(self) -> None:
        sizes = [size for size in (64, 128, 256) if size // self.network.total_stride in (4, 8)]
        if self.input.size not in sizes:
            raise ToolkitError(
                f"input.size {self.input.size} does not fit network.total_stride "
                f"{self.network.total_stride}; "
                f"use {' or '.join(map(str, sizes))}"
            )
        smallest = math.ceil(self.input.size * self.input.canonical_zoom / self.input.zoom)
        if self.input.canonical_size < smallest:
            raise ToolkitError(
                f"input.size {self.input.size} would be enlarged from fewer pixels: input.canonical_size "
                f"{self.input.canonical_size} covers {self.input.canonical_zoom:g} boxes, the input "
                f"{self.input.zoom:g}; set input.canonical_size to {smallest} or more"
            )
        if self.augmentation.zoom_max > self.input.canonical_zoom:
            raise ToolkitError(
                "augmentation.zoom_max exceeds input.canonical_zoom; enlarge input.canonical_zoom"
            )


def load(path: str | Path, base: ExperimentConfig | None = None) -> ExperimentConfig:
    """Reads experiment.toml; fields left out keep the values of `base`, or of `fast`.

    Raises ToolkitError: a missing file, an unknown field (with the nearest valid one), a wrong type, values
    that do not fit.
    """
    return typed_toml.load(ExperimentConfig, path, "check the path, or leave it out", base)


def save(config: ExperimentConfig, path: str | Path) -> None:
    """Writes `config` as TOML that `load` reads back equal."""
    Path(path).write_text(typed_toml.dumps(config), encoding="utf-8")
