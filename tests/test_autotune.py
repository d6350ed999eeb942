"""Tuning from study to result: limits that hold, bits that repeat, and interruptions of every kind."""

from __future__ import annotations

import json
import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import equimus_ctrl as eq
from equimus_ctrl import presets, workflow
from equimus_ctrl.errors import NothingFeasible
from equimus_ctrl.executors.where import Where
from equimus_ctrl.tuning import autotune as tuning
from equimus_ctrl.tuning.autotune import autotune, best_feasible
from equimus_ctrl.tuning.ensemble import make_ensemble
from equimus_ctrl.tuning.evaluation import Evaluation
from equimus_ctrl.tuning.journal import RowJournal
from equimus_ctrl.tuning.objective import Problem, make_task
from equimus_ctrl.tuning.result import TuningResult
from equimus_ctrl.tuning.search import Trial
from equimus_ctrl.tuning.study import EnsembleSettings, Limits, Study, Weights, study_from_dict

STUDY: dict[str, Any] = {
    "seed": 5,
    "candidates": 40,
    "objectives": [{"scenario": "hold", "duration": 2.5}],
    "limits": {"overshoot": 0.6},
    "ensemble": {"members": 3, "unseen": 2, "delay": [0.0, 0.04], "lag": [0.02, 0.06]},
    "search": {
        "kp": {"low": 5.0, "high": 3000.0, "start": 150.0},
        "ki": {"low": 5.0, "high": 5000.0, "start": 200.0},
        "kd": {"low": 0.2, "high": 200.0, "start": 5.0},
        "derivative_time": {"low": 0.005, "high": 0.1, "start": 0.02},
    },
}


class Rows:
    """A store in memory that keeps rows as a file would."""

    def __init__(self, rows: Sequence[dict[str, Any]] = ()) -> None:
        self.rows = list(rows)

    def append(self, row: Any) -> None:
        self.rows.append(json.loads(json.dumps(row)))

    def truncate(self, count: int) -> None:
        del self.rows[count:]


@pytest.fixture(scope="module")
def study() -> Study:
    return study_from_dict(STUDY)


@pytest.fixture(scope="module")
def problem(study: Study) -> Problem:
    model = eq.nominal_model()
    return tuning.make_problem(study, model, [workflow.load_scenario("hold", model.morphology, search=False)])


@pytest.fixture(scope="module")
def rows() -> Rows:
    return Rows()


@pytest.fixture(scope="module")
def result(study: Study, problem: Problem, rows: Rows) -> TuningResult:
    return autotune(study, problem, RowJournal(rows))


def bits(history: Sequence[Trial]) -> list[str]:
    return [json.dumps(trial.to_dict()) for trial in history]


# What is found.


def test_the_result_is_the_cheapest_within_the_limits(result: TuningResult, study: Study) -> None:
    best = result.best.evaluation
    assert best.stable and best.feasible and best.modulus <= study.limits.modulus and best.raised_modulus < 1
    assert best.overshoot <= study.limits.overshoot and best.saturation <= study.limits.saturation
    cheaper = [t for t in result.history if t.evaluation.feasible and t.evaluation.cost < best.cost]
    assert not cheaper or not all(result.problem.verified(_settings(result, t)) for t in cheaper)
    assert len(result.history) == study.candidates and not result.interrupted
    assert best.cost <= result.start_evaluation.cost


def _settings(result: TuningResult, trial: Trial) -> eq.PidSettings:
    return replace(result.study.settings(np.array(trial.values), ("maa", "baa")), lateness=result.problem.lateness)


def test_the_settings_are_those_of_the_best(result: TuningResult) -> None:
    assert result.settings == _settings(result, result.best)
    np.testing.assert_allclose(result.history[0].values, [150, 200, 5, 150, 200, 5, 0.02], rtol=1e-9)
    assert result.start == _settings(result, result.history[0])
    assert result.start_evaluation is result.history[0].evaluation


def test_it_works_on_the_plant(result: TuningResult) -> None:
    """Also what the tuner saw: the two engines agree, and the tuned leg comes to rest where it should."""
    assert [check.scenario for check in result.checks] == ["hold"]
    assert result.checks[0].difference < 1e-3
    run = eq.run(
        eq.MujocoPlant(eq.nominal_model()), eq.PidController(result.settings), eq.HoldReference([1.57, 0.05]), 8.0
    )
    np.testing.assert_allclose(run.position[-1], [1.57, 0.05], atol=0.01)


