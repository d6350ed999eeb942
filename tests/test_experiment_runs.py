"""Experiments in a loop: what is kept, what is not done again, when they end, and what is asked for."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from pendulum_runs import PENDULUM, SERVO
from rival_legs import with_other

import equimus_ctrl as eq
from equimus_ctrl.cli.main import main
from equimus_ctrl.diagnosis.results import Diagnosis
from equimus_ctrl.effects import CoulombFriction
from equimus_ctrl.errors import ConfigError
from equimus_ctrl.experiments.loop import Predicted, Realised
from equimus_ctrl.experiments.power import Power
from equimus_ctrl.experiments.predicted import Commands
from equimus_ctrl.experiments.results import Pair
from equimus_ctrl.models.model import Model
from equimus_ctrl.recordings import read_commands
from equimus_ctrl.robots.mjcf.robot import MjcfRobot
from equimus_ctrl.types import Recording
from equimus_ctrl.workflow import experiment_runs

LEG = eq.nominal_leg()
TIMES = np.arange(120) / 120


class Bench:
    """In the place of the search for designs and of diagnoses: what they are to say, and how often they were asked.

    Attributes:
        leaves: diagnoses in order, the last one for ever.
        powers: of every design.
        notes: of each design in order, the last one for ever.
    """

    def __init__(self, leaves: list[Diagnosis]) -> None:
        self.leaves = leaves
        self.powers = (power(50.0), power(40.0, swapped=True))
        self.notes: list[dict[str, str]] = [{}]
        self.record: dict[str, Any] = {}
        self.designs = self.diagnoses = 0
        self.seen: list[list[str]] = []

    def designed(self, rivals: Any, **options: Any) -> Any:
        self.designs += 1
        notes = self.notes[min(self.designs, len(self.notes)) - 1]
        rows = np.column_stack([9e3 + 3e3 * np.sin(6 * TIMES), np.full(len(TIMES), 6e3)])
        commands = Commands(TIMES, rows, 1.0, notes=notes)
        record = {"family": "multisine", "condition": ", ".join(notes), "amplitude": 1.0, **self.record}
        return SimpleNamespace(commands=commands, pairs=(Pair(self.powers, "one trial"),), to_dict=lambda: record)

    def diagnose(self, trials: list[Recording], *given: Any, **options: Any) -> Diagnosis:
        self.diagnoses += 1
        self.seen.append([trial.name for trial in trials])
        return self.leaves[min(self.diagnoses, len(self.leaves)) - 1]


def power(gap: float, swapped: bool = False, repeats: float = 1.0) -> Power:
    return Power(int(swapped), int(not swapped), np.full(4, gap), 0.0, 10.0, 0.97 if repeats == 1.0 else 0.0, repeats)


@pytest.fixture
def bench(diagnosis: Diagnosis, monkeypatch: pytest.MonkeyPatch) -> Bench:
    own = Bench([with_other(diagnosis), diagnosis])
    monkeypatch.setattr(experiment_runs, "design_experiment", own.designed)
    monkeypatch.setattr(experiment_runs, "diagnose", own.diagnose)
    # What a trial spoke against is fitted once more; here the trials are none that the diagnoses are of.
    gone = lambda before, found, now: tuple(  # noqa: E731
        replace(r, deviance=r.deviance + 60.0) for r in before.rivals[1:] if len(now.rivals) == 1
    ) if before else ()  # fmt: skip
    monkeypatch.setattr(experiment_runs, "no_longer_left", gone)
    return own


@pytest.fixture(scope="module")
def before(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("before") / "poor.csv"
    eq.run_scenario("chirp", options={"duration": "2"}, noise=1e-3, record=path)
    return path


def run(folder: Path, before: Path, **options: Any) -> Any:
    return eq.run_experiments(folder, [before], **options)


def test_a_trial_that_no_explanation_foresees_is_told(
    bench: Bench, before: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    became = Realised(Predicted("a delay", "friction", 80.0, 60.0, 110.0, 0.99, 1.0), 3.0, settled=False)
    monkeypatch.setattr(experiment_runs, "realised", lambda *given: (became,))
    said: list[str] = []
    found = run(tmp_path / "runs", before, say=said.append)
    doubt = "designed_01 went as it hardly does with a delay as the whole truth (a gap of 80, 60 to 110, was expected"
    assert found.end == "resolved" and f"; but {doubt}" in found.said
    assert any(doubt in sentence for sentence in said) and doubt[1:] in (tmp_path / "runs" / "log.md").read_text()
    first, last = found.to_dict()["steps"]
    assert "doubt" not in first and last["doubt"].startswith(doubt)


def test_a_trial_is_designed_made_and_diagnosed_until_one_explanation_is_left(
    bench: Bench, before: Path, tmp_path: Path
) -> None:
    found = run(tmp_path / "runs", before)
    assert found.end == "resolved" and [len(own.belief.left) for own in found.steps] == [2, 1]
    assert bench.seen == [["poor"], ["poor", "designed_01"]] and bench.designs == 1
    (trial,) = found.trials
    assert trial.name == "designed_01" and trial.time[-1] == pytest.approx(1.0, abs=0.02)
    played = read_commands(tmp_path / "runs/step_01/design.csv", *names(), *LEG.command_limits)
    np.testing.assert_allclose(trial.command[3:], played.values[3 : len(trial.command)], atol=1e-6)
    (became,) = found.steps[1].realised
    assert became.predicted.gap == 50.0 and became.gap == pytest.approx(60.0) and became.settled
    gone = found.steps[1].belief.explanations[-1]
    assert not gone.left and gone.behind > 0
    lines = [json.loads(line) for line in (tmp_path / "runs/log.jsonl").read_text().splitlines()]
    assert [line.get("step") for line in lines] == [0, 1, None] and "one explanation is left" in lines[2]["end"]
    said = (tmp_path / "runs/log.md").read_text()
    assert "expected gap of 50" in said and "realised: 60" in said


def names() -> tuple[tuple[str, ...], tuple[str, ...]]:
    return LEG.actuator_names, LEG.joint_names


def test_what_is_there_is_not_done_again(bench: Bench, before: Path, tmp_path: Path) -> None:
    first = run(tmp_path / "runs", before)
    again = run(tmp_path / "runs", before)
    assert (bench.designs, bench.diagnoses) == (1, 2)
    assert again.to_dict() == first.to_dict()


def test_it_goes_on_where_it_was_stopped(
    bench: Bench, before: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = experiment_runs.run_scenario

    def stopped(*given: Any, **options: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(experiment_runs, "run_scenario", stopped)
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path / "runs", before)
    assert not list(tmp_path.glob("runs/trials/*"))
    monkeypatch.setattr(experiment_runs, "run_scenario", real)
    (tmp_path / "runs/step_00/belief.json").unlink()  # as if that step had been stopped between its last two files
    bench.diagnoses = 0
    assert run(tmp_path / "runs", before).end == "resolved"
    assert (bench.designs, bench.diagnoses) == (1, 2)


def test_a_trial_that_broke_off_is_kept_apart_and_made_again(
    bench: Bench, before: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    attempt = tmp_path / "runs/attempts/designed_01.csv"
    attempt.parent.mkdir(parents=True)
    attempt.write_text("half of it")
    assert run(tmp_path / "runs", before).end == "resolved"
    assert attempt.read_text() == "half of it"


def test_other_options_than_those_it_began_with_are_refused(bench: Bench, before: Path, tmp_path: Path) -> None:
    run(tmp_path / "runs", before)
    for change, said in (
        ({"seed": 1}, "seed 0, not 1"),
        ({"noise": 2e-3}, "noise 0.0, not 0.002"),
        ({"effects": [CoulombFriction("knee", friction=0.1)]}, "effects"),
        ({"model": eq.nominal_model().with_parameters({"maa.stiffness": 900.0})}, "another model"),
    ):
        with pytest.raises(ConfigError, match=said):
            run(tmp_path / "runs", before, **change)
    with pytest.raises(ConfigError, match="other recordings"):
        eq.run_experiments(tmp_path / "runs", ())


def test_a_budget_that_is_spent_may_grow(bench: Bench, before: Path, tmp_path: Path) -> None:
    bench.leaves = bench.leaves[:1]
    found = run(tmp_path / "runs", before, trials=1)
    assert found.end == "trials" and len(found.trials) == 1
    found = run(tmp_path / "runs", before, trials=2)
    assert found.end == "trials" and [t.name for t in found.trials] == ["designed_01", "designed_02"]
    # The limits' duration counts for the next one, 6 s; two trials of 1 s were made.
    assert run(tmp_path / "runs", before, trials=9, seconds=7.5).end == "seconds"


def test_it_ends_where_no_trial_tells_more_apart(bench: Bench, before: Path, tmp_path: Path) -> None:
    bench.powers = (power(0.1, repeats=np.inf), power(0.2, swapped=True, repeats=np.inf))
    found = run(tmp_path / "runs", before)
    assert found.end == "inseparable" and not found.trials
    assert "nothing more can be distinguished" in found.said and "no number of them would do" in found.said


def test_what_is_named_may_be_inseparable_though_trials_show_what_may_hide_beside_it(
    bench: Bench, before: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench.leaves, bench.powers = bench.leaves[:1], (power(0.1, repeats=np.inf), power(0.2, True, np.inf))
    sensor = {"kind": "sensor", "name": "vel.hip", "gap": 900.0, "without": 0.1, "settles": True, "pair": [0, 1]}
    useless = {**sensor, "name": "maa.area", "kind": "parameter", "gap": 999.0, "settles": False}
    bench.record = {"remedies": [{**sensor, "name": "vel.knee", "gap": 10.0}, useless, sensor]}
    monkeypatch.setattr(experiment_runs, "worth_making", lambda predicted, left: True)
    found = run(tmp_path / "runs", before, trials=2)
    assert len(found.trials) == 2 and found.end == "inseparable"
    assert "no number of them would do; measuring vel.hip would (an expected gap of 900" in found.said


def test_what_has_to_be_set_is_asked_for(bench: Bench, before: Path, tmp_path: Path) -> None:
    bench.leaves, bench.notes = bench.leaves[:1], [{"payload.foot": "0.2"}, {"payload.foot": "0.2"}, {}]
    asked: list[str] = []
    found = run(tmp_path / "runs", before, trials=3, ask=asked.append)
    assert len(asked) == 2
    assert asked[0] == "designed_01 expects of the robot: payload.foot = 0.2"
    assert asked[1] == "designed_03 expects the robot as it usually is (no longer payload.foot = 0.2)"
    assert [trial.notes.get("payload.foot") for trial in found.trials] == ["0.2", "0.2", None]


def test_who_says_no_is_asked_again_the_next_time(bench: Bench, before: Path, tmp_path: Path) -> None:
    bench.notes = [{"payload.foot": "0.2"}]

    def no(said: str) -> None:
        raise ConfigError(said)

    with pytest.raises(ConfigError, match="payload"):
        run(tmp_path / "runs", before, ask=no)
    assert run(tmp_path / "runs", before, ask=lambda said: None).end == "resolved" and bench.designs == 1


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"plant": "hardware"}, "expected --arm"),
        ({"trials": 0}, "trials is 0"),
        ({"seconds": -1.0}, "expected a time above 0"),
        ({"can": ["payload:nowhere=1"]}, "nowhere"),
        ({"family": ["square"]}, "square"),
        ({"limit": {"knee.width": "1"}}, "width"),
        ({"effects": [CoulombFriction("nowhere", 0.1)]}, "nowhere"),
    ],
)
def test_what_cannot_be_is_refused_before_anything_is_done(
    change: dict[str, Any], said: str, bench: Bench, before: Path, tmp_path: Path
) -> None:
    with pytest.raises(ConfigError, match=said):
        run(tmp_path / "runs", before, **change)
    assert bench.diagnoses == 0 and not (tmp_path / "runs").exists()


def test_recordings_whose_names_trials_get_are_refused(bench: Bench, before: Path, tmp_path: Path) -> None:
    (own,) = eq.read_recordings([before])
    with pytest.raises(ConfigError, match="designed_01"):
        eq.run_experiments(tmp_path / "runs", [replace(own, name="designed_01")])


def test_the_verb_draws_and_tells(
    bench: Bench, before: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "runs"
    assert main(["experiment", "run", str(before), "--output", str(folder), "--json"]) == 0
    out, err = capsys.readouterr()
    told = json.loads(out)
    assert told["end"] == "resolved" and told["trials"] == ["designed_01"]
    assert {Path(file).name for file in told["files"]} == {"log.jsonl", "log.md", "belief.png", "trials.png"}
    assert "step 1: designed_01" in err
    assert "One explanation is left, which does not explain all that was measured." in err


@pytest.mark.parametrize(
    ("words", "said"),
    [(["--plant", "hardware", "--yes"], "only you know"), (["--arm"], "for --plant hardware alone")],
)
def test_words_that_do_not_go_together_are_refused(
    words: list[str], said: str, bench: Bench, before: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["experiment", "run", str(before), "--output", str(tmp_path / "runs"), *words]) == 2
    assert said in capsys.readouterr().err


@pytest.mark.slow
def test_friction_of_a_pendulum_is_found_from_nothing(tmp_path: Path) -> None:
    """The whole of it on a robot of which nothing was recorded before."""
    model = Model(MjcfRobot("arm", PENDULUM.format(drive=SERVO.replace("/>", ' ctrlrange="-1.5 1.5"/>'))))
    found = eq.run_experiments(
        tmp_path / "runs", (), model, effects=[CoulombFriction("hinge", friction=0.1)], noise=5e-4, trials=2,
        evaluations=60, draws=19, threads=1,
    )  # fmt: skip
    named = [(f["effect"], f["locations"]) for f in found.steps[-1].findings]
    assert named == [("coulomb_friction", ["hinge"])], found.steps[-1].belief
    assert found.end in ("resolved", "inseparable", "trials")
