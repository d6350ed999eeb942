"""The equations of motion that controllers compute with, beside MuJoCo's and beside the statics of pressures."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from mjcf_models import CRANE, HINGES, RIG, pendulum, refusal

from equimus_ctrl.effects import REGISTRY, CoulombFriction, ParallelSpring, PayloadMass
from equimus_ctrl.errors import NotAvailable
from equimus_ctrl.models.dynamics import Dynamics
from equimus_ctrl.models.inverse import holding_pressure
from equimus_ctrl.models.linear import state_matrices
from equimus_ctrl.models.model import Model, nominal_model
from equimus_ctrl.robots.mjcf.robot import MjcfRobot

RNG = np.random.default_rng(7)


def without_constraints(robot: MjcfRobot) -> tuple[mujoco.MjModel, mujoco.MjData]:
    model = robot.mujoco_model()
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    return model, mujoco.MjData(model)


@pytest.mark.parametrize("robot", [RIG, HINGES, CRANE], ids=lambda robot: robot.name)
def test_forces_of_a_motion_are_mujocos(robot: MjcfRobot) -> None:
    dynamics, (model, data) = Dynamics(Model(robot)), without_constraints(robot)
    for _ in range(5):
        q, v, a = RNG.uniform(-0.8, 0.8, (3, model.nv))
        u = RNG.uniform(-0.5, 0.5, model.nu)
        data.qpos[:], data.qvel[:], data.qacc[:], data.ctrl[:] = q, v, a, u
        mujoco.mj_inverse(model, data)
        mujoco.mj_fwdActuation(model, data)
        rubbed = model.dof_frictionloss * np.tanh(v / 0.02)
        np.testing.assert_allclose(dynamics.needed(q, v, a), data.qfrc_inverse + rubbed, atol=1e-12)
        np.testing.assert_allclose(dynamics.exerted(q, v, u), data.qfrc_actuator, atol=1e-12)
        whole = np.zeros((model.nv, model.nv))
        mujoco.mj_fullM(model, data, whole)
        np.testing.assert_allclose(dynamics.mass(q), whole, atol=1e-12)


def test_commands_exert_what_was_asked_for_and_a_limit_of_force_is_seen() -> None:
    dynamics = Dynamics(Model(CRANE))
    q, v, torque = np.array([0.3, 0.1]), np.array([0.2, -0.1]), np.array([4.0, 15.0])
    command = dynamics.commands(q, v, torque)
    np.testing.assert_allclose(dynamics.exerted(q, v, command), torque, atol=1e-12)
    assert np.all(np.abs(command) > 0)  # the servo and the drive of the shoulder share it
    beyond = dynamics.commands(q, v, [4.0, 30.0])
    np.testing.assert_allclose(dynamics.exerted(q, v, beyond), [4.0, 20.0], atol=1e-12)


SHARED = MjcfRobot(
    "shared",
    pendulum(
        drive='<position name="goal" joint="pivot" kp="60" kv="1" ctrlrange="-3 3" forcerange="-1 1"/>'
        '<motor name="motor" joint="pivot" ctrlrange="-10 10"/>'
    ),
)
"""A servo of little force beside a motor."""


def test_what_a_limit_of_force_stops_another_actuator_exerts() -> None:
    dynamics, still = Dynamics(Model(SHARED)), np.zeros(1)
    for torque in (0.4, 2.6, -7.0):
        command = dynamics.commands([0.5], still, [torque])
        np.testing.assert_allclose(dynamics.exerted([0.5], still, command), torque, atol=1e-9)
    command, lack = dynamics.holding([np.pi / 2])
    np.testing.assert_allclose(lack, 0.0, atol=1e-9)
    np.testing.assert_allclose(command[1], 9.81 * 0.3 - 1.0, atol=1e-9)
    beyond = dynamics.shared([0.5], still, np.array([0.5, 0.0]), np.array([20.0]), dynamics.low, dynamics.high)
    np.testing.assert_allclose(dynamics.exerted([0.5], still, beyond), 11.0, atol=1e-9)


def test_a_stopped_actuator_is_no_spring_about_the_pose_that_it_helps_to_hold() -> None:
    dynamics = Dynamics(Model(SHARED))
    held, resting = dynamics.linear([np.pi / 2]), dynamics.linear([0.0])
    np.testing.assert_allclose(held.stiffness, 0.0, atol=1e-9)
    np.testing.assert_allclose(held.drive, [[0.0, 1.0]])
    np.testing.assert_allclose(resting.stiffness, 60 + 9.81 * 0.3, rtol=1e-9)


def test_ties_of_joints_and_integrating_actuators_are_told() -> None:
    body = (
        '<body name="hand" pos="0 0 -0.6"><joint name="wrist" axis="0 1 0"/>'
        '<inertial mass="0.5" pos="0 0 -0.2" diaginertia="0.01 0.01 0.01"/></body>'
    )
    tie = '<equality><joint joint1="wrist" joint2="pivot" {}/></equality>'
    tied, free = (MjcfRobot("tied", pendulum(body=body, tail=tie.format(of))) for of in ("", 'active="false"'))
    assert "which cannot hold its equality of wrist and pivot" in refusal(lambda: Dynamics(Model(tied)))
    assert not tied.offers and not tied.obstacles and "inverse" in free.offers
    drive = '<intvelocity name="goal" joint="pivot" kp="40" kv="2" actrange="-2 2"/>'
    rate = MjcfRobot("rate", pendulum(drive=drive))
    assert "which cannot hold its integrating actuator 'goal'" in refusal(lambda: Dynamics(Model(rate)))


def test_what_a_joint_lacks_is_told_beyond_its_friction() -> None:
    weak = MjcfRobot("weak", pendulum(drive='<motor name="motor" joint="pivot" ctrlrange="-1 1"/>'))
    level = np.array([np.pi / 2])
    command, lack = Dynamics(Model(weak)).holding(level)
    np.testing.assert_allclose(np.abs(command), 1.0)
    np.testing.assert_allclose(np.abs(lack), 9.81 * 0.3 - 1.0, atol=1e-9)
    rubbing = Model(weak, (CoulombFriction("pivot", 5.0),))
    np.testing.assert_allclose(Dynamics(rubbing).holding(level)[1], 0.0, atol=1e-12)
    np.testing.assert_allclose(Dynamics(Model(weak)).holding([0.0])[1], 0.0, atol=1e-12)


def test_a_joint_without_actuator_lacks_all_that_it_needs() -> None:
    body = (
        '<body name="hand" pos="0 0 -0.6"><joint name="wrist" axis="0 1 0"/>'
        '<inertial mass="0.5" pos="0 0 -0.2" diaginertia="0.01 0.01 0.01"/></body>'
    )
    dynamics = Dynamics(Model(MjcfRobot("two", pendulum(body=body))))
    _, lack = dynamics.holding([0.4, 0.3])
    np.testing.assert_allclose(lack, [0.0, 0.5 * 9.81 * 0.2 * np.sin(0.7)], atol=1e-9)
    np.testing.assert_allclose(dynamics.holding([0.0, 0.0])[1], 0.0, atol=1e-12)


@pytest.mark.parametrize(
    "effects", [(), (ParallelSpring("knee", 1.5, 0.3), PayloadMass("foot", 0.1))], ids=["", "more"]
)
def test_a_leg_is_held_by_the_pressures_of_its_statics(effects: tuple[object, ...]) -> None:
    model = Model(nominal_model().robot, effects)  # type: ignore[arg-type]
    dynamics, pose, still = Dynamics(model), np.array([1.4, 0.4]), np.zeros(2)
    found = dynamics.commands(pose, still, dynamics.needed(pose, still, still))
    np.testing.assert_allclose(found, holding_pressure(model, pose), rtol=1e-9)


def test_linearised_about_a_pose_a_leg_is_what_it_is_elsewhere() -> None:
    model, pose = nominal_model(), np.array([1.4, 0.4])
    held = holding_pressure(model, pose)
    for found, known in zip(
        Dynamics(model).linear(pose, held).matrices(), state_matrices(model.morphology, pose, held), strict=True
    ):
        np.testing.assert_allclose(found, known, rtol=1e-8, atol=1e-9)


def test_a_servo_that_holds_where_it_is_is_a_spring() -> None:
    linear = Dynamics(Model(CRANE)).linear(CRANE.home)
    assert linear.stiffness[0, 0] == pytest.approx(30 + 3 + 1.5 + 9.81 * (2 * 0.3 + 0.5 * 0.6), rel=0.01)
    assert linear.damping[0, 0] == pytest.approx(0.1 + 1.5 + 0.5)
    np.testing.assert_allclose(linear.drive, [[0, 30, 5], [1, 0, 0]])


def test_what_the_equations_cannot_hold_is_a_sentence() -> None:
    ball = MjcfRobot(
        "wrapped",
        pendulum(
            body='<geom name="roll" type="cylinder" size="0.02 0.1"/>',
            head="",
            tail='<tendon><spatial name="cord"><site site="tip"/><geom geom="roll"/><site site="end"/></spatial></tendon>',
        ).replace("<worldbody>", '<worldbody><site name="end" pos="1 0 0"/>'),
    )
    assert "which cannot hold its tendon 'cord' that wraps around a geom" in refusal(lambda: Dynamics(Model(ball)))


def test_dry_friction_over_two_joints_acts_against_the_sum_of_their_rates() -> None:
    first, second = next(iter(HINGES.next_hinges.items()))
    own = REGISTRY["coupled_friction"](first, friction=0.3)
    plain, rubbing = (Dynamics(Model(HINGES, effects)) for effects in ((), (own,)))
    places = [HINGES.joint_names.index(name) for name in (first, second)]
    still = np.zeros(len(HINGES.joint_names))
    for rates, torque in (((0.5, 0.4), 0.3), ((-0.5, 0.1), -0.3), ((0.4, -0.4), 0.0)):
        v = still.copy()
        v[places] = rates
        more = rubbing.needed(still, v, still) - plain.needed(still, v, still)
        wanted = still.copy()
        wanted[places] = torque
        assert more == pytest.approx(wanted, abs=1e-6), rates


def test_friction_that_grows_with_what_a_drive_exerts_is_refused() -> None:
    joint = CRANE.joint_names[0]
    law = REGISTRY["load_friction"]
    model = Model(CRANE, (law(joint, **dict.fromkeys(law.parameter_info(), 0.1)),))
    with pytest.raises(NotAvailable, match="load_friction: dry friction that grows with what a drive exerts"):
        Dynamics(model)
