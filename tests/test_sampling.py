"""The sampling controller and its methods: what they find, what they keep to, and what they do where nothing is found."""

from __future__ import annotations

import re
import textwrap
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from equimus_ctrl.controllers.horizon import FALLBACKS
from equimus_ctrl.controllers.registry import make_controller
from equimus_ctrl.controllers.sampling import SamplingController, SamplingState
from equimus_ctrl.controllers.sampling_settings import FORMAT, SamplingSettings
from equimus_ctrl.effects import Effect, make
from equimus_ctrl.errors import ConfigError, ControllerError
from equimus_ctrl.loop import run
from equimus_ctrl.models.inverse import holding_pressure
from equimus_ctrl.models.model import Model
from equimus_ctrl.plants.mujoco_plant import MujocoPlant
from equimus_ctrl.predictive.costs import Wanted
from equimus_ctrl.predictive.sampling import METHODS, Memory, Method, Spread
from equimus_ctrl.robots.elastic.leg import nominal_leg
from equimus_ctrl.scenarios.references import FunctionReference, HoldReference
from equimus_ctrl.types import Array, Observation, Run, Start

LEG, DT, POSE = nominal_leg(), 1 / 120, np.array([1.45, 0.6])
LAG = (make("first_order_lag", "maa", {"time_constant": 0.1}), make("first_order_lag", "baa", {"time_constant": 0.06}))
DELAYS = (make("transport_delay", "maa", {"delay": 0.05}), make("transport_delay", "baa", {"delay": 0.1}))
CREEP = (make("creep", "maa", {"stiffness": 500.0, "time_constant": 0.5}),)
KNOWN: dict[str, tuple[Effect, ...]] = {
    "nothing": (), "lags": LAG, "late": (*LAG, *DELAYS), "creeps": (*LAG, *CREEP),
}  # fmt: skip
QUICK = {"engine": "exact"}
"""Without MuJoCo a run takes a third of the time where there is a C compiler."""
SPREAD = Spread(30.0, 3000.0, 0.1, 0.1)


def smooth(time: float) -> Array:
    return POSE + np.array([0.07, 0.12]) * np.sin([2.0 * time, 3.0 * time])


def controller(**options: object) -> SamplingController:
    return SamplingController(SamplingSettings(**{**QUICK, **options}))  # type: ignore[arg-type]


def tracked(
    effects: tuple[Effect, ...], known: tuple[Effect, ...], *, leg: object = LEG, noise: float = 0.0,
    reference: object = smooth, duration: float = 3.0, own: SamplingController | None = None, **options: object,
) -> Run:  # fmt: skip
    plant = MujocoPlant(Model(leg, effects), nominal=Model(LEG, known), noise=noise)  # type: ignore[arg-type]
    own = own or controller(**options)
    return run(plant, own, FunctionReference(reference), duration, seed=1)  # type: ignore[arg-type]


def rmse(done: Run, after: float = 1.0) -> Array:
    assert done.truth is not None
    return np.asarray(np.sqrt(((done.truth - done.reference)[done.time > after] ** 2).mean(axis=0)))


def begun(own: SamplingController, effects: tuple[Effect, ...] = LAG) -> tuple[Observation, SamplingState]:
    """A leg that has long been at rest."""
    plant = MujocoPlant(Model(LEG, effects))
    first = plant.reset(Start(command=np.clip(holding_pressure(Model(LEG, effects), POSE), 0, 5e4), position=POSE), 0)
    return first, own.init(plant.spec, first)


def later(observation: Observation, steps: int = 1) -> Observation:
    return replace(observation, time=observation.time + steps * DT, stamp=observation.stamp + steps * DT)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "method"), [*(("late", method) for method in METHODS), ("creeps", "mppi")])
def test_it_follows_a_smooth_reference_through_what_it_knows(method: str, name: str) -> None:
    done = tracked(KNOWN[name], KNOWN[name], method=method)
    assert set(done.status) == {"sampled"}
    assert np.all(rmse(done) < [2e-3, 4e-3])


@pytest.mark.slow
def test_in_mujoco_as_well() -> None:
    done = tracked(LAG, LAG, engine="mujoco", noise=2e-3)
    assert set(done.status) == {"sampled"} and np.all(rmse(done) < [2e-3, 4e-3])


@pytest.mark.slow
def test_it_comes_back_from_where_it_does_not_belong() -> None:
    """A pull on the knee for half a second that nobody told it of: without feedback the leg would be elsewhere."""

    def jump(time: float) -> Array:
        return POSE + np.array([0.1, 0.2]) * (time > 1.0)

    done = tracked(LAG, LAG, reference=jump, duration=3.0)
    assert np.all(rmse(done, 2.5) < 0.02)


