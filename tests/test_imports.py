"""Imports point one way, and only a few modules touch files: read off the source, nothing is imported."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1] / "equimus_ctrl"

ORDER: tuple[tuple[str, ...], ...] = (
    ("errors", "computer", "shown"),
    ("frames",),
    ("executors",),
    ("types", "settings", "registry", "quiet"),
    ("presets",),
    ("outputs",),
    ("effects", "recordings"),
    ("robots",),
    ("models",),
    ("engines",),
    ("plants", "controllers", "estimation", "predictive"),
    ("scenarios",),
    ("loop", "emulation"),
    ("testing",),
    ("tuning", "identification", "diagnosis", "validation"),
    ("preflight",),
    ("experiments",),
    ("proof",),
    ("report",),
    ("learning",),
    ("options",),
    ("workflow",),
    ("cli",),
    ("__main__",),
)
"""From the ground up: a part may import what stands before it, its own, and its neighbours where these do not back."""

LEVEL = {part: level for level, parts in enumerate(ORDER) for part in parts}

MAY_TOUCH_FILES = (
    "recordings",
    "cli",
    "presets",
    "outputs",
    "report",
    "engines.compiled",
    "engines.native",
    "executors",
)
"""Modules that open files: data, the command line, what a user edits, pictures, and the cache of kernels."""

PRESETS_SERVE = ("workflow", "cli", "report", "recordings", "outputs")
"""Who may hand files to ``presets``; anybody else would touch files by its hand."""

FILE_CALLS = {
    "open", "read_text", "write_text", "read_bytes", "write_bytes", "mkdir", "makedirs", "rmdir", "unlink", "touch",
    "rename", "renames", "symlink_to", "iterdir", "glob", "rglob", "savefig", "savetxt", "loadtxt", "genfromtxt",
    "fromfile", "tofile", "memmap", "urlopen", "urlretrieve", "rmtree", "copyfile", "copytree",
}  # fmt: skip
FILE_MODULES = {"tempfile", "shutil", "urllib", "socket", "pooch", "pickle", "shelve", "sqlite3", "imageio"}
KEEPS_DEADLINES = ("controllers.nmpc", "controllers.sampling", "plants.hardware.plant", "plants.hardware.dds")
OS_CALLS = {"replace", "remove", "listdir", "scandir", "walk", "chmod"}


@lru_cache(maxsize=1)
def modules() -> dict[str, ast.Module]:
    """Dotted name under the package → syntax tree; the package's own face, which offers everything, left out."""
    found = {}
    for path in sorted(ROOT.rglob("*.py")):
        parts = path.relative_to(ROOT).with_suffix("").parts
        if parts[0] in ("_presets", "__pycache__", "__init__"):
            continue
        name = ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
        found[name] = ast.parse(path.read_text(encoding="utf-8"), str(path))
    return found


def part(module: str) -> str:
    return module.partition(".")[0]


def imported(module: str) -> Iterator[tuple[str, int]]:
    """(module of the package, line) for every import, wherever it stands: at the top, in a function, for types only."""
    is_package = (ROOT / module.replace(".", "/")).is_dir()
    here = module.split(".") if is_package else module.split(".")[:-1]
    for node in ast.walk(modules()[module]):
        if isinstance(node, ast.Import):
            for alias in node.names:
                if alias.name.split(".")[0] == "equimus_ctrl":
                    yield alias.name.partition(".")[2], node.lineno
        elif isinstance(node, ast.ImportFrom):
            source = (node.module or "").split(".") if node.module else []
            if node.level:
                source = ["equimus_ctrl", *here[: len(here) - node.level + 1], *source]
            if source[:1] != ["equimus_ctrl"]:
                continue
            for alias in node.names:
                # ``from equimus_ctrl import presets`` names a module, ``… import __version__`` what is in one.
                full = ".".join([*source[1:], alias.name])
                yield (full if full in modules() else ".".join(source[1:]) or alias.name), node.lineno


def all_imports() -> list[tuple[str, str, int]]:
    return [(module, target, line) for module in modules() for target, line in imported(module)]


def test_the_source_was_found() -> None:
    assert len(modules()) > 40
    assert len(all_imports()) > 150
    assert "models.symbolic" in modules()
    assert ("loop", "types") in {(module, target) for module, target, _ in all_imports()}


def test_every_part_has_its_place_in_the_order() -> None:
    assert {part(module) for module in modules()} <= set(LEVEL)


def test_imports_point_downwards() -> None:
    wrong = [
        f"{module}:{line} imports {target}"
        for module, target, line in all_imports()
        if target != "__version__" and LEVEL.get(part(target), 99) > LEVEL[part(module)]
    ]
    assert not wrong, "\n".join(wrong)


