"""The command line: `s2p3 VERB`. Nothing heavy is imported before a verb needs it."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from typing import Any

import tyro

from dataset.errors import ToolkitError
from s2p3.commands import calibrate, capture, demo, devices, learn, sessions

Verb = Callable[..., Any]

VERBS: dict[str, Verb | dict[str, Verb]] = {
    "demo": demo.demo,
    "doctor": devices.doctor,
    "simulate": devices.simulate,
    "capture": capture.capture,
    "calibrate": {
        "board": calibrate.board,
        "intrinsics": calibrate.intrinsics,
        "hand-eye": calibrate.hand_eye,
        "time-offset": calibrate.time_offset,
        "object": calibrate.object_pose,
    },
    "annotate": sessions.annotate,
    "dataset": {
        "info": sessions.info,
        "validate": sessions.validate,
        "repair": sessions.repair,
        "split": sessions.split,
    },
    "decode": sessions.decode,
    "synthesize": learn.synthesize,
    "train": {
        "detector": learn.train_detector,
        "teacher": learn.train_teacher,
        "student": learn.train_student,
        "self-supervised": learn.train_self_supervised,
    },
    "evaluate": learn.evaluate,
}

_DESCRIPTION = (
    "From a polarization camera and a robot arm to a trained 6-D object pose model, "
    "without annotating a single real image. "
    "Start with `s2p3 demo`."
)
_USER_MISTAKE = 2
_INTERRUPTED = 130


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs one verb.

    Returns:
        0, or 2 for a user's mistake (one line on stderr says what, where and what to do), or 130 after
        Ctrl-C.
    """
    words = list(sys.argv[1:] if arguments is None else arguments)
    try:
        _dispatch(words)
    except ToolkitError as error:
        print(f"s2p3: {error}", file=sys.stderr)
        return _USER_MISTAKE
    except KeyboardInterrupt:
        print("s2p3: interrupted; what was recorded or trained so far is on disk", file=sys.stderr)
        return _INTERRUPTED
    except BrokenPipeError:
        return 0
    return 0


def _dispatch(words: list[str]) -> None:
    group = VERBS.get(words[0]) if words else None
    if isinstance(group, dict):
        _run(group, f"s2p3 {words[0]}", _summary(words[0], group), words[1:])
    else:
        verbs = {name: _as_verb(name, verb) for name, verb in VERBS.items()}
        _run(verbs, "s2p3", _DESCRIPTION, words)


def _run(verbs: dict[str, Verb], prog: str, description: str, words: list[str]) -> None:
    tyro.extras.subcommand_cli_from_dict(
        verbs, prog=prog, description=description, args=words, config=(tyro.conf.FlagCreatePairsOff,)
    )


def _as_verb(name: str, verb: Verb | dict[str, Verb]) -> Verb:
    """A group appears in `s2p3 --help` as one line that names its verbs."""
    if not isinstance(verb, dict):
        return verb

    def group() -> None: ...

    group.__doc__ = _summary(name, verb)
    return group


def _summary(name: str, group: dict[str, Verb]) -> str:
    purpose = {
        "calibrate": "From recorded sessions to intrinsics, hand-eye, clock offset and object poses",
        "dataset": "Recorded sessions",
        "train": "Detector, teacher and student, and the self-supervised stage",
    }[name]
    return f"{purpose}: {', '.join(group)}."


if __name__ == "__main__":
    sys.exit(main())
