"""A bank of valves: what it says of each hypothesis is what a filter of it says, and controllers find late valves by it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from mjcf_models import pendulum

from equimus_ctrl.controllers.lqr import LqrController, LqrSettings
from equimus_ctrl.controllers.nmpc import NmpcController, NmpcSettings
from equimus_ctrl.controllers.sampling import SamplingController
from equimus_ctrl.controllers.sampling_settings import SamplingSettings
from equimus_ctrl.effects import Effect, make
from equimus_ctrl.estimation import bank_kernel
from equimus_ctrl.estimation.observer import Observer, ObserverState
from equimus_ctrl.estimation.valve_bank import Sent, ValveBank
from equimus_ctrl.loop import run
from equimus_ctrl.models.model import Model
from equimus_ctrl.models.solved import valves_of
from equimus_ctrl.plants.mujoco_plant import MujocoPlant
from equimus_ctrl.robots.elastic.leg import nominal_leg
from equimus_ctrl.robots.mjcf.robot import MjcfRobot
from equimus_ctrl.scenarios.references import FunctionReference
from equimus_ctrl.types import Array, Controller, Observation, Run

LEG, DT, POSE = nominal_leg(), 1 / 120, np.array([1.45, 0.6])
LATE: tuple[Effect, ...] = tuple(
    effect
    for name in LEG.actuator_names
    for effect in (make("transport_delay", name, {"delay": 0.1}), make("first_order_lag", name, {"time_constant": 0.1}))
)


def smooth(time: float) -> Array:
    return POSE + np.array([0.07, 0.12]) * np.sin([2.0 * time, 3.0 * time])


def followed(effects: tuple[Effect, ...], controller: object, seconds: float = 4.0) -> Run:
    plant = MujocoPlant(Model(LEG, effects), nominal=Model(LEG), noise=2e-3)
    return run(plant, controller, FunctionReference(smooth), seconds, seed=1)  # type: ignore[arg-type]


def rmse(done: Run, after: float = 1.0) -> Array:
    assert done.truth is not None
    return np.asarray(np.sqrt(((done.truth - done.reference)[done.time > after] ** 2).mean(axis=0)))


def excited(
    effects: tuple[Effect, ...], bank: ValveBank | None
) -> tuple[Observer, list[ObserverState], list[Observation]]:
    """An observer of the nominal leg over two seconds of a leg with effects, under commands that jump."""
    plant = MujocoPlant(Model(LEG, effects), nominal=Model(LEG), noise=1e-3)
    observer, rng = Observer.of(plant.spec, bank=bank), np.random.default_rng(2)
    observation, command = plant.reset(seed=4), np.zeros(2)
    states, seen = [observer.init(observation)], [observation]
    for k in range(240):
        command = rng.uniform((2e3, 0), (2.5e4, 1.2e4)) if k % 30 == 0 else command
        observation = plant.step(command)
        seen.append(observation)
        states.append(observer.update(observation, states[-1]))
    return observer, states, seen


def test_it_finds_the_valves_and_knows_what_a_filter_of_them_knows() -> None:
    effects = (make("transport_delay", "maa", {"delay": 0.05}), make("first_order_lag", "baa", {"time_constant": 0.1}))
    bank = ValveBank(Model(LEG))
    observer, states, seen = excited(effects, bank)
    last = states[-1].bank
    assert last is not None
    found = bank.late[[0, 1], list(last.choice)]
    np.testing.assert_allclose(found, [[0.05, 0.0], [0.0, 0.1]], atol=1e-12)
    np.testing.assert_allclose(valves_of(bank.model(last.choice)), valves_of(Model(LEG, effects)))
    # A filter of these valves from the beginning says the same, as far as the leg is linear.
    other = Observer(bank.model(last.choice), DT)
    state, ours, plain = other.init(seen[0]), [], []
    for observation, own in zip(seen[1:], states[1:], strict=True):
        state = other.update(observation, state)
        assert own.bank is not None
        chosen = replace(own, bank=replace(own.bank, choice=last.choice))
        ours.append(observer.others(chosen).mean[:6] - state.mean[:6])
        plain.append(own.mean[:6] - state.mean[:6])
    far, near = (np.sqrt((np.array(off) ** 2).mean(axis=0)) for off in (plain, ours))
    assert np.all(near < 0.15 * far)


def test_the_filter_itself_does_not_depend_on_its_bank() -> None:
    _, with_bank, _ = excited(LATE, ValveBank(Model(LEG)))
    _, without, _ = excited(LATE, None)
    for ours, theirs in zip(with_bank, without, strict=True):
        np.testing.assert_array_equal(ours.mean, theirs.mean)
        np.testing.assert_array_equal(ours.covariance, theirs.covariance)


def test_known_valves_stay_in_force_on_a_leg_that_has_them() -> None:
    _, states, _ = excited((), ValveBank(Model(LEG)))
    assert all(state.bank is not None and state.bank.choice == (0, 0) for state in states)


def test_there_is_nothing_to_be_found_where_valves_are_known_to_be_as_late_as_usual() -> None:
    assert ValveBank(Model(LEG)).is_open and not ValveBank(Model(LEG, LATE)).is_open
    half = ValveBank(Model(LEG, LATE[:2]))
    assert half.is_open and not half.late[0].any() and half.late[1].max() == pytest.approx(0.1)


def test_commands_pass_their_valves_one_after_the_other() -> None:
    """Two steps through a dead time and a lag, against the exponentials that a first-order lag's step is made of."""
    times, values = np.array([-np.inf, 0.1, 0.2]), np.array([[1.0], [2.0], [4.0]])
    late, first = np.array([[[0.0, 0.0], [0.02, 0.05]]]), np.array([[1.0, 1.0]])
    after, mean = np.empty((1, 2)), np.empty((1, 2))
    bank_kernel.passed(times, values, 0.05, 0.25, late, first, after, mean)
    assert mean[0, 0] == pytest.approx((0.05 * 1.0 + 0.1 * 2.0 + 0.05 * 4.0) / 0.2) and after[0, 0] == 4.0
    second = 2.0 - np.exp(-0.1 / 0.05)
    assert after[0, 1] == pytest.approx(4.0 + (second - 4.0) * np.exp(-0.03 / 0.05))
    rises = 0.07 + 2.0 * 0.1 - 0.05 * (second - 1.0) + 4.0 * 0.03 - 0.05 * (after[0, 1] - second)
    assert mean[0, 1] == pytest.approx(rises / 0.2)
    assert [Sent(times, values).at(time, 0) for time in (0.05, 0.1, 0.25)] == [1.0, 2.0, 4.0]


