"""Optimal control over a horizon: its parts against plain algebra, its plans against an interior-point solver."""

from __future__ import annotations

import math
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

from equimus_ctrl.effects import make
from equimus_ctrl.engines import native as native_code
from equimus_ctrl.errors import ConfigError
from equimus_ctrl.models.inverse import holding_pressure
from equimus_ctrl.models.model import Model
from equimus_ctrl.models.prediction import prediction
from equimus_ctrl.predictive.condensing import fold, steepest, weigh
from equimus_ctrl.predictive.costs import Wanted, Weights
from equimus_ctrl.predictive.problem import Answer, Plan, Problem
from equimus_ctrl.predictive.quadratic import SOLVERS, QuadraticProgram
from equimus_ctrl.robots.elastic.leg import nominal_leg
from equimus_ctrl.types import Array

LEG = nominal_leg()
LAG = tuple(make("first_order_lag", name, {"time_constant": tau}) for name, tau in (("maa", 0.1), ("baa", 0.06)))
MODEL = Model(LEG, LAG)
DT = 1 / 60
WEIGHTS = Weights(0.03, 1.0, 1e3, 0.003)
POSE = np.array([1.45, 0.6])


def problem(n: int = 12, *, model: Model = MODEL, angles: Array | None = None, **options: object) -> Problem:
    given = np.array(LEG.joint_range) if angles is None else angles
    return Problem(
        prediction(model, stops=False), np.full(n, DT), WEIGHTS, given, np.array([[0.0, 0.0], [5e4, 5e4]]),
        **{"compiled": False, **options},  # type: ignore[arg-type]
    )  # fmt: skip


def rest(pose: Array, n: int, model: Model = MODEL) -> Wanted:
    """Staying at a pose, the last state as dear as a second of all others."""
    held = holding_pressure(model, pose)
    at = np.concatenate([pose, np.zeros(2), held])
    last = np.diag(1 / np.array([0.03, 0.03, 1.0, 1.0, 1e3, 1e3]))
    return Wanted(np.tile(at, (n + 1, 1)), np.tile(held, (n, 1)), last)


def solved(
    p: Problem, start: Array, wanted: Wanted, disturbance: Array | None = None, **options: object
) -> tuple[Answer, Plan]:
    given, disturbance = (
        {"iterations": 60, "tolerance": 1e-7, **options},
        np.zeros(2) if disturbance is None else disturbance,
    )
    guess = p.first_guess(0.0, start, disturbance, wanted)
    answer = p.solve(start, disturbance, wanted, guess, **given)  # type: ignore[arg-type]
    return answer, answer.plan


def by_interior_point(p: Problem, start: Array, wanted: Wanted, disturbance: Array) -> tuple[float, Array]:
    """The same problem written down once more: cost and inputs (n, na)."""
    n, na, nj, nx = len(p.durations), 2, 2, p.prediction.nx
    u, x, slack = ca.MX.sym("u", na, n), ca.MX.sym("x", nx, n + 1), ca.MX.sym("slack", nj, n)
    cost, same = ca.MX(0), [x[:, 0] - start]
    for k in range(n):
        same.append(p.prediction.step(x[:, k], u[:, k], disturbance, DT) * 1.0 - x[:, k + 1])
        cost += DT / 2 * ca.sumsqr((u[:, k] - wanted.feed[k]) / WEIGHTS.pressure)
        cost += DT / 2 * ca.sumsqr(slack[:, k] / WEIGHTS.limit)
        if k > 0:
            cost += DT / 2 * ca.sumsqr((x[:nj, k] - wanted.states[k, :nj]) / WEIGHTS.angle)
            cost += DT / 2 * ca.sumsqr((x[nj : 2 * nj, k] - wanted.states[k, nj : 2 * nj]) / WEIGHTS.rate)
    cost += ca.sumsqr(wanted.last @ (x[:, n] - wanted.states[n])) / 2
    unknowns = ca.vertcat(ca.vec(u), ca.vec(x), ca.vec(slack))
    equal, soft = ca.vertcat(*same), ca.vec(x[:nj, 1:] + slack)
    solver = ca.nlpsol(
        "exact", "ipopt", {"x": unknowns, "f": cost, "g": ca.vertcat(equal, soft)},
        {"ipopt.print_level": 0, "print_time": False, "ipopt.tol": 1e-9, "ipopt.sb": "yes"},
    )  # fmt: skip
    free = np.full((n + 1) * nx + n * nj, np.inf)
    found = solver(
        x0=ca.vertcat(ca.vec(ca.DM(wanted.feed.T)), ca.vec(ca.DM(wanted.states.T)), ca.DM.zeros(n * nj)),
        lbx=np.concatenate([np.tile(p.inputs[0], n), -free]), ubx=np.concatenate([np.tile(p.inputs[1], n), free]),
        lbg=np.concatenate([np.zeros(equal.numel()), np.tile(p.angles[0], n)]),
        ubg=np.concatenate([np.zeros(equal.numel()), np.tile(p.angles[1], n)]),
    )  # fmt: skip
    assert solver.stats()["success"]
    return float(found["f"]), np.array(found["x"][: na * n]).reshape(n, na)


