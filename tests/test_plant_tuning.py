"""Tuning the PID of any robot on its plant: what varies, what counts, what is written and found again."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cloudpickle
import numpy as np
import pytest
from mjcf_models import RIG, pendulum, refusal

from equimus_ctrl import presets, workflow
from equimus_ctrl.computer import Workers
from equimus_ctrl.controllers.pid_settings import PidSettings
from equimus_ctrl.controllers.search_space import Narrowing
from equimus_ctrl.effects import FirstOrderLag, PayloadMass, TransportDelay
from equimus_ctrl.models.model import Model, nominal_model
from equimus_ctrl.robots.mjcf.robot import MjcfRobot
from equimus_ctrl.tuning.autotune import best_feasible
from equimus_ctrl.tuning.ensemble import make_members
from equimus_ctrl.tuning.evaluation import Evaluation
from equimus_ctrl.tuning.plant_problem import PlantProblem
from equimus_ctrl.tuning.plant_tuning import make_plant_problem
from equimus_ctrl.tuning.search import Trial
from equimus_ctrl.tuning.study import PlantStudy, study_from_dict
from equimus_ctrl.workflow.runs import own_settings
from equimus_ctrl.workflow.tuning import study_for

ROOT = Path(__file__).parents[1]
STUDY = study_from_dict(presets.read_toml(ROOT / "tuning" / "pid_any.toml"))
ARM = MjcfRobot("arm", pendulum('damping="0.3"').replace('timestep="0.001"', 'timestep="0.004"'))


def quick(**changes: object) -> PlantStudy:
    short = tuple(replace(o, duration=1.6) for o in STUDY.objectives)
    ensemble = replace(STUDY.ensemble, members=2, unseen=1)
    return replace(STUDY, objectives=short, ensemble=ensemble, candidates=3, **changes)  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def problem() -> PlantProblem:
    study, model = quick(), Model(ARM)
    scenarios = [workflow.load_scenario(o.scenario, ARM, search=False) for o in study.objectives]
    return make_plant_problem(study, model, scenarios)


def test_a_problem_judges_loops_alike_in_another_process(problem: PlantProblem) -> None:
    there = cloudpickle.loads(cloudpickle.dumps(problem))
    assert problem.space.growth is not None
    looked_at = problem.first.table, problem.members[1], problem.poses(), (1.0, 2.0)
    assert there.space.growth(*looked_at) == problem.space.growth(*looked_at)


def test_members_are_the_model_the_latest_and_others_within_the_spread() -> None:
    model = Model(RIG, (PayloadMass("tip", 0.2), TransportDelay("push", 0.01)))
    members = make_members(model, STUDY.ensemble, 6, 3)
    delays = [{e.location: e.delay for e in m.effects if isinstance(e, TransportDelay)} for m in members]
    assert delays[0] == {"lift": 0.01, "push": 0.02} and delays[1] == {"lift": 0.02, "push": 0.03}
    known = members[0].robot.parameters()
    assert known["shoulder.damping"] == RIG.parameters()["shoulder.damping"]
    latest = members[1].robot.parameters()
    assert latest["shoulder.damping"] == pytest.approx(0.6 * known["shoulder.damping"])
    assert latest["arm.mass"] == pytest.approx(0.85 * known["arm.mass"])
    for member in members[2:]:
        share = member.robot.parameters()["rod.mass"] / known["rod.mass"]
        assert 0.85 <= share <= 1.15
        assert member.robot.parameters()["rod.inertia"] / known["rod.inertia"] == pytest.approx(share)
    assert members == members and repr(make_members(model, STUDY.ensemble, 6, 3)[4].robot.parameters()) == repr(
        members[4].robot.parameters()
    )


def test_where_lags_spread_the_hardest_robot_is_also_behind_short_ones() -> None:
    """With its dead times as long, for these weaken nothing; lags that the model has itself are its own."""
    spread = replace(STUDY.ensemble, lag=(0.02, 0.1), delay=(0.0, 0.05))
    members = make_members(Model(ARM), spread, 4, 3)
    lags = [[e.time_constant for e in m.effects if isinstance(e, FirstOrderLag)] for m in members]
    delays = [[e.delay for e in m.effects if isinstance(e, TransportDelay)] for m in members]
    assert lags[:3] == [[pytest.approx(0.06)], [0.1], [0.02]] and delays[:3] == [[0.025], [0.05], [0.05]]
    assert members[2].robot.parameters() == members[1].robot.parameters() != members[3].robot.parameters()
    own = FirstOrderLag(ARM.actuator_names[0], 0.03)
    known = make_members(Model(ARM, (own,)), spread, 3, 3)
    assert known[2].robot.parameters() != known[1].robot.parameters() and all(own in m.effects for m in known)


def test_candidates_are_factors_on_placed_gains_to_six_digits(problem: PlantProblem) -> None:
    placed = PidSettings.from_dict(problem.candidate(np.ones(4)).table)
    found = PidSettings.from_dict(problem.candidate(np.array([2.0, 0.5, 1.0, 3.0])).table)
    own, first = found.gains["pivot"], placed.gains["pivot"]
    assert own.kp == pytest.approx(2 * first.kp, rel=1e-5) and own.ki == pytest.approx(first.ki / 2, rel=1e-5)
    assert found.derivative_time == pytest.approx(3 * placed.derivative_time, rel=1e-5) and found.decoupled
    assert own.kd == float(f"{own.kd:.6g}")


def test_a_search_begins_with_placed_gains_slow_enough_for_every_robot(problem: PlantProblem) -> None:
    """Powers of one speed, by which a triple integrator's loop stays the same but for its time scale."""
    kp, ki, kd, filtered = problem.first.values.values()
    assert kp == pytest.approx(kd**2, rel=1e-5) and ki == pytest.approx(kd**3, rel=1e-5) and filtered == 1.0
    placed, slower = problem.candidate(np.ones(4)), problem.first
    kept = [[problem.keeps(*problem.moduli(own, robot)) for robot in problem.members] for own in (placed, slower)]
    assert kept[0] == [True, False] and all(kept[1]) and 0.5 < kd < 1.0
    study = quick(search={"kp": Narrowing(start=1.0)})
    scenarios = [workflow.load_scenario(o.scenario, ARM, search=False) for o in study.objectives]
    said = make_plant_problem(study, Model(ARM), scenarios)
    assert set(said.first.values.values()) == {1.0}


