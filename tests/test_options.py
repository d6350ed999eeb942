"""Options of verbs: what the command line offers is what the library takes, with the same defaults."""

from __future__ import annotations

import inspect
from dataclasses import FrozenInstanceError, fields, replace
from pathlib import Path
from typing import Any, get_args

import pytest
import typer

from equimus_ctrl import workflow
from equimus_ctrl.cli import (
    autotune,
    check,
    compare,
    diagnose,
    experiment,
    export,
    identify,
    prove,
    score,
    sensitivity,
    train,
    validate,
)
from equimus_ctrl.cli.experiment_run import run as run_experiments
from equimus_ctrl.cli.main import app, main
from equimus_ctrl.cli.model_choice import ModelChoice
from equimus_ctrl.cli.options import filled
from equimus_ctrl.diagnosis.policy import SearchSettings
from equimus_ctrl.errors import ConfigError, EquimusError
from equimus_ctrl.options import (
    EXCITATIONS,
    KINDS,
    AutotuneOptions,
    CheckOptions,
    CompareOptions,
    DesignOptions,
    DiagnoseOptions,
    ExportOptions,
    IdentifyOptions,
    ProveOptions,
    RunExperimentsOptions,
    ScoreOptions,
    SensitivityOptions,
    Shard,
    TrainOptions,
    ValidateOptions,
    offered,
    with_changes,
)
from equimus_ctrl.proof.designs import DURATION, TRIALS
from equimus_ctrl.proof.drawing import Kind
from equimus_ctrl.proof.legs import Excitation
from equimus_ctrl.workflow import proofs, validations