@pytest.mark.parametrize("far", [0.02, 0.3])
def test_its_plan_is_the_one_an_interior_point_solver_finds(far: float) -> None:
    p, wanted, disturbance = problem(), rest(POSE, 12), np.array([0.05, -0.02])
    start = np.concatenate([POSE + np.array([far, -far]), [0.5, -1.0], [1e4, 2e4]])
    answer, plan = solved(p, start, wanted, disturbance)
    cost, inputs = by_interior_point(p, start, wanted, disturbance)
    assert answer.outcome == "converged"
    again, _ = solved(p, start, wanted, disturbance)
    assert answer.cost == pytest.approx(cost, rel=1e-5)
    np.testing.assert_allclose(plan.inputs, inputs, atol=20.0)
    np.testing.assert_array_equal(again.plan.inputs, plan.inputs)
    if far > 0.1:
        assert np.any((plan.inputs == 0) | (plan.inputs == 5e4))  # limits were in the way
    # The states of the plan are what the inputs lead to.
    x = start
    for k in range(12):
        x = np.array(p.prediction.step(x, plan.inputs[k], disturbance, DT)).ravel()
        np.testing.assert_allclose(plan.states[k + 1], x, atol=1e-5 * np.array([1, 1, 10, 10, 1e5, 1e5]).max())


def test_joint_ranges_are_soft_and_the_plan_is_still_the_best() -> None:
    angles = np.array([[1.2, 0.3], [1.5, 0.62]])
    p, wanted = problem(angles=angles), rest(POSE + np.array([0.0, 0.1]), 12)  # wanted beyond the knee's range
    start = np.concatenate([POSE + np.array([0.02, -0.1]), [0.0, 1.5], holding_pressure(MODEL, POSE)])
    answer, plan = solved(p, start, wanted)
    cost, inputs = by_interior_point(p, start, wanted, np.zeros(2))
    assert answer.outcome == "converged"
    assert answer.cost == pytest.approx(cost, rel=1e-5)
    np.testing.assert_allclose(plan.inputs, inputs, atol=50.0)
    free = solved(problem(), start, wanted)[1]
    assert plan.states[:, 1].max() < free.states[:, 1].max() - 0.01


@pytest.mark.parametrize("solver", ["daqp", "osqp"])
def test_rates_are_limited_to_the_last_bit(solver: str) -> None:
    rate, before = 1e5, np.array([1.5e4, 1.2e4])
    start = np.concatenate([POSE, [0.0, 0.0], before])
    answer, plan = solved(problem(rate=rate, solver=solver), start, rest(POSE + 0.2, 12), before=before, period=1 / 120)
    assert answer.outcome in ("converged", "iterated")
    change = np.diff(np.vstack([before, plan.inputs]), axis=0)
    assert np.abs(change[0]).max() <= rate / 120 + 1
    assert np.abs(change[1:]).max() <= rate * DT + 1
    assert np.abs(change[1:]).max() > 0.9 * rate * DT


def test_limits_that_leave_no_way_are_named() -> None:
    p, start = problem(rate=1e5), np.concatenate([POSE, np.zeros(2), [1e4, 1e4]])
    answer, _ = solved(p, start, rest(POSE, 12), before=np.array([1e4, 6e4]), period=1 / 120)
    assert answer.outcome == "failed" and answer.iterations == 0
    assert answer.reason == (
        "baa: from 60 kPa the rate limit of 100 kPa/s leads to 59.17 to 60.83 kPa, but the limits of what reaches the "
        "valve are 0 to 50 kPa"
    )


def test_inputs_that_are_given_stay_as_they_are() -> None:
    fixed = np.full((12, 2), np.nan)
    fixed[:3, 1] = [3e4, 2e4, 1e4]
    start = np.concatenate([POSE, np.zeros(2), [1e4, 1e4]])
    answer, plan = solved(problem(), start, rest(POSE, 12), fixed=fixed)
    assert answer.outcome == "converged"
    np.testing.assert_allclose(plan.inputs[:3, 1], [3e4, 2e4, 1e4], atol=1e-3)
    limited, plan = solved(
        problem(rate=2e5), start, rest(POSE, 12), fixed=fixed, before=np.array([1e4, 9e3]), period=1 / 120
    )
    assert limited.outcome == "converged"
    np.testing.assert_allclose(plan.inputs[:3, 1], [3e4, 2e4, 1e4], atol=1e-3)
    assert abs(plan.inputs[3, 1] - 1e4) <= 2e5 / 120 + 1


