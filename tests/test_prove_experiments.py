"""``equimus-ctrl prove --experiments``: what is counted, what is done when and not again, and one case for real."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from proof_answers import LAG, RUB, SAID_LAG, SAID_RUB, effect, finding, left, report, truth
from rival_legs import of_a_pendulum

from equimus_ctrl.cli.main import main
from equimus_ctrl.diagnosis.rivals import Rivals
from equimus_ctrl.effects.base import REGISTRY
from equimus_ctrl.errors import ConfigError
from equimus_ctrl.executors.local import OnThisComputer
from equimus_ctrl.experiments.limits import Limits
from equimus_ctrl.experiments.loop import fitted_share
from equimus_ctrl.experiments.predicted import Commands
from equimus_ctrl.options import ProveOptions, Shard
from equimus_ctrl.presets import plain
from equimus_ctrl.proof import blind, chirps, designing
from equimus_ctrl.proof.answers import Case, Places
from equimus_ctrl.proof.designing import Design, Designing, next_trial
from equimus_ctrl.proof.designs import TrialDesign
from equimus_ctrl.proof.further import further, trial_design
from equimus_ctrl.proof.legs import Legs
from equimus_ctrl.proof.resolved import Followed, Resolved, followed, near, outcome
from equimus_ctrl.proof.seal import digest
from equimus_ctrl.proof.shares import Share
from equimus_ctrl.proof.store import Made, Request, redrawn, truth_of
from equimus_ctrl.recordings.folders import write_text
from equimus_ctrl.report import style
from equimus_ctrl.report.proof_experiments import experiment_sheets, experiments_figure
from equimus_ctrl.robots.elastic.leg import nominal_leg
from equimus_ctrl.types import FeedbackLaw
from equimus_ctrl.workflow import load_model, proof_experiments
from equimus_ctrl.workflow import proofs as workflow
from equimus_ctrl.workflow.proofs import experiment_of, prove

PENDULUM = Path(__file__).resolve().parents[1] / "docs" / "examples" / "pendulum.xml"

# --- counting


def leaves(*several: list[dict[str, Any]], accepted: bool = True) -> dict[str, Any]:
    return {"rivals": {"explanations": [{"effects": own, "accepted": accepted} for own in several]}}


def hides(first: list[dict[str, Any]], hidden: list[dict[str, Any]], **size: float) -> dict[str, Any]:
    """What is named first, and what may hide, the last effect of which is of a given size."""
    last = hidden[-1]
    own = {"effect": last["effect"], "location": last["locations"][0], **size}
    (key,) = size
    given = {"given": [f"{last['effect']}.{key}"], "model": {"effects": [own]}}
    found = leaves(first, hidden)
    found["rivals"]["explanations"][1] |= given
    return found


def judged(kind: str, missing: list[dict[str, Any]], said: Any) -> str:
    return outcome(Case({**truth(kind, *missing), "case": 3}, said, {}, Places.of(nominal_leg())))


LAG_SEEN_AT = {"effect": "first_order_lag", "locations": ["maa"]}
OF_LAG, OF_RUB = [{"effect": "first_order_lag", "locations": ["maa"]}], [finding("coulomb_friction", "knee")]


@pytest.mark.parametrize(
    ("kind", "missing", "said", "wanted"),
    [
        ("none", [], report(), "exact"),
        ("none", [], report(SAID_LAG), "wrong"),
        ("none", [], {**report(unexplained=(left("knee"),)), **leaves([], OF_LAG)}, "told"),
        ("single", [LAG], report(SAID_LAG), "exact"),
        ("single", [LAG], report(SAID_RUB), "wrong"),
        ("single", [LAG], report(), "silent"),
        ("single", [LAG], {**report(), **leaves([], OF_LAG)}, "silent"),
        ("single", [LAG], report(finding("dead_zone", "maa", equivalent=(("first_order_lag", "maa"),))), "told"),
        ("single", [LAG], report(finding("dead_zone", "maa", equivalent=(("first_order_lag", "baa"),))), "wrong"),
        ("single", [LAG], {**report(SAID_RUB), **leaves(OF_RUB, OF_LAG)}, "told"),
        ("single", [LAG], {**report(SAID_RUB), **leaves(OF_RUB, [*OF_LAG, *OF_RUB])}, "wrong"),
        ("single", [LAG], {**report(SAID_RUB), **leaves(OF_RUB, OF_LAG, accepted=False)}, "wrong"),
        ("pair", [LAG, RUB], {**report(SAID_RUB), **leaves(OF_RUB, [*OF_RUB, *OF_LAG])}, "told"),
        ("pair", [LAG, RUB], report(SAID_RUB, SAID_LAG), "exact"),
        ("single", [LAG], {**report(), "detectable": [LAG_SEEN_AT | {"size": 0.3}]}, "unseen"),
        ("single", [LAG], {**report(), "detectable": [LAG_SEEN_AT | {"size": 0.1}]}, "silent"),
        ("single", [LAG], {**report(), "detectable": [LAG_SEEN_AT | {"size": None}]}, "unseen"),
        ("single", [LAG], {**report(SAID_RUB), "detectable": [LAG_SEEN_AT | {"size": 0.3}]}, "wrong"),
        ("pair", [LAG, RUB], {**report(SAID_RUB), "detectable": [LAG_SEEN_AT | {"size": 0.3}]}, "unseen"),
        ("pair", [LAG, RUB], {**report(SAID_RUB), "detectable": [LAG_SEEN_AT | {"size": 0.1}]}, "wrong"),
        ("single", [LAG], {**report(SAID_RUB), **hides(OF_RUB, OF_LAG, time_constant=0.3)}, "unseen"),
        ("single", [LAG], {**report(SAID_RUB), **hides(OF_RUB, OF_LAG, time_constant=0.1)}, "wrong"),
        ("single", [LAG], {**report(SAID_RUB), **hides(OF_RUB, [*OF_RUB, *OF_LAG], time_constant=0.3)}, "wrong"),
        ("outside", [effect("cogging", "knee")], report(unexplained=(left("knee", "knee"),)), "exact"),
        ("outside", [effect("cogging", "knee")], report(unexplained=(left("hip", "hip"),)), "wrong"),
        ("outside", [effect("cogging", "knee")], {**report(SAID_RUB), **leaves(OF_RUB, [])}, "wrong"),
    ],
)
def test_an_answer_is_right_only_where_the_truth_is_among_what_is_told(
    kind: str, missing: list[dict[str, Any]], said: Any, wanted: str
) -> None:
    assert judged(kind, missing, said) == wanted


@pytest.mark.parametrize(
    ("missing", "size", "wanted"),
    [
        (effect("saturation", "maa", level=2e4), 1.9e4, "unseen"),  # the higher the level, the less it does
        (effect("saturation", "maa", level=2e4), 2.1e4, "silent"),
        (effect("cutoff", "maa", least=2e3), 2.1e3, "unseen"),
        (effect("cutoff", "maa", least=2e3), 1.9e3, "silent"),
        (effect("joint_stop", "hip", angle=1.7, stiffness=9.0, damping=0.1), 1.7, "silent"),  # the upper or the lower
    ],
)
def test_effects_that_no_value_switches_off_are_weaker_on_one_side(
    missing: dict[str, Any], size: float, wanted: str
) -> None:
    seen_at = {"effect": missing["effect"], "locations": missing["locations"], "size": size}
    assert judged("single", [missing], {**report(), "detectable": [seen_at]}) == wanted
    assert judged("single", [missing], {**report(), "detectable": [{**seen_at, "size": None}]}) == "unseen"


def test_which_effects_have_a_weaker_side() -> None:
    for law in REGISTRY.values():
        assert not law.weaker or law.grows_from() is None, law.name


def test_a_diagnosis_that_failed_is_no_answer() -> None:
    said = report()
    assert judged("none", [], {**said, "proof": {**said["proof"], "failed": "too short"}}) == "failed"


@pytest.mark.parametrize(
    ("predicted", "realised", "strictly", "noisily"),
    [(100.0, 51.0, True, True), (100.0, 201.0, False, True), (100.0, 221.0, False, False), (100.0, 29.0, False, False),
     (4.0, -1.9, False, True), (4.0, -2.1, False, False), (0.0, 0.1, False, False), (1e-12, -1e-3, True, True)],
)  # fmt: skip
def test_gaps_are_near_within_a_factor_of_two_and_noise(
    predicted: float, realised: float, strictly: bool, noisily: bool
) -> None:
    assert (near(predicted, realised, noise=False), near(predicted, realised)) == (strictly, noisily)


def pair(gap: float, realised: float, true: str = "lag", settled: bool = True) -> dict[str, Any]:
    own = {"true": true, "other": "rub", "gap": gap, "low": gap / 3, "high": 3 * gap, "chance": 0.9, "repeats": 1.0}
    return {"predicted": own, "gap": realised, "settled": settled}


def design(end: str | None = None, said: str = "", **more: Any) -> dict[str, Any]:
    return {"end": end, "said": said, "design": {"family": "steps"}, "proof": {"seconds": 30.0}, **more}


def case_of(number: int, *said: Any, ended: str | None = None, excess: float = -0.1, kind: str = "single") -> Followed:
    missing = [LAG] if kind == "single" else []
    more = [design(ended, "nothing more")] if ended else []
    return followed(
        {**truth(kind, *missing), "case": number},
        said,
        [design() for _ in said[1:]] + more,
        [{"failed": "", "kept": excess <= 0, "excess": excess, "nearest": "knee above its range"} for _ in said[1:]],
        ended,  # type: ignore[arg-type]
        nominal_leg(),
    )


@pytest.fixture
def counted() -> Resolved:
    told = report(finding("dead_zone", "maa", equivalent=(("first_order_lag", "maa"),)))
    settled = {**report(SAID_LAG), "realised": [pair(100.0, 130.0), pair(100.0, 450.0)]}
    cases = (
        case_of(0, report(SAID_LAG), ended="resolved"),
        case_of(1, told, settled, ended="resolved"),
        case_of(2, report(SAID_RUB), report(SAID_RUB), settled, excess=0.02),
        case_of(3, told, ended="inseparable"),
        case_of(4, report(), kind="none", ended="none"),
    )
    return Resolved(2, cases, 0.01, "abc")


def test_answers_are_counted_after_each_number_of_trials(counted: Resolved) -> None:
    assert counted.shares() == (Share(4, 5), Share(4, 5), Share(5, 5))
    assert counted.shares(("exact",)) == (Share(2, 5), Share(3, 5), Share(4, 5))
    assert counted.shares(("told",)) == (Share(2, 5), Share(1, 5), Share(1, 5))
    assert counted.by_kind()["none"] == (Share(1, 1),) * 3
    assert counted.ends["resolved"] == Share(2, 2) and counted.ends["trials"] == Share(1, 1)
    assert counted.ends["inseparable"] == Share(1, 1) and counted.ends["failed"].of == 0
    assert counted.kept == Share(1, 3)
    assert counted.kept_promises == Share(1, 1)  # nothing was promised where the truth was not among what was left
    assert counted.near == Share(2, 4) and [gap.within for gap in counted.gaps] == [True, False] * 2
    assert counted.seconds(1) == (30.0, 10.0) and np.isnan(counted.seconds(0)[0])
    states = {goal.name: goal.state for goal in counted.goals}
    assert states == {"resolved": "too few", "gaps": "missed", "limits": "too few"} and not counted.accurate


def test_the_interval_of_a_share_is_wilsons(counted: Resolved) -> None:
    (low, high) = counted.shares()[1].interval
    assert (low, high) == pytest.approx((0.3755, 0.9638), abs=1e-4)


def test_a_trial_that_could_not_be_made_is_told() -> None:
    own = followed(
        truth("single", LAG), [report(SAID_RUB)], [design()], [{"failed": "it diverged"}], "failed", nominal_leg()
    )
    assert own.trials == () and own.said == "it diverged" and own.outcome(2) == "wrong"


def test_tables_figure_and_json_say_what_was_counted(counted: Resolved) -> None:
    data = json.loads(json.dumps(counted.to_dict(), allow_nan=False))
    assert data["right"][2]["count"] == 5 and data["outcomes"]["silent"][0]["count"] == 0
    assert data["cases"][2]["outcomes"] == ["wrong", "wrong", "exact"] and data["answers_sha256"] == "abc"
    assert data["gaps"]["within_factor_2"]["count"] == 2 and data["limits"]["kept"]["of"] == 3
    text = "\n".join(sheet.markdown() for sheet in experiment_sheets(counted))
    for wanted in ("80.0 % (4/5)", "100.0 % (5/5)", "coulomb_friction:knee → coulomb_friction:knee → first_order_lag",
                   "all trials were made 1 (1 right)", "37.6 to 96.4 %"):  # fmt: skip
        assert wanted in text, wanted
    assert style.png(experiments_figure(counted)).startswith(b"\x89PNG")
    assert style.png(experiments_figure(Resolved(2, counted.followed[:1], 0.01, ""))).startswith(b"\x89PNG")


# --- robots


def test_poor_legs_are_driven_by_small_chirps() -> None:
    poor = Legs(chirps.TRIALS, chirps.DURATION, excitation="poor").draw(7, 2)
    longer = Legs(chirps.TRIALS + 2, chirps.DURATION, excitation="poor").draw(7, 2)
    assert [trial.kind for trial in poor.trials] == ["chirp", "chirp"]
    for own, same in zip(poor.trials, longer.trials, strict=False):  # more of them begin with the same
        assert np.array_equal(own.command, same.command)
        assert np.all(np.ptp(own.command, axis=0) < 21e3) and own.time[-1] < chirps.DURATION
    assert poor.robot.parameters() == Legs().draw(7, 2).robot.parameters()


def test_a_robot_is_drawn_again_from_its_seed(tmp_path: Path) -> None:
    request = Request(tmp_path, 11, None, 1, 2.0, 480.0, excitation="poor")
    drawn = request.source.draw(11, 3)
    known = truth_of(request.source, drawn, request.source.simulate(drawn)[1])
    known = json.loads(json.dumps(known))
    again = redrawn(request, known)
    assert again.robot.parameters() == drawn.robot.parameters() and again.effects == drawn.effects
    known["parameters"]["maa.stiffness"] += 1e-6
    with pytest.raises(ConfigError, match="this version of the program draws other robots"):
        redrawn(request, known)


def scaled_sensor() -> Any:
    """A leg whose knee sensor shows half as much again."""
    from dataclasses import replace

    from equimus_ctrl.effects import make

    drawn = Legs(1, 2.0, 480.0, "poor").draw(5, 0, "none")
    return replace(drawn, effects=(make("sensor_scale", "knee", {"scale": 1.5}),), noise=(0.0, 0.0))


def test_limits_are_judged_by_the_true_motion_not_by_what_sensors_show() -> None:
    source, robot = Legs(1, 2.0, 480.0, "poor"), scaled_sensor()
    levels = np.array([[12e3, 8e3], [22e3, 2e3]])
    own = trial_design(source, robot, Commands(np.array([0.0, 0.5]), levels, 2.0), 1, 120.0, {})
    assert own.name == "designed_01" and np.array_equal(own.command[[0, -1]], levels)
    made = further(source, robot, own, 1)
    shown, motion = made.recording.position, made.motion
    assert shown[:, 0] == pytest.approx(motion[:, 0], abs=2e-5)
    assert np.abs(shown[:, 1] - motion[:, 1]).max() > 0.05
    rate = np.gradient(motion[:, 0], made.recording.time)
    assert np.abs(rate - motion[:, 2]).max() < 0.1 * np.abs(motion[:, 2]).max()
    far, speed = motion[:, 1].max() - motion[0, 1], np.abs(motion[:, 2]).max()
    free = {"knee.high": str(motion[:, 1].max() + 0.01), "knee.margin": "0", "hip.margin": "0"}
    limits = Limits.read(nominal_leg(), None, {**free, "hip.rate": str(1.01 * speed)})
    assert made.excess(limits).worst <= 0
    tight = Limits.read(nominal_leg(), None, {**free, "hip.rate": str(0.9 * speed)})
    assert made.excess(tight).worst == pytest.approx(1 / 9, rel=1e-6)
    assert far > 0.05 or speed > 0.1  # it moved


def test_a_known_condition_is_one_of_the_true_robot() -> None:
    source = Legs(1, 2.0, 480.0, "poor")
    drawn = source.draw(5, 0, "none")
    times, rows = np.arange(60) / 120.0, np.tile([15e3, 6e3], (60, 1))
    usual, loaded = (
        further(source, drawn, TrialDesign("more", "steps", times, rows, None, notes), 1)
        for notes in ({}, {"payload.foot": "0.3"})
    )
    assert loaded.recording.notes == {"payload.foot": "0.3"}
    assert np.abs(usual.motion - loaded.motion).max() > 0.05  # it rests elsewhere


def test_a_trial_that_has_to_be_tracked_is_none_that_a_proof_makes(monkeypatch: pytest.MonkeyPatch) -> None:
    law = FeedbackLaw(np.ones((2, 2)), np.ones((2, 2)), 0.01)
    tracked = Commands(np.zeros(1), np.zeros((1, 2)), 1.0, None, {}, np.zeros((1, 2)), law)
    given: list[Rivals] = []

    def designed(rivals: Rivals, *_: Any, **__: Any) -> Any:
        given.append(rivals)
        return SimpleNamespace(commands=tracked)

    monkeypatch.setattr(designing, "designed", designed)
    two = of_a_pendulum()
    left, how = json.loads(json.dumps(plain(two.to_dict()))), Designing(Limits.of(two.model.robot))
    own = Design.from_dict(json.loads(next_trial(left, two.model, how, 0, 1, {})))
    assert [rivals.fitted for rivals in given] == [fitted_share()]
    assert own.end == "none" and own.commands is None and "proofs make no tracked trials" in own.said


def test_further_trials_repeat_and_differ_from_each_other() -> None:
    source = Legs(1, 2.0, 480.0, "poor")
    drawn = source.draw(5, 0, "none")
    own = TrialDesign("more", "steps", np.arange(120) / 120.0, np.tile([15e3, 6e3], (120, 1)))
    one, same, other = (further(source, drawn, own, k).recording.position for k in (1, 1, 2))
    assert np.array_equal(one, same) and not np.array_equal(one, other)


@pytest.fixture(scope="module")
def poor_pendulum() -> Any:
    options = ProveOptions(experiments=1, limit={"motor.low": "-2", "motor.high": "2"}, seed=4)
    return experiment_of((), load_model(PENDULUM), options), options


@pytest.mark.slow
def test_an_mjcf_robot_without_recordings_is_driven_by_small_chirps(poor_pendulum: Any) -> None:
    own, options = poor_pendulum
    assert own.trial_names == ["trial_00", "trial_01"]
    for recording in own.recordings:
        assert 0.05 < np.ptp(recording.command) <= 4.0 and np.ptp(recording.position) > 1e-3
        assert recording.time[-1] == pytest.approx(chirps.DURATION, abs=0.02)
    again = experiment_of((), load_model(PENDULUM), options)
    assert again is not None and digest(again.recordings) == digest(own.recordings)


# --- what is done when, and not again


class World:
    """Two ground truths, of which the second is told after one designed trial, without a simulation."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.done: list[str] = []
        self.truths = {0: {**truth("none"), "case": 0}, 1: {**truth("single", LAG), "case": 1}}
        self.worth, self.failed, self.version = True, "", "one"
        monkeypatch.setattr(workflow, "make_cases", self.make)
        monkeypatch.setattr(workflow, "open_truth", self.open)
        monkeypatch.setattr(workflow, "recorded", lambda folder, model: (folder,))
        monkeypatch.setattr(proof_experiments, "recorded", lambda folder, model: (folder,))
        monkeypatch.setattr(proof_experiments, "digest", lambda recordings: "as it was")
        monkeypatch.setattr(proof_experiments, "write_folder", lambda folder, own: write_text(folder / own[0], "rows"))
        monkeypatch.setattr(proof_experiments.Further, "_truth", lambda further, case: self.truths[case])
        monkeypatch.setattr(OnThisComputer, "each_apart", lambda executor, *given: self.apart(*given))
        monkeypatch.setattr(OnThisComputer, "each", lambda executor, *given: self.drive(*given))
        monkeypatch.setattr(blind, "report_fingerprint", lambda further: "reports" if further else "alone")
        monkeypatch.setattr(blind, "further_fingerprint", lambda: self.version)

    def make(self, request: Request, cases: Any, executor: Any, notify: Any) -> list[Made]:
        return [Made(case, f"seal {case}", 0.0) for case in cases]

    def open(self, request: Request, case: int) -> Any:
        self.done.append(f"opened {case}")
        return self.truths[case]

    def apart(self, work: Any, tasks: Any) -> Iterator[tuple[int, str]]:
        for k, task in enumerate(tasks):
            if work is blind.answer:
                recordings, *_, seal = task
                case = int(recordings[0].name[-1])
                said = {**report(*([SAID_RUB] if case else [])), **leaves([], OF_RUB)}
                proof = {**said["proof"], "seal": seal, "fingerprint": "reports"}
                yield k, (json.dumps({**said, "proof": proof}), None)  # type: ignore[misc]
            elif work is next_trial:
                rivals, _, designing, case, number, made = task
                self.done.append(f"designed {case} {number} of {len(rivals['explanations'])}")
                yield k, json.dumps(self.design(case, number, {**made, "fingerprint": designing.fingerprint}))
            else:
                assert work is blind.answer_with
                recordings, _, first, before, predicted, made = task
                self.done.append(f"diagnosed {[own.parent.parent.name for own in recordings]}")
                assert first == 1 and before["explanations"] and predicted[0]["true"] == "lag"
                said = {**report(SAID_LAG), **leaves(OF_LAG), "realised": [pair(100.0, 130.0)]}
                proof = {**said["proof"], **made, "fingerprint": self.version}
                yield k, json.dumps({**said, "proof": proof})

    def design(self, case: int, number: int, made: dict[str, Any]) -> dict[str, Any]:
        proof = {"seconds": 30.0, "cpu_seconds": 30.0, **made}
        known = {
            "rate_hz": 120.0,
            "notes": {},
            "alone": False,
            "said": "",
            "design": {"family": "steps"},
            "proof": proof,
        }
        if number > 1:
            return {**known, "end": "resolved", "commands": None, "predicted": []}
        commands = {"times": [0.0], "commands": [[1e4, 1e4]], "duration_s": 6.0, "start": None, "notes": {}}
        own = pair(100.0, 0.0)["predicted"]
        if not (case and self.worth):
            own = {**own, "chance": 0.0, "repeats": None}
        return {**known, "end": None, "commands": commands, "predicted": [own]}

    def drive(self, work: Any, tasks: Any) -> Iterator[tuple[int, Any]]:
        for k, (known, own) in enumerate(tasks):
            self.done.append(f"drove {known['case']}")
            assert Design.from_dict(own).commands is not None
            if self.failed:
                yield k, (None, {"failed": self.failed})
            else:
                said = {"failed": "", "kept": True, "excess": -0.1, "nearest": "knee", "recording_sha256": "as it was"}
                yield k, ("designed_01.csv", said)

    def prove(self, folder: Path, **options: Any) -> Any:
        given = {"cases": 2, "workers": 1, "baselines": False, "experiments": 2, "say": self.done.append}
        return prove(folder, **{**given, **options})


