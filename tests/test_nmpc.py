"""The predictive controller: the regulator where nothing is in the way, and what it does where something is."""

from __future__ import annotations

import copy
from dataclasses import replace

import numpy as np
import pytest

from equimus_ctrl.controllers.horizon import FALLBACKS
from equimus_ctrl.controllers.lqr import LqrController
from equimus_ctrl.controllers.nmpc import FORMAT, NmpcController, NmpcSettings, NmpcState, intervals
from equimus_ctrl.controllers.registry import make_controller
from equimus_ctrl.effects import Effect, make
from equimus_ctrl.errors import ConfigError, ControllerError
from equimus_ctrl.estimation.observer import ObserverFault
from equimus_ctrl.loop import run
from equimus_ctrl.models.inverse import holding_pressure
from equimus_ctrl.models.model import Model
from equimus_ctrl.plants.mujoco_plant import MujocoPlant
from equimus_ctrl.robots.elastic.leg import nominal_leg
from equimus_ctrl.scenarios.references import FunctionReference, HoldReference
from equimus_ctrl.types import Array, Observation, Run, Start

LEG, DT, POSE = nominal_leg(), 1 / 120, np.array([1.45, 0.6])
LAG = (make("first_order_lag", "maa", {"time_constant": 0.1}), make("first_order_lag", "baa", {"time_constant": 0.06}))
DELAYS = (make("transport_delay", "maa", {"delay": 0.05}), make("transport_delay", "baa", {"delay": 0.1}))
KNOWN: dict[str, tuple[Effect, ...]] = {"nothing": (), "lags": LAG, "late": (*LAG, *DELAYS)}
QUICK = {"compiled": False}
"""The interpreter is fast enough here, and nothing has to be compiled."""


def smooth(time: float) -> Array:
    return POSE + np.array([0.07, 0.12]) * np.sin([2.0 * time, 3.0 * time])


def controller(**options: object) -> NmpcController:
    return NmpcController(NmpcSettings(**{**QUICK, **options}))  # type: ignore[arg-type]


def tracked(
    effects: tuple[Effect, ...], known: tuple[Effect, ...], *, leg: object = LEG, noise: float = 0.0,
    reference: object = smooth, duration: float = 3.0, **options: object,
) -> Run:  # fmt: skip
    plant = MujocoPlant(Model(leg, effects), nominal=Model(LEG, known), noise=noise)  # type: ignore[arg-type]
    return run(plant, controller(**options), FunctionReference(reference), duration, seed=1)  # type: ignore[arg-type]


def rmse(done: Run, after: float = 1.0) -> Array:
    error = (done.position - done.reference)[done.time > after]
    return np.asarray(np.sqrt((error**2).mean(axis=0)))


def begun(own: NmpcController, pose: Array = POSE, effects: tuple[Effect, ...] = LAG) -> tuple[Observation, NmpcState]:
    """A leg that has long been at rest."""
    held = np.clip(holding_pressure(Model(LEG, effects), pose), 0, 5e4)
    plant = MujocoPlant(Model(LEG, effects))
    first = plant.reset(Start(command=held, position=pose), 0)
    return first, own.init(plant.spec, first)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["nothing", "late"])
def test_where_nothing_is_in_the_way_it_is_the_regulator(name: str) -> None:
    """A linear quadratic problem with the regulator's cost behind it has the regulator's solution."""
    effects = KNOWN[name]
    held = holding_pressure(Model(LEG, effects), POSE)
    plant = MujocoPlant(Model(LEG, effects))
    first = plant.reset(Start(command=held, position=POSE), 0)
    reference = HoldReference(POSE + np.array([2e-4, -3e-4]))
    others = [LqrController(), controller(stride=1, nodes=20, tolerance=1e-6)]
    asked = []
    for one in others:
        observation, state, commands = plant.reset(Start(command=held, position=POSE), 0), None, []
        state = one.init(plant.spec, first)
        for _ in range(30):
            command, state = one.step(observation, reference, state)
            observation = plant.step(command)
            commands.append(command - held)
        asked.append(np.array(commands))
    np.testing.assert_allclose(asked[1], asked[0], atol=0.03 * np.abs(asked[0]).max())


