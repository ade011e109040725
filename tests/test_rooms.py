"""Arrows between the rooms point one way, and importing the package is cheap."""

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest

ROOT = Path(__file__).parent.parent
ROOMS = {"m3gn_bench", "baselines", "datasets", "generators", "leaderboard"}
# Not installed; these may import everything, and no room may import them.
OUTSIDE = {"tests", "validation", "benchmarks"}
SCRIPTS = {path.stem: folder for folder in OUTSIDE for path in (ROOT / folder).glob("*.py")}
# Modules of m3gn_bench that import nothing of ours: each counts as a room of its own.
FREE = {"version", "provenance"}
ALLOWED = {
    "datasets": {"datasets"},
    "generators": {"generators", "datasets", *FREE},
    "m3gn_bench": {"m3gn_bench", "datasets", *FREE},
    "baselines": {"baselines", "m3gn_bench", "datasets", *FREE},
    "leaderboard": {"leaderboard", "m3gn_bench", "datasets", *FREE},
}
# These reach further, but only inside functions: a model can be evaluated without a simulator installed.
COMMANDS = ("dataset_commands", "leaderboard_commands", "model_commands", "report_commands", "study_commands")
LAZY = {f"m3gn_bench/{name}.py" for name in ("cli", *COMMANDS, "doctor", "sources", "stability", "tradeoff")}
LAZILY_ALLOWED = {"generators", "leaderboard", "baselines"}


class Import(NamedTuple):
    """One of our modules, imported somewhere."""

    room: str
    lazy: bool
    line: int


def runs_later(node: ast.AST) -> bool:
    """Whether an import inside the node does not run when the module is loaded."""
    if isinstance(node, ast.If) and isinstance(node.test, ast.Name):
        return node.test.id == "TYPE_CHECKING"
    return isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)


def our_imports(source: str) -> Iterator[Import]:
    """Every import of one of our modules."""

    def visit(node: ast.AST, lazy: bool) -> Iterator[Import]:
        names: list[str] = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "relative imports would not survive the package-dir table"
            names = [f"{node.module}.{alias.name}" for alias in node.names]
        for name in names:
            package, *rest = name.split(".")
            if package in OUTSIDE | set(SCRIPTS):
                yield Import(SCRIPTS.get(package, package), lazy, node.lineno)
            elif package in ROOMS:
                place = rest[0] if package == "m3gn_bench" and rest else package
                yield Import(place if place in ROOMS | FREE else "m3gn_bench", lazy, node.lineno)
        for child in ast.iter_child_nodes(node):
            yield from visit(child, lazy or runs_later(node))

    yield from visit(ast.parse(source), False)


def violations(path: str, source: str) -> list[str]:
    """Imports in the file at `path` (relative to the checkout) that the table of rooms forbids."""
    room = path.split("/")[0]
    return [
        f"{path}:{found.line} imports {found.room}"
        for found in our_imports(source)
        if found.room not in ALLOWED[room]
        and not (path in LAZY and found.lazy and found.room in LAZILY_ALLOWED)
    ]


def sources(room: str) -> dict[str, str]:
    return {str(path.relative_to(ROOT)): path.read_text() for path in sorted((ROOT / room).rglob("*.py"))}


@pytest.mark.parametrize("room", sorted(ROOMS))
def test_rooms_import_only_what_they_may(room: str) -> None:
    found = sources(room)
    assert any(list(our_imports(source)) for source in found.values())  # the parser sees something
    assert [violation for path, source in found.items() for violation in violations(path, source)] == []


@pytest.mark.parametrize("module", sorted(FREE))
def test_free_modules_import_nothing_of_ours(module: str) -> None:
    assert not list(our_imports((ROOT / "m3gn_bench" / f"{module}.py").read_text()))


@pytest.mark.parametrize(
    ("path", "source"),
    [
        ("datasets/file.py", "import m3gn_bench.version"),
        ("datasets/file.py", "from m3gn_bench import data"),
        ("generators/scene.py", "def f():\n    from m3gn_bench.tasks import TASKS"),
        ("m3gn_bench/data.py", "def f():\n    import m3gn_bench.generators.scene"),
        ("m3gn_bench/sources.py", "from m3gn_bench.generators import scene"),
        ("m3gn_bench/cli.py", "if True:\n    from m3gn_bench import leaderboard"),
        ("baselines/mgn.py", "from m3gn_bench.generators.scene import get_scene"),
        ("leaderboard/check.py", "import baselines.mgn"),
        ("m3gn_bench/profiling.py", "import benchmarks.usual_m3gn"),
        ("m3gn_bench/cli.py", "def f():\n    from usual_m3gn import PlainM3GN"),
    ],
)
def test_a_forbidden_import_is_seen(path: str, source: str) -> None:
    assert violations(path, source)


@pytest.mark.parametrize(
    ("module", "unwanted"),
    [
        ("m3gn_bench", {"torch", "skfem", "h5py", "numpy"}),
        ("m3gn_bench.cli", {"torch", "skfem", "h5py", "numpy"}),  # --help is instant
        ("m3gn_bench.datasets.file", {"torch", "skfem"}),
        ("m3gn_bench.generators.generate", {"torch", "skfem"}),  # a scene brings its own simulator
        ("m3gn_bench.generators.falling", {"torch", "skfem", "warp", "newton", "trimesh", "meshio"}),
        ("m3gn_bench.generators.deformable_block", {"torch", "warp"}),
        ("m3gn_bench.generators.tissue_manipulation", {"torch", "warp"}),
        ("m3gn_bench.evaluation, m3gn_bench.checkpoint, m3gn_bench.sources", {"skfem"}),
    ],
)
def test_imports_are_cheap(module: str, unwanted: set[str]) -> None:
    code = f"import {module}, sys; print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert unwanted & set(loaded.split()) == set()


def test_console_script_is_installed() -> None:
    script = Path(sys.executable).parent / "m3gn-bench"
    shown = subprocess.run([script, "--help"], capture_output=True, text=True, check=True).stdout
    assert "generate" in shown
    assert "leaderboard" in shown
