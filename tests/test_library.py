"""What ``import equimus_ctrl as eq`` offers: one call a verb, a small result, nothing that happens unasked."""

from __future__ import annotations

import ast
import doctest
import inspect
import os
import re
import subprocess
import sys
import typing
from collections.abc import Callable
from dataclasses import fields, is_dataclass
from functools import cache
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from matplotlib.figure import Figure

import equimus_ctrl as eq
from equimus_ctrl import frames, workflow
from equimus_ctrl.errors import ConfigError, NotAvailable
from equimus_ctrl.identification.uncertainty import uncertainty
from equimus_ctrl.shown import LONGEST, Short

ROOT = Path(__file__).resolve().parents[1]
PENDULUM = eq.load_model(ROOT / "docs" / "examples" / "pendulum.xml")
PACKAGE = ROOT / "equimus_ctrl"
VERBS = (
    "check", "compare", "design_experiment", "diagnose", "export_model", "identify", "linearise", "list_names", "prove",
    "run_experiments", "run_scenario", "score", "sensitivity", "train", "tune",
    "validate",
)  # fmt: skip
"""Of ``equimus-ctrl``, as functions that give a result."""
FUNCTIONS = sorted(name for name in eq.__all__ if inspect.isfunction(getattr(eq, name)))
CLASSES = sorted(name for name in eq.__all__ if inspect.isclass(getattr(eq, name)))


@cache
def runs() -> tuple[eq.Recording, ...]:
    """What it did."""
    return eq.read_recordings(ROOT / "docs" / "examples" / "pendulum", PENDULUM)


def result_of(verb: str) -> type[Any]:
    """The class that a verb gives."""
    function = getattr(eq, verb)
    kind = eval(function.__annotations__["return"], function.__globals__)  # what it is given may be known to mypy alone
    return typing.cast("type[Any]", kind)


# --- names


IDENTITY = """
import importlib, inspect, pkgutil, sys
import equimus_ctrl as eq
from equimus_ctrl import workflow
def kinds():
    return {{(m.__name__, n): type(getattr(m, n)).__name__ for m in (eq, workflow) for n in m.__all__}}
before = kinds() if {first} else None
for found in pkgutil.walk_packages(eq.__path__, "equimus_ctrl."):
    if not found.name.endswith("__main__") and "_presets" not in found.name:
        importlib.import_module(found.name)
after = kinds()
assert before in (None, after), {{k: (before[k], v) for k, v in after.items() if before[k] != v}}
wrong = [k for k, kind in after.items() if kind == "module" and k[1] != "testing"]
assert not wrong, wrong
"""


@pytest.mark.slow
@pytest.mark.parametrize("first", [True, False], ids=["names first", "modules first"])
def test_a_function_stays_one_whatever_is_imported(first: bool) -> None:
    """A module of the same name would hide it once somebody imports that."""
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", IDENTITY.format(first=first)], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr


def test_former_names_are_the_same_functions() -> None:
    assert all(getattr(eq, former) is getattr(eq, name) for former, name in eq.FORMER.items())
    assert not set(eq.FORMER) & set(dir(eq)), "and nobody is offered them any more"
    with pytest.raises(AttributeError):
        _ = eq.diagnosse  # type: ignore[attr-defined]


@pytest.mark.parametrize("name", FUNCTIONS)
def test_every_function_says_what_it_takes(name: str) -> None:
    function = getattr(eq, name)
    text = inspect.getdoc(function) or ""
    assert text.split("\n")[0].endswith((".", "?")), "one line that ends"
    parameters = [p for p in inspect.signature(function).parameters.values() if p.name not in ("self", "cls")]
    if len(parameters) > 1:
        asked, _, rest = text.partition("Args:\n")
        assert rest, f"{name} does not say what it is given: {asked}"
        told = {line.strip().split(":")[0].lstrip("*") for line in rest.splitlines() if ":" in line}
        assert {p.name for p in parameters} <= told
    if name in VERBS or name.startswith(("read_", "write_", "load_", "export_")):
        assert "Raises:\n" in text


@pytest.mark.parametrize("name", CLASSES)
def test_every_class_says_what_it_is(name: str) -> None:
    kind = getattr(eq, name)
    assert kind.__doc__ and not kind.__doc__.startswith(f"{name}("), "not the signature that dataclasses write"


# --- results


@pytest.mark.parametrize("verb", VERBS)
def test_every_result_is_frozen_shows_itself_in_a_line_and_is_plain_data_when_asked(verb: str) -> None:
    kind = result_of(verb)
    assert is_dataclass(kind) and kind.__dataclass_params__.frozen  # type: ignore[attr-defined]
    assert kind.__repr__ is Short.__repr__ or "repr" in inspect.getsource(kind)
    assert hasattr(kind, "to_dict") or hasattr(kind, "as_json")