@pytest.mark.slow
def test_wrong_numbers_leave_no_offset() -> None:
    leg = LEG.with_parameters({"maa.stiffness": 1.1 * LEG.parameters()["maa.stiffness"]})
    done = tracked(LAG, LAG, leg=leg, reference=lambda time: POSE, duration=6.0)
    assert done.truth is not None
    assert np.all(np.abs((done.truth - POSE)[done.time > 5].mean(axis=0)) < 2e-3)


@pytest.mark.slow
def test_more_plans_cost_less_where_limits_are_in_the_way() -> None:
    """Where none are, the regulator's own plan is the best of any number."""
    found = []
    for samples in (4, 16, 256):
        own = controller(method="predictive_sampling", samples=samples, pressure_rate=1e5)
        observation, state = begun(own)
        costs = []
        for k in range(1, 20):
            _, state = own.step(later(observation, k), HoldReference(POSE + 0.1), state)
            assert state.plan is not None
            costs.append(state.plan.cost.min())
        found.append(np.mean(costs[5:]))
    assert found[0] > 1.01 * found[1] > 1.01 * found[2]


def test_the_plan_of_the_instant_before_is_tried_first() -> None:
    """Nothing moves it where nothing better is drawn: rounds only ever bring its cost down."""
    once, often = controller(method="predictive_sampling"), controller(method="predictive_sampling", iterations=5)
    observation, state = begun(once)
    reference = HoldReference(POSE + 0.1)
    _, one = once.step(later(observation), reference, state)
    _, five = often.step(later(observation), reference, begun(often)[1])
    assert one.plan is not None and five.plan is not None and (one.plan.rounds, five.plan.rounds) == (1, 5)
    assert five.plan.cost[0] <= one.plan.cost.min() * (1 + 1e-12)
    assert five.plan.cost.min() <= five.plan.cost[0]


@pytest.mark.slow
def test_the_same_seed_gives_the_same_bits_and_another_seed_others() -> None:
    first, again, other = (tracked(LAG, LAG, noise=2e-3, duration=0.5, seed=seed) for seed in (3, 3, 4))
    np.testing.assert_array_equal(first.command, again.command)
    assert np.abs(first.command - other.command).max() > 1.0
    own = controller()
    observation, state = begun(own)
    steps = [own.step(later(observation), HoldReference(POSE + 0.1), state)[0] for _ in range(2)]
    np.testing.assert_array_equal(*steps)


def test_commands_stay_within_their_limits_and_rates() -> None:
    done = tracked(LAG, LAG, reference=lambda time: POSE + 0.3 * (time > 0.5), duration=1.5, pressure_rate=1e5)
    assert np.all((done.asked >= 0) & (done.asked <= 5e4))
    assert np.abs(np.diff(done.asked, axis=0)).max() <= 1e5 * DT + 1e-6
    assert np.abs(np.diff(done.asked, axis=0)).max() > 0.99e5 * DT


@pytest.mark.slow
def test_joint_ranges_are_kept_where_they_can_be() -> None:
    low, wanted = LEG.joint_range[0][1], np.array([1.45, 0.3])
    margin = 0.5 - low  # the knee is to stay above half a radian
    kept = tracked(LAG, LAG, reference=lambda time: wanted, margin=margin, duration=2.0)
    assert kept.position[60:, 1].min() > 0.48
    free = tracked(LAG, LAG, reference=lambda time: wanted)
    assert abs(free.position[-1, 1] - 0.3) < 2e-3