def test_margins_leave_the_room_that_was_asked_for(result: TuningResult) -> None:
    assert [m.actuator for m in result.margins] == [m.actuator for m in result.least_margins] == ["maa", "baa"]
    for own, least in zip(result.margins, result.least_margins, strict=True):
        assert least.gain <= own.gain and least.phase <= own.phase and least.delay <= own.delay
        assert least.gain > 1 and least.delay > 0


def test_with_an_inverse_it_is_told_of_the_model(study: Study) -> None:
    """The same study, whose legs are then followed closely from the first gains on, and on the plant too."""
    model = eq.Model(eq.nominal_leg(), (eq.DeadZone("maa", 4e3), eq.SensorOffset("knee", 0.05)))
    scenarios = [workflow.load_scenario("hold", model.morphology, search=False)]
    results = []
    for inverse in (False, True):
        small = replace(study, inverse=inverse, candidates=8, ensemble=replace(study.ensemble, unseen=1))
        results.append(autotune(small, tuning.make_problem(small, model, scenarios), RowJournal(Rows())))
    static, informed = results
    assert informed.settings.inverse and not static.settings.inverse
    assert informed.best.evaluation.terms["error"] < 0.9 * static.best.evaluation.terms["error"]
    assert informed.checks[0].difference < 1e-3
    assert informed.record()["study"]["inverse"] is True
    assert len(informed.unseen) == 1


def test_other_legs_judge_it(result: TuningResult, problem: Problem, study: Study) -> None:
    assert len(result.unseen) == len(result.start_unseen) == study.ensemble.unseen
    assert all(len(e.member_costs) == 1 for e in result.unseen)
    others = tuning.unseen_problem(problem, study)
    tuned_on = {leg.parameters.tobytes() for leg in problem.members}
    assert len(others.members) == 2 and all(leg.parameters.tobytes() not in tuned_on for leg in others.members)
    one = replace(others, members=[others.members[1]], _starts={}, _legs={})
    again = one.judge(one.leg_outcomes([(result.settings, 0)], raised=False))
    assert repr(again.to_dict()) == repr(result.unseen[1].to_dict())


def test_the_record_is_json_and_holds_everything(result: TuningResult) -> None:
    record = json.loads(presets.json_text(result.record()))
    assert record["schema"] == "equimus-ctrl/tuning-record/1" and record["seed"] == 5
    assert record["interrupted"] is False and record["evaluated"] == len(record["evaluations"]) == 40
    assert set(record["versions"]) >= {"python", "equimus-ctrl", "numpy", "mujoco", "numba"}
    assert "unknown" not in record["versions"].values()
    assert record["settings"] == result.settings.to_dict()
    assert eq.PidSettings.from_dict(record["settings"]) == result.settings
    assert record["evaluations"][record["best"]["index"]] == record["best"]
    assert record["study"]["search"]["kp"] == {**STUDY["search"]["kp"], "scale": "log"}
    assert study_from_dict({k: v for k, v in record["study"].items() if v is not None}) == result.study
    assert record["unseen"]["legs"] == 2 and len(record["unseen"]["costs"]) == 2
    each = [e.member_costs[0] if e.stable else None for e in result.start_unseen]
    assert record["unseen"]["start_worst"] == (None if None in each else max(each))
    assert [m["actuator"] for m in record["margins"]] == ["maa", "baa"]
    assert set(record["mujoco"][0]["rmse_rad"]) == {"hip", "knee"}
    for k, row in enumerate(record["evaluations"]):
        assert row["index"] == k and len(row["values"]) == 7


# The same bits.


def test_the_same_seed_gives_the_same_bits_on_any_number_of_threads(
    study: Study, problem: Problem, result: TuningResult
) -> None:
    again = autotune(study, replace(problem, _starts={}, _legs={}), RowJournal(Rows()), where=Where(1))
    assert bits(again.history) == bits(result.history) and again.settings == result.settings


def test_another_seed_gives_others(study: Study, problem: Problem, result: TuningResult) -> None:
    other = autotune(replace(study, seed=6, candidates=10), problem, RowJournal(Rows()))
    assert bits(other.history[1:10]) != bits(result.history[1:10])


# Batches of this study end after 1, 7, 16 and 25 candidates, so that 6 leaves one alone of its batch.
@pytest.mark.parametrize("kept", [1, 6, 25, 39])
def test_it_goes_on_with_the_same_bits(
    kept: int, study: Study, problem: Problem, result: TuningResult, rows: Rows
) -> None:
    later = Rows(rows.rows[:kept])
    again = autotune(study, problem, RowJournal(later))
    assert bits(again.history) == bits(result.history)
    assert sum(trial.reused for trial in again.history) == kept
    assert json.dumps(later.rows) == json.dumps(rows.rows)


