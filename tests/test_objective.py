"""What candidates are judged by: the compiled loop against the plant in MuJoCo, and every figure by hand."""

from __future__ import annotations

import math
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest

import equimus_ctrl as eq
from equimus_ctrl.effects.command import POWER
from equimus_ctrl.robots.elastic.morphology import pack
from equimus_ctrl.tuning.ensemble import make_ensemble
from equimus_ctrl.tuning.evaluation import BAND, TERMS, Evaluation, LegOutcome, Outcome
from equimus_ctrl.tuning.objective import Problem, make_task
from equimus_ctrl.tuning.study import EnsembleSettings, Limits, Weights

DT = 1 / 120
HOLD = eq.Scenario("hold", "", 3.0, eq.HoldReference([1.5, 0.6]), step_like=True)
SWAY = eq.Scenario(
    "sway",
    "",
    2.0,
    eq.FunctionReference(lambda t: (1.45 + 0.12 * math.sin(4 * t), 0.5 + 0.2 * math.sin(3 * t))),
    start=eq.Start(command=[14e3, 6e3], position=[1.42, 0.45]),
)

UNLIMITED = (np.inf, np.inf, 0.0)
"""A valve's rate and filling flow where it has neither."""


def gains(kp: float, ki: float, kd: float, tf: float = 0.02) -> eq.PidSettings:
    return eq.PidSettings(
        {"maa": eq.PidGains(kp, ki, kd), "baa": eq.PidGains(kp / 2, ki / 2, kd / 2)}, derivative_time=tf
    )


JOINT = eq.PidSettings({"hip": eq.PidGains(2.0, 3.0, 0.1), "knee": eq.PidGains(1.5, 1.0, 0.08)}, "joint")
STOP = eq.Scenario("stop", "", 1.0, eq.HoldReference([1.55, 0.0]), step_like=True)
GENTLE, BRISK, WILD = gains(150, 150, 5), gains(500, 300, 15), gains(3000, 5000, 200)


def make_problem(noise: float = 0.0, tasks: tuple[eq.Scenario, ...] = (HOLD, SWAY), **ensemble: object) -> Problem:
    model = eq.nominal_model()
    legs = make_ensemble(model, EnsembleSettings(**{"members": 4, **ensemble}), 4, 2)  # type: ignore[arg-type]
    sampled = [make_task(s, 1.0 + k, 0.0, model, noise, 5 + k) for k, s in enumerate(tasks)]
    return Problem(model, legs, sampled, Weights(), Limits(overshoot=0.6))


@pytest.fixture(scope="module")
def problem() -> Problem:
    return make_problem()


@pytest.fixture(scope="module")
def pool() -> Iterator[ThreadPoolExecutor]:
    with ThreadPoolExecutor(2) as pool:
        yield pool


def in_mujoco(
    problem: Problem, settings: eq.PidSettings, member: int, scenario: eq.Scenario, physics: float = 480.0
) -> eq.Run:
    """One leg of an ensemble in the plant that users have."""
    leg = problem.members[member]
    valves = [
        effect
        for name, (delay, lag, *_) in zip(("maa", "baa"), leg.valve, strict=True)
        for effect in (eq.TransportDelay(name, delay), eq.FirstOrderLag(name, lag))
    ]
    model, rates = eq.Model(leg.morphology, tuple(valves)), eq.PlantRates(physics=physics)
    plant = eq.MujocoPlant(model, nominal=eq.nominal_leg(), rates=rates)
    return eq.run(plant, eq.PidController(settings), scenario.reference, scenario.duration, start=scenario.start)


# The loop.


@pytest.mark.parametrize(
    ("settings", "task", "member"),
    [(GENTLE, 0, 1), (BRISK, 1, 1), (BRISK, 0, 3), (JOINT, 1, 3)],
    ids=["gentle, hold, hardest", "brisk, sway, hardest", "brisk, hold, drawn", "joint, sway, drawn"],
)
def test_the_compiled_loop_is_the_plant_and_the_pid(
    problem: Problem, settings: eq.PidSettings, task: int, member: int
) -> None:
    """A perturbed leg behind valves that are late and slow: MuJoCo's 3-2-1 elements within 2e-5 rad."""
    scenario = (HOLD, SWAY)[task]
    assert problem.members[member].valve[:, :POWER].min() > 0
    run = in_mujoco(problem, settings, member, scenario)
    q, u, done = problem.simulate(settings, member, task)
    assert done == len(run.time) == round(scenario.duration * 120)
    np.testing.assert_allclose(q, run.position, rtol=0, atol=2e-5)
    np.testing.assert_allclose(u, run.command, rtol=0, atol=20.0)