def test_the_likeliest_hypotheses_are_those_of_the_least_sum() -> None:
    """Against Σ (ν − Σ Hδ)²/s of every pair of hypotheses, measurement by measurement."""
    rng, na, k, m = np.random.default_rng(3), 2, 4, 5
    deviation, fits, alike = rng.normal(size=(m, na * k)), np.zeros(na * k), np.zeros((na * k, na * k))
    sums, total = np.zeros((k, k)), 0.0
    for _ in range(30):
        row, gain, off, variance = rng.normal(size=m), 0.1 * rng.normal(size=m), rng.normal(), rng.uniform(1, 2)
        own = row @ deviation
        sums += (off - own[:k, None] - own[None, k:]) ** 2 / variance
        total += off**2 / variance
        wanted = deviation - np.outer(gain, own)
        bank_kernel.seen(row, gain, off, variance, deviation, fits, alike)
        np.testing.assert_allclose(deviation, wanted, atol=1e-12)
    each = np.array(
        [[total + bank_kernel.unlikely(fits, alike, np.array([a, b]), k) for b in range(k)] for a in range(k)]
    )
    np.testing.assert_allclose(each, sums, rtol=1e-9)
    assert bank_kernel.alike_for_all(fits, alike, na, k) == int(np.argmin(np.diag(sums)))
    begin = np.array([int(np.argmin(np.diag(sums)))] * 2)
    cost = bank_kernel.improved(total, fits, alike, begin, k)
    assert cost == pytest.approx(sums[tuple(begin)])
    assert cost <= sums[begin[0]].min() + 1e-9 and cost <= sums[:, begin[1]].min() + 1e-9


@pytest.mark.slow
@pytest.mark.parametrize("effects", [LATE, LATE[::2], LATE[1::2]], ids=["both", "dead_time", "lag"])
def test_valves_that_nobody_told_of_cost_little_once_they_are_found(effects: tuple[Effect, ...]) -> None:
    done = followed(effects, LqrController())
    assert "valves were found to be later than is known: maa" in done.note and "baa by" in done.note
    assert np.all(rmse(done) < 3e-3)
    blind = followed(effects, LqrController(LqrSettings(estimate_valves=False)))
    assert np.all(rmse(done) < 0.5 * rmse(blind)) and blind.note == ""


@pytest.mark.slow
def test_the_nmpc_finds_them_too() -> None:
    done = followed(LATE, NmpcController(NmpcSettings(nodes=15)), 3.0)
    assert "valves were found" in done.note and np.all(rmse(done) < 5e-3)


@pytest.mark.slow
def test_where_nothing_is_late_the_commands_are_those_without_a_bank() -> None:
    wrong = LEG.with_parameters({name: 1.1 * value for name, value in LEG.parameters().items() if "stiffness" in name})
    for controller, plain in (
        (LqrController(), LqrController(LqrSettings(estimate_valves=False))),
        (NmpcController(NmpcSettings(nodes=10)), NmpcController(NmpcSettings(nodes=10, estimate_valves=False))),
    ):
        plants = [MujocoPlant(Model(wrong), nominal=Model(LEG), noise=2e-3) for _ in range(2)]
        runs = [
            run(plant, own, FunctionReference(smooth), 1.5, seed=1)
            for plant, own in zip(plants, (controller, plain), strict=True)
        ]
        np.testing.assert_array_equal(runs[0].command, runs[1].command)
        assert runs[0].note == ""


@pytest.mark.parametrize(
    "sampled", [False, pytest.param(True, marks=[pytest.mark.slow, pytest.mark.long])], ids=["lqr", "sampling"]
)
def test_a_servos_late_goals_are_found_and_where_they_are_not_late_nothing_is(sampled: bool) -> None:
    drive = '<position name="goal" joint="pivot" kp="300" kv="3"/>'
    servo = MjcfRobot("servo", pendulum('damping="0.6" frictionloss="0.05"', drive=drive))

    def driven(late: float, find: bool) -> Run:
        effects = (make("transport_delay", "goal", {"delay": late}),) if late else ()
        plant = MujocoPlant(Model(servo, effects), nominal=Model(servo), noise=2e-3)
        swing = FunctionReference(lambda time: np.array([0.5 * np.sin(2.5 * time)]))
        own: Controller = LqrController(LqrSettings(estimate_valves=find))
        if sampled:
            own = SamplingController(SamplingSettings(estimate_valves=find, samples=8, compiled=False))
        return run(plant, own, swing, 4.0, seed=1)

    found, blind = driven(0.02, True), driven(0.02, False)
    assert "drives were found to be later than is known: goal by 0.0" in found.note and "found" not in blind.note
    assert rmse(found, 2.0)[0] < 0.5 * rmse(blind, 2.0)[0]
    np.testing.assert_array_equal(driven(0.0, True).command, driven(0.0, False).command)