@pytest.fixture
def world(monkeypatch: pytest.MonkeyPatch) -> World:
    return World(monkeypatch)


def test_answers_are_sealed_before_truths_are_opened(world: World, tmp_path: Path) -> None:
    found = world.prove(tmp_path)
    own = found.experiments
    assert own.shares(("exact",)) == (Share(1, 2), Share(2, 2), Share(2, 2))
    assert [f.end for f in own.followed] == ["inseparable", "resolved"]
    assert world.done.count("drove 1") == 1 and "drove 0" not in world.done
    assert f"diagnosed {[tmp_path.name, '01']}" in world.done  # the first recordings and the designed one
    sealed = next(k for k, line in enumerate(world.done) if line.startswith("all answers after 0 to 2"))
    assert world.done.index("opened 0") > sealed and found.experiments.answers in world.done[sealed]
    lines = (tmp_path / "answers.txt").read_text().splitlines()
    assert lines[0] == f"{own.answers}  all" and [line.split("  ")[1] for line in lines[1:]] == [
        "case_0000 after 0", "case_0001 after 0", "case_0001 after 1",
    ]  # fmt: skip
    assert found.accurate and found.goals[0].name == "resolved"
    assert found.to_dict()["experiments"]["cases"][1]["outcomes"] == ["wrong", "exact", "exact"]