def test_neighbours_on_one_level_do_not_import_each_other_both_ways() -> None:
    """Plants may know controllers, or controllers plants, but not both: there is no cycle among the parts."""
    edges: dict[str, set[str]] = {}
    for module, target, _ in all_imports():
        if part(target) in LEVEL and part(target) != part(module):
            edges.setdefault(part(module), set()).add(part(target))
    done: set[str] = set()

    def visit(name: str, path: tuple[str, ...]) -> None:
        assert name not in path, " → ".join([*path, name])
        if name not in done:
            for other in sorted(edges.get(name, ())):
                visit(other, (*path, name))
            done.add(name)

    for name in sorted(edges):
        visit(name, ())


def test_there_is_no_cycle_among_modules_either() -> None:
    """Not even one hidden by an import inside a function; a package's own face counts as its modules'."""
    graph = {
        module: {target for target, _ in imported(module) if target in modules() and target != module}
        for module in modules()
    }
    state: dict[str, int] = {}

    def visit(name: str, path: tuple[str, ...]) -> None:
        assert state.get(name) != 1, " → ".join([*path[path.index(name) :], name])
        if name not in state:
            state[name] = 1
            for other in sorted(graph[name]):
                visit(other, (*path, name))
            state[name] = 2

    for name in sorted(graph):
        visit(name, ())


def test_the_package_does_not_import_its_own_face() -> None:
    """``import equimus_ctrl`` loads everything on first use; inside, each module names what it needs."""
    wrong = [
        f"{module}:{line} imports {target or 'equimus_ctrl'}"
        for module, target, line in all_imports()
        if target not in modules() and target != "__version__"
    ]
    assert not wrong, "\n".join(wrong)


def test_only_those_that_deal_with_users_files_go_through_presets() -> None:
    wrong = [
        f"{module}:{line}"
        for module, target, line in all_imports()
        if part(target) == "presets" and part(module) not in PRESETS_SERVE
    ]
    assert not wrong, "\n".join(wrong)


def file_calls(tree: ast.Module) -> Iterator[tuple[int, str]]:
    """(line, what) for calls that open, list, write or move files, and imports of modules that exist for that."""
    own = {
        alias.asname or alias.name
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("equimus_ctrl")
        for alias in node.names
    }
    for node in ast.walk(tree):
        if isinstance(node, ast.Import | ast.ImportFrom):
            names = [node.module or ""] if isinstance(node, ast.ImportFrom) else [alias.name for alias in node.names]
            for name in names:
                if name.split(".")[0] in FILE_MODULES:
                    yield node.lineno, f"imports {name}"
        if not isinstance(node, ast.Call):
            continue
        called = node.func
        if isinstance(called, ast.Name) and called.id == "open":
            yield node.lineno, "open()"
        if isinstance(called, ast.Attribute):
            owner = called.value.id if isinstance(called.value, ast.Name) else ""
            if owner in own:  # a function of ours, which answers for itself
                continue
            if called.attr in FILE_CALLS or (owner == "os" and called.attr in OS_CALLS):
                yield node.lineno, f"{owner or '…'}.{called.attr}()"


def touches_files(module: str) -> bool:
    return any(module == allowed or module.startswith(f"{allowed}.") for allowed in MAY_TOUCH_FILES)


def test_only_a_few_modules_touch_files() -> None:
    wrong = [
        f"{module}:{line} {what}"
        for module, tree in modules().items()
        if not touches_files(module)
        for line, what in file_calls(tree)
    ]
    assert not wrong, "\n".join(wrong)


@pytest.mark.parametrize("module", ["presets", "engines.compiled", "recordings.csvfile"])
def test_those_that_touch_files_are_seen_to(module: str) -> None:
    """The test above would see it."""
    assert list(file_calls(modules()[module]))


def test_wall_clock_time_does_not_enter_the_physics() -> None:
    """Engines, models, effects, plants, controllers and scenarios know no other clock than the simulation's.

    A deadline is one of the clock on the wall; who sets none does not read it.
    """
    wrong = [
        f"{module}:{node.lineno}"
        for module, tree in modules().items()
        if LEVEL[part(module)] <= LEVEL["scenarios"] and part(module) not in ("recordings", "presets", "executors")
        if module not in KEEPS_DEADLINES
        for node in ast.walk(tree)
        if isinstance(node, ast.Import | ast.ImportFrom)
        for name in ([node.module or ""] if isinstance(node, ast.ImportFrom) else [a.name for a in node.names])
        if name.split(".")[0] in ("time", "datetime", "random")
    ]
    assert not wrong, "\n".join(wrong)