def test_on_a_hardest_robot_a_candidate_may_cost_a_fifth_more_than_the_first(problem: PlantProblem) -> None:
    three = replace(problem, members=[problem.members[0]] * 3, hardest=1)
    assert three.paying == [0, 2]

    def judged(*costs: float) -> Evaluation:
        return Evaluation(sum(costs), {}, costs, 0.0, 0.0, 0.9, 0.95, True, True)

    first = judged(0.5, 0.6, 0.5)
    for costs, kept in (((0.4, 0.71, 0.3), True), ((0.4, 0.73, 0.3), False), ((0.9, 0.5, 0.9), True)):
        own = three.kept_on_hardest(judged(*costs), first)
        assert own.feasible is kept and (own.cost == sum(costs)) is kept
    beaten = replace(judged(0.4, 0.73), feasible=False)
    assert three.kept_on_hardest(beaten, first) is beaten


@pytest.mark.slow
def test_what_a_servo_overshoots_by_itself_is_no_candidate_s_doing() -> None:
    """A servo without friction of damping ratio ζ goes exp(−πζ/√(1 − ζ²)) beyond; one that is damped goes nowhere."""
    servo = """<mujoco><option timestep="0.002" gravity="0 0 0"/><worldbody><body><joint name="slide" type="slide" axis="1 0 0"
      range="0 0.4" damping="{damping}"/><inertial mass="0.5" pos="0 0 0" diaginertia="1e-3 1e-3 1e-3"/></body></worldbody>
      <actuator><position name="slide" joint="slide" kp="50" ctrlrange="0 0.4"/></actuator></mujoco>"""
    found = {}
    for ratio in (0.2, 0.8):
        robot = MjcfRobot("gripper", servo.format(damping=2 * ratio * np.sqrt(50 * 0.5)))
        alone = replace(STUDY.ensemble, members=1, damping=0.0, mass=0.0, delay=(0.0, 0.0))
        study = replace(quick(), ensemble=alone)
        scenarios = [workflow.load_scenario(o.scenario, robot, search=False) for o in study.objectives]
        own = make_plant_problem(study, Model(robot), scenarios)
        found[ratio] = own.limits.overshoot
    beyond = np.exp(-np.pi * 0.2 / np.sqrt(1 - 0.2**2))
    assert study.limits.overshoot < beyond and found[0.2] == pytest.approx(1.1 * beyond, rel=0.02)
    assert found[0.8] == study.limits.overshoot


def test_placed_gains_are_stable_on_the_ensemble_and_wild_ones_are_refused(problem: PlantProblem) -> None:
    wilder, wildest = problem.candidate(np.array([1.0, 1.0, 40.0, 0.3])), problem.candidate(np.full(4, 40.0))
    good, wild = problem.evaluations([problem.first, wilder], Workers())
    assert good.stable and good.cost < 1e4 and len(good.member_costs) == 2
    assert not wild.feasible and wild.cost > 1e3
    model = problem.members[0]
    assert problem.moduli(problem.first, model)[0] < 1 < problem.moduli(wildest, model)[0]


