"""The house's plan: which room may import which, where a vendor's SDK may appear, what must stay light.

The rules are read off the syntax trees, so that an import inside a function counts as much as one at the top.
"""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]

ROOMS: dict[str, set[str]] = {
    "dataset": set(),
    "acquisition": {"dataset"},
    "calibration": {"dataset"},
    "s2p3": {"dataset", "acquisition", "calibration"},
}
"""Each room and the other rooms it may import: the arrows run one way."""

OUTSIDE = {"tests", "tools", "docs"}
"""Nothing in a room imports these."""

VENDOR_SDKS = (
    "gi",
    "genicam",
    "harvesters",
    "rtde_control",
    "rtde_receive",
    "rtde_io",
    "script_client",
    "dashboard_client",
)
"""Each is imported by one file of the acquisition room, inside a function, which its users share: `gi` serves
the camera driver and the simulated camera."""

SDKS_IN_USE = {"gi", "rtde_control"}
"""Those without which a driver of this version would be missing."""


@dataclass(frozen=True)
class Import:
    """One imported module: its full dotted name, where, and whether importing the file executes it.

    Attributes:
        names: what is imported from the module; maybe modules themselves.
        for_types: whether only a type checker sees it.
    """

    module: str
    line: int
    at_top: bool
    names: tuple[str, ...] = ()
    for_types: bool = False

    @property
    def package(self) -> str:
        return self.module.split(".")[0]


def imports(source: str, package: str = "") -> list[Import]:
    """Every import in Python `source`, of a module inside `package` (which relative imports start from)."""
    return list(_walk(ast.parse(source), package, at_top=True))


def _walk(node: ast.AST, package: str, at_top: bool, for_types: bool = False) -> Iterator[Import]:
    if isinstance(node, ast.Import):
        for alias in node.names:
            yield Import(alias.name, node.lineno, at_top, (), for_types)
    elif isinstance(node, ast.ImportFrom):
        parents = package.split(".")[: len(package.split(".")) - node.level + 1] if node.level else []
        module = ".".join([*parents, *([node.module] if node.module else [])])
        yield Import(module, node.lineno, at_top, tuple(alias.name for alias in node.names), for_types)
    elif isinstance(node, ast.Call) and ast.unparse(node.func).endswith(("import_module", "__import__")):
        if node.args and isinstance(node.args[0], ast.Constant):
            yield Import(str(node.args[0].value), node.lineno, at_top)
    elif isinstance(node, ast.If) and ast.unparse(node.test).endswith("TYPE_CHECKING"):
        at_top, for_types = False, True
    inside = isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef, ast.Lambda))
    for child in ast.iter_child_nodes(node):
        yield from _walk(child, package, at_top and not inside, for_types)


def files(room: str) -> list[Path]:
    return sorted((ROOT / room).rglob("*.py"))


def imports_of(path: Path) -> list[Import]:
    return imports(path.read_text(encoding="utf-8"), ".".join(path.relative_to(ROOT).parent.parts))


def wrong_arrows(found: list[Import], room: str) -> list[Import]:
    forbidden = (ROOMS.keys() | OUTSIDE) - {room} - ROOMS[room]
    return [item for item in found if item.package in forbidden]


@pytest.mark.parametrize("room", ROOMS)
def test_rooms_import_one_way(room: str) -> None:
    assert files(room), f"{room} holds no Python files"
    wrong = [
        f"{path.relative_to(ROOT)}:{item.line} imports {item.module}"
        for path in files(room)
        for item in wrong_arrows(imports_of(path), room)
    ]
    assert not wrong, "\n".join(wrong)


def module_name(path: Path) -> str:
    return ".".join(path.relative_to(ROOT).with_suffix("").parts)


def loaded(item: Import, modules: Collection[str]) -> set[str]:
    """Those of `modules` that an import takes: what it names are modules, or come from one."""
    names = [f"{item.module}.{name}" for name in item.names]
    found = set()
    for path in names or [item.module]:
        places = (path, f"{path}.__init__", item.module, f"{item.module}.__init__")
        found |= set([place for place in places if place in modules][:1])
    return found


def parting(importer: str, imported: str) -> tuple[str, str]:
    """The two names, of modules or packages beside each other, at which the paths of two modules part."""
    one, other = importer.split("."), imported.split(".")
    depth = next(depth for depth, (a, b) in enumerate(zip(one, other, strict=False), start=1) if a != b)
    return ".".join(one[:depth]), ".".join(other[:depth])


def arrows(found: dict[str, list[Import]]) -> dict[str, set[str]]:
    """Which modules and packages import which beside them when the program runs, by the imports of each
    module."""
    inside: dict[str, set[str]] = {}
    for importer, items in found.items():
        for item in (item for item in items if not item.for_types):
            for imported in loaded(item, found) - {importer}:
                one, other = parting(importer, imported)
                inside.setdefault(one, set()).add(other)
    return inside


def cycle(found: dict[str, list[Import]]) -> list[str]:
    """Modules and packages that import each other in a ring; none where there is no ring."""
    try:
        TopologicalSorter(arrows(found)).prepare()
    except CycleError as error:
        return list(error.args[1])
    return []


