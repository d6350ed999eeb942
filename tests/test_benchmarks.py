"""Benchmarks are run by hand, so they have to keep up with what they import and call."""

from __future__ import annotations

import ast
import dataclasses
import importlib
import importlib.util
import runpy
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from pendulum_runs import MOTOR, PENDULUM, recorded

from equimus_ctrl.diagnosis.thresholds import Thresholds
from equimus_ctrl.effects.force import CoulombFriction
from equimus_ctrl.models.model import Model
from equimus_ctrl.recordings.csvfile import write
from equimus_ctrl.robots.mjcf.robot import MjcfRobot
from equimus_ctrl.workflow import load_model

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


@pytest.mark.slow
def test_mutants_are_given_to_tests_of_their_module_and_of_what_it_is_for() -> None:
    importers = runpy.run_path(str(ROOT / "benchmarks" / "mutants.py"))["Importers"](ROOT)
    files = importers.files("diagnosis/fitting.py", 6)
    assert files[0] == "test_diagnosis_fitting.py" and "test_diagnosis_budget.py" in files
    assert len(files) == len(set(files)) == 6
    assert importers.files("effects/command.py", 3)[0] == "test_command_laws.py"


@pytest.mark.long
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


@pytest.fixture
def benchmark_modules(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[str], ModuleType]]:
    """Modules of the benchmarks by name, forgotten again afterwards."""
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    yield importlib.import_module
    for name in ("_peers", "_controller_works"):
        sys.modules.pop(name, None)


def test_lines_that_a_user_writes_are_those_with_code(benchmark_modules: Callable[[str], ModuleType]) -> None:
    source = 'class A:\n    """Two lines\n    of words."""\n\n    # why\n    x = (\n        1,\n    )  # fmt\n'
    assert benchmark_modules("_peers").code_lines(source) == 4


def test_a_filtered_difference_finds_the_rate_of_a_ramp(benchmark_modules: Callable[[str], ModuleType]) -> None:
    own = benchmark_modules("_peers").FilteredDifference(0.01, 0.02)
    found = [own(np.array([0.3 * k * 0.01, -k * 0.02])) for k in range(60)]
    np.testing.assert_allclose(found[-1], [0.3, -2.0], rtol=1e-6)
    assert np.abs(found[1]).max() < 1.0  # behind a low-pass


@pytest.mark.slow
def test_controllers_are_driven_and_scored_alike_whoever_wrote_them(
    benchmark_modules: Callable[[str], ModuleType],
) -> None:
    """python-control comes with this package; what falls is told from what stands."""
    works = benchmark_modules("_controller_works")
    work = works.stabilise()
    short = dataclasses.replace(
        work, scenario=dataclasses.replace(work.scenario, duration=3.0, score_window=(2.0, 3.0))
    )
    row, done = works.driven(short, "python-control", work.model, 0, 0)
    assert not row.failure and 0.5 < row.arrival < 2.0 and row.rmse < 0.02 and row.median < 0.01
    assert done is not None and len(done.time) == 300
    idle = dataclasses.replace(short, makers={"idle": lambda seed: lambda observation, reference: np.zeros(1)})
    assert works.driven(idle, "idle", work.model, 0, 0)[0].failure == "not there by the end"


@pytest.mark.slow
def test_the_pid_beside_others_is_tuned_and_kept(
    benchmark_modules: Callable[[str], ModuleType], tmp_path: Path
) -> None:
    works = benchmark_modules("_controller_works")
    model, fed = load_model(ROOT / "docs" / "examples" / "pendulum.xml"), {"feedforward": False, "inverse": False}
    found = works.tuned(model, fed, 2, 0, tmp_path / "gains.toml")
    assert found.gains["hinge"].kp > 0 and not found.feedforward and not found.inverse
    assert works.tuned(model, {}, 2, 0, tmp_path / "gains.toml") == found, "read again"


def test_masses_differ_and_commands_are_late_where_a_work_says_so(
    benchmark_modules: Callable[[str], ModuleType],
) -> None:
    works = benchmark_modules("_controller_works")
    spread = dataclasses.replace(works.stabilise(), spread=True)
    robots = spread.robots(3, 1)
    masses = np.array([own.robot.parameters()["pole.mass"] for own in robots])
    assert len(set(masses)) == 3 and np.all(np.abs(masses / 0.1 - 1) <= works.MASS)
    assert all(effect.parameters()["delay"] == works.LATE for own in robots for effect in own.effects)
    assert spread.robots(3, 1)[0].robot.parameters() == robots[0].robot.parameters()


@pytest.mark.parametrize(
    ("script", "package"), [("nmpc.py", "do_mpc"), ("hardware.py", "cyclonedds")], ids=["do-mpc", "dds"]
)
def test_a_benchmark_says_what_it_lacks_before_it_begins(
    script: str, package: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("rich")
    found = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name, *more: None if name == package else found(name, *more)
    )
    monkeypatch.setattr(sys, "argv", [script])
    monkeypatch.setenv("CYCLONEDDS_URI", "")
    own = runpy.run_path(str(ROOT / "benchmarks" / script))
    with pytest.raises(SystemExit, match="is not installed; get it with: pip install"):
        own["main"]()
    assert capsys.readouterr().out == ""


@pytest.mark.parametrize(
    ("script", "folder"), [("machines.py", "--robots"), ("real_machines/run.py", "--converted")]
)  # fmt: skip
def test_a_benchmark_says_which_recordings_are_absent_before_it_begins(
    script: str, folder: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", [script, folder, str(tmp_path)])
    own = runpy.run_path(str(ROOT / "benchmarks" / script))
    with pytest.raises(SystemExit, match="there is no such"):
        own["main"]()
    assert capsys.readouterr().out == "" and not list(tmp_path.iterdir())
