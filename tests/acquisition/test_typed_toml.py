"""Typed TOML: what is written is read back; every mistake is named with its place and its remedy."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from acquisition import typed_toml
from dataset.errors import ToolkitError


@dataclass(frozen=True)
class Motor:
    name: str
    speed: float = 0.25
    steps: int = 10
    enabled: bool = True
    mode: Literal["free", "software"] = "free"
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    tags: tuple[str, ...] = ()
    limit: float | None = None

    def __post_init__(self) -> None:
        if self.speed <= 0:
            raise ToolkitError(f"speed must be positive, not {self.speed:g}")


@dataclass(frozen=True)
class Machine:
    motor: Motor
    title: str = "machine"
    spare: Motor = field(default_factory=lambda: Motor("spare"))


finite = st.floats(allow_nan=False, allow_infinity=False)
text = st.text(st.characters(exclude_categories=["Cs"]), max_size=20)
motors = st.builds(
    Motor,
    name=text,
    speed=finite.filter(lambda x: x > 0),
    steps=st.integers(-(2**62), 2**62),
    enabled=st.booleans(),
    mode=st.sampled_from(["free", "software"]),
    offset=st.tuples(finite, finite, finite),
    tags=st.lists(text, max_size=3).map(tuple),
    limit=st.none() | finite,
)


@given(st.builds(Machine, motor=motors, title=text, spare=motors))
def test_round_trip(machine: Machine) -> None:
    assert typed_toml.loads(Machine, typed_toml.dumps(machine)) == machine


def test_numpy_numbers_are_written_as_toml() -> None:
    motor = Motor("a", speed=np.float64(0.5), steps=int(np.int64(3)))
    assert typed_toml.loads(Motor, typed_toml.dumps(motor)) == motor


def test_defaults_fill_what_the_file_leaves_out() -> None:
    assert typed_toml.loads(Machine, "[motor]\nname = 'a'\nspeed = 1") == Machine(Motor("a", speed=1.0))


@pytest.mark.parametrize(
    ("toml", "parts"),
    [
        ("[motor]\nname = 'a'\nsped = 1", ["[motor]", "field 'sped'", "did you mean 'speed'"]),
        ("[moter]\nname = 'a'", ["table 'moter'", "did you mean 'motor'"]),
        ("[motor]\nspeed = 1", ["[motor]", "lacks the field 'name'"]),
        ("title = 'x'", ["lacks the table 'motor'"]),
        ("motor = 3", ["motor must be a table", "[motor]"]),
        ("[motor]\nname = 3", ["motor.name", "text in quotes", "3"]),
        ("[motor]\nname = 'a'\nspeed = 'fast'", ["motor.speed", "number", "'fast'"]),
        ("[motor]\nname = 'a'\nspeed = true", ["motor.speed", "number", "True"]),
        ("[motor]\nname = 'a'\nspeed = inf", ["motor.speed", "finite"]),
        ("[motor]\nname = 'a'\nspeed = -1", ["[motor]", "speed must be positive, not -1"]),
        ("[motor]\nname = 'a'\nsteps = 1.5", ["motor.steps", "whole number", "1.5"]),
        ("[motor]\nname = 'a'\nsteps = true", ["motor.steps", "whole number", "True"]),
        ("[motor]\nname = 'a'\nenabled = 1", ["motor.enabled", "true or false"]),
        ("[motor]\nname = 'a'\nmode = 'sofware'", ["motor.mode", "'free', 'software'", "mean 'software'"]),
        ("[motor]\nname = 'a'\nmode = 3", ["motor.mode", "'free', 'software'", "not 3"]),
        ("[motor]\nname = 'a'\noffset = [1, 2]", ["motor.offset", "3 entries, not 2"]),
        ("[motor]\nname = 'a'\noffset = [1, 2, 'x']", ["motor.offset[2]", "number", "'x'"]),
        ("[motor]\nname = 'a'\ntags = 'x'", ["motor.tags", "list"]),
        ("[motor]\nname = 'a'\nspeed =", ["line 3"]),
    ],
)
def test_mistakes_are_named(toml: str, parts: list[str]) -> None:
    with pytest.raises(ToolkitError) as caught:
        typed_toml.loads(Machine, toml, source="lab.toml")
    message = str(caught.value)
    assert message.startswith("lab.toml")
    assert "\n" not in message
    for part in parts:
        assert part in message


def test_missing_file_says_what_to_do(tmp_path: Path) -> None:
    with pytest.raises(ToolkitError, match=r"rig\.toml: no such file; copy the example"):
        typed_toml.load(Machine, tmp_path / "rig.toml", hint="copy the example")


def test_directory_and_binary_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ToolkitError, match="cannot be read"):
        typed_toml.load(Machine, tmp_path)
    (tmp_path / "bytes").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ToolkitError, match="not a text file"):
        typed_toml.load(Machine, tmp_path / "bytes")