def holds_arrays(kind: type[Any], seen: tuple[type[Any], ...] = ()) -> bool:
    """Whether values of a dataclass have arrays somewhere in them."""
    for own in fields(kind):
        text = str(own.type)
        if any(word in text for word in ("Array", "NDArray", "ndarray", "Recording", "Model", "Morphology", "Robot")):
            return True
    return False


@pytest.mark.parametrize(
    "name", [n for n in CLASSES if is_dataclass(getattr(eq, n)) and not issubclass(getattr(eq, n), eq.Effect)]
)
def test_no_class_that_is_offered_prints_arrays(name: str) -> None:
    kind = getattr(eq, name)
    if holds_arrays(kind) and "reference" not in name.lower():
        assert issubclass(kind, Short) or "__repr__" in vars(kind), f"{name} would print what it holds"


def made() -> dict[str, Callable[[], Any]]:
    """Name → what makes a value, in a second or two."""
    trials = runs()
    return {
        "model": lambda: PENDULUM,
        "robot": lambda: PENDULUM.robot,
        "leg": eq.nominal_leg,
        "recording": lambda: trials[0],
        "check": lambda: eq.check(trials, PENDULUM, quick=True),
        "compare": lambda: eq.compare(["hold"], ["pid"], ["nominal"], scenario_options={"duration": "0.5"}),
        "identify": lambda: eq.identify(trials, PENDULUM, free=["*.damping"], folds=0),
        "linearise": lambda: eq.linearise(PENDULUM, {"hinge": 0.1}),
        "list_names": lambda: eq.list_names("effects"),
        "run_scenario": lambda: eq.run_scenario("hold", "pid", options={"duration": "0.5"}),
        "score": lambda: eq.score(trials, PENDULUM),
        "sensitivity": lambda: eq.sensitivity(trials, PENDULUM, parameters=["*.damping"]),
        "tune": lambda: eq.tune("pid", candidates=3, scenarios=["hold"], workers=1),
    }


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """A value of each kind, made in an empty folder; and what was in the folder after."""
    before, state = Path.cwd(), np.random.get_state()[1].tobytes()  # type: ignore[union-attr,index]
    folder = tmp_path_factory.mktemp("empty")
    os.chdir(folder)
    try:
        values = {name: make() for name, make in made().items()}
        values["figures"] = {name: eq.figures(values[name]) for name in FIGURES}
    finally:
        os.chdir(before)
    values["written"] = sorted(path.name for path in folder.rglob("*"))
    values["random"] = state == np.random.get_state()[1].tobytes()  # type: ignore[union-attr,index]
    return values


FIGURES = ("check", "compare", "identify", "run_scenario", "sensitivity", "tune")


@pytest.mark.parametrize("name", made())
def test_a_value_shows_itself_in_a_line(name: str, found: dict[str, Any]) -> None:
    text = repr(found[name])
    assert "\n" not in text and 10 < len(text) <= LONGEST and text.startswith("<") and "array(" not in text


def test_nothing_is_written_and_no_global_generator_is_used(found: dict[str, Any]) -> None:
    assert found["written"] == []
    assert found["random"]


@pytest.mark.parametrize("name", FIGURES)
def test_figures_are_matplotlibs(name: str, found: dict[str, Any]) -> None:
    figures = found["figures"][name]
    assert figures and all(isinstance(figure, Figure) for figure in figures.values())
    first = next(iter(figures))
    assert isinstance(eq.figure(found[name]), Figure)
    with pytest.raises(ConfigError, match=f"there is no figure 'joint_anlges'.*{first}"):
        eq.figure(found[name], "joint_anlges")


def test_of_what_has_no_figures_it_is_said(found: dict[str, Any]) -> None:
    with pytest.raises(ConfigError, match="there are no figures of MjcfRobot, expected one of CheckResult, Comparison"):
        eq.figures(PENDULUM.robot)


# --- the source


NUMPYS = ("np.random", "numpy.random")


def modules() -> list[tuple[Path, ast.Module]]:
    return [
        (path, ast.parse(path.read_text(encoding="utf-8")))
        for path in sorted(PACKAGE.rglob("*.py"))
        if "_presets" not in path.parts
    ]


@pytest.mark.slow
def test_nothing_draws_from_a_global_generator_or_touches_pyplot() -> None:
    own = {"Generator", "default_rng", "SeedSequence", "BitGenerator", "PCG64", "Philox"}
    wrong = []
    for path, tree in modules():
        for node in ast.walk(tree):
            if isinstance(node, ast.Import | ast.ImportFrom):
                names = [node.module or ""] if isinstance(node, ast.ImportFrom) else [a.name for a in node.names]
                bare = {"random", "matplotlib.pyplot"}
                if bare & set(names) or (names == ["matplotlib"] and any(a.name == "pyplot" for a in node.names)):
                    wrong.append(f"{path.name}:{node.lineno}")
            elif isinstance(node, ast.Attribute) and node.attr not in own and ast.unparse(node.value) in NUMPYS:
                wrong.append(f"{path.name}:{node.lineno} {ast.unparse(node)}")
    assert not wrong, wrong


