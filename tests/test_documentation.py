"""The commands that the documentation shows are understood by the command line; its links lead somewhere."""

from __future__ import annotations

import functools
import re
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from s2p3 import cli

ROOT = Path(__file__).parents[1]
PAGES = (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")))


def commands(text: str) -> Iterator[list[str]]:
    """The words after `s2p3` of every line of a fenced block that runs it."""
    for block in re.findall(r"^```bash\n(.*?)^```", text, re.MULTILINE | re.DOTALL):
        for line in block.replace("\\\n", " ").splitlines():
            words = shlex.split(line, comments=True)
            if words and Path(words[0]).name == "s2p3":
                yield words[1:]


SHOWN = [(page.name, words) for page in PAGES for words in commands(page.read_text(encoding="utf-8"))]


def parsed_only(verb: cli.Verb, done: list[str]) -> cli.Verb:
    """A verb with the same arguments that only says that they were understood."""

    @functools.wraps(verb)
    def understood(*_: Any, **__: Any) -> None:
        done.append(verb.__name__)

    return understood


@pytest.mark.parametrize(
    ("page", "words"), SHOWN, ids=[" ".join([page, *words[:3]]) for page, words in SHOWN]
)
def test_a_shown_command_is_understood(page: str, words: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    done: list[str] = []
    for name, verb in cli.VERBS.items():
        if isinstance(verb, cli.Group):
            understood: Any = cli.Group(
                verb.purpose, {n: parsed_only(v, done) for n, v in verb.verbs.items()}
            )
        else:
            understood = parsed_only(verb, done)
        monkeypatch.setitem(cli.VERBS, name, understood)
    assert cli.main(words) == 0
    assert len(done) == 1


def test_every_verb_is_shown_somewhere() -> None:
    shown = {words[0] for _, words in SHOWN}
    assert shown == set(cli.VERBS)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_to_files_lead_somewhere(page: Path) -> None:
    targets = re.findall(r"\]\((?!https?:|#)([^)#]+)(?:#[^)]*)?\)", page.read_text(encoding="utf-8"))
    missing = [target for target in targets if not (page.parent / target).exists()]
    assert missing == []