def test_a_study_that_names_joints_is_for_these_alone(tmp_path: Path) -> None:
    table = presets.read_toml(ROOT / "tuning" / "pid.toml")
    assert table["joints"] == ["hip", "knee"]
    said = refusal(lambda: study_from_dict({**table, "joints": "hip"}, "mine.toml"))
    assert said == "mine.toml: joints is 'hip', expected a list of names of joints"
    assert own_settings("pid.toml", ARM) == "pid_arm.toml"


@pytest.mark.slow
def test_what_is_tuned_is_written_for_that_robot_and_run_takes_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "tuning").mkdir()
    text = (ROOT / "tuning" / "pid_any.toml").read_text()
    text = text.replace("members = 4 ", "members = 1 ").replace("unseen = 8 ", "unseen = 1 ")
    text = text.replace("duration = 3.0", "duration = 1.5").replace("duration = 4.0", "duration = 1.5")
    (tmp_path / "tuning" / "pid_any.toml").write_text(text)
    model = Model(ARM)
    tuned = workflow.tune_into("pid", None, model, candidates=3, workers=1)
    assert tuned.settings == tmp_path / "controllers" / "pid_arm.toml" and tuned.reused == 0
    record = json.loads(tuned.record.read_text())
    assert record["evaluated"] == 3 and record["unseen"]["robots"] == 1
    again = workflow.tune_into("pid", None, model, candidates=3, workers=1)
    assert again.reused == 3 and again.settings.read_text() == tuned.settings.read_text()
    done = workflow.run_scenario("hold", "pid", model=model, options={"duration": "0.5"})
    assert done.run.note == ""  # gains that were tuned
    assert workflow.run_scenario("hold", "pid", options={"duration": "0.1"}).run.note == ""


def test_the_leg_has_its_own_study() -> None:
    assert study_for("pid", nominal_model()).name == "pid.toml"
    assert study_for("pid", Model(ARM)).name == "pid_any.toml"
    assert study_for("nmpc", nominal_model()).name == "leg.toml"
    assert study_for("lqr", nominal_model()).name == "lqr.toml"
    assert study_for("lqr", Model(ARM)).name == "any.toml"


@pytest.mark.slow
def test_a_study_may_say_that_the_hardest_robots_only_have_to_keep_the_limits() -> None:
    for counts, hardest in ((True, 0), (False, 1)):
        study = quick()
        study = replace(study, ensemble=replace(study.ensemble, corners_count=counts))
        scenarios = [workflow.load_scenario(o.scenario, ARM, search=False) for o in study.objectives]
        assert make_plant_problem(study, Model(ARM), scenarios).hardest == hardest


def judged(cost: float, members: tuple[float, ...]) -> Evaluation:
    return Evaluation(cost, {}, members, 0.0, 0.0, 0.9, 0.9, True, True)


@pytest.fixture(scope="module")
def three(problem: PlantProblem) -> PlantProblem:
    """The model, the robot that is hardest, and that once more as if it had been drawn."""
    first, hardest = problem.members
    starts = [problem.starts[k] for k in (0, 1, 1)]
    own = replace(problem, members=[first, hardest, hardest], starts=starts, hardest=1)
    assert problem.paying == [0, 1] and own.paying == [0, 2] and own.stages == [[1], [0], [2]]
    return own


@pytest.mark.slow
def test_what_the_hardest_robot_costs_does_not_count_and_each_has_noise_of_its_own(three: PlantProblem) -> None:
    (whole,) = three.evaluations([three.first], Workers())
    model, hardest, drawn = whole.member_costs
    assert whole.feasible and hardest != drawn and hardest == pytest.approx(drawn, rel=0.2)
    assert whole.cost == pytest.approx(0.5 * (model + drawn) / 2 + 0.5 * max(model, drawn), rel=1e-12)
    (alone,) = three.on_each([three.first], Workers())
    assert [own.cost for own in alone] == list(whole.member_costs)


@pytest.mark.slow
def test_a_candidate_that_is_not_to_become_the_cheapest_is_not_tried_to_the_end(three: PlantProblem) -> None:
    (whole,) = three.evaluations([three.first], Workers())
    dearer = judged(2 * whole.cost, tuple(2 * cost for cost in whole.member_costs))
    (again,) = three.evaluations([three.first], Workers(), [dearer])
    assert repr(again) == repr(whole) and len(whole.member_costs) == 3
    # As dear as it is on the model alone, it would have to be cheaper on the other than is thought possible.
    cheap = judged(0.5 * whole.cost, tuple(0.5 * cost for cost in whole.member_costs))
    (beaten,) = three.evaluations([three.first], Workers(), [cheap])
    assert beaten.beaten and not beaten.feasible and beaten.within and len(beaten.member_costs) == 2
    least = three._at_least({0: whole.member_costs[0]}, 0.9 * np.array(cheap.member_costs)[[0, 2]])
    assert beaten.cost == pytest.approx(least) and cheap.cost < beaten.cost <= whole.cost
    assert beaten.told == f"at least {beaten.cost:.4f}"
    assert Evaluation.from_dict(json.loads(json.dumps(beaten.to_dict()))).to_dict() == beaten.to_dict()


