"""Batches and objectives as trees: tensors inside dataclasses, tuples and dicts."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, TypeVar, cast

import torch
from torch import Tensor

Tree = TypeVar("Tree")


def map_tensors(tree: Tree, change: Callable[[Tensor], Tensor]) -> Tree:
    """The same tree with every tensor changed; what is neither tensor nor branch stays as it is."""
    result: Any = tree
    if isinstance(tree, Tensor):
        result = change(tree)
    elif dataclasses.is_dataclass(tree) and not isinstance(tree, type):
        parts = {field.name: getattr(tree, field.name) for field in dataclasses.fields(tree) if field.init}
        result = dataclasses.replace(
            tree, **{name: map_tensors(part, change) for name, part in parts.items()}
        )
    elif isinstance(tree, tuple):
        result = tuple(map_tensors(part, change) for part in tree)
    elif isinstance(tree, dict):
        result = {name: map_tensors(part, change) for name, part in tree.items()}
    return cast(Tree, result)


def named_tensors(tree: object, name: str) -> dict[str, Tensor]:
    """Every tensor of a tree by its path, which begins with `name`: batch.seen.priors."""
    if isinstance(tree, Tensor):
        return {name: tree}
    parts: dict[Any, Any] = {}
    if dataclasses.is_dataclass(tree):
        parts = {field.name: getattr(tree, field.name) for field in dataclasses.fields(tree)}
    elif isinstance(tree, (tuple, dict)):
        parts = tree if isinstance(tree, dict) else dict(enumerate(tree))
    found: dict[str, Tensor] = {}
    for part_name, part in parts.items():
        found |= named_tensors(part, f"{name}.{part_name}")
    return found


def to_device(tree: Tree, device: torch.device) -> Tree:
    """The tree with its tensors on `device`; the same tensors where they are there already."""
    return map_tensors(tree, lambda tensor: tensor.to(device, non_blocking=True))