@pytest.mark.parametrize("kind", [KeyboardInterrupt, RuntimeError])
def test_an_interruption_keeps_the_best_so_far(
    kind: type[BaseException], study: Study, problem: Problem, result: TuningResult, rows: Rows
) -> None:
    def notify(trial: Trial) -> None:
        if trial.index == 19:
            raise kind

    kept = Rows()
    if kind is RuntimeError:
        with pytest.raises(RuntimeError):
            autotune(study, problem, RowJournal(kept), notify)
    else:
        stopped = autotune(study, problem, RowJournal(kept), notify)
        assert stopped.interrupted and stopped.record()["interrupted"] is True
        assert bits(stopped.history) == bits(result.history)[:20]
        feasible = [t for t in result.history[:20] if t.evaluation.feasible]
        assert stopped.best.evaluation.cost == min(t.evaluation.cost for t in feasible)
    assert json.dumps(kept.rows) == json.dumps(rows.rows[:20])


def test_an_interruption_before_anything_was_tried_is_one(study: Study, problem: Problem) -> None:
    class Impatient(RowJournal):
        def known(self, index: int, values: Sequence[float]) -> Evaluation | None:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        autotune(study, problem, Impatient(Rows()))


# Limits that nothing gets round.


HOLD = eq.Scenario("hold", "", 2.0, eq.HoldReference([1.5, 0.6]), step_like=True)
MOVE = eq.Scenario(
    "move",
    "",
    1.5,
    eq.FunctionReference(lambda t: (1.5 - 0.1 * math.cos(2 * t), 0.5 + 0.1 * math.sin(2 * t))),
    start=eq.Start(command=[14e3, 6e3], position=[1.4, 0.5]),
)


def gains(kp: float, ki: float, kd: float) -> eq.PidSettings:
    return eq.PidSettings({"maa": eq.PidGains(kp, ki, kd), "baa": eq.PidGains(kp / 2, ki / 2, kd / 2)})


def crowd(scenario: eq.Scenario) -> Problem:
    """Five legs with quick valves and one, not the hardest by its numbers, whose valves are late."""
    model = eq.nominal_model()
    legs = make_ensemble(model, EnsembleSettings(members=6, delay=(0.0, 0.02), lag=(0.02, 0.04)), 6, 2)
    legs[3] = replace(legs[3], name="late", valve=np.array([[0.12, 0.1, 0.1, np.inf, np.inf, 0.0]] * 2))
    only_error = Weights(error=10, overshoot=0, settling=0, offset=0, effort=0, chatter=0, worst=0)
    wide = Limits(overshoot=9.0, saturation=1.0, modulus=0.9999, gain_margin=1.0)
    return Problem(model, legs, [make_task(scenario, 1.0, 0.0, model, 0.0, 0)], only_error, wide)


def trial(index: int, evaluation: Evaluation) -> Trial:
    return Trial(index, "start", (float(index),), evaluation, False)


@pytest.mark.parametrize("scenario", [HOLD, MOVE], ids=["seen in simulation", "seen in the linear loop only"])
def test_the_best_on_average_is_not_taken_where_it_is_unstable_on_one_leg(scenario: eq.Scenario) -> None:
    from concurrent.futures import ThreadPoolExecutor

    problem = crowd(scenario)
    eager, gentle = gains(800, 500, 20), gains(300, 200, 10)
    mean = [np.mean([problem.outcome(g, i, 0).terms[0] for i in range(6)]) for g in (eager, gentle)]
    assert mean[0] < mean[1], "the eager gains should follow better on average, the unstable leg included"
    assert [problem.moduli(eager, i)[0] >= 1 for i in range(6)] == [False, False, False, True, False, False]
    with ThreadPoolExecutor(2) as pool:
        found = list(problem.evaluate([eager, gentle], pool))
    assert not found[0].stable and not found[0].feasible and found[1].feasible
    history = [trial(k, evaluation) for k, evaluation in enumerate(found)]
    assert best_feasible(history) is history[1]
    with pytest.raises(NothingFeasible) as caught:
        best_feasible(history[:1])
    assert str(caught.value) == (
        "none of 1 sets of gains is stable and within the limits on every leg; the nearest is unstable on some leg"
    )


def judged(cost: float, feasible: bool = True, stable: bool = True) -> Evaluation:
    return Evaluation(cost, {}, (), 0.123, 0.45, 0.99812, 1.00234, stable, feasible)


def test_the_cheapest_feasible_and_verified_is_taken() -> None:
    costs = [(3.0, True), (1.0, False), (2.0, True), (0.5, False), (2.5, True)]
    history = [trial(k, judged(cost, feasible)) for k, (cost, feasible) in enumerate(costs)]
    assert best_feasible(history).index == 2
    asked: list[int] = []

    def verified(t: Trial) -> bool:
        asked.append(t.index)
        return t.index == 0

    assert best_feasible(history, verified).index == 0
    assert asked == [2, 4, 0]


