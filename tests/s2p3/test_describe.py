"""`s2p3 train teacher --describe`: the published networks in numbers, counted and not typed in."""

from __future__ import annotations

import json

import pytest

from s2p3.cli import main


@pytest.mark.parametrize(("kind", "parameters", "gflop"), [("teacher", 5.5e6, 4.0), ("student", 5.0e6, 1.85)])
def test_a_network_is_described_without_data(
    kind: str, parameters: float, gflop: float, capfd: pytest.CaptureFixture[str]
) -> None:
    assert main(["train", kind, "--describe", "--json", "--preset", "paper"]) == 0
    found = json.loads(capfd.readouterr().out)
    assert set(found) == {"parameters", "gflop_256", "inputs", "outputs"}
    assert found["parameters"] == pytest.approx(parameters, rel=0.01)
    assert found["gflop_256"] == pytest.approx(gflop, rel=0.02)
    assert found["inputs"] == {"polarization": [1, 7, 256, 256], "priors": [1, 9, 256, 256]}
    assert found["outputs"]["pose"] == [1, 9]
    assert ("coordinates" in found["outputs"]) == (kind == "teacher")


def test_the_cost_at_256_does_not_depend_on_the_preset(capfd: pytest.CaptureFixture[str]) -> None:
    costs = []
    for preset in ("fast", "paper"):
        assert main(["train", "student", "--describe", "--json", "--preset", preset]) == 0
        costs.append(json.loads(capfd.readouterr().out)["gflop_256"])
    assert costs[0] == costs[1]


def test_a_training_without_object_and_folder_is_told_what_is_missing(
    capfd: pytest.CaptureFixture[str],
) -> None:
    assert main(["train", "teacher", "set.h5", "--object", "cup"]) == 2
    (line,) = capfd.readouterr().err.splitlines()
    assert "--out missing" in line
