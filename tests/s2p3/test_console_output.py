"""How far work is, told to a log file: there a bar would be nothing until its end."""

from __future__ import annotations

import pytest

from s2p3 import console_output


def test_a_log_file_gets_a_line_now_and_then(
    capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = iter(range(0, 1000, 25))
    monkeypatch.setattr(console_output.time, "monotonic", lambda: float(next(clock)))
    with console_output.progress_bars() as report:
        for step in range(1, 7):
            report("teacher", step, 6, {"total": 1 / step})
        report("teacher", 6, 6, {"total": 1 / 6})
        report("detection", 1, 1, {})
    lines = capfd.readouterr().err.splitlines()
    assert lines == ["teacher 4/6 loss 0.250", "teacher 6/6 loss 0.167", "detection 1/1"]
