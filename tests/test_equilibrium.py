"""Where robots of any kind rest under constant commands."""

from __future__ import annotations

import numpy as np
import pytest
from mjcf_models import CRANE, HINGES, RIG, pendulum, refusal, slider

from equimus_ctrl.effects import CoulombFriction, PayloadMass, TransportDelay
from equimus_ctrl.engines.mjcf import simulate_mjcf
from equimus_ctrl.engines.rest import rest_pose
from equimus_ctrl.engines.trials import Trial
from equimus_ctrl.models.dynamics import Dynamics
from equimus_ctrl.models.model import Model, nominal_model
from equimus_ctrl.plants.mujoco_plant import MujocoPlant
from equimus_ctrl.robots.mjcf.robot import MjcfRobot
from equimus_ctrl.types import Start

FREE = MjcfRobot("free", pendulum())
WEIGHT = 1.0 * 9.81 * 0.3
"""Of the pendulum times its arm [N·m]."""


@pytest.mark.parametrize("u", [0.0, 0.9, 2.5])
def test_a_pendulum_rests_where_its_motor_bears_its_weight(u: float) -> None:
    assert rest_pose(Model(FREE), [u])[0] == pytest.approx(np.arcsin(u / WEIGHT), abs=1e-9)


def test_too_strong_a_motor_turns_it_for_ever_and_that_is_said() -> None:
    assert refusal(lambda: rest_pose(Model(FREE), [3.0])) == "free: rests in no pose under commands of (3) N·m"


def test_from_where_it_is_balanced_but_falls_it_goes_to_where_it_hangs() -> None:
    upright = rest_pose(Model(FREE), [0.0], near=[np.pi])
    assert np.cos(upright[0]) == pytest.approx(1.0, abs=1e-12)


def test_an_end_of_a_range_bears_what_presses_on_it() -> None:
    held = MjcfRobot("held", pendulum('range="-0.5 0.6" limited="true"'))
    assert rest_pose(Model(held), [2.9])[0] == pytest.approx(0.6)
    assert rest_pose(Model(held), [-9.0])[0] == pytest.approx(-0.5)
    assert rest_pose(Model(held), [0.3])[0] == pytest.approx(np.arcsin(0.3 / WEIGHT))


def test_a_carriage_without_springs_stays_where_it_is_and_a_force_carries_it_off() -> None:
    cart = MjcfRobot("cart", slider())
    assert rest_pose(Model(cart), [0.0], near=[0.2]).tolist() == [0.2]
    assert "rests in no pose" in refusal(lambda: rest_pose(Model(cart), [0.1]))


@pytest.mark.parametrize("robot", [CRANE, RIG, HINGES], ids=lambda own: own.name)
@pytest.mark.parametrize("u", [-0.4, 0.7])
def test_what_rests_does_not_move_in_mujoco(robot: MjcfRobot, u: float) -> None:
    """Dry friction only helps."""
    command = np.full(len(robot.actuator_names), u)
    pose = rest_pose(Model(robot), command)
    times = np.linspace(0, 0.5, 6)
    trial = Trial("still", np.zeros(1), command[None], command, 0.0, pose, times)
    (found,) = simulate_mjcf([Model(robot)], [trial], threads=1)
    low, high = robot.joint_range
    at_end = np.isclose(pose, low) | np.isclose(pose, high)
    assert np.abs(found.position[0] - pose)[:, ~at_end].max() < 1e-6  # MuJoCo's ends give way a little
    assert np.abs(found.position[0] - pose).max() < 5e-3


def test_effects_that_push_or_change_bodies_count_and_delays_and_friction_do_not() -> None:
    model = Model(FREE, (PayloadMass("tip", 0.5),))
    (q,) = rest_pose(model, [0.8])
    torque = Dynamics(model).needed([q], [0.0], [0.0])
    assert torque == pytest.approx(0.8, abs=1e-9) and abs(q - rest_pose(Model(FREE), [0.8])[0]) > 0.02
    other = Model(FREE, (TransportDelay("motor", 0.2), CoulombFriction("pivot", 0.3)))
    assert rest_pose(other, [0.8]) == pytest.approx(rest_pose(Model(FREE), [0.8]))


def test_every_plant_begins_at_rest_under_the_command_that_is_given() -> None:
    model = Model(FREE, (PayloadMass("tip", 0.5),))
    seen = MujocoPlant(model).reset(Start(command=[0.8]))
    assert seen.position == pytest.approx(rest_pose(model, [0.8])) and seen.command.tolist() == [0.8]
    home = MujocoPlant(Model(CRANE)).reset()
    assert home.position == pytest.approx(CRANE.home)
    leg = nominal_model()
    assert MujocoPlant(leg).reset(Start(command=[9e3, 4e3])).position == pytest.approx(rest_pose(leg, [9e3, 4e3]))
    assert "rests in no pose" in refusal(lambda: MujocoPlant(Model(FREE)).reset(Start(command=[9.0])))
