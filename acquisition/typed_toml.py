"""Typed TOML: a file of tables read into a tree of frozen dataclasses, every mistake named where it stands.

A table is a dataclass, a key is a field. Field types: `bool`, `int`, `float`, `str`, `Literal[...]`, fixed
and variable-length tuples of these, another dataclass (a table), a `dict` of texts, and any of them `| None`
(absent: `None`).
A dataclass refuses values out of range by raising `ToolkitError` in `__post_init__`; the reader adds file and
table (once: a message may already begin with its table, as ``[motor]`` or ``motor:``).
"""

from __future__ import annotations

import dataclasses
import difflib
import json
import math
import sys
import types
import typing
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, TypeVar

from dataset.errors import ToolkitError

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

T = TypeVar("T")


def load(cls: type[T], path: str | Path, hint: str = "check the path", base: T | None = None) -> T:
    """Reads the dataclass tree `cls` from the TOML file at `path`.

    Args:
        hint: what to do where the file cannot be read.
        base: fields left out keep its values; without it, those that `cls` defaults to.

    Raises ToolkitError: the file is missing or unreadable, is not TOML (with the line), or does not fit `cls`
    (see `loads`).
    """
    try:
        text = Path(path).read_text(encoding="utf-8")
    except FileNotFoundError as error:
        raise ToolkitError(f"{path}: no such file; {hint}") from error
    except UnicodeDecodeError as error:
        raise ToolkitError(f"{path}: not a text file in UTF-8; {hint}") from error
    except OSError as error:
        raise ToolkitError(f"{path}: cannot be read ({error.strerror}); {hint}") from error
    return loads(cls, text, str(path), base)


def loads(cls: type[T], text: str, source: str = "TOML text", base: T | None = None) -> T:
    """Reads the dataclass tree `cls` from TOML `text`; `source` names it in messages. `base`: see `load`.

    Raises ToolkitError: syntax (with the line), an unknown table or field (with the nearest valid name), a
    missing field, a wrong type, a value out of range.
    """
    try:
        table = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        last = f"line {text.count(chr(10)) + 1}, the end of the file"
        what = str(error).replace("end of document", last)
        raise ToolkitError(f"{source}: TOML syntax: {what}; correct that line") from error
    return from_table(cls, table, source, base)


def from_table(cls: type[T], table: Mapping[str, Any], source: str, base: T | None = None) -> T:
    """Reads the dataclass tree `cls` from nested mappings, such as a parsed file, parts of which may be
    dataclasses already; see `loads`."""
    value: T = _dataclass(cls, table, source, "", base)
    return value


def dumps(tree: Any) -> str:
    """The dataclass instance `tree` as TOML text that `loads` reads back equal; None is left out."""
    return "\n".join(_lines(tree, prefix="")).strip() + "\n"


def nearest(name: str, valid: Iterable[str]) -> str | None:
    """The valid name closest to `name`, or None where there is nothing to choose from."""
    matches = difflib.get_close_matches(name, list(valid), n=1, cutoff=0.0)
    return matches[0] if matches else None


def _dataclass(cls: Any, table: Mapping[str, Any], source: str, prefix: str, base: Any) -> Any:
    where = f"{source}: [{prefix}]" if prefix else source
    kind = "field" if prefix else "table"
    fields = {field.name: field for field in dataclasses.fields(cls) if field.init}
    hints = typing.get_type_hints(cls)
    for key in table:
        if key not in fields:
            raise ToolkitError(
                f"{where} has an unknown {kind} {key!r}; did you mean {nearest(key, fields)!r}? "
                f"Valid here: {', '.join(fields)}"
            )
    values = {}
    for name, field in fields.items():
        if name in table:
            key = f"{prefix}.{name}" if prefix else name
            values[name] = _value(table[name], hints[name], source, key, getattr(base, name, None))
        elif base is not None:
            values[name] = getattr(base, name)
        elif field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING:
            raise ToolkitError(f"{where} lacks the {kind} {name!r}; add it")
    try:
        return cls(**values)
    except ToolkitError as error:
        what = str(error).removeprefix(f"[{prefix}]").removeprefix(f"{prefix}:").strip()
        raise ToolkitError(f"{where} {what}") from error


def _value(value: Any, annotation: Any, source: str, key: str, base: Any = None) -> Any:
    """`value` as the annotated type; `key` is its dotted name, `base` has what a table leaves out."""
    if isinstance(annotation, type) and dataclasses.is_dataclass(annotation):
        if isinstance(value, annotation):
            return value
        if not isinstance(value, Mapping):
            raise ToolkitError(f"{source}: {key} must be a table; write it as [{key}]")
        return _dataclass(annotation, value, source, key, base)
    origin, arguments = typing.get_origin(annotation), typing.get_args(annotation)
    if origin in (typing.Union, types.UnionType):
        (inner,) = (argument for argument in arguments if argument is not type(None))
        return _value(value, inner, source, key, base)
    if origin is typing.Literal:
        if value not in arguments:
            guess = f"; did you mean {nearest(value, arguments)!r}?" if isinstance(value, str) else ""
            choices = ", ".join(map(repr, arguments))
            raise ToolkitError(f"{source}: {key} must be one of {choices}, not {value!r}{guess}")
        return value
    if origin is tuple:
        return _tuple(value, arguments, source, key)
    if origin is dict:
        if not isinstance(value, Mapping):
            raise ToolkitError(f"{source}: {key} must be a table; write it as [{key}]")
        return {name: _value(item, arguments[1], source, f"{key}.{name}") for name, item in value.items()}
    if annotation is float:
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
            raise ToolkitError(f"{source}: {key} must be a finite number, not {value!r}")
        return float(value)
    if type(value) is not annotation:
        names = {bool: "true or false", int: "a whole number", str: "a text in quotes"}
        raise ToolkitError(f"{source}: {key} must be {names[annotation]}, not {value!r}")
    return value


def _tuple(value: Any, arguments: tuple[Any, ...], source: str, key: str) -> tuple[Any, ...]:
    if not isinstance(value, list):
        raise ToolkitError(f"{source}: {key} must be a list in square brackets, not {value!r}")
    if arguments[-1] is Ellipsis:
        arguments = (arguments[0],) * len(value)
    elif len(value) != len(arguments):
        raise ToolkitError(f"{source}: {key} must have {len(arguments)} entries, not {len(value)}")
    return tuple(
        _value(item, annotation, source, f"{key}[{i}]")
        for i, (item, annotation) in enumerate(zip(value, arguments, strict=True))
    )


def _lines(tree: Any, prefix: str) -> list[str]:
    """The lines of one table: its plain values first, as TOML demands, then the tables inside it."""
    values = {field.name: getattr(tree, field.name) for field in dataclasses.fields(tree) if field.init}
    tables = {name: value for name, value in values.items() if dataclasses.is_dataclass(value)}
    lines = [
        f"{name} = {_literal(value)}"
        for name, value in values.items()
        if name not in tables and value is not None
    ]
    for name, table in tables.items():
        key = f"{prefix}.{name}" if prefix else name
        lines += ["", f"[{key}]", *_lines(table, key)]
    return lines


def _literal(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, (tuple, list)):
        return "[" + ", ".join(map(_literal, value)) + "]"
    return repr(float(value)) if isinstance(value, float) else str(value)  # a numpy float's repr is not TOML