@pytest.mark.slow
@pytest.mark.parametrize(
    ("options", "most"),
    [({}, 3e-4), ({"iterations": 1}, 3e-4), ({"noise": 2e-3}, 3e-3)],  # the measurement's own included
    ids=["as it is", "one iteration", "noise"],
)
def test_it_follows_a_smooth_reference_through_lags_and_delays_that_it_knows(
    options: dict[str, float], most: float
) -> None:
    assert np.all(rmse(tracked(KNOWN["late"], KNOWN["late"], **options), 2.0) < most)


@pytest.mark.slow
def test_an_unknown_torque_leaves_no_offset() -> None:
    spring = make("parallel_spring", "hip", {"stiffness": 0.8, "rest": 1.2})
    done = tracked((*LAG, spring), LAG, reference=lambda time: POSE, duration=9.0)
    assert np.all(np.abs((done.position - done.reference)[-60:]) < 2e-3)


@pytest.mark.slow
@pytest.mark.parametrize("disturbance", [True, False])
def test_what_creeps_is_reckoned_with_as_it_creeps(disturbance: bool) -> None:
    """The horizon goes on from the effects' own states, with unknown torques to make up for them and without."""
    creep = make("creep", "baa", {"stiffness": 100.0, "time_constant": 0.5})
    done = tracked((*LAG, creep), (*LAG, creep), disturbance=disturbance)
    assert np.all(rmse(done, 2.0) < 2e-3)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1])
def test_wrong_numbers_leave_no_offset_and_do_not_make_it_swing(seed: int) -> None:
    rng = np.random.default_rng(seed)
    numbers = {
        name: value * (1 + 0.15 * rng.uniform(-1, 1))
        for name, value in LEG.parameters().items()
        if name.endswith((".stiffness", ".area", ".damping"))
    }
    done = tracked(LAG, LAG, leg=LEG.with_parameters(numbers), reference=lambda time: POSE, duration=9.0)
    assert np.all(np.abs((done.position - done.reference)[-60:]) < 5e-3)


@pytest.mark.slow
def test_rates_of_commands_stay_within_their_limit() -> None:
    rate = 1e5
    done = tracked(
        LAG, LAG, reference=lambda time: POSE + 0.2 * (time > 1), pressure_rate=rate, duration=2.0, start_time=0.0
    )
    change = np.abs(np.diff(np.vstack([done.before, done.command]), axis=0))
    assert change.max() <= rate * DT + 1e-6
    assert change.max() > 0.99 * rate * DT


@pytest.mark.slow
def test_joint_ranges_are_kept_where_they_can_be() -> None:
    low, wanted = LEG.joint_range[0][1], np.array([1.45, 0.3])
    margin = 0.5 - low  # the knee is to stay above half a radian
    kept = tracked(LAG, LAG, reference=lambda time: wanted, margin=margin, duration=2.0)
    assert kept.position[60:, 1].min() > 0.48
    free = tracked(LAG, LAG, reference=lambda time: wanted)
    assert abs(free.position[-1, 1] - 0.3) < 1e-3


@pytest.mark.slow
def test_random_states_and_references_all_get_a_command() -> None:
    """Whatever it is told, commands are finite and within limits, and what fell back says so and why."""
    rng = np.random.default_rng(7)
    low, high = LEG.joint_range
    statuses = []
    for options, name in (({}, "late"), ({"pressure_rate": 2e5}, "lags")):
        own = controller(iterations=10, **options)
        observation, first = begun(own, POSE, KNOWN[name])
        state = first
        for k in range(125):
            at = DT * (1 + k % 5)
            if k % 5 == 0:
                # Anywhere, moving and pushed.
                mean = [*rng.uniform(low, high), *rng.uniform(-3, 3, 2), *rng.uniform(0, 5e4, 2)]
                mean += rng.uniform(-0.3, 0.3, 2).tolist()
                known = replace(first.observer, mean=np.array(mean))
                state = replace(first, observer=known, watched=known)
                reference = HoldReference(rng.uniform(low - 0.5, high + 0.5))
            seen = state.observer.mean[:2]
            observation = replace(observation, time=at, stamp=at, position=seen, command=rng.uniform(0, 5e4, 2))
            command, state = own.step(observation, reference, state)
            assert np.all(np.isfinite(command)) and np.all((command >= 0) & (command <= 5e4))
            assert bool(state.reason) == state.fell_back == (state.status in FALLBACKS)
            statuses.append(state.status)
    assert len(statuses) == 250
    assert np.mean([status == "converged" for status in statuses]) > 0.7
    assert not any(status in FALLBACKS for status in statuses)