VERBS: dict[str, tuple[Any, type[Any], Any, str, list[str]]] = {
    "autotune": (autotune.autotune, AutotuneOptions, workflow, "tune_into", ["lqr"]),
    "autotune-pid": (autotune.autotune_pid, AutotuneOptions, workflow, "tune_into", []),
    "check": (check.check, CheckOptions, workflow, "check", ["trials"]),
    "compare": (compare.compare, CompareOptions, workflow, "compare", ["hold"]),
    "diagnose": (diagnose.diagnose, DiagnoseOptions, workflow, "diagnose", ["trials"]),
    "experiment design": (experiment.design, DesignOptions, workflow, "design_experiment", ["record.json"]),
    "experiment run": (run_experiments, RunExperimentsOptions, workflow, "run_experiments", []),
    "export": (export.export, ExportOptions, workflow, "export_model", []),
    "identify": (identify.identify, IdentifyOptions, workflow, "identify", ["trials"]),
    "prove": (prove.prove, ProveOptions, proofs, "prove", []),
    "score": (score.score, ScoreOptions, workflow, "score", ["trials"]),
    "sensitivity": (sensitivity.sensitivity, SensitivityOptions, workflow, "sensitivity", ["trials"]),
    "train": (train.train, TrainOptions, workflow, "train", ["kick"]),
    "validate": (validate.validate, ValidateOptions, validations, "validate", []),
}
"""Verb → its function, its options, where the library's function is, that function's name, and what it needs."""
LIBRARY_ONLY = {("identify", "settings")}
"""Fields that are too much for a command line."""
EXAMPLES: dict[str, tuple[str, Any]] = {
    "algorithm": ("--algorithm sac", "sac"),
    "also": ("--also vel.* --also site.tip.x", ["vel.*", "site.tip.x"]),
    "anyway": ("--anyway", True),
    "baselines": ("--no-baselines", False),
    "bounds": ("--bound a=1,2 --bound b=-1e-3,0", {"a": (1.0, 2.0), "b": (-1e-3, 0.0)}),
    "budget": ("--budget 60", 60.0),
    "can": ("--can payload:foot=0.2 --can supply:all=0.8", ["payload:foot=0.2", "supply:all=0.8"]),
    "candidates": ("--candidates 12", 12),
    "by": ("--by folder", "folder"),
    "cases": ("--cases 7", 7),
    "control": ("--control 60", 60.0),
    "controllers": ("-c pid --controller lqr", ["pid", "lqr"]),
    "diagnosis": ("--diagnosis report", Path("report")),
    "draws": ("--draws 5", 5),
    "dt": ("--dt 0.002", 0.002),
    "duration": ("--duration 3.5", 3.5),
    "engine": ("--engine mujoco", "mujoco"),
    "force": ("--force", True),
    "envs": ("--envs 8", 8),
    "evaluations": ("--evaluations 50", 50),
    "excitation": ("--excitation poor", "poor"),
    "experiments": ("--experiments 2", 2),
    "exclude": ("--exclude creep --exclude hysteresis", ["creep", "hysteresis"]),
    "family": ("--family steps --family hold", ["steps", "hold"]),
    "fit_start": ("--no-fit-start", False),
    "fix": ("--fix a.mass", ["a.mass"]),
    "folds": ("--folds 0", 0),
    "folder": ("--results kept", Path("kept")),
    "fresh": ("--fresh", True),
    "free": ("--free a.* --free b", ["a.*", "b"]),
    "heldout": ("--heldout one --heldout two", ["one", "two"]),
    "history": ("--history 5", 5),
    "hyper": ("--hyper gamma=0.9 --hyper policy=x", {"gamma": 0.9, "policy": "x"}),
    "kind": ("--kind pair", "pair"),
    "start": ("--start measured", "measured"),
    "track": ("--track 2.5", 2.5),
    "quick": ("--quick", True),
    "randomise": ("--randomise 20", 0.2),
    "rate": ("--rate 60", 60.0),
    "shares": ("--share 20 --share -5 --share 20", (-0.05, 0.2)),
    "leave_out": ("--leave-out backlash --leave-out creep@maa", ["backlash", "creep@maa"]),
    "limit": ("--limit knee.margin=0.1 --limit maa.high=40e3", {"knee.margin": "0.1", "maa.high": "40e3"}),
    "limits": ("--limits own.toml", Path("own.toml")),
    "mapping": ("--map columns.toml", Path("columns.toml")),
    "most": ("--most 2", 2),
    "noise": ("--noise 0.01", 0.01),
    "output": ("-o mine.toml", Path("mine.toml")),
    "parameters": ("--parameters free.toml", Path("free.toml")),
    "recordings": ("--recordings trials", Path("trials")),
    "robots": ("--robots 9", 9),
    "scenarios": ("--scenario hold --scenario chirp", ["hold", "chirp"]),
    "scenario_options": ("--set duration=2 --set hip=80", {"duration": "2", "hip": "80"}),
    "seconds": ("--seconds 30", 30.0),
    "sensor_noise": ("--sensor-noise vel.hip=0.01", {"vel.hip": 0.01}),
    "settings": ("--settings pid=mine.toml", {"pid": Path("mine.toml")}),
    "merge": ("--merge one --merge two", [Path("one"), Path("two")]),
    "scheduler": ("--scheduler tcp://head:8786", "tcp://head:8786"),
    "seed": ("--seed 9", 9),
    "shard": ("--shard 2/5", Shard(2, 5)),
    "slurm": ("--slurm jobs.toml", Path("jobs.toml")),
    "splits": ("--splits 8", 8),
    "steps": ("--steps 1000", 1000),
    "select": ("--select step_*", ["step_*"]),
    "shoot": ("--shoot 2", 2.0),
    "threads": ("--threads 3", 3),
    "timestep": ("--timestep 0.001", 0.001),
    "trials": ("--trials 2", 2),
    "task_options": ("--set gap=0.1 --set kicker=hand", {"gap": "0.1", "kicker": "hand"}),
    "test": ("--test last", ["last"]),
    "under": ("--condition delayed --condition noisy", ["delayed", "noisy"]),
    "unseen": ("--unseen 4", 4),
    "until": ("--until 20", 20.0),
    "validation": ("--validation step_* --validation chirp", ["step_*", "chirp"]),
    "window": ("--window 5 9", (5.0, 9.0)),
    "workers": ("--workers 2", 2),
    "zero_per_trial": ("--zero-per-trial elbow --zero-per-trial wrist*", ["elbow", "wrist*"]),
}
"""Field → how the command line is told, and what the library is told."""