def test_a_far_start_does_not_throw_it_off() -> None:
    rng, p = np.random.default_rng(5), problem()
    low, high = LEG.joint_range
    for _ in range(40):
        start = np.concatenate([rng.uniform(low, high), rng.uniform(-8, 8, 2), rng.uniform(0, 5e4, 2)])
        wanted = rest(rng.uniform(low, high), 12)
        answer, plan = solved(p, start, wanted, tolerance=1e-4, iterations=100)
        assert answer.outcome == "converged", answer
        assert plan.inputs.min() >= 0 and plan.inputs.max() <= 5e4


def test_time_that_is_up_ends_it() -> None:
    start, asked = np.concatenate([POSE + 0.3, np.zeros(4)]), []

    def enough() -> bool:
        asked.append(None)
        return len(asked) > 2

    answer, _ = solved(problem(), start, rest(POSE, 12), enough=enough)
    assert answer.outcome == "iterated" and answer.iterations == 2
    never, plan = solved(problem(), start, rest(POSE, 12), enough=lambda: True)
    assert never.outcome == "failed" and never.reason == "no time was left for a solution"
    assert np.isfinite(plan.inputs).all()


def test_a_state_that_is_no_number_fails_in_words() -> None:
    start = np.concatenate([POSE, [math.nan, 0.0], [1e4, 1e4]])
    answer, _ = solved(problem(), start, rest(POSE, 12))
    assert answer.outcome == "failed" and answer.reason == "the predicted motion leaves every bound"


def test_an_interval_in_several_steps_is_the_finer_motion() -> None:
    p, one = problem(4, steps=3), prediction(MODEL, stops=False).step
    start, u, disturbance = (
        np.concatenate([POSE + 0.2, [1.0, -2.0], [1e4, 2e4]]),
        np.array([3e4, 1e3]),
        np.array([0.1, 0.0]),
    )
    wanted = rest(POSE, 4)
    _, plan = solved(p, start, wanted, disturbance, fixed=np.tile(u, (4, 1)))
    x = start
    for k in range(4):
        for _ in range(3):
            x = np.array(one(x, u, disturbance, DT / 3)).ravel()
        np.testing.assert_allclose(plan.states[k + 1], x, rtol=1e-7, atol=1e-7)
    answer, _ = solved(p, start, wanted, disturbance)
    assert answer.outcome == "converged" and answer.defect < 1e-6  # so its derivatives are right


def test_a_plan_shifted_by_one_interval_is_the_same_plan() -> None:
    p, wanted = problem(), rest(POSE, 12)
    _, plan = solved(p, np.concatenate([POSE + 0.1, np.zeros(2), [1e4, 1e4]]), wanted)
    later = p.shifted(plan, plan.time + DT, wanted)
    np.testing.assert_array_equal(later.inputs[:-1], plan.inputs[1:])
    np.testing.assert_array_equal(later.inputs[-1], wanted.feed[-1])
    np.testing.assert_allclose(later.states[:-1], plan.states[1:], atol=1e-9)
    half = p.shifted(plan, plan.time + DT / 2, wanted)
    np.testing.assert_allclose(half.states[:-1], (plan.states[1:] + plan.states[:-1]) / 2, atol=1e-9)