class Clock:
    """A clock that moves on by the next of some spans each time it is read, then by the same each time."""

    def __init__(self, *spans: float, each: float = 0.0) -> None:
        self.time, self.spans, self.each = 0.0, list(spans), each

    def __call__(self) -> float:
        self.time += self.spans.pop(0) if self.spans else self.each
        return self.time


@pytest.mark.slow
def test_what_is_not_solved_in_time_falls_back_in_order() -> None:
    clock = Clock()
    own = NmpcController(NmpcSettings(deadline=5e-3, iterations=10, compiled=False), clock)
    observation, state = begun(own)
    reference = HoldReference(POSE + 0.05)

    def next_step(state: NmpcState) -> tuple[Array, NmpcState]:
        nonlocal observation
        observation = replace(observation, time=observation.time + DT, stamp=observation.time + DT)
        return own.step(observation, reference, state)

    clock.each = 20e-3
    early, state = next_step(state)  # nothing was ever solved: the regulator
    assert state.status == "lqr" and state.reason == "no time was left for a solution" and state.fell_back
    clock.each = 0.0
    _, state = next_step(state)
    assert state.status == "converged" and state.reason == "" and state.plan is not None
    planned = state.plan
    clock.each = 20e-3
    observation = replace(observation, command=np.array(planned.inputs[0]))
    shifted, state = next_step(state)
    assert state.status == "shifted" and state.plan is planned
    np.testing.assert_allclose(shifted, planned.inputs[1], atol=1e-6)  # the first interval lasts one period
    # Read when the step begins, before each iteration, and at the end: there is time for two.
    clock.spans, reference = [0.0, 1e-3, 1.5e-3, 1.7e-3, 0.1e-3], HoldReference(POSE - 0.3)
    _, state = next_step(state)
    assert state.status == "iterated" and state.answer is not None and state.answer.iterations == 2
    assert state.expected == pytest.approx(1.7e-3)
    clock.each = 20e-3
    for _ in range(60):
        _, state = next_step(state)
    assert state.status == "lqr"  # the plan has run out
    assert np.all(np.isfinite(early))


def test_a_solution_that_comes_late_is_kept_for_the_next_instant() -> None:
    clock = Clock(0.0, 1e-3, 50e-3)
    own = NmpcController(NmpcSettings(deadline=5e-3, iterations=1, compiled=False), clock)
    observation, state = begun(own)
    observation = replace(observation, time=DT, stamp=DT)
    _, state = own.step(observation, HoldReference(POSE + 0.05), state)
    assert state.status == "lqr" and state.plan is not None
    assert state.reason == "the solution came 51 ms after the step began, but the deadline is 5 ms"


def test_where_nothing_else_is_left_the_command_in_force_stays() -> None:
    own = NmpcController(NmpcSettings(deadline=1e-3, compiled=False), Clock(each=1.0))
    observation, state = begun(own)

    class Nothing:
        def correction(self, *given: object) -> Array:
            raise ControllerError("no gains")

        def cost(self, pose: Array) -> Array:
            raise ControllerError("no gains")

        def effort(self, pose: Array) -> Array:
            raise ControllerError("no gains")

    horizon = copy.copy(state.tools.horizon)
    horizon.schedule = Nothing()  # type: ignore[assignment]
    state = replace(state, tools=replace(state.tools, horizon=horizon))
    observation = replace(observation, time=DT, stamp=DT, command=np.array([1.2e4, 3.4e4]))
    command, state = own.step(observation, HoldReference(POSE), state)
    assert state.status == "hold"
    np.testing.assert_array_equal(command, [1.2e4, 3.4e4])