def doings(world: World) -> list[str]:
    return [line for line in world.done if line.split()[0] in ("designed", "drove", "diagnosed")]


def test_what_is_there_is_not_done_again_and_what_follows_from_a_change_is(world: World, tmp_path: Path) -> None:
    world.prove(tmp_path, experiments=1)
    assert len(doings(world)) == 4  # two designs, one of them worth making
    world.done.clear()
    world.prove(tmp_path, experiments=1)
    assert not doings(world)
    world.prove(tmp_path)  # one more
    assert [line.split()[:3] for line in doings(world)] == [["designed", "1", "2"]]
    world.done.clear()
    path = tmp_path / "further" / "01" / "driven" / "case_0001.json"
    path.write_text(path.read_text().replace("-0.1", "-0.2"))
    world.prove(tmp_path)
    assert [line.split()[0] for line in doings(world)] == ["diagnosed", "designed"]
    world.done.clear()
    world.prove(tmp_path, evaluations=3)  # designs are others, so all that follows is
    assert [line.split()[0] for line in doings(world)] == ["designed", "designed", "drove", "diagnosed", "designed"]
    world.done.clear()
    world.version = "two"
    world.prove(tmp_path, evaluations=3)
    assert [line.split()[0] for line in doings(world)] == ["diagnosed", "designed"]