@pytest.mark.parametrize(("physics", "tolerance"), [(480.0, 2e-4), (1920.0, 3e-6)])
def test_at_a_stop_the_two_agree_the_better_the_shorter_the_step(physics: float, tolerance: float) -> None:
    """The knee's stop is stiff, and the loop on the hardest leg swings into it."""
    problem = replace(make_problem(tasks=(STOP,)), steps=round(physics / 120))
    run = in_mujoco(problem, BRISK, 1, STOP, physics)
    q, _, _ = problem.simulate(BRISK, 1, 0)
    assert q[:, 1].min() < -0.035
    np.testing.assert_allclose(q, run.position, rtol=0, atol=tolerance)


def test_asymmetric_valves_too(problem: Problem) -> None:
    leg = replace(problem.members[2], valve=np.array([[0.013, 0.03, 0.11, *UNLIMITED], [0.0, 0.0, 0.0, *UNLIMITED]]))
    one = replace(problem, members=[leg], _starts={}, _legs={})
    effects = (eq.TransportDelay("maa", 0.013), eq.AsymmetricLag("maa", 0.03, 0.11))
    plant = eq.MujocoPlant(eq.Model(leg.morphology, effects), nominal=eq.nominal_leg())
    run = eq.run(plant, eq.PidController(GENTLE), SWAY.reference, SWAY.duration, start=SWAY.start)
    np.testing.assert_allclose(one.simulate(GENTLE, 0, 1)[0], run.position, rtol=0, atol=2e-5)


def test_noise_is_seen_by_the_controller_and_not_in_the_angles() -> None:
    quiet, noisy = make_problem(), make_problem(noise=0.002)
    assert noisy.tasks[0].noise.std() == pytest.approx(0.002, rel=0.1)
    (q, u, _), (q_noisy, u_noisy, _) = (p.simulate(BRISK, 2, 1) for p in (quiet, noisy))
    rough = np.diff(u_noisy, axis=0).std() / np.diff(u, axis=0).std()
    assert rough > 1.5 and np.abs(q - q_noisy).max() < 0.01
    again = make_problem(noise=0.002).simulate(BRISK, 2, 1)
    assert np.array_equal(again[0], q_noisy) and np.array_equal(again[1], u_noisy)


def test_a_leg_starts_at_its_own_rest_or_where_the_scenario_says(problem: Problem) -> None:
    for k, leg in enumerate(problem.members):
        np.testing.assert_allclose(problem.simulate(GENTLE, k, 0)[0][0], leg.rest(np.zeros(2), "swing"), atol=1e-9)
        np.testing.assert_allclose(problem.simulate(GENTLE, k, 1)[0][0], [1.42, 0.45], atol=1e-12)


def test_a_task_samples_its_scenario() -> None:
    task = make_task(SWAY, 2.0, 0.5, eq.nominal_model(), 0.0, 0)
    assert task.reference.shape == (60, 2) and task.control_dt == DT and task.weight == 2.0
    for k in (0, 17, 59):
        np.testing.assert_array_equal(task.reference[k], SWAY.reference.position(k / 120))
    np.testing.assert_array_equal(task.command_before, [14e3, 6e3])
    np.testing.assert_array_equal(make_task(HOLD, 1.0, 0.0, eq.nominal_model(), 0.0, 0).command_before, 0.0)
    assert len(make_task(HOLD, 1.0, 0.0, eq.nominal_model(), 0.0, 0).reference) == 360
    assert not make_task(HOLD, 1.0, 0.0, eq.nominal_model(), 0.0, 0).noise.any()


# Its figures.


