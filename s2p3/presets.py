"""Experiments to start from.

`paper` holds the values the S2P3 paper states (256x256 crops, Adam 1e-4 halved every 25 of 100 epochs, batch
8 and 4, all loss weights 1, masked inputs). `fast` is our choice: what reaches a usable model soonest on two
CPU cores. Values the paper does not state are our choice in both.
"""

from __future__ import annotations

import dataclasses

from s2p3.config import (
    ExperimentConfig,
    InputConfig,
    NetworkConfig,
    PretrainConfig,
    Self6DConfig,
    SelfSupervisionConfig,
)


def paper() -> ExperimentConfig:
    """The paper's stated values; the rest is our choice."""
    pretraining = PretrainConfig(
        epochs=100,
        batch=8,
        learning_rate=1e-4,
        schedule="halving",
        weight_decay=0.0,
        ema=0.0,
        validations=100,
        dense_weight=0.0,
    )
    return ExperimentConfig(
        input=InputConfig(size=256, canonical_size=348, background="mask"),
        network=NetworkConfig(total_stride=32),
        teacher=pretraining,
        student=pretraining,
        self_supervision=SelfSupervisionConfig(
            epochs=100,
            batch=4,
            learning_rate=1e-4,
            schedule="halving",
            ema=0.0,
            pose_weight=1.0,
            mask_weight=1.0,
            normals_weight=1.0,
            physics_weight=1.0,
            smoothing=1,
            adapt_batches=0,
            adapt_teacher=False,
        ),
        self6d=Self6DConfig(epochs=100, batch=6, learning_rate=1e-4, ema=0.0),
    )


def fast() -> ExperimentConfig:
    """Our choice for two CPU cores: 64x64 crops, about ten minutes a network."""
    return ExperimentConfig()


def quick() -> ExperimentConfig:
    """Our smoke-test choice: every stage runs, in seconds; the recall is poor."""
    base = fast()
    return dataclasses.replace(
        base,
        detector=dataclasses.replace(base.detector, steps=40),
        teacher=dataclasses.replace(base.teacher, steps=50),
        student=dataclasses.replace(base.student, steps=50),
        self_supervision=dataclasses.replace(base.self_supervision, steps=20, adapt_batches=5),
        self6d=dataclasses.replace(base.self6d, steps=20),
    )


PRESETS = {"paper": paper, "fast": fast, "quick": quick}