def test_a_trial_that_cannot_be_made_ends_its_case(world: World, tmp_path: Path) -> None:
    world.failed = "it diverged"
    own = world.prove(tmp_path).experiments.followed[1]
    assert own.end == "failed" and own.said == "it diverged" and len(own.cases) == 1 and not own.trials


def test_trials_that_are_not_worth_making_are_not_made(world: World, tmp_path: Path) -> None:
    world.worth = False
    found = world.prove(tmp_path).experiments
    assert [f.end for f in found.followed] == ["inseparable"] * 2 and not found.made
    world.worth = True


def test_shards_bring_their_designed_trials(world: World, tmp_path: Path) -> None:
    folders = [tmp_path / "one", tmp_path / "two"]
    for k, folder in enumerate(folders):
        world.prove(folder, shard=Shard(k + 1, 2))
        assert (folder / f"answers_{k + 1}_of_2.txt").exists()
        (folder / "recordings" / f"case_000{k}").mkdir(parents=True)
        for name in ("truth", "seals"):
            (folder / name).mkdir()
        (folder / "truth" / f"case_000{k}.json").write_text("{}")
        (folder / "seals" / f"case_000{k}.txt").write_text("seal")
    world.done.clear()
    whole = world.prove(tmp_path / "whole", merge=folders)
    assert not doings(world) and whole.experiments.shares(("exact",))[-1] == Share(2, 2)
    assert (tmp_path / "whole" / "further" / "01" / "recordings" / "case_0001" / "designed_01.csv").exists()
    with pytest.raises(ConfigError, match="shard 1/2 has 2 designed trials of each case; expected --experiments 2"):
        world.prove(tmp_path / "more", merge=folders, experiments=3)