def test_what_the_nearest_lacked_is_told() -> None:
    history = [trial(0, judged(1e6, False, False)), trial(1, judged(1100.0, False))]
    with pytest.raises(NothingFeasible) as caught:
        best_feasible(history)
    said = str(caught.value)
    assert said.startswith("none of 2 sets of gains is stable and within the limits on every leg; the nearest ")
    for part in ("overshoots by 12 %", "saturated 45 % of the time", "0.9981", "1.0023 with the gain margin"):
        assert part in said
    with pytest.raises(NothingFeasible, match="stopped before any sets of gains were tried"):
        best_feasible([])


def test_a_result_that_only_failed_verification_is_told_apart() -> None:
    fine = Evaluation(1.0, {}, (), 0.01, 0.0, 0.99, 0.995, True, True)
    with pytest.raises(NothingFeasible) as caught:
        best_feasible([trial(0, fine)], lambda t: False)
    assert "within the limits on every leg; the nearest overshoots by 1 %" not in str(caught.value)


def test_verification_looks_along_the_whole_way() -> None:
    """A reference whose middle is harmless and whose ends are not: one pose is not enough."""

    def path(t: float) -> tuple[float, float]:
        return (1.6 + 0.4 * abs(t - 0.75) / 0.75, 0.1 + 1.1 * abs(t - 0.75) / 0.75)

    problem = crowd(eq.Scenario("v", "", 1.5, eq.FunctionReference(path)))
    problem = replace(problem, members=problem.members[:3], limits=replace(problem.limits, modulus=0.99999))
    np.testing.assert_allclose(problem.poses()[0], path(0.75), atol=0.02)
    assert len(problem.poses(8)) == 8
    eager, gentle = gains(1400, 300.0, 70), gains(300, 200, 10)
    assert all(problem.moduli(eager, i)[0] < 1 for i in range(3))
    assert not problem.verified(eager) and problem.verified(gentle)


# The fingerprint of a journal.


def test_everything_an_evaluation_depends_on_is_in_the_key(study: Study, problem: Problem) -> None:
    key = tuning.study_key(study, problem)
    assert key == tuning.study_key(study, replace(problem, _starts={}, _legs={}))
    task = problem.tasks[0]
    others = [
        (replace(study, seed=6), problem),
        (replace(study, weights=Weights(error=11.0)), problem),
        (replace(study, limits=Limits(overshoot=0.59)), problem),
        (study, replace(problem, model=eq.Model(eq.nominal_leg().with_parameters({"maa.area": 0.0004})))),
        (study, replace(problem, model=eq.Model(eq.nominal_leg(), (eq.TransportDelay("baa", 0.01),)))),
        (study, replace(problem, tasks=[replace(task, reference=task.reference + 1e-9)])),
        (study, replace(problem, tasks=[replace(task, noise=task.noise + 1e-9)])),
        (study, replace(problem, tasks=[replace(task, command_before=task.command_before + 1.0)])),
    ]
    keys = [tuning.study_key(*other) for other in others]
    assert len({key, *keys}) == len(others) + 1


def test_so_are_the_laws_of_a_user_s_own_effects(study: Study, problem: Problem, tmp_path: Path) -> None:
    text = (Path(__file__).resolve().parents[1] / "docs" / "examples" / "drag.py").read_text(encoding="utf-8")
    keys = []
    for law in (text, text.replace("* rate * ca.fabs(rate)", "* rate**3"), text):
        (tmp_path / "own.py").write_text(law, encoding="utf-8")
        workflow.load_plugins([tmp_path / "own.py"])
        effect = eq.effects.make("quadratic_drag", "knee", {"coefficient": 0.1})
        keys.append(tuning.study_key(study, replace(problem, model=eq.Model(eq.nominal_leg(), (effect,)))))
    assert keys[0] == keys[2] != keys[1]


@pytest.mark.parametrize("change", [{"position": np.array([1.4, 0.5])}, {"step_like": False}])
def test_the_rest_of_a_task_is_in_the_key_too(change: dict[str, Any], study: Study, problem: Problem) -> None:
    other = replace(problem, tasks=[replace(problem.tasks[0], **change)])
    assert tuning.study_key(study, other) != tuning.study_key(study, problem)


# Real processes, really interrupted.