# --- covariance and residuals


def test_the_covariance_is_that_of_the_estimates_and_the_intervals_are_as_wide() -> None:
    """Of a line through white noise, fitted 2000 times; the slopes of both parameters overlap."""
    rng = np.random.default_rng(5)
    x = np.linspace(0, 1, 200)
    columns = np.stack([np.ones_like(x), x], axis=1)
    scale, sigma = np.array([1.0, 1e-3]), 0.2
    true = np.array([2.0, 0.5])
    noises = sigma * rng.standard_normal((2000, len(x)))
    estimates = np.array([np.linalg.lstsq(columns, columns @ true + own, rcond=None)[0] for own in noises])
    fitted, noise = estimates[0], noises[0]
    residual = (columns @ (true - fitted) + noise)[:, None]
    known = uncertainty([columns[:, None, :]], [residual], [np.zeros((200, 1, 0))], ("a", "b"), scale, fitted)
    assert known.covariance == pytest.approx(np.cov(estimates.T), rel=0.35)
    assert np.sqrt(np.diag(known.covariance)) == pytest.approx(known.standard_error)
    assert known.half_width == pytest.approx(known.factor * np.sqrt(np.diag(known.covariance)))


def test_what_is_not_identifiable_has_no_covariance() -> None:
    rng = np.random.default_rng(5)
    seen, same = rng.standard_normal((2, 100))
    columns = np.stack([seen, same, -same], axis=1)[:, None, :]
    residual = rng.standard_normal((100, 1))
    known = uncertainty([columns], [residual], [np.zeros((100, 1, 0))], ("a", "b", "c"), np.ones(3), np.ones(3))
    assert np.isfinite(known.covariance[0, 0]) and np.all(np.isinf(np.diag(known.covariance)[1:]))
    assert np.all(np.isnan(known.covariance[0, 1:])) and np.isnan(known.covariance[1, 2])


def test_of_an_identification(found: dict[str, Any]) -> None:
    done = found["identify"]
    own, fit = done.covariance, done.trials.fit
    assert own.names == tuple(fit.parameters.names) and own.units == ("N·m·s/rad",)
    assert np.asarray(own).shape == (1, 1)
    assert own.factor * own.standard_error + own.step_error == pytest.approx(fit.uncertainty.half_width)
    assert own.correlation == pytest.approx(np.ones((1, 1)))


def test_residuals_have_the_times_of_their_samples(found: dict[str, Any]) -> None:
    trials, done = runs(), found["identify"]
    residuals = done.trial_residuals()
    assert [own.name for own in residuals] == [trial.name for trial in trials]
    for own, trial in zip(residuals, trials, strict=True):
        assert np.all(np.isin(np.round(own.time, 9), np.round(trial.time, 9))) and own.values.shape == (
            len(own.time),
            1,
        )
    rmse = np.sqrt(np.concatenate([own.values**2 for own in residuals]).mean(axis=0))
    assert rmse == pytest.approx(done.trials.fit.rmse)
    before = done.trial_residuals("initial")
    assert (
        np.concatenate([own.values for own in before]).std() > np.concatenate([own.values for own in residuals]).std()
    )
    with pytest.raises(ConfigError, match="there is no state of the model 'first'"):
        done.trial_residuals("first")


def test_residuals_of_a_score_are_measured_less_predicted(found: dict[str, Any]) -> None:
    score = found["score"]
    for own, trial in zip(score.trial_residuals(), score.trials, strict=True):
        assert np.array_equal(own.values, trial.recording.position - trial.predicted)
        assert np.array_equal(own.time, trial.recording.time)
        assert own.rmse == pytest.approx(trial.rmse)


# --- data frames


FRAMES = ("recording", "compare", "identify", "linearise", "list_names", "run_scenario", "score", "sensitivity", "tune")


@pytest.mark.parametrize("name", FRAMES)
def test_rows_become_a_data_frame(name: str, found: dict[str, Any]) -> None:
    pytest.importorskip("pandas")
    frame = found[name].to_dataframe()
    assert len(frame) and len(frame.columns) > 1


def test_a_recording_as_a_data_frame_has_its_columns() -> None:
    pytest.importorskip("pandas")
    trial = runs()[0]
    frame = trial.to_dataframe()
    assert frame.index.name == "time" and list(frame.columns) == ["cmd.motor", "pos.hinge"]
    assert np.array_equal(frame["pos.hinge"], trial.position[:, 0])