def test_folding_is_the_recursion_and_weighing_the_sum() -> None:
    rng, n, nx, nu = np.random.default_rng(1), 5, 3, 2
    a, b = rng.normal(size=(n, nx, nx)) / 2, rng.normal(size=(n, nx, nu))
    gap, scale = rng.normal(size=(n, nx)), np.array([2.0, 0.5])
    big, small = np.zeros((n, nx, n * nu)), np.zeros((n, nx))
    fold(np.hstack(list(a)), np.hstack(list(b)), gap, scale, big, small)
    u, x, states = rng.normal(size=(n, nu)), np.zeros(nx), []
    for k in range(n):
        x = a[k] @ x + b[k] @ (scale * u[k]) + gap[k]
        states.append(x)
    np.testing.assert_allclose(big @ u.ravel() + small, states, atol=1e-12)

    error, effort = rng.normal(size=(n, nx)), rng.normal(size=n * nu)
    weight, last, span = rng.uniform(0, 2, (n - 1, nx)), rng.normal(size=(nx, nx)), rng.uniform(1, 2, n * nu)
    weight[:, 0] = 0
    hessian, gradient = np.zeros((n * nu, n * nu)), np.zeros(n * nu)
    rows = np.zeros((nx * n, n * nu))

    def total(change: Array, *, follows: bool = True) -> float:
        off = error + (big @ change + small if follows else 0)
        inputs = (span * (effort + change) ** 2).sum()
        return float(((weight * off[:-1]) ** 2).sum() + ((last @ off[-1]) ** 2).sum() + inputs) / 2

    cost = weigh(big, small, error, weight, last, effort, span, rows, hessian, gradient)
    assert cost == pytest.approx(total(np.zeros(n * nu), follows=False))
    there = rng.normal(size=n * nu)
    expected = total(there) - total(np.zeros(n * nu))
    assert gradient @ there + there @ hessian @ there / 2 == pytest.approx(expected)

    # What a state's jump costs: by differences of the cost where it happens.
    most, found = np.zeros(nx), np.zeros(nx)
    steepest(np.hstack(list(a)), error, weight, last, found)
    for k in range(n):
        for i in range(nx):
            x, cost_slope = np.zeros(nx), 0.0
            for m in range(k, n):
                x = a[m] @ x if m > k else np.eye(nx)[i]
                w = last.T @ last if m == n - 1 else np.diag(weight[m] ** 2)
                cost_slope += error[m] @ w @ x
            most[i] = max(most[i], abs(cost_slope))
    np.testing.assert_allclose(found, most)


@pytest.mark.parametrize("solver", SOLVERS)
def test_programs_are_solved_and_checked(solver: str) -> None:
    rng, n = np.random.default_rng(3), 8
    root = rng.normal(size=(n, n))
    hessian, gradient = root @ root.T + np.eye(n), 5 * rng.normal(size=n)
    box, rows = np.full(n, 0.3), np.eye(n) - np.eye(n, k=-1)
    program = QuadraticProgram(n, rows, solver)
    x = program.solve(hessian, gradient, -box, box, np.full(n, -0.2), np.full(n, 0.2))
    assert x is not None
    assert np.abs(x).max() <= 0.3 + 1e-5 and np.abs(rows @ x).max() <= 0.2 + 1e-5

    def value(y: Array) -> float:
        return float(y @ hessian @ y / 2 + gradient @ y)

    for _ in range(300):
        y = np.clip(x + 0.05 * rng.normal(size=n), -box, box)
        if np.abs(rows @ y).max() <= 0.2:
            assert value(y) >= value(x) - 1e-5
    nowhere = program.solve(hessian, gradient, -box, box, np.full(n, 0.5), np.full(n, 0.6))
    assert nowhere is None  # eight rises of half in a box of 0.6
    assert program.solve(hessian, np.full(n, math.nan), -box, box, -box, box) is None


def test_a_solver_that_there_is_not() -> None:
    with pytest.raises(ConfigError, match="no QP solver 'dapq'; did you mean 'daqp'"):
        QuadraticProgram(2, None, "dapq")


def test_intervals_that_make_no_sense() -> None:
    with pytest.raises(ConfigError, match="intervals are .* expected each more than 0"):
        Problem(prediction(MODEL, stops=False), np.array([0.1, 0.0]), WEIGHTS, np.zeros((2, 2)), np.zeros((2, 2)))


def test_machine_code_gives_the_same_numbers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    if native_code.compiler() is None:
        pytest.skip("no C compiler here")
    monkeypatch.setenv("EQUIMUS_CACHE", str(tmp_path))
    slow, fast = problem(), problem(compiled=True)
    assert fast.is_native and not slow.is_native
    assert len(list(tmp_path.glob("equimus_slopes_*.so"))) == 1
    assert [p.suffix for p in tmp_path.iterdir()] == [".so"]  # nothing is left of how it was made
    start = np.concatenate([POSE + 0.3, [1.0, -1.0], [1e4, 2e4]])
    one, other = (solved(p, start, rest(POSE, 12))[1].inputs for p in (slow, fast))
    np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-6)


@pytest.mark.parametrize("broken", ["", "/nowhere/cc", "false"])
def test_without_a_compiler_the_interpreter_does(broken: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("EQUIMUS_CACHE", str(tmp_path))
    monkeypatch.setenv("CC", broken)
    p = problem(3, compiled=True)
    assert not p.is_native
    assert solved(p, np.concatenate([POSE, np.zeros(4)]), rest(POSE, 3))[0].outcome == "converged"
    assert list(tmp_path.iterdir()) == []
