"""The command line: `s2p3 VERB`. Nothing heavy is imported before a verb needs it."""

from __future__ import annotations

import os
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, TextIO

import tyro

from dataset.errors import ToolkitError, ToolkitWarning
from s2p3.commands import (
    calibrate,
    capture,
    console,
    demo,
    devices,
    exchange,
    sessions,
    synthesize,
    train,
    trained_networks,
)
from s2p3.commands.experiment import with_defaults

Verb = Callable[..., Any]


@dataclass(frozen=True)
class Group:
    """Verbs that share a first word, and what they are for."""

    purpose: str
    verbs: dict[str, Verb]


VERBS: dict[str, Verb | Group] = {
    "demo": demo.demo,
    "doctor": devices.doctor,
    "simulate": devices.simulate,
    "capture": Group(
        "Record a session with the devices of a rig",
        {
            "intrinsics": capture.intrinsics,
            "hand-eye": capture.hand_eye,
            "board-motion": capture.board_motion,
            "tool-tip": capture.tool_tip,
            "touches": capture.touches,
            "polarizer": capture.polarizer,
            "sequence": capture.sequence,
        },
    ),
    "console": console.console,
    "calibrate": Group(
        "Calibrate from recorded sessions; each result is added to calibration.json",
        {
            "board": calibrate.board,
            "intrinsics": calibrate.intrinsics,
            "hand-eye": calibrate.hand_eye,
            "time-offset": calibrate.time_offset,
            "tool-tip": calibrate.tool_tip,
            "polarizer": calibrate.polarizer,
            "object": calibrate.object_pose,
        },
    ),
    "annotate": sessions.annotate,
    "dataset": Group(
        "Look into session files, check, repair, divide and join them, and exchange them with other formats",
        {
            "info": sessions.info,
            "validate": sessions.validate,
            "repair": sessions.repair,
            "split": sessions.split,
            "subset": exchange.subset,
            "merge": exchange.merge,
            "convert": exchange.convert,
            "export-bop": exchange.export_bop,
            "import": exchange.import_,
            "view": console.view,
        },
    ),
    "decode": sessions.decode,
    "synthesize": synthesize.synthesize,
    "train": Group(
        "Train the networks, on synthetic sessions first, then on captured ones",
        {
            "detector": train.train_detector,
            "teacher": train.train_teacher,
            "student": train.train_student,
            "supervised": train.train_supervised,
            "self-supervised": train.train_self_supervised,
        },
    ),
    "evaluate": trained_networks.evaluate,
    "predict": trained_networks.predict,
    "export": trained_networks.export,
}

_DESCRIPTION = (
    "From a polarization camera and a robot arm to a 6-D pose model, no real image annotated by hand.\n\n"
    "Start with: s2p3 demo. Every verb and every group of verbs answers --help."
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
        with _warnings_in_a_line():
            _dispatch(words)
        sys.stdout.flush()
    except ToolkitError as error:
        print(f"s2p3: {error}", file=sys.stderr)
        return _USER_MISTAKE
    except KeyboardInterrupt:
        print(
            "s2p3: interrupted; what was recorded is on disk, and a training goes on from its last state",
            file=sys.stderr,
        )
        return _INTERRUPTED
    except BrokenPipeError:
        # Who read our output has gone; the interpreter must not find that out again when it ends.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        print(f"s2p3: {where}{error.strerror or error}; check the path and who may write", file=sys.stderr)
        return _USER_MISTAKE
    return 0


@contextmanager
def _warnings_in_a_line() -> Iterator[None]:
    """The toolkit's warnings are told as its errors are; those of others as ever."""
    with warnings.catch_warnings():
        as_ever = warnings.showwarning

        def tell(
            message: Warning | str,
            category: type[Warning],
            filename: str,
            lineno: int,
            file: TextIO | None = None,
            line: str | None = None,
        ) -> None:
            if issubclass(category, ToolkitWarning):
                print(f"s2p3: warning: {message}", file=sys.stderr)
            else:
                as_ever(message, category, filename, lineno, file, line)

        warnings.showwarning = tell
        yield


def _dispatch(words: list[str]) -> None:
    group = VERBS.get(words[0]) if words else None
    if isinstance(group, Group):
        _run(group.verbs, f"s2p3 {words[0]}", f"{group.purpose}.", words[1:])
    else:
        _run({name: _as_verb(verb) for name, verb in VERBS.items()}, "s2p3", _DESCRIPTION, words)


def _run(verbs: dict[str, Verb], prog: str, description: str, words: list[str]) -> None:
    config = (tyro.conf.FlagCreatePairsOff, tyro.conf.PositionalMetavarFromFieldName)
    if words and words[0] in verbs:  # alone, so that a mistake is answered with this verb's options only
        verb = with_defaults(verbs[words[0]], words)
        tyro.cli(verb, prog=f"{prog} {words[0]}", args=words[1:], config=config)
    else:
        tyro.extras.subcommand_cli_from_dict(
            verbs, prog=prog, description=description, args=words, config=config
        )


def _as_verb(verb: Verb | Group) -> Verb:
    """A group appears in `s2p3 --help` as one entry that names its verbs."""
    if not isinstance(verb, Group):
        return verb

    def group() -> None: ...

    group.__doc__ = f"{verb.purpose}: {', '.join(verb.verbs)}."
    return group


if __name__ == "__main__":
    sys.exit(main())