@pytest.mark.parametrize("room", ROOMS)
def test_no_imports_of_a_room_run_in_a_ring(room: str) -> None:
    ring = cycle({module_name(path): imports_of(path) for path in files(room)})
    assert not ring, " is imported by ".join(ring)


def importers(sdk: str) -> dict[Path, list[Import]]:
    """The files of the four rooms that import `sdk`, with those imports."""
    found = {path: imports_of(path) for room in ROOMS for path in files(room)}
    hits = {path: [item for item in items if item.package == sdk] for path, items in found.items()}
    return {path.relative_to(ROOT): items for path, items in hits.items() if items}


@pytest.mark.parametrize("sdk", VENDOR_SDKS)
def test_vendor_sdk_lives_in_one_file_and_is_imported_lazily(sdk: str) -> None:
    found = importers(sdk)
    assert len(found) <= 1, f"{sdk} is imported by {', '.join(map(str, found))}"
    assert all(path.parts[0] == "acquisition" for path in found), f"{sdk} is imported by {list(found)}"
    assert found or sdk not in SDKS_IN_USE, f"nothing imports {sdk}: its driver is missing"
    at_top = [f"{path}:{item.line}" for path, items in found.items() for item in items if item.at_top]
    assert not at_top, f"{sdk} is imported when the file is: {', '.join(at_top)}"


@pytest.mark.parametrize("room", ["dataset", "acquisition", "calibration"])
def test_only_the_method_room_needs_torch(room: str) -> None:
    users = [
        f"{path.relative_to(ROOT)}:{item.line}"
        for path in files(room)
        for item in imports_of(path)
        if item.package == "torch"
    ]
    assert not users, ", ".join(users)


HEAVY = ("torch", "cv2", "numba", "trimesh", "scipy", "h5py", "gi")

LOADED = f"""
import sys
try:
    exec(sys.argv[1])
except SystemExit:
    pass
print("LOADED", *(name for name in {HEAVY!r} if name in sys.modules))
"""


def loaded_by(statement: str) -> list[str]:
    """The heavy packages that a fresh interpreter has loaded after executing `statement`."""
    command = [sys.executable, "-c", LOADED, statement]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    assert "NO HELP" not in done.stdout
    return done.stdout.splitlines()[-1].split()[1:]


def test_the_command_line_starts_light() -> None:
    assert loaded_by("import s2p3.cli") == []


ALL_HELP = """
import contextlib
from s2p3 import cli
groups = {name: verb for name, verb in cli.VERBS.items() if isinstance(verb, cli.Group)}
inner = [[name, verb] for name, group in groups.items() for verb in group.verbs]
for words in [[], *([name] for name in cli.VERBS), *inner]:
    with contextlib.suppress(SystemExit):
        cli.main([*words, "--help"])
        print("NO HELP", *words)
"""


def test_help_of_every_verb_answers_without_torch() -> None:
    assert loaded_by(ALL_HELP) == []


def test_loaded_packages_are_seen() -> None:
    assert loaded_by("import h5py") == ["h5py"]


@pytest.mark.parametrize(
    ("source", "expected"),
    [
        ("import calibration.board", ["calibration.board"]),
        ("def f():\n    from s2p3 import cli", ["s2p3"]),
        ("from .. import camera", []),
        ("from ...calibration import board", ["calibration"]),
        ("import importlib\nimportlib.import_module('s2p3.lab')", ["s2p3.lab"]),
        ("import dataset, numpy", []),
        ("from tests.helpers import x", ["tests.helpers"]),
    ],
)
def test_wrong_arrows_are_found(source: str, expected: list[str]) -> None:
    wrong = wrong_arrows(imports(source, "acquisition.cameras"), "acquisition")
    assert [item.module for item in wrong] == expected


@pytest.mark.parametrize(
    ("source", "ring"),
    [
        ("from s2p3 import b", {"s2p3.a", "s2p3.b"}),
        ("from s2p3.b import inner", {"s2p3.a", "s2p3.b"}),
        ("def f():\n    from s2p3.b.inner import x", {"s2p3.a", "s2p3.b"}),
        ("if TYPE_CHECKING:\n    from s2p3 import b", set()),
        ("import numpy", set()),
    ],
)
def test_rings_are_found(source: str, ring: set[str]) -> None:
    others = {
        "s2p3.__init__": "",
        "s2p3.b.__init__": "from s2p3.b.inner import x",
        "s2p3.b.inner": "from s2p3.a import y\nfrom s2p3.b import other",
        "s2p3.b.other": "",
    }
    assert set(cycle({name: imports(text) for name, text in {"s2p3.a": source, **others}.items()})) == ring


@pytest.mark.parametrize(
    ("source", "at_top"),
    [
        ("import gi", True),
        ("try:\n    import gi\nexcept ImportError:\n    gi = None", True),
        ("class A:\n    import gi", True),
        ("def f():\n    import gi", False),
        ("from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    import gi", False),
    ],
)
def test_imports_at_the_top_are_told_from_lazy_ones(source: str, at_top: bool) -> None:
    assert [item.at_top for item in imports(source) if item.package == "gi"] == [at_top]