def test_the_command_prints_tables_and_draws_the_figure(
    world: World, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "130")
    given = ["prove", "--cases", "2", "--experiments", "2", "--no-baselines", "--no-figures", "--output", str(tmp_path)]
    assert main([*given, "--json"]) == 0
    out, err = capsys.readouterr()
    assert json.loads(out)["experiments"]["right"][1]["count"] == 2
    for text in (
        "right, not distinguishable or unseen",
        "trial 1: designs: 2 of 2",
        "limits kept by the true robot",
        "SHA-256",
    ):
        assert text in err, text
    assert "Answers after designed trials" in (tmp_path / "score.md").read_text()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--limit", "knee.margin=0.1"], "--limit is for designed trials; expected --experiments with it"),
        (["--excitation", "poor", "--evaluations", "3"], "--evaluations is for designed trials"),
        (["--experiments", "1", "--limit", "knee.magin=0.1"], "did you mean 'margin'?"),
        (["--experiments", "1", "--model", str(PENDULUM), "--limit", "motor.low=x"], "motor.low is 'x', expected a"),
    ],
)
def test_what_is_wrong_is_a_sentence(
    arguments: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["prove", *arguments, "--output", str(tmp_path / "out")]) == 2
    err = capsys.readouterr().err.strip()
    assert message in err and len(err.splitlines()) == 1


# --- one case for real


@pytest.mark.slow
def test_a_case_is_followed_from_poor_chirps_through_a_designed_trial(tmp_path: Path) -> None:
    limit = {"motor.low": "-2", "motor.high": "2"}
    given = {"cases": 1, "seed": 21, "kind": "none", "experiments": 1, "evaluations": 24, "workers": 1,
             "limit": limit, "model": load_model(PENDULUM)}  # fmt: skip
    found = prove(tmp_path, **given)
    own = found.experiments
    assert own is not None
    (case,) = own.followed
    assert len(case.trials) == 1 and len(case.cases) == 2
    texts = [path.read_text() for path in sorted(tmp_path.rglob("*/case_0000.json")) if path.parent.name != "truth"]
    assert len(texts) == 1 + 3 * len(case.trials) + (case.end is not None and case.end != "failed")
    for trial in case.trials:
        assert trial.seconds > 0 and trial.kept
        assert trial.excess is not None and trial.excess < 0  # its hinge may go one turn
    hidden = json.loads((tmp_path / "truth" / "case_0000.json").read_text())["salt"]
    assert not any(hidden in text for text in texts)
    again = prove(tmp_path, **given)
    assert again.experiments is not None and again.experiments.answers == own.answers
