"""Do the fast tests notice? One small change of the package at a time, and whether a test fails because of it.

python benchmarks/mutants.py [--count 100] [--seed 0] [--only effects/force.py ...] [--limit 120] [--files 6] [--json]

A mutant is one comparison, boundary, sign, operator, number or line of the effects, the engines, the identification or
the diagnosis changed, drawn by the seed (DeMillo, Lipton & Sayward, 1978). Each is made in a copy of the tree in a
temporary folder, never in the checkout, and given to fast tests until one fails: of those that import its module the
most specific files, and some of what uses it. A test that fails is run once more where nothing is changed. What no
test notices is printed as a diff: it is either equivalent or a gap in the tests. What was tried is kept in ``--work``
and not tried again.
"""

from __future__ import annotations

import argparse
import ast
import difflib
import hashlib
import json
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from functools import cache
from itertools import zip_longest
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = "equimus_ctrl"
FOLDERS = ("effects", "engines", "identification", "diagnosis")
NEAR = {"<": "<=", "<=": "<", ">": ">=", ">=": ">"}
FLIPPED = {"<": ">", "<=": ">=", ">": "<", ">=": "<=", "==": "!=", "!=": "==", "is": "is not", "in": "not in"}
FLIPPED |= {"is not": "is", "not in": "in"}
OTHER = {"+": "-", "-": "+", "*": "/", "/": "*", "//": "*", "**": "*", "@": "*", "and": "or", "or": "and"}


@dataclass(frozen=True)
class Mutant:
    """A change of one place.

    Attributes:
        module: path within the package.
        line: of the place, from 1.
        kind: of change.
        start: of what is replaced, in characters.
        end: of it.
        text: in its place.
    """

    module: str
    line: int
    kind: str
    start: int
    end: int
    text: str

    def applied(self, source: str) -> str:
        return source[: self.start] + self.text + source[self.end :]

    def key(self, source: str) -> str:
        """The same in every run for the same change of the same source."""
        return hashlib.sha256(repr((asdict(self), source)).encode()).hexdigest()[:16]


class Places(ast.NodeVisitor):
    """All mutants of a module."""

    def __init__(self, module: str, source: str) -> None:
        self.module, self.source, self.found = module, source, list[Mutant]()
        starts = [0]
        for line in source.splitlines(keepends=True):
            starts.append(starts[-1] + len(line))
        self._starts, self._lines = starts, source.splitlines()
        self.visit(ast.parse(source))

    def _at(self, line: int, column: int) -> int:
        """Characters before a place; ast counts bytes."""
        return self._starts[line - 1] + len(self._lines[line - 1].encode()[:column].decode())

    def _span(self, node: ast.expr | ast.stmt) -> tuple[int, int]:
        assert node.end_lineno is not None and node.end_col_offset is not None
        return self._at(node.lineno, node.col_offset), self._at(node.end_lineno, node.end_col_offset)

    def _add(self, node: ast.expr | ast.stmt, kind: str, start: int, end: int, text: str) -> None:
        self.found.append(Mutant(self.module, node.lineno, kind, start, end, text))

    def _between(self, left: ast.expr, right: ast.expr, changes: dict[str, str], kind: str) -> None:
        """Change the operator between two operands."""
        low, high = self._span(left)[1], self._span(right)[0]
        told = re.search(r"not\s+in|is\s+not|and|or|in|is|[<>=!]=|\*\*|//|[-+*/@<>]", self.source[low:high])
        if told and (new := changes.get(re.sub(r"\s+", " ", told[0]))):
            self._add(left, kind, low + told.start(), low + told.end(), new)

    def visit_Compare(self, node: ast.Compare) -> None:
        for left, right in zip([node.left, *node.comparators], node.comparators, strict=False):
            self._between(left, right, FLIPPED, "comparison")
            self._between(left, right, NEAR, "boundary")
        self.generic_visit(node)

    def visit_BinOp(self, node: ast.BinOp) -> None:
        self._between(node.left, node.right, OTHER, "operator")
        self.generic_visit(node)

    def visit_BoolOp(self, node: ast.BoolOp) -> None:
        self._between(node.values[0], node.values[1], OTHER, "operator")
        self.generic_visit(node)

    def visit_UnaryOp(self, node: ast.UnaryOp) -> None:
        if isinstance(node.op, ast.USub | ast.Not):
            start = self._span(node)[0]
            self._add(node, "sign", start, start + (1 if isinstance(node.op, ast.USub) else len("not ")), "")
        self.generic_visit(node)

    def visit_Constant(self, node: ast.Constant) -> None:
        value = node.value
        if isinstance(value, bool):
            self._add(node, "constant", *self._span(node), str(not value))
        elif isinstance(value, int | float):
            self._add(
                node,
                "constant",
                *self._span(node),
                repr(value + 1 if isinstance(value, int) else value * 1.5 + (not value)),
            )

    def _line(self, node: ast.stmt) -> None:
        self._add(node, "line", *self._span(node), "pass")
        self.generic_visit(node)

    def visit_Expr(self, node: ast.Expr) -> None:
        if not isinstance(node.value, ast.Constant):
            self._line(node)

    def visit_AugAssign(self, node: ast.AugAssign) -> None:
        self._line(node)

    def visit_Raise(self, node: ast.Raise) -> None:
        self._add(node, "line", *self._span(node), "pass")

    # What is said of types and to readers runs nowhere.
    def visit_AnnAssign(self, node: ast.AnnAssign) -> None:
        if node.value is not None:
            self.visit(node.value)

    def visit_arg(self, node: ast.arg) -> None:
        pass

    def visit_JoinedStr(self, node: ast.JoinedStr) -> None:
        pass

    def visit_FunctionDef(self, node: ast.FunctionDef) -> None:
        for part in (*node.args.defaults, *(d for d in node.args.kw_defaults if d), *node.body):
            self.visit(part)


