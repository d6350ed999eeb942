"""The equations of motion that controllers compute with, beside MuJoCo's and beside the statics of pressures."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from mjcf_models import CRANE, HINGES, RIG, pendulum, refusal

from equimus_ctrl.effects import CoulombFriction, ParallelSpring, PayloadMass
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
