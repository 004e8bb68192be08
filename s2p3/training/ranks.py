"""Which of the processes that train together this one is, whether they have met yet or not."""

from __future__ import annotations

import os

import torch.distributed as dist


def is_first() -> bool:
    """Whether this is the process that writes files and speaks; one that is alone is."""
    if have_met():
        return dist.get_rank() == 0
    alone = int(os.environ.get("WORLD_SIZE", "1")) == 1
    return alone or int(os.environ.get("RANK", "0")) == 0


def have_met() -> bool:
    """Whether there are several, and they can wait for each other."""
    return dist.is_available() and dist.is_initialized()
