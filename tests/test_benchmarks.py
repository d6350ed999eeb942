"""Benchmarks are run by hand, so they have to keep up with what they import and call."""

from __future__ import annotations

import ast
import runpy
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]


SCRIPTS = [path for path in sorted((ROOT / "benchmarks").rglob("*.py")) if not path.stem.startswith("_")]


EACH = """
import runpy, sys
for path in sys.argv[1:]:
    sys.argv = [path, "--help"]
    sys.path.insert(0, path.rpartition("/")[0])
    try:
        runpy.run_path(path, run_name="__main__")
    except SystemExit as end:
        assert not end.code, path
    else:
        raise AssertionError(f"{path} went on after --help")
    del sys.path[0]
"""


@pytest.mark.slow
def test_benchmarks_say_what_they_do() -> None:
    """One process for all, for most of the time is taken by what they import."""
    paths = [path.as_posix() for path in SCRIPTS]
    done = subprocess.run([sys.executable, "-c", EACH, *paths], capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("usage:") == len(paths) > 10


def test_every_mutant_is_a_program_that_says_something_else() -> None:
    own = runpy.run_path(str(ROOT / "benchmarks" / "mutants.py"))
    source = (ROOT / "equimus_ctrl" / "effects" / "command.py").read_text(encoding="utf-8")
    found = own["Places"]("effects/command.py", source).found
    assert {m.kind for m in found} == {"comparison", "boundary", "operator", "sign", "constant", "line"}
    same = ast.dump(ast.parse(source))
    for mutant in found[::9]:
        changed = mutant.applied(source)
        assert ast.dump(ast.parse(changed)) != same, mutant
        lines = [
            k for k, (a, b) in enumerate(zip(source.splitlines(), changed.splitlines(), strict=False), 1) if a != b
        ]
        assert lines[0] >= mutant.line


def test_mutants_are_given_to_tests_of_their_module_and_of_what_it_is_for() -> None:
    importers = runpy.run_path(str(ROOT / "benchmarks" / "mutants.py"))["Importers"](ROOT)
    files = importers.files("diagnosis/fitting.py", 6)
    assert files[0] == "test_diagnosis_fitting.py" and "test_diagnosis_budget.py" in files
    assert len(files) == len(set(files)) == 6
    assert importers.files("effects/command.py", 3)[0] == "test_command_laws.py"