LONG = {
    **STUDY,
    "candidates": 110,
    "polish": 0.9,
    "objectives": [{"scenario": "hold", "duration": 10.0}],
    "limits": {"overshoot": 9.0, "saturation": 1.0, "modulus": 0.99999, "gain_margin": 1.0},
    "ensemble": {**STUDY["ensemble"], "members": 12, "unseen": 0},
}
"""Nelder–Mead from the 20th candidate on, one at a time, so that an interruption has something to interrupt."""


TRIES = 8
"""How often an interruption is tried that came too late."""


class Command:
    """``equimus-ctrl autotune-pid`` on the long study, in a folder of its own."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        presets.write_text(folder / "study.toml", presets.toml_text(LONG))
        self.journal = folder / "results" / "journal.jsonl"
        self.settings, self.record = folder / "pid.toml", folder / "results" / "record.json"

    def start(self) -> subprocess.Popen[str]:
        code = "from equimus_ctrl.cli.main import entry; entry()"
        options = ["--study", "study.toml", "--output", "pid.toml", "--results", "results", "--no-figures", "--json"]
        return subprocess.Popen(
            [sys.executable, "-W", "error", "-c", code, "autotune-pid", *options],
            cwd=self.folder,
            env={**os.environ, "EQUIMUS_RECORDINGS": ""},
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            # What runs in the background of a shell has Ctrl-C ignored, and so have its children.
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
        )

    def rows(self) -> int:
        return max(self.journal.read_bytes().count(b"\n") - 1, 0) if self.journal.exists() else 0

    def at(self, rows: int, act: Callable[[subprocess.Popen[str]], None]) -> tuple[int, str, str]:
        """Start it, act once so many evaluations are on disk, and wait: (exit code, stdout, stderr).

        On a busy machine it may be done before anything was seen on disk; the exit code then is 0.
        """
        process = self.start()
        try:
            while process.poll() is None and self.rows() < rows:
                time.sleep(0.005)
            if process.poll() is None:
                act(process)
            out, err = process.communicate(timeout=120)
        finally:
            process.kill()
            process.wait()
        return process.returncode, out, err

    def finish(self) -> tuple[int, str, str]:
        process = self.start()
        try:
            out, err = process.communicate(timeout=120)
        finally:
            process.kill()
            process.wait()
        return process.returncode, out, err


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    folder = tmp_path_factory.mktemp("uninterrupted")
    presets.write_text(folder / "study.toml", presets.toml_text(LONG))
    tuned = workflow.tune_into("pid", folder / "study.toml", output=folder / "pid.toml", folder=folder)
    found: dict[str, Any] = json.loads(tuned.record.read_text())
    return found


@pytest.mark.slow
def test_a_killed_command_goes_on_where_it_was(tmp_path: Path, uninterrupted: dict[str, Any]) -> None:
    for attempt in range(TRIES):
        command = Command(tmp_path / str(attempt))
        code, out, _ = command.at(30, subprocess.Popen.kill)
        if code != 0 and command.rows() < 110:  # else it was done before
            break
    assert code == -signal.SIGKILL and out == ""
    assert not command.settings.exists() and not command.record.exists()
    kept = command.rows()
    assert 30 <= kept < 110
    with command.journal.open("ab") as journal:
        journal.write(b'{"index": 99, "stage": "nel')  # as if killed within a row
    code, out, err = command.finish()
    assert code == 0, err
    record = json.loads(command.record.read_text())
    assert json.loads(out)["reused"] == kept and f"{kept} evaluations were taken over" in err
    assert record == uninterrupted
    assert command.rows() == 110


@pytest.mark.slow
def test_ctrl_c_keeps_the_best(tmp_path: Path, uninterrupted: dict[str, Any]) -> None:
    for attempt in range(TRIES):
        command = Command(tmp_path / str(attempt))
        code, out, err = command.at(30, lambda process: process.send_signal(signal.SIGINT))
        if code != 0:  # else it was done before
            break
    assert code == 130 and "Traceback" not in err, err
    said, record = json.loads(out), json.loads(command.record.read_text())
    assert said["interrupted"] is record["interrupted"] is True
    done = record["evaluated"]
    assert 30 <= done < 110 and record["evaluations"] == uninterrupted["evaluations"][:done]
    assert f"stopped after {done} of 110 sets of gains: the best so far was kept" in " ".join(err.split())
    settings = eq.PidSettings.from_dict(presets.read_toml(command.settings))
    assert settings.to_dict() == record["settings"]
    feasible = [row["cost"] for row in record["evaluations"] if row["feasible"]]
    assert record["best"]["cost"] == min(feasible)
    # The interrupt may fall between a row's writing and its counting; such a row is taken over by the next run.
    assert done <= command.rows() <= done + 1