@pytest.mark.parametrize("settings", [GENTLE, BRISK, gains(900, 2000, 3)], ids=["gentle", "brisk", "loose"])
@pytest.mark.parametrize("task", [0, 1], ids=["hold", "sway"])
def test_the_terms_by_hand(problem: Problem, settings: eq.PidSettings, task: int) -> None:
    q, u, _ = problem.simulate(settings, 0, task)
    r = problem.tasks[task].reference
    expected = dict.fromkeys(TERMS, 0.0)
    n = len(q)
    expected["error"] = math.sqrt(sum((q[k, j] - r[k, j]) ** 2 for k in range(n) for j in range(2)) / (2 * n))
    expected["effort"] = math.sqrt(sum((u[k, i] / 50e3) ** 2 for k in range(n) for i in range(2)) / (2 * n))
    travelled = sum(abs(u[k + 1, i] - u[k, i]) for k in range(n - 1) for i in range(2)) / 2
    expected["chatter"] = travelled / 50e3 / ((n - 1) * DT)
    restless = 0.0
    if task == 0:
        late = range(n - n // 4, n)
        for j in range(2):
            step = r[-1, j] - q[0, j]
            beyond = max((q[k, j] - r[-1, j]) * math.copysign(1, step) for k in range(n))
            expected["overshoot"] = max(expected["overshoot"], beyond / max(abs(step), BAND))
            restless = max(restless, max(q[k, j] for k in late) - min(q[k, j] for k in late))
        expected["offset"] = math.sqrt(sum((q[k, j] - r[k, j]) ** 2 for k in late for j in range(2)) / (2 * len(late)))
        for k in range(n):
            if any(abs(q[k, j] - r[k, j]) > problem.weights.settled for j in range(2)):
                expected["settling"] = (k + 1) * DT
    found = problem.outcome(settings, 0, task)
    for key, value in zip(TERMS, found.terms, strict=True):
        assert value == pytest.approx(expected[key], rel=1e-9, abs=1e-15), key
    assert found.restless == pytest.approx(restless) and not found.diverged
    limited = sum(u[k, i] in (0.0, 50e3) for k in range(n) for i in range(2))
    assert found.saturation == pytest.approx(limited / (2 * n))


def made(
    terms: tuple[float, ...] = (0.1, 0.0, 1.0, 0.01, 0.3, 0.2), saturation: float = 0.1, restless: float = 0.0
) -> Outcome:
    return Outcome(np.array(terms), saturation, restless, False)


CRASH = Outcome(np.full(6, math.inf), 1.0, math.inf, True)


def leg_of(*runs: Outcome, modulus: float = 0.99, raised: float = 0.995) -> LegOutcome:
    return LegOutcome(runs, modulus, raised)


def test_the_cost_is_the_weighted_sum_between_mean_and_worst(problem: Problem) -> None:
    judge = replace(problem, weights=Weights(1.0, 2.0, 3.0, 4.0, 5.0, 6.0, worst=0.25))
    legs = [leg_of(made(), made((0.2, 0.1, 0, 0, 0, 0))), leg_of(made((1, 0, 0, 0, 0, 0)), made((0, 0, 0, 0, 0, 1.0)))]
    first = (0.1 + 3.0 + 0.04 + 1.5 + 1.2) * 1 / 3 + (0.2 + 0.2) * 2 / 3  # tasks weigh 1 and 2
    second = 1.0 / 3 + 6.0 * 2 / 3
    found = judge.judge(legs)
    assert found.member_costs == pytest.approx((first, second))
    assert found.cost == pytest.approx(0.75 * (first + second) / 2 + 0.25 * second)
    assert sum(found.terms.values()) == pytest.approx((first + second) / 2)
    assert found.terms["chatter"] == pytest.approx((1.2 / 3 + 6.0 * 2 / 3) / 2)
    assert found.overshoot == pytest.approx(0.1) and found.stable and found.feasible


BEYOND = {
    "overshoot": leg_of(made((0.1, 0.7, 1, 0, 0, 0)), made()),
    "saturation": leg_of(made(saturation=0.6), made()),
    "slow": leg_of(made(), made(), modulus=0.9985),
    "gain margin": leg_of(made(), made(), raised=1.001),
}
UNSTABLE = {
    "eigenvalue": leg_of(made(), made(), modulus=1.0001, raised=math.nan),
    "restless": leg_of(made(restless=BAND * 1.1), made(), modulus=math.nan, raised=math.nan),
}


def test_any_leg_beyond_a_limit_costs_more_than_all_within(problem: Problem) -> None:
    poor = problem.judge([leg_of(made((2.0, 0.2, 6.0, 0.5, 1.0, 1.0)), made())] * 4)
    assert poor.feasible
    for name, leg in BEYOND.items():
        for place in range(4):
            legs = [leg_of(made(), made())] * 4
            legs[place] = leg
            found = problem.judge(legs)
            assert found.stable and not found.feasible and 1e3 <= found.cost < 1e6, name
            assert found.cost > poor.cost


def test_an_unstable_leg_costs_more_than_anything_stable(problem: Problem) -> None:
    good = leg_of(made((0, 0, 0, 0, 0, 0)), made((0, 0, 0, 0, 0, 0)))
    beyond = max(problem.judge([leg] * 4).cost for leg in BEYOND.values())
    for name, leg in UNSTABLE.items():
        for place in range(4):
            legs = [good] * 4
            legs[place] = leg
            found = problem.judge(legs)
            assert not found.stable and not found.feasible and found.cost > beyond, name
    crash = problem.judge([good, leg_of(CRASH, made(), modulus=math.nan, raised=math.nan), good, good])
    assert not crash.stable and not crash.feasible and crash.cost >= 1e9 and math.isinf(crash.overshoot)
    worse = problem.judge([leg_of(CRASH, CRASH, modulus=math.nan, raised=math.nan)] * 4)
    assert worse.cost > crash.cost


def test_farther_beyond_costs_more(problem: Problem) -> None:
    for key in (0.7, 0.9, 1.5):
        little, much = (problem.judge([leg_of(made((0.1, x, 1, 0, 0, 0)), made())] * 2).cost for x in (key - 0.02, key))
        assert little < much
    slow, slower = (problem.judge([leg_of(made(), made(), modulus=m)] * 2).cost for m in (0.9985, 0.9995))
    assert slow < slower


def test_a_diverged_run_is_seen() -> None:
    """A leg so light and stiff that no step of physics is short enough."""
    problem = make_problem()
    light = eq.nominal_leg().with_parameters(
        {"thigh.mass": 1e-9, "calf.mass": 1e-9, "thigh.inertia": 0.0, "calf.inertia": 0.0, "maa.stiffness": 1e7}
    )
    leg = replace(problem.members[0], morphology=light, parameters=pack(light))
    one = replace(problem, members=[leg], _starts={(0, 0): np.array([1.5, 0.3]), (0, 1): np.array([1.5, 0.3])})
    outcome = one.outcome(WILD, 0, 1)
    assert outcome.diverged and np.all(np.isinf(outcome.terms)) and outcome.saturation == 1.0
    (judged,) = one.leg_outcomes([(WILD, 0)], raised=False)
    assert not judged.calm and math.isnan(judged.modulus)
    assert not one.judge([judged]).stable


def test_stable_gains_are_feasible_and_wild_ones_are_not(problem: Problem, pool: ThreadPoolExecutor) -> None:
    gentle, wild = problem.evaluate([GENTLE, WILD], pool)
    assert gentle.stable and gentle.modulus < 1 and gentle.cost < 1e3
    assert not wild.stable and not wild.feasible and wild.cost >= 1e6


def test_candidates_come_in_order_whatever_the_number_of_threads(problem: Problem) -> None:
    asked = [GENTLE, WILD, BRISK, gains(200, 100, 3), gains(80, 50, 2)]
    found = []
    for workers in (1, 3):
        with ThreadPoolExecutor(workers) as pool:
            found.append([e.to_dict() for e in problem.evaluate(asked, pool)])
    assert repr(found[0]) == repr(found[1])
    with ThreadPoolExecutor(1) as pool:
        alone = [next(iter(problem.evaluate([settings], pool))) for settings in asked]
    for one, other in zip(alone, found[0], strict=True):
        if one.stable:
            assert repr(one.to_dict()) == repr(other)


def test_a_candidate_is_worth_the_same_alone_and_beside_others(problem: Problem, pool: ThreadPoolExecutor) -> None:
    """Else a search that goes on after an interruption sees other numbers than one that was never interrupted."""
    together = next(iter(problem.evaluate([WILD, GENTLE], pool)))
    alone = next(iter(problem.evaluate([WILD], pool)))
    assert repr(alone.to_dict()) == repr(together.to_dict())


def test_an_error_in_a_job_is_handed_on(problem: Problem, pool: ThreadPoolExecutor) -> None:
    wrong = eq.PidSettings({"maa": eq.PidGains(1.0)})
    with pytest.raises(eq.ConfigError, match="channel 'baa' has none"):
        list(problem.evaluate([GENTLE, wrong], pool))


def test_evaluations_survive_plain_types(problem: Problem, pool: ThreadPoolExecutor) -> None:
    found = next(iter(problem.evaluate([GENTLE], pool)))
    again = Evaluation.from_dict(found.to_dict())
    assert repr(again) == repr(found) and again is not found


def test_poses_are_the_targets_of_steps_and_points_along_the_way(problem: Problem) -> None:
    poses = problem.poses(4)
    assert len(poses) == 5
    np.testing.assert_allclose(poses[0], [1.5, 0.6])
    for pose, k in zip(poses[1:], (30, 90, 150, 210), strict=True):
        np.testing.assert_allclose(pose, SWAY.reference.position(k / 120))


def test_a_joint_that_stays_where_it_is_cannot_hide_its_swing(problem: Problem) -> None:
    """The knee is to stay, to the last bit, and swings by a fifth of a radian while the hip moves."""
    pose = problem.members[0].rest(np.array([14e3, 6e3]), "swing")
    stay = eq.Scenario(
        "stay", "", 1.5, eq.HoldReference([1.1, pose[1]]), start=eq.Start([14e3, 6e3], pose), step_like=True
    )
    one = make_problem(tasks=(stay,))
    q, _, _ = one.simulate(GENTLE, 0, 0)
    swing = np.abs(q[:, 1] - pose[1]).max()
    assert swing > 2 * BAND
    assert one.outcome(GENTLE, 0, 0).terms[1] >= swing