def test_without_pandas_a_sentence_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(NotAvailable, match=r"a data frame needs the pandas library.*'equimus-ctrl\[pandas\]'"):
        frames.dataframe([{"a": 1}])


# --- linear models


def test_a_linear_model_has_the_pendulums_poles() -> None:
    """About its lower rest: ω² = m g l/J, whatever pushes it."""
    own = eq.linearise(PENDULUM, [0.0])
    assert own.states == ("pos_hinge", "vel_hinge") and own.inputs == ("cmd_motor",)
    told = mujoco.MjModel.from_xml_path(str(ROOT / "docs" / "examples" / "pendulum.xml"))
    arm = told.body("arm")
    inertia = arm.inertia[1] + arm.mass[0] * float(arm.ipos @ arm.ipos) + told.joint("hinge").armature[0]
    frequency = np.sqrt(arm.mass[0] * 9.81 * abs(arm.ipos[2]) / inertia)
    assert np.abs(own.poles) == pytest.approx([frequency, frequency], rel=1e-6)
    assert np.sort_complex(own.system.poles()) == pytest.approx(np.sort_complex(own.poles))
    assert own.to_dict()["pose"] == {"hinge": 0.0}


@pytest.mark.parametrize(
    ("pose", "sentence"),
    [
        ({"hnige": 0.0}, "there is no joint 'hnige'; did you mean 'hinge'"),
        ({}, "the pose lacks hinge, expected a position of each joint"),
        ([0.0, 1.0], r"the pose has shape \(2,\), expected \(1,\): hinge"),
    ],
)
def test_a_pose_that_cannot_be_is_refused(pose: Any, sentence: str) -> None:
    with pytest.raises(ConfigError, match=sentence):
        eq.linearise(PENDULUM, pose)


# --- files, where they are asked for


def test_what_is_there_is_not_replaced_unless_that_is_asked_for(tmp_path: Path) -> None:
    trial = runs()[0]
    path = eq.write_recording(tmp_path / "one.csv", trial)
    with pytest.raises(ConfigError, match="is there already"):
        eq.write_recording(path, trial)
    assert eq.write_recording(path, trial, force=True) == path
    assert np.array_equal(eq.read_recordings(path, PENDULUM)[0].position, trial.position)
    assert [own.rows for own in eq.check_recordings(path, PENDULUM)] == [len(trial.time)]
    assert len(eq.write_recordings([trial], tmp_path / "set")) == 1


def test_tuned_settings_are_written_where_it_is_said(found: dict[str, Any], tmp_path: Path) -> None:
    tuned = found["tune"]
    path = tuned.save(tmp_path / "mine.toml")
    with pytest.raises(ConfigError, match="is there already"):
        tuned.save(path)
    kept = eq.tune("pid", candidates=3, scenarios=["hold"], workers=1, folder=tmp_path / "all")
    assert sorted(p.name for p in (tmp_path / "all").iterdir()) == ["journal.jsonl", "pid.toml", "record.json"]
    assert kept.result.settings == tuned.result.settings
    driven = eq.run_scenario("hold", tuned.made(), options={"duration": "0.2"})
    other = eq.run_scenario("hold", "pid", settings=path, options={"duration": "0.2"})
    assert np.array_equal(driven.run.command, other.run.command)


# --- the documents


def test_the_help_begins_with_ten_things() -> None:
    """Each an example whose names there are; that they run, the next test sees."""
    examples = doctest.DocTestParser().get_examples(eq.__doc__ or "")
    names = {
        node.attr
        for own in examples
        for node in ast.walk(ast.parse(own.source))
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "eq"
    }
    assert len(names) == 10 and names <= set(eq.__all__)
    assert set(VERBS) <= names | set(re.findall(r"``eq\.(\w+)``", eq.__doc__ or ""))


@pytest.mark.slow
def test_the_helps_examples_run(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)
    flags = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE
    test = doctest.DocTestParser().get_doctest(eq.__doc__ or "", {"eq": eq}, "equimus_ctrl", None, 0)
    failed, tried = doctest.DocTestRunner(optionflags=flags).run(test)
    assert tried >= 10 and not failed


@pytest.mark.slow
def test_the_pages_examples_run(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """All of docs/library.md, one after the other, in a folder of their own."""
    text = (ROOT / "docs" / "library.md").read_text(encoding="utf-8")
    blocks = [part.split("```")[0] for part in text.split("```python\n")[1:]]
    assert len(blocks) > 5
    (tmp_path / "docs").symlink_to(ROOT / "docs")
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    for block in blocks:
        exec(compile(block, "docs/library.md", "exec"), names)
    assert {path.name for path in tmp_path.iterdir()} == {"docs", "out"}, "and only there is anything written"


def test_every_verb_of_the_command_has_its_function() -> None:
    assert {verb for verb in VERBS if verb not in workflow.__all__} == set()
