"""A diagnosis that is ended gives its best so far, and says what it did not look at."""

from __future__ import annotations

import json
import signal
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from pendulum_runs import MOTOR, PENDULUM, recorded

from equimus_ctrl import workflow
from equimus_ctrl.cli.main import main
from equimus_ctrl.diagnosis import stages
from equimus_ctrl.diagnosis.budget import BudgetSpent
from equimus_ctrl.diagnosis.diagnose import DiagnosisSettings, diagnose
from equimus_ctrl.diagnosis.holdout import Split, split
from equimus_ctrl.diagnosis.hypothesis import default_free_parameters
from equimus_ctrl.diagnosis.results import Diagnosis
from equimus_ctrl.diagnosis.search import Search
from equimus_ctrl.diagnosis.stages import STAGES
from equimus_ctrl.effects.force import CoulombFriction
from equimus_ctrl.effects.joint_friction import QuadraticDamping
from equimus_ctrl.engines.choice import ReducedEngine
from equimus_ctrl.errors import ConfigError
from equimus_ctrl.models.model import Model
from equimus_ctrl.recordings.csvfile import write
from equimus_ctrl.report.diagnosis_text import verdict
from equimus_ctrl.robots.mjcf.robot import MjcfRobot

NOMINAL = Model(MjcfRobot("robot", PENDULUM.format(drive=MOTOR)))


@pytest.fixture(scope="module")
def parts() -> Split:
    """Trials of a pendulum whose model lacks dry friction."""
    return split(NOMINAL, recorded(Model(NOMINAL.robot, [CoulombFriction("hinge", 0.05)]), seed=7))


def asked_after(count: int) -> tuple[Callable[[], bool], list[int]]:
    """Somebody who asks for the best so far at the next step after so many, and how many there were."""
    steps = [0]

    def asked() -> bool:
        steps[0] += 1
        return steps[0] > count

    return asked, steps


def ended(parts: Split, count: int) -> Diagnosis:
    return diagnose(
        default_free_parameters(NOMINAL), parts, settings=DiagnosisSettings(threads=1), asked=asked_after(count)[0]
    )


@pytest.fixture(scope="module")
def whole(parts: Split) -> tuple[Diagnosis, int]:
    """The diagnosis carried out, and how many steps it took."""
    asked, steps = asked_after(10**9)
    shares: list[float] = []
    found = diagnose(
        default_free_parameters(NOMINAL), parts, settings=DiagnosisSettings(threads=1), asked=asked,
        progress=lambda stage, share, best: shares.append(share),
    )  # fmt: skip
    assert shares == sorted(shares) and shares[-1] == 1.0
    return found, steps[0]


def test_the_diagram_of_the_stages_has_them_in_order() -> None:
    assert " → ".join(("refit", *STAGES, "report")) in " ".join(str(stages.__doc__).split())


@pytest.mark.slow
def test_what_is_carried_out_lacks_nothing(whole: tuple[Diagnosis, int]) -> None:
    found, _ = whole
    assert found.verdict == "explained" and found.not_done == ()
    assert not any("not looked at" in note for note in found.notes)


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.2, *(pytest.param(share, marks=pytest.mark.long) for share in (0.5, 0.8))])
def test_the_best_so_far_is_given_with_what_was_not_looked_at(
    parts: Split, whole: tuple[Diagnosis, int], share: float
) -> None:
    full, steps = whole
    found = ended(parts, int(share * steps))
    assert found.not_done and found.not_done == STAGES[-len(found.not_done) :]
    assert found.verdict == "unfinished"
    assert verdict(found).startswith(f"Unfinished, ended in the stage {found.not_done[0]}: so far ")
    assert any(note.startswith("Ended before its end; not looked at: ") for note in found.notes)
    assert any((d.stage, d.decision) == (found.not_done[0], "ended") for d in found.decisions)
    record = found.to_dict()
    assert record["not_done"] == list(found.not_done) and record["verdict"] == "unfinished"
    json.dumps(record)
    # What was known by then is what the whole diagnosis knew.
    assert found.base.deviance == pytest.approx(full.base.deviance, rel=1e-9)
    assert ended(parts, int(share * steps)).to_dict() | {"seconds": 0} == record | {"seconds": 0}


@pytest.mark.long
@pytest.mark.slow
def test_a_search_that_had_found_something_names_it(parts: Split, whole: tuple[Diagnosis, int]) -> None:
    full, steps = whole
    found = [ended(parts, count) for count in (steps - 1, int(0.9 * steps))]
    assert all(f.best.labels == full.best.labels for f in found)