@pytest.fixture
def told(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> dict[str, Any]:
    """What the library's function of a verb is called with; nothing more happens."""
    found: dict[str, Any] = {}
    monkeypatch.chdir(tmp_path)

    def library(*given: Any, **more: Any) -> None:
        values = [*given, *more.values()]
        (found["options"],) = [value for value in values if type(value).__name__.endswith("Options")]
        raise EquimusError("seen")

    for _, _, module, name, _ in VERBS.values():
        monkeypatch.setattr(module, name, library)
    return found


@pytest.mark.parametrize("verb", VERBS)
def test_every_option_is_a_field_with_the_same_default(verb: str) -> None:
    function, kind, *_ = VERBS[verb]
    command: Any = typer.main.get_command(app)
    for word in verb.split():
        command = command.commands[word]
    parameters = {parameter.name: parameter for parameter in command.params}
    own = set(inspect.signature(function.__wrapped__).parameters) - {"options"}
    if "chosen" in own:
        own = own - {"chosen"} | set(offered(ModelChoice))
    assert own | set(offered(kind)) == set(parameters)
    assert set(offered(kind)) == {f.name for f in fields(kind) if (verb, f.name) not in LIBRARY_ONLY}
    assert filled(kind, {name: parameters[name].default for name in offered(kind)}) == kind()
    assert all(parameters[name].help for name in offered(kind))


@pytest.mark.parametrize("verb", VERBS)
def test_without_options_the_library_is_told_the_defaults(verb: str, told: dict[str, Any]) -> None:
    _, kind, *_, needs = VERBS[verb]
    assert main([*verb.split(), *needs]) == 2
    assert told["options"] == kind()


@pytest.mark.parametrize(("verb", "name"), [(verb, name) for verb, own in VERBS.items() for name in offered(own[1])])
def test_an_option_sets_its_field_and_no_other(verb: str, name: str, told: dict[str, Any]) -> None:
    _, kind, *_, needs = VERBS[verb]
    text, value = EXAMPLES[name]
    if (verb, name) == ("sensitivity", "parameters"):
        text, value = "--parameter baa.* --parameter gravity", ["baa.*", "gravity"]
    if (verb, name) == ("identify", "heldout"):
        value = [Path(item) for item in value]
    assert main([*verb.split(), *needs, *text.split()]) == 2
    assert told["options"] == replace(kind(), **{name: value})
    assert told["options"] != kind()


MODEL_EXAMPLES: dict[str, tuple[str, Any]] = {
    "model": ("--model robot.xml", Path("robot.xml")),
    "lock": ("--lock wrist=0.5 --lock grip", {"wrist": 0.5, "grip": 0.0}),
    "ignore": ("--ignore gripper --ignore box", ["gripper", "box"]),
    "motors": ("--motors", True),
    "prescribe": ("--prescribe base_*", ["base_*"]),
    "unmeasured": ("--unmeasured toe", ["toe"]),
}
"""Of ``ModelChoice``, likewise."""


@pytest.mark.parametrize("verb", [("run", "hold"), ("identify", "trials")], ids=lambda verb: verb[0])
@pytest.mark.parametrize("name", offered(ModelChoice))
def test_a_model_is_chosen_alike_by_every_verb(
    verb: tuple[str, str], name: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    seen: list[dict[str, Any]] = []

    def load(model: Path | None, **more: Any) -> None:
        seen.append({"model": model, **more})
        raise EquimusError("seen")

    monkeypatch.setattr(workflow, "load_model", load)
    text, value = MODEL_EXAMPLES[name]
    assert main([*verb]) == main([*verb, *text.split()]) == 2
    without, given = seen
    assert given == {**without, name: value} and given != without


def test_defaults_that_other_modules_have_too_are_the_same() -> None:
    assert DiagnoseOptions().most == SearchSettings().most_parts
    assert get_args(Kind) == KINDS
    assert f"{TRIALS} by default" in offered(ProveOptions)["trials"].help
    assert f"{DURATION:g} by default" in offered(ProveOptions)["duration"].help
    assert get_args(Excitation) == EXCITATIONS


@pytest.mark.parametrize(
    ("kind", "changes", "sentence"),
    [
        (AutotuneOptions, {"workers": 0}, "workers is 0, expected at least 1"),
        (AutotuneOptions, {"budget": 0.0}, "the budget is 0 s, expected more than 0"),
        (CompareOptions, {"draws": 0}, "draws is 0, expected at least 1"),
        (CompareOptions, {"seed": -1}, "seed is -1, expected at least 0"),
        (DesignOptions, {"draws": 0}, "draws is 0, expected at least 1"),
        (DesignOptions, {"duration": 0.0}, "the duration is 0 s, expected a time above 0"),
        (DesignOptions, {"budget": -1.0}, "the budget is -1 s, expected a time above 0"),
        (DesignOptions, {"sensor_noise": {"vel.hip": 0.0}}, "the noise of vel.hip is 0, expected more than 0"),
        (DiagnoseOptions, {"most": 7}, "the largest number of effects is 7, expected 1 to 6"),
        (DiagnoseOptions, {"until": float("nan")}, "the end of what is fitted is nan s, expected a finite time"),
        (DiagnoseOptions, {"by": "day"}, "by: there is no grouping 'day'"),
        (DiagnoseOptions, {"threads": 0}, "threads is 0, expected at least 1"),
        (DiagnoseOptions, {"mots": 2}, "there is no option 'mots'; did you mean 'most'"),
        (ExportOptions, {"timestep": 0.0}, "the physics step is 0 s, expected 1e-05 to 0.05"),
        (IdentifyOptions, {"folds": -1}, "the cross-validation has -1 folds, expected 0 or more"),
        (IdentifyOptions, {"threads": -2}, "threads is -2, expected at least 1"),
        (ScoreOptions, {"start": "fited"}, "there is no start 'fited'; did you mean 'fitted'?"),
        (ScoreOptions, {"rate": 0.0}, "the rate of the grid is 0 Hz, expected more than 0 and at most 100000"),
        (SensitivityOptions, {"threads": 0}, "threads is 0, expected at least 1"),
        (TrainOptions, {"algorithm": "popo"}, "there is no algorithm 'popo' (known: a2c"),
        (TrainOptions, {"budget": 0.0}, "the budget is 0 s, expected a time above 0"),
        (TrainOptions, {"seed": 1_000_000}, "seed is 1000000, expected 0 to 999,999"),
        (TrainOptions, {"envs": 0}, "envs is 0, expected at least 1"),
        (ValidateOptions, {"seed": -1}, "seed is -1, expected at least 0"),
        (ValidateOptions, {"threads": 0}, "threads is 0, expected at least 1"),
        (ProveOptions, {"cases": 0}, "cases is 0, expected at least 1"),
        (ProveOptions, {"seed": -1}, "seed is -1, expected at least 0"),
        (ProveOptions, {"kind": "singel"}, "there is no kind of ground truth 'singel'; did you mean 'single'"),
        (ProveOptions, {"trials": 0}, "trials is 0, expected at least 1"),
        (ProveOptions, {"duration": 1.9}, "duration is 1.9 s, expected at least 2 s"),
        (ProveOptions, {"duration": float("nan")}, "duration is nan s, expected at least 2 s"),
        (ProveOptions, {"workers": 0}, "workers is 0, expected at least 1"),
        (ProveOptions, {"experiments": -1}, "experiments is -1, expected at least 0"),
        (ProveOptions, {"experiments": 100}, "experiments is 100, expected at most 99"),
        (ProveOptions, {"evaluations": 0}, "evaluations is 0, expected at least 1"),
        (ProveOptions, {"excitation": "por"}, "there is no excitation 'por'; did you mean 'poor'?"),
    ],
)
def test_values_that_cannot_be_are_refused(kind: type[Any], changes: dict[str, Any], sentence: str) -> None:
    with pytest.raises(ConfigError) as refused:
        with_changes(kind, None, changes)
    assert str(refused.value).startswith(sentence)


def test_changes_leave_the_options_as_they_are() -> None:
    options = DiagnoseOptions(most=2)
    assert with_changes(DiagnoseOptions, options, {"until": 5.0}) == DiagnoseOptions(most=2, until=5.0)
    assert options == DiagnoseOptions(most=2)
    with pytest.raises(FrozenInstanceError):
        options.most = 1  # type: ignore[misc]