def test_limits_that_leave_no_way_are_told() -> None:
    own = controller(pressure_rate=1e5)
    observation, state = begun(own)
    observation = replace(observation, time=DT, stamp=DT, command=np.array([1e4, 6e4]))
    command, state = own.step(observation, HoldReference(POSE), state)
    assert state.status == "lqr" and state.reason.startswith("baa: from 60 kPa the rate limit of 100 kPa/s leads to")
    assert np.all((command >= 0) & (command <= 5e4))


def test_a_sensor_that_falls_silent_is_a_fault() -> None:
    own = controller()
    observation, state = begun(own)

    def silent(count: int) -> NmpcState:
        seen = state
        for k in range(1, count):
            at = replace(observation, time=k * DT, position=np.array([np.nan, 0.6]), stamp=k * DT)
            _, seen = own.step(at, HoldReference(POSE), seen)
        return seen

    assert silent(6).observer.status == "coasting"
    with pytest.raises(ObserverFault, match="hip was last measured at 0.000 s"):
        silent(30)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"nodes": 1}, "nodes is 1, expected 2 to 500"),
        ({"stride": 0}, "stride is 0, expected 1 to 100"),
        ({"iterations": 0}, "iterations is 0, expected 1 to 1000"),
        ({"angle": 0.0}, "angle is 0, expected more than 0"),
        ({"pressure": float("nan")}, "pressure is nan, expected more than 0"),
        ({"deadline": -1.0}, "deadline is -1, expected at least 0"),
        ({"solver": "qp"}, "solver is 'qp', expected one of daqp, osqp"),
        ({"nods": 3}, "own.toml: there is no key 'nods'"),
        ({"observer": {"noise": -1.0}}, "observer: noise is -1.0"),
        ({"format": "equimus-ctrl/lqr/1"}, "format is 'equimus-ctrl/lqr/1', expected 'equimus-ctrl/nmpc/1'"),
    ],
)
def test_settings_that_make_no_sense(given: dict[str, object], message: str) -> None:
    with pytest.raises(ConfigError) as raised:
        make_controller("nmpc", given, None, "own.toml")
    assert message.split(": ")[-1] in str(raised.value) and "own.toml" in str(raised.value)


def test_settings_are_what_their_table_says() -> None:
    own = NmpcSettings(nodes=30, pressure_rate=2e5)
    assert own.to_dict()["format"] == FORMAT
    assert NmpcSettings.from_dict(own.to_dict()) == own


def test_what_the_robot_cannot_do_is_told_at_the_start() -> None:
    with pytest.raises(ConfigError, match="margin is 2 rad, but hip turns from"):
        begun(controller(margin=2.0))
    plant = MujocoPlant(Model(LEG))
    first = plant.reset()
    with pytest.raises(ControllerError, match="needs a model"):
        controller().init(replace(plant.spec, model=None), first)


@pytest.mark.slow
def test_long_intervals_are_divided() -> None:
    done = tracked(LAG, LAG, stride=8, nodes=8)
    assert set(done.status) <= {"converged", "iterated"}
    assert np.all(rmse(done, 2.0) < 2e-3)


def test_intervals_are_short_where_the_next_command_takes_hold() -> None:
    assert intervals(5, 2, np.array([0, 0])).tolist() == [1, 2, 2, 2, 2]
    assert intervals(7, 2, np.array([0, 6])).tolist() == [1, 2, 2, 1, 1, 2, 2]
    assert intervals(6, 4, np.array([3, 0])).tolist() == [1, 2, 1, 4, 4, 4]
    assert intervals(3, 1, np.array([0, 5])).tolist() == [1, 1, 1]


def test_an_iteration_that_was_held_up_once_does_not_put_off_the_next_for_long() -> None:
    clock = Clock()
    own = NmpcController(NmpcSettings(deadline=5e-3, iterations=3, compiled=False), clock)
    observation, state = begun(own)
    statuses = []
    for k, span in enumerate([1e-3, 40e-3, 1e-3, 1e-3]):
        clock.spans = [0.0, 0.5e-3, *([span] * 3)]
        observation = replace(observation, time=(k + 1) * DT, stamp=(k + 1) * DT)
        _, state = own.step(observation, HoldReference(POSE + 0.05), state)
        statuses.append(state.status)
    assert statuses == ["converged", "shifted", "converged", "converged"]