def drawn(folder: Path, count: int, seed: int, only: list[str]) -> list[Mutant]:
    """So many mutants, as many of each kind as there are, no two of one line."""
    paths = sorted(path for name in FOLDERS for path in (folder / PACKAGE / name).glob("*.py"))
    names = [path.relative_to(folder / PACKAGE).as_posix() for path in paths]
    if unknown := [name for name in only if name not in names]:
        sys.exit(f"there is no module {unknown[0]}; expected one of {', '.join(names)}")
    found = [m for name in only or names for m in Places(name, (folder / PACKAGE / name).read_text("utf-8")).found]
    random.Random(seed).shuffle(found)
    kinds: dict[str, list[Mutant]] = {}
    for mutant in found:
        kinds.setdefault(mutant.kind, []).append(mutant)
    first: dict[tuple[str, int], Mutant] = {}
    for row in zip_longest(*kinds.values()):
        for mutant in filter(None, row):
            first.setdefault((mutant.module, mutant.line), mutant)
    return list(first.values())[:count]


class Importers:
    """Which test files import which modules of the package, by themselves or by what they share."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.tests = {p.name: self._of(p) for p in sorted((folder / "tests").glob("test_*.py"))}
        modules = (folder / PACKAGE).rglob("*.py")
        self.modules = {p.relative_to(folder / PACKAGE).as_posix(): self._of(p) for p in modules}

    def files(self, module: str, most: int) -> list[str]:
        """So many test files of a module: of those that import it the most specific, then of what imports it.

        A third of them are of the latter at least, where there are such: they see what the module is for.
        """
        rings, near, known = list[list[str]](), {module}, {module}
        folder, own, taken = Path(module).parent.name.rstrip("s"), Path(module).stem, set[str]()
        while near:
            found = {name for name, imported in self.tests.items() if imported & near} - taken
            told = own if not rings else folder
            rings.append(sorted(found, key=lambda name: (told not in name, len(self.tests[name]), name)))
            taken |= found
            near = {name for name, imported in self.modules.items() if imported & near} - known
            known |= near
        farther = [name for ring in rings[1:] for name in ring]
        return [*rings[0][: most - min(len(farther), most // 3)], *farther][:most]

    def _of(self, path: Path) -> frozenset[str]:
        return self._imported(path, path.parent == self.folder / "tests")

    @cache  # noqa: B019
    def _imported(self, path: Path, is_test: bool) -> frozenset[str]:
        found: set[str] = set()
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.ImportFrom) and node.module and not node.level:
                beside = self.folder / "tests" / f"{node.module}.py"
                if is_test and beside.is_file() and beside != path:
                    found |= self._imported(beside, True)
                for name in node.names:
                    found |= self._defined(node.module, name.name)
            elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "eq":
                found |= self._defined(PACKAGE, node.attr)
        return frozenset(found)

    @cache  # noqa: B019
    def _defined(self, module: str, name: str) -> frozenset[str]:
        """The module that a name comes from, as a path within the package."""
        if not module.startswith(PACKAGE):
            return frozenset()
        place = self.folder / module.replace(".", "/")
        for path in (place / f"{name}.py", place.with_suffix(".py")):
            if path.is_file():
                return frozenset({path.relative_to(self.folder / PACKAGE).as_posix()})
        for init in (place / "__init__.pyi", place / "__init__.py"):
            if init.is_file():
                for node in ast.parse(init.read_text("utf-8")).body:
                    if isinstance(node, ast.ImportFrom) and any((n.asname or n.name) == name for n in node.names):
                        other = f"{module}.{node.module}" if node.level else str(node.module)
                        return self._defined(other, name) if other != module else frozenset()
        return frozenset()


class Trial:
    """Runs of tests in a copy of the tree."""

    def __init__(self, folder: Path, work: Path, limit: float) -> None:
        self.folder, self.limit = folder, limit
        self.sound: dict[str, bool] = {}
        recordings = os.environ.get("EQUIMUS_RECORDINGS") or ROOT.parent / "shared" / "recordings"
        own = {"PYTHONPATH": str(folder), "EQUIMUS_CACHE": str(work / "cache"), "EQUIMUS_RECORDINGS": str(recordings)}
        self.environment = {**os.environ, **own, "PYTHONDONTWRITEBYTECODE": "1", "OMP_NUM_THREADS": "1"}
        where = subprocess.run(
            [sys.executable, "-c", f"import {PACKAGE}; print({PACKAGE}.__file__)"],
            cwd=folder, env=self.environment, capture_output=True, text=True, check=True,
        ).stdout  # fmt: skip
        if not Path(where.strip()).is_relative_to(folder):
            sys.exit(f"{PACKAGE} is imported from {where.strip()}, not from the copy in {folder}")

    def failing(self, files: list[str], limit: float) -> tuple[str, str]:
        """(outcome, first test that fails): ``passed``, ``failed`` or ``out of time``."""
        command = [sys.executable, "-m", "pytest", "-x", "-n", "0", "-p", "no:cacheprovider", "--tb", "no", "-rfE"]
        process = subprocess.Popen(
            [*command, *(f"tests/{name}" for name in files)], cwd=self.folder, env=self.environment, text=True,
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, start_new_session=True,
        )  # fmt: skip
        try:
            said = process.communicate(timeout=limit)[0]
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            process.communicate()
            return "out of time", ""
        told = re.search(r"^(?:FAILED|ERROR) (.+?)(?: - |$)", said, re.MULTILINE)
        return ("passed" if process.returncode in (0, 5) else "failed"), told[1] if told else ""

    def passes(self, test: str) -> bool:
        """Whether a test passes in time where nothing is changed; asked once."""
        if test not in self.sound:
            self.sound[test] = self.failing([test.removeprefix("tests/")], self.limit)[0] == "passed"
            if not self.sound[test]:
                print(f"{test} says nothing: it does not pass within {self.limit:g} s either way", file=sys.stderr)
        return self.sound[test]


def copied(work: Path) -> Path:
    """A copy of what git knows of the tree, as it stands."""
    listed = subprocess.run(
        ["git", "ls-files", "-co", "--exclude-standard", "-z"], cwd=ROOT, capture_output=True, text=True, check=True
    )
    folder = Path(tempfile.mkdtemp(prefix="tree-", dir=work))
    for name in filter(None, listed.stdout.split("\0")):
        if (ROOT / name).is_file():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, folder / name)
    return folder


def tried(mutants: list[Mutant], folder: Path, work: Path, limit: float, most: int) -> Iterator[dict[str, object]]:
    """Each mutant's fate, from the journal where it is known."""
    journal = work / "mutants.jsonl"
    rows = [json.loads(line) for line in journal.read_text("utf-8").splitlines()] if journal.exists() else []
    known = {row["key"]: row for row in rows}
    trial, importers = Trial(folder, work, limit), Importers(folder)
    for mutant in mutants:
        path = folder / PACKAGE / mutant.module
        source = path.read_text("utf-8")
        key = mutant.key(source)
        if key not in known:
            files, begun = importers.files(mutant.module, most), time.monotonic()
            while True:
                try:
                    path.write_text(mutant.applied(source), encoding="utf-8")
                    outcome, by = trial.failing(files, limit) if files else ("passed", "")
                finally:
                    path.write_text(source, encoding="utf-8")
                # A test that fails of itself tells nothing of the mutant, nor does the rest of its file.
                if not by or trial.passes(by):
                    break
                files = [name for name in files if name != by.partition("::")[0].removeprefix("tests/")]
            fate = {"failed": "caught", "passed": "survived"}.get(outcome, outcome)
            name = f"{PACKAGE}/{mutant.module}"
            diff = difflib.unified_diff(
                source.splitlines(), mutant.applied(source).splitlines(), name, name, n=2, lineterm=""
            )
            known[key] = {
                "key": key, "module": mutant.module, "line": mutant.line, "kind": mutant.kind, "outcome": fate,
                "by": by, "files": files, "seconds": round(time.monotonic() - begun, 1), "diff": "\n".join(diff),
            }  # fmt: skip
            with journal.open("a", encoding="utf-8") as out:
                out.write(json.dumps(known[key]) + "\n")
        yield known[key]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=100, help="of mutants")
    parser.add_argument("--seed", type=int, default=0, help="by which they are drawn")
    parser.add_argument("--only", nargs="*", default=[], metavar="MODULE", help="paths within the package")
    parser.add_argument("--limit", type=float, default=120.0, help="of the tests of one mutant [s]")
    parser.add_argument("--files", type=int, default=6, help="most test files for one mutant")
    parser.add_argument(
        "--work", type=Path, default=Path(tempfile.gettempdir()) / "equimus-mutants", help="folder of the journal"
    )
    parser.add_argument("--json", action="store_true", help="print the record, and what happens beside it")
    arguments = parser.parse_args()
    arguments.work.mkdir(parents=True, exist_ok=True)
    folder = copied(arguments.work.resolve())
    shown = sys.stderr if arguments.json else sys.stdout
    found = []
    try:
        mutants = drawn(folder, arguments.count, arguments.seed, arguments.only)
        for row in tried(mutants, folder, arguments.work.resolve(), arguments.limit, arguments.files):
            found.append(row)
            print(
                f"{row['outcome']:>11} {row['seconds']:6} s  {row['module']}:{row['line']} {row['kind']}  {row['by']}",
                file=shown,
                flush=True,
            )
    finally:
        shutil.rmtree(folder)
    count = Counter(row["outcome"] for row in found)
    for row in found:
        if row["outcome"] == "survived":
            print(f"\n{row['diff']}", file=shown)
    decided = count["caught"] + count["survived"]
    share = count["caught"] / decided if decided else float("nan")
    print(
        f"\n{count['caught']} of {decided} caught ({100 * share:.0f} %), {count['out of time']} out of time", file=shown
    )
    if arguments.json:
        print(json.dumps({"seed": arguments.seed, "caught_share": share, **count, "mutants": found}))


if __name__ == "__main__":
    main()
