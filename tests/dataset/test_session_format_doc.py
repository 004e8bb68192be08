"""The page about the session file says what the schema declares."""

from __future__ import annotations

import importlib.util
from pathlib import Path

from dataset.schema import ATTRIBUTES, DATASETS

ROOT = Path(__file__).parents[2]


def generated_page() -> str:
    """What tools/session_format.py makes; tools are scripts, so it is loaded by path."""
    path = ROOT / "tools" / "session_format.py"
    specification = importlib.util.spec_from_file_location("session_format", path)
    assert specification is not None
    assert specification.loader is not None
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    page: str = module.page()
    return page


def test_the_committed_page_is_the_generated_one() -> None:
    committed = (ROOT / "docs" / "session-format.md").read_text(encoding="utf-8")
    assert committed == generated_page(), "run: python tools/session_format.py"


def test_every_declared_name_is_on_the_page() -> None:
    page = generated_page()
    missing = [dataset.path for dataset in DATASETS if f"`{dataset.path}`" not in page]
    missing += [attribute.name for attribute in ATTRIBUTES if f"`{attribute.name}`" not in page]
    assert missing == []