@pytest.mark.slow
def test_a_method_of_ones_own_is_three_functions() -> None:
    """Coordinate search: one knot at a time, up and down by a step that halves where neither helps."""

    def begin(shape: tuple[int, int], spread: Spread) -> Memory:
        return spread.most

    def draw(rng: np.random.Generator, nominal: Array, step: Memory, count: int, spread: Spread) -> Array:
        found = np.repeat(nominal[None], count, axis=0)
        for i in range(count):
            found[i].ravel()[(i // 2) % nominal.size] += step * (-1) ** i
        return found

    def update(candidates: Array, cost: Array, step: Memory, spread: Spread) -> tuple[Array, Memory]:
        best = int(np.argmin(cost))
        return candidates[best], max(step / 2, spread.least) if best == 0 else min(2 * step, spread.most)

    own = SamplingController(SamplingSettings(**QUICK), Method("by coordinates", begin, draw, update))  # type: ignore[arg-type]
    done = tracked(LAG, LAG, own=own)
    assert set(done.status) == {"sampled"} and np.all(rmse(done) < [4e-3, 8e-3])


@pytest.mark.slow
def test_a_penalty_of_ones_own_is_part_of_the_cost() -> None:
    """Pressure in one actuator is dear: less of it is commanded."""

    def dear(times: Array, states: Array, inputs: Array, wanted: Wanted) -> Array:
        return np.asarray((np.diff(times)[:, None] * (inputs[..., :1] / 3e3) ** 2).sum(axis=(1, 2)))

    plain = tracked(LAG, LAG, reference=lambda time: POSE)
    own = SamplingController(SamplingSettings(**QUICK), penalty=dear)  # type: ignore[arg-type]
    sparing = tracked(LAG, LAG, reference=lambda time: POSE, own=own)
    assert sparing.command[-60:, 0].mean() < 0.9 * plain.command[-60:, 0].mean()


@pytest.mark.slow
def test_risk_counts_the_worst_models() -> None:
    costs = {}
    for name, options in {
        "one": {}, "mean": {"ensemble": 5, "spread": 0.3}, "worst": {"ensemble": 5, "spread": 0.3, "risk": 0.2},
    }.items():  # fmt: skip
        own = controller(**options)
        observation, state = begun(own)
        _, state = own.step(later(observation), HoldReference(POSE + 0.1), state)
        assert state.plan is not None
        costs[name] = state.plan.cost[0]
    assert costs["worst"] > 1.1 * costs["mean"] and costs["worst"] > 1.1 * costs["one"]
    done = tracked(LAG, LAG, ensemble=3, risk=0.34, noise=2e-3)
    assert set(done.status) == {"sampled"} and np.all(rmse(done) < [4e-3, 8e-3])


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
def test_random_states_and_references_all_get_a_command(method: str) -> None:
    """Whatever it is told, commands are finite and within limits, and what fell back says so and why."""
    rng = np.random.default_rng(7)
    low, high = LEG.joint_range
    for options, name in (({}, "late"), ({"pressure_rate": 2e5}, "lags")):
        own = controller(method=method, estimate_valves=False, **options)
        observation, first = begun(own, KNOWN[name])
        state = first
        for k in range(50):
            at = DT * (1 + k % 5)
            if k % 5 == 0:
                # Anywhere, moving and pushed.
                mean = [*rng.uniform(low, high), *rng.uniform(-3, 3, 2), *rng.uniform(0, 5e4, 2)]
                mean += rng.uniform(-0.3, 0.3, 2).tolist()
                state = replace(first, observer=replace(first.observer, mean=np.array(mean)))
                reference = HoldReference(rng.uniform(low - 0.5, high + 0.5))
            seen = state.observer.mean[:2]
            observation = replace(observation, time=at, stamp=at, position=seen, command=rng.uniform(0, 5e4, 2))
            command, state = own.step(observation, reference, state)
            assert np.all(np.isfinite(command)) and np.all((command >= 0) & (command <= 5e4))
            assert state.status == "sampled" and not state.reason and not state.fell_back


class Clock:
    """Says the time as it is set to."""

    def __init__(self, each: float) -> None:
        self.time, self.each = 0.0, each

    def __call__(self) -> float:
        self.time += self.each
        return self.time


def test_what_is_not_found_in_time_falls_back_in_order() -> None:
    clock = Clock(1e-4)
    own = SamplingController(SamplingSettings(deadline=5e-3, **QUICK), now=clock)  # type: ignore[arg-type]
    observation, state = begun(own)
    reference = HoldReference(POSE + 0.05)
    _, state = own.step(later(observation), reference, state)
    assert state.status == "sampled" and not state.fell_back
    planned = state.plan
    clock.each = 20e-3
    _, state = own.step(later(observation, 2), reference, state)
    assert state.status == "shifted" and state.plan is planned and state.reason == "no time was left for a solution"
    for k in range(3, 60):
        command, state = own.step(later(observation, k), reference, state)
        assert np.all((command >= 0) & (command <= 5e4))
    assert state.status == "lqr"  # the plan has run out
    clock.each = 1e-4
    state = replace(state, expected=0.0)
    _, state = own.step(later(observation, 60), reference, state)
    assert state.status == "sampled"


def test_where_all_plans_diverge_it_falls_back_and_says_so() -> None:
    own = controller()
    observation, state = begun(own)
    _, state = own.step(later(observation), HoldReference(POSE), state)
    planned = state.plan

    def lost(start: Array, disturbance: Array, inputs: Array) -> Array:
        return np.full((1, len(inputs), 41, 6), np.nan)

    state = replace(state, tools=replace(state.tools, rollouts=lost))
    command, state = own.step(later(observation, 2), HoldReference(POSE), state)
    assert state.status == "shifted" and state.plan is planned and np.all(np.isfinite(command))
    assert state.reason == "no sampled plan could be rolled out: all diverged" and state.status in FALLBACKS


def test_some_that_diverge_are_left_out() -> None:
    own = controller(method="mppi")
    observation, state = begun(own)
    whole = state.tools.rollouts

    def some(start: Array, disturbance: Array, inputs: Array) -> Array:
        states = whole(start, disturbance, inputs)
        states[:, 1::2, 5:] = np.nan
        return states

    state = replace(state, tools=replace(state.tools, rollouts=some))
    command, state = own.step(later(observation), HoldReference(POSE + 0.05), state)
    assert state.status == "sampled" and state.plan is not None and np.all(np.isfinite(command))
    assert np.isinf(state.plan.cost[1::2]).all() and np.isfinite(state.plan.cost[::2]).all()


@pytest.mark.parametrize("name", METHODS)
def test_methods_find_the_bottom_of_a_bowl(name: str) -> None:
    method, rng, shape = METHODS[name], np.random.default_rng(0), (4, 2)
    bottom = rng.normal(0, 4000, shape)
    nominal, memory = np.zeros(shape), method.begin(shape, SPREAD)
    for _ in range(150):
        candidates = np.concatenate([nominal[None], method.draw(rng, nominal, memory, 31, SPREAD)])
        cost = (((candidates - bottom) / 1e3) ** 2).sum(axis=(1, 2))
        cost[-3:] = np.inf
        nominal, memory = method.update(candidates, cost, memory, SPREAD)
    assert np.abs(nominal - bottom).max() < 300.0


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"method": "mpi"}, "there is no method 'mpi'; did you mean 'mppi'?"),
        ({"engine": "gpu"}, "engine is 'gpu', expected one of auto, exact, mujoco"),
        ({"spline": "quintic"}, "there is no spline 'quintic'"),
        ({"knots": 2, "spline": "cubic"}, "knots is 2, expected at least 4 for a cubic spline"),
        ({"knots": -1}, "knots is -1, expected 0 to 1000"),
        ({"samples": 1}, "samples is 1, expected 4 to 100000, or 0 for what is usual"),
        ({"deviation": 0.1, "least_deviation": 0.2}, "deviation is 0.1, expected at least 0.2"),
        ({"least_deviation": -0.1}, "least_deviation is -0.1, expected at least 0"),
        ({"risk": 1.5}, "risk is 1.5, expected at most 1"),
        ({"spread": 1.0}, "spread is 1, expected at most 0.95"),
        ({"temperature": float("nan")}, "temperature is nan, expected more than 0"),
        ({"seed": -1}, "seed is -1, expected 0 to"),
        ({"angle": 0.0}, "angle is 0, expected more than 0"),
        ({"sampels": 3}, "own.toml: there is no key 'sampels'"),
        ({"format": "equimus-ctrl/nmpc/1"}, "format is 'equimus-ctrl/nmpc/1', expected 'equimus-ctrl/sampling/2'"),
    ],
)
def test_settings_that_make_no_sense(given: dict[str, object], message: str) -> None:
    with pytest.raises(ConfigError) as raised:
        make_controller("sampling", given, None, "own.toml")
    assert message.split(": ")[-1] in str(raised.value) and "own.toml" in str(raised.value)


