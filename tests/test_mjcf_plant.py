"""The simulated plant of MJCF robots."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from mjcf_models import CRANE, HINGES, RIG, cart, pendulum, refusal, swinging

from equimus_ctrl.controllers.custom import FunctionController
from equimus_ctrl.effects import CoulombFriction, Effect, FirstOrderLag, SensorDelay, SensorOffset, TransportDelay
from equimus_ctrl.engines.mjcf import simulate_mjcf
from equimus_ctrl.errors import SimulationDiverged
from equimus_ctrl.loop import run
from equimus_ctrl.models.model import Model
from equimus_ctrl.plants.events import Load, Push
from equimus_ctrl.plants.mujoco_plant import MujocoPlant, rates_of
from equimus_ctrl.robots.mjcf.editing import Edits
from equimus_ctrl.robots.mjcf.robot import MjcfRobot
from equimus_ctrl.scenarios.references import HoldReference
from equimus_ctrl.types import Array, Observation, Reference, Start


def driven(plant: MujocoPlant, command: Callable[[float], Array], n: int, start: Start) -> Array:
    """(n + 1, nj) positions as measured."""
    seen = [plant.reset(start)]
    for k in range(n):
        seen.append(plant.step(command(k * plant.spec.control_dt)))
    return np.array([o.position for o in seen])


@pytest.mark.parametrize(
    "effects",
    [
        (),
        (CoulombFriction("shoulder", 0.3), TransportDelay("push", 0.013), FirstOrderLag("lift", 0.05)),
        (SensorOffset("reach", 0.02), SensorDelay("shoulder", 0.02)),
    ],
    ids=["bare", "friction and late drives", "sensors"],
)
def test_it_moves_and_measures_as_the_engine_of_trials(effects: tuple[Effect, ...]) -> None:
    model, trial = Model(RIG, effects), swinging()
    plant = MujocoPlant(model)
    n = 120
    times = plant.spec.control_dt * np.arange(n + 1)
    # Commands change at control instants.
    own = plant.spec.control_dt * np.round(trial.times / plant.spec.control_dt)
    again = replace(trial, times=own, sample_times=times, velocity=None)
    (expected,) = simulate_mjcf([model], [again], threads=1)
    start = Start(command=again.before, position=again.position)
    found = driven(plant, lambda t: again.commands[np.searchsorted(again.times, t + 1e-9, side="right") - 1], n, start)
    np.testing.assert_allclose(found, expected.position[0], atol=1e-9)


def test_physics_has_the_files_step_and_commands_come_near_120_times_a_second() -> None:
    rates = rates_of(RIG)
    assert rates.physics == pytest.approx(1000) and rates.control == rates.sensor == pytest.approx(125)
    assert rates_of(cart(dt=0.01)).control == pytest.approx(100)
    spec = MujocoPlant(Model(CRANE)).spec
    assert spec.joint_units == ("rad", "m") and spec.command_units == ("N", "rad", "rad")
    assert spec.goals == (False, True, True)
    np.testing.assert_array_equal(spec.command_low, [-20, -1, -np.inf])


def test_it_begins_in_the_files_pose_under_what_holds_it() -> None:
    xml = HINGES.xml.replace("</mujoco>", '<keyframe><key name="bent" qpos="0.5 0.4"/></keyframe></mujoco>')
    robot = MjcfRobot("bent", xml)
    assert set(robot.keyframes) == {"bent"}
    plant = MujocoPlant(Model(robot))
    first = plant.reset()
    np.testing.assert_allclose(first.position, [0.5, 0.4])
    for _ in range(100):
        last = plant.step(first.command)
    np.testing.assert_allclose(last.position, [0.5, 0.4], atol=1e-4)


def test_a_pose_out_of_range_is_no_home() -> None:
    robot = MjcfRobot("arm", pendulum(joint='range="0.4 1.2" limited="true"'))
    assert robot.home.tolist() == [0.4]


def test_a_push_and_a_load_move_it_as_they_weigh() -> None:
    still = Start(command=np.zeros(2), position=np.zeros(2))

    def moved(n: int, *events: Push | Load) -> Array:
        plant = MujocoPlant(Model(RIG), events=events)
        return driven(plant, lambda t: np.zeros(2), n, still)[-1]

    # A tenth of a second after rest it has gone t²/2 times force by inertia.
    push, n = Push(0.0, 10.0, np.array([0.0, 1.0])), 5
    time = n * MujocoPlant(Model(RIG)).spec.control_dt
    inertia = 0.5 + 0.2  # of the rod, and of its drive
    assert moved(n, push)[1] - moved(n)[1] == pytest.approx(time**2 / 2 / inertia, rel=0.1)
    # Two kilograms more hang on a spring of 120 N/m.
    assert moved(1500, Load(0.0, 2.0, "tip"))[1] - moved(1500)[1] == pytest.approx(2 * 9.81 / 120, rel=0.05)


def test_what_is_lost_is_told_with_its_commands_in_their_own_unit() -> None:
    plant = MujocoPlant(Model(cart(option='integrator="Euler"')))
    plant.reset(Start(command=np.zeros(1)))
    told = r"cart: the simulation diverged at .* under commands of \(1e\+09\) N; "
    with pytest.raises(SimulationDiverged, match=told):
        [plant.step([1e9]) for _ in range(100)]


def test_a_joint_whose_motion_is_an_input_is_refused() -> None:
    from equimus_ctrl.robots.mjcf.editing import edited

    xml, edits = edited("rig", RIG.xml, {}, Edits(prescribe=("shoulder",)))
    robot = MjcfRobot("rig", xml, edits=edits)
    assert "the motion of shoulder is an input" in refusal(lambda: MujocoPlant(Model(robot)))


def test_the_same_seed_gives_the_same_bits() -> None:
    plant = MujocoPlant(Model(CRANE, (CoulombFriction("shoulder", 0.2),)), noise=1e-3)

    def once() -> bytes:
        plant.reset(seed=4)
        return b"".join(plant.step([1.0, 0.3, 0.1]).position.tobytes() for _ in range(40))

    assert once() == once()


def test_a_run_that_is_lost_keeps_what_happened_before() -> None:
    plant = MujocoPlant(Model(cart()))

    def wild(observation: Observation, reference: Reference) -> Array:
        return np.array([1e9 if observation.time > 0.1 else 0.0])

    with pytest.raises(SimulationDiverged) as caught:
        run(plant, FunctionController(wild), HoldReference([0.0]), 1.0, start=Start(command=np.zeros(1)))
    kept = caught.value.run
    assert 0.1 < kept.time[-1] < 0.3 and len(kept.position) == len(kept.time) == len(kept.status)
    assert kept.command[-1, 0] == 1e9
