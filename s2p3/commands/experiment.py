"""The experiment on the command line: a preset or a file, any field of which an option overrides.

Every training verb has a parameter `experiment`, the parts of the experiment it depends on. Its options are
made from the fields of these dataclasses, `--config.teacher.steps` and the like; their defaults are those of
the preset, file or checkpoint that the other words of the command name.
"""

from __future__ import annotations

import argparse
import functools
import inspect
import json
import typing
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import tyro

from acquisition import typed_toml
from dataset.errors import ToolkitError
from s2p3.config import (
    AugmentationConfig,
    DetectorConfig,
    ExperimentConfig,
    InputConfig,
    NetworkConfig,
    PretrainConfig,
    Self6DConfig,
    SelfSupervisionConfig,
    load,
)
from s2p3.presets import PRESETS

Preset = Literal["fast", "paper", "quick"]
OptionalPreset = Annotated[
    Preset | None, tyro.conf.arg(metavar="{fast,paper,quick}", help_behavior_hint="(optional)")
]
"""One that need not be given."""

_FAST = PRESETS["fast"]()


@dataclass(frozen=True)
class Part:
    """Some tables of an experiment."""

    def within(self, base: ExperimentConfig) -> ExperimentConfig:
        """`base` with these tables instead of its own. Raises ToolkitError: values that do not fit."""
        return replace(base, **{field.name: getattr(self, field.name) for field in fields(self)})


@dataclass(frozen=True)
class DetectorPart(Part):
    detector: DetectorConfig = _FAST.detector


@dataclass(frozen=True)
class TeacherPart(Part):
    input: InputConfig = _FAST.input
    augmentation: AugmentationConfig = _FAST.augmentation
    network: NetworkConfig = _FAST.network
    teacher: PretrainConfig = _FAST.teacher


@dataclass(frozen=True)
class StudentPart(Part):
    input: InputConfig = _FAST.input
    augmentation: AugmentationConfig = _FAST.augmentation
    network: NetworkConfig = _FAST.network
    student: PretrainConfig = _FAST.student


@dataclass(frozen=True)
class SupervisedPart(StudentPart):
    teacher: PretrainConfig = _FAST.teacher


@dataclass(frozen=True)
class SelfSupervisionPart(Part):
    self_supervision: SelfSupervisionConfig = _FAST.self_supervision
    self6d: Self6DConfig = _FAST.self6d


_UNDER_CONFIG: Any = tyro.conf.arg(name="config")
DetectorFields = Annotated[DetectorPart, _UNDER_CONFIG]
TeacherFields = Annotated[TeacherPart, _UNDER_CONFIG]
StudentFields = Annotated[StudentPart, _UNDER_CONFIG]
SupervisedFields = Annotated[SupervisedPart, _UNDER_CONFIG]
SelfSupervisionFields = Annotated[SelfSupervisionPart, _UNDER_CONFIG]


def experiment_of(preset: Preset = "fast", config: Path | None = None) -> ExperimentConfig:
    """The preset, with the fields of the file where one is given. Raises ToolkitError as `config.load`."""
    base = PRESETS[preset]()
    return base if config is None else load(config, base)


Verb = TypeVar("Verb", bound=Callable[..., Any])


def with_defaults(verb: Verb, words: Sequence[str]) -> Verb:
    """A verb whose `experiment` has the values of the preset, file or checkpoint named in the words after it;
    other verbs as they are."""
    parameter = inspect.signature(verb).parameters.get("experiment")
    if parameter is None:
        return verb
    base, part = named_in(words), type(parameter.default)
    values = {field.name: getattr(base, field.name) for field in fields(part)}
    return typing.cast(Verb, functools.partial(verb, experiment=part(**values)))


def named_in(words: Sequence[str]) -> ExperimentConfig:
    """The experiment that --preset or --student names, with the fields of --config; where they are wrong, the
    verb says so."""
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
    for name in ("--preset", "--config", "--student"):
        parser.add_argument(name, nargs="?")
    found, _ = parser.parse_known_args(list(words))
    try:
        if found.preset is not None or found.student is None:
            base = PRESETS[found.preset or "fast"]()
        else:
            base = _of_checkpoint(Path(found.student))
        return base if found.config is None else load(found.config, base)
    except (ToolkitError, OSError, ValueError, KeyError, TypeError):
        return _FAST


def _of_checkpoint(path: Path) -> ExperimentConfig:
    """What a network was trained with; read without torch."""
    text = json.loads(path.with_suffix(".json").read_text(encoding="utf-8"))["config"]
    return typed_toml.loads(ExperimentConfig, text, source=str(path))