@pytest.mark.slow
def test_where_no_loops_tell_the_hardest_robot_is_tried_last_and_of_the_cheapest_only(three: PlantProblem) -> None:
    blind = replace(three, space=replace(three.space, growth=None))
    assert blind.stages == [[0], [2], [1]]
    (whole,) = blind.evaluations([three.first], Workers())
    assert whole.feasible and len(whole.member_costs) == 3
    dear = judged(0.99 * whole.cost, whole.member_costs)
    (beaten,) = blind.evaluations([three.first], Workers(), [dear])
    assert beaten.beaten and beaten.cost == whole.cost and beaten.member_costs == whole.member_costs[::2]
    # What it cost on those that count is known all the same.
    assert blind._paid(beaten) == blind._paid(whole) == whole.member_costs[::2]
    two = replace(blind, members=three.members[:2], starts=three.starts[:2])
    mild, hard = (
        max(run.terms[1] for own in two.member_outcomes([two.first], number) for run in own.runs) for number in (0, 1)
    )
    assert mild < hard
    for most, kept in ((1.01 * hard, True), ((mild + hard) / 2, False)):
        limited = replace(two, limits=replace(two.limits, overshoot=most))
        (found,) = limited.evaluations([two.first], Workers())
        assert found.within == kept and len(found.member_costs) == 2


@pytest.mark.slow
def test_a_further_dead_time_is_tried_only_of_what_would_be_the_cheapest(problem: PlantProblem) -> None:
    """With a dead time so long that no loop bears it, who is the cheapest fails, and who is not is never asked."""
    lost = replace(problem, margin=True, limits=replace(problem.limits, delay_margin=0.5))
    (whole,) = problem.evaluations([problem.first], Workers())
    (asked,) = lost.evaluations([problem.first], Workers())
    assert not asked.within and asked.cost > 1e3
    least = (0.0, 0.0)
    (spared,) = lost.evaluations([problem.first], Workers(), [judged(0.99 * whole.cost, least)])
    assert spared.beaten and spared.cost == whole.cost and spared.member_costs == whole.member_costs


def test_a_candidate_whose_loops_are_beyond_the_limits_does_not_run(problem: PlantProblem) -> None:
    (found,) = problem.evaluations([problem.candidate(np.ones(4))], Workers())
    assert found.stable and not found.within and found.cost > 1e3 and np.isnan(found.overshoot)
    said = refusal(lambda: best_feasible([Trial(0, "start", (1.0,) * 4, found, False)]))
    assert "the nearest its slowest mode has modulus" in said and "nan" not in said


SHORT = {
    "members = 7 ": "members = 4 ", "unseen = 40 ": "unseen = 1 ", "duration = 4.0": "duration = 2.0",
    "duration = 3.0": "duration = 1.0",
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize(
    ("controller", "study"), [("lqr", "lqr.toml"), pytest.param("nmpc", "leg.toml", marks=pytest.mark.long)]
)
def test_regulators_of_the_leg_are_tuned_from_the_study_to_the_file(
    controller: str, study: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All of the command, shortened: better than where it begins, taken up again where it stopped, and driven by run."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "tuning").mkdir()
    text = (ROOT / "tuning" / study).read_text()
    for long, short in SHORT.items():
        assert long in text
        text = text.replace(long, short)
    (tmp_path / "tuning" / study).write_text(text)
    tuned = workflow.tune_into(controller, candidates=8, workers=1)
    record = json.loads(tuned.record.read_text())
    assert record["best"]["feasible"] and record["best"]["cost"] < record["start"]["cost"]
    assert set(record["searched"]["tuned"]) >= {"pressure", "observer.torque", "observer.pressure"}
    assert record["unseen"]["stable"] == record["unseen"]["robots"] == 1 and record["evaluated"] == 8
    again = workflow.tune_into(controller, candidates=8, workers=1)
    assert again.reused == 8 and again.settings.read_text() == tuned.settings.read_text()
    done = workflow.run_scenario("hold", controller, options={"duration": "0.3"})
    assert np.isfinite(done.run.command).all()
