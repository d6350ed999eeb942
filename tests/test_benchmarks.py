"""Benchmarks are run by hand, so they have to keep up with what they import and call."""

from __future__ import annotations

import ast
import runpy
import subprocess
import sys
from pathlib import Path

import pytest
from pendulum_runs import MOTOR, PENDULUM, recorded

from equimus_ctrl.diagnosis.policy import Thresholds
from equimus_ctrl.effects.force import CoulombFriction
from equimus_ctrl.models.model import Model
from equimus_ctrl.recordings.csvfile import write
from equimus_ctrl.robots.mjcf.robot import MjcfRobot

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


@pytest.mark.slow
def test_a_case_is_diagnosed_with_other_thresholds_where_decisions_fall_otherwise(tmp_path: Path) -> None:
    own = runpy.run_path(str(ROOT / "benchmarks" / "thresholds.py"))
    nominal = Model(MjcfRobot("robot", PENDULUM.format(drive=MOTOR)))
    (case := tmp_path / "recordings" / "case_0000").mkdir(parents=True)
    for trial in recorded(Model(nominal.robot, [CoulombFriction("hinge", 0.05)]), seed=7):
        write(case / f"{trial.name}.csv", trial)
    variants = own["varied"](["simulation_error=1e9"], ["residual_gain"])
    row = own["case_row"](nominal, tmp_path, 0, variants)
    assert own["said"](row["base"]) == ("explained", [("coulomb_friction", ["hinge"])])
    assert set(row["varied"]) <= set(row["asked"]) == set(variants)
    assert not row["varied"]["simulation_error=1e9"].get("findings")  # so much is explained by nothing
    parts = own["split"](nominal, own["recorded"](case, nominal))
    for name, thresholds in {"as they are": Thresholds(), **{name: variants[name] for name in row["varied"]}}.items():
        alone = own["answered"](nominal, parts, thresholds)  # nothing taken over from another diagnosis
        kept = row["varied"].get(name, row["base"])
        assert own["said"](alone) == own["said"](kept), name
        assert alone["findings"] == kept["findings"], name