def test_settings_are_what_their_table_says() -> None:
    own = SamplingSettings(samples=30, method="cem")
    assert own.to_dict()["format"] == FORMAT and SamplingSettings.from_dict(own.to_dict()) == own


@pytest.mark.slow
def test_what_the_robot_cannot_do_is_told_at_the_start() -> None:
    with pytest.raises(ConfigError, match="margin is 2 rad, but hip turns from"):
        begun(controller(margin=2.0))
    with pytest.raises(ConfigError, match="engine is 'mujoco', which does not simulate creep"):
        begun(controller(engine="mujoco"), (*LAG, *CREEP))
    plant = MujocoPlant(Model(LEG))
    with pytest.raises(ControllerError, match="needs a model"):
        controller().init(replace(plant.spec, model=None), plant.reset())


@pytest.mark.slow
def test_the_method_in_the_documents_works() -> None:
    text = (Path(__file__).resolve().parents[1] / "docs" / "control.md").read_text(encoding="utf-8")
    block = next(b for b in re.findall(r"```python\n(.*?)```", text, re.DOTALL) if "standard_cauchy" in b)
    names: dict[str, Any] = {}
    exec(textwrap.dedent(block), names)
    done = tracked(LAG, LAG, own=names["controller"]())
    assert set(done.status) == {"sampled"} and np.all(rmse(done) < [4e-3, 8e-3])