@pytest.mark.slow
def test_intervals_of_discontinuous_parameters_are_had_after_the_end(
    parts: Split, whole: tuple[Diagnosis, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """They are read off a profile, which simulates: a budget that has ended does not end the report."""
    monkeypatch.setattr(CoulombFriction, "discontinuous", ("friction",))
    found = ended(parts, whole[1])
    assert found.not_done and [f.named.effect for f in found.findings] == ["coulomb_friction"]


def test_before_there_is_any_nothing_is_given(parts: Split) -> None:
    with pytest.raises(KeyboardInterrupt):
        ended(parts, 0)
    with pytest.raises(ConfigError, match=r"the budget of 1e-06 s ended before the model was refitted once; expected"):
        diagnose(default_free_parameters(NOMINAL), parts, settings=DiagnosisSettings(threads=1, budget=1e-6))
    for budget in (0.0, -1.0, float("nan"), float("inf")):
        with pytest.raises(ConfigError, match="expected a time above 0"):
            diagnose(default_free_parameters(NOMINAL), parts, settings=DiagnosisSettings(threads=1, budget=budget))


def simulations(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """How many models the engine is given, call by call."""
    own, counts = ReducedEngine.simulate, list[int]()

    def simulate(engine: ReducedEngine, models: Any, *given: Any) -> Any:
        counts.append(len(models))
        return own(engine, models, *given)

    monkeypatch.setattr(ReducedEngine, "simulate", simulate)
    return counts


@pytest.mark.parametrize("count", [1, 4, 9, pytest.param(100, marks=pytest.mark.slow)])
def test_between_two_questions_whether_to_end_lie_few_simulations(
    parts: Split, monkeypatch: pytest.MonkeyPatch, count: int
) -> None:
    """A step's derivatives and what is tried with them, wherever in a fit the time is up."""
    counts = simulations(monkeypatch)
    at = list[int]()

    def asked() -> bool:
        if len(counts) >= count:
            at.append(len(counts))
        return len(counts) >= count

    free = default_free_parameters(NOMINAL)
    found = None
    with suppress(KeyboardInterrupt):  # where it was not refitted once
        found = diagnose(free, parts, settings=DiagnosisSettings(threads=1), asked=asked)
    assert at[0] <= count + 2
    assert found is None or found.not_done == STAGES


def test_a_budget_begins_before_anything_is_simulated(monkeypatch: pytest.MonkeyPatch) -> None:
    counts = simulations(monkeypatch)
    with pytest.raises(ConfigError, match=r"the budget of 1e-09 s ended before the model was refitted once"):
        workflow.diagnose(recorded(NOMINAL, seed=7), NOMINAL, budget=1e-9)
    assert not counts


@pytest.mark.slow
def test_what_was_found_is_confirmed_after_the_end_in_the_torque_domain_too(monkeypatch: pytest.MonkeyPatch) -> None:
    given = recorded(Model(NOMINAL.robot, [QuadraticDamping("hinge", 0.02)]), seed=7)
    found_so_far = False
    own: Any = Search.steps

    def steps(*given: Any) -> Any:
        nonlocal found_so_far
        for state in own(*given):
            found_so_far = bool(state.best.hypothesis)
            yield state
            if found_so_far:
                raise BudgetSpent

    monkeypatch.setattr(Search, "steps", steps)
    found = diagnose(
        default_free_parameters(NOMINAL), split(NOMINAL, given), settings=DiagnosisSettings(threads=1),
        asked=lambda: found_so_far,
    )  # fmt: skip
    assert found.not_done == STAGES and [str(f.named) for f in found.findings] == ["quadratic_damping at hinge"]


@pytest.mark.slow
def test_ctrl_c_gives_the_best_so_far_and_a_second_one_ends_at_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "robot.xml").write_text(PENDULUM.format(drive=MOTOR))
    trials = recorded(Model(NOMINAL.robot, [CoulombFriction("hinge", 0.05)]), seed=7)
    files = []
    for trial in trials:
        files.append(str(tmp_path / f"{trial.name}.csv"))
        write(Path(files[-1]), trial)
    arguments = ["diagnose", *files, "--model", str(tmp_path / "robot.xml"), "--threads", "1", "--json"]
    own: Any = Search.challenge
    pressed = 1

    def challenge(*given: Any) -> Any:
        for _ in range(pressed):
            signal.raise_signal(signal.SIGINT)
        return own(*given)

    monkeypatch.setattr(Search, "challenge", challenge)
    before = signal.getsignal(signal.SIGINT)
    assert main([*arguments, "--report", str(tmp_path / "report")]) == 130
    out, err = capsys.readouterr()
    assert json.loads(out)["not_done"] == list(STAGES) and "Ctrl-C again ends at once" in err and "Unfinished" in err
    assert (tmp_path / "report" / "report.html").is_file()
    pressed = 2
    assert main([*arguments, "--report", str(tmp_path / "none")]) == 130
    out, err = capsys.readouterr()
    assert out == "" and "stopped: nothing was written" in err and not (tmp_path / "none").exists()
    assert signal.getsignal(signal.SIGINT) is before
