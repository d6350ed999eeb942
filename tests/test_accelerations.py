"""The equations of motion that are offered to other solvers, against MuJoCo's."""

from __future__ import annotations

import re
from pathlib import Path

import casadi as ca
import mujoco
import numpy as np
import pytest
from mjcf_models import ARM, RIG, pendulum

import equimus_ctrl as eq
from equimus_ctrl.robots.mjcf.robot import MjcfRobot

CARTPOLE = eq.load_model(Path(__file__).parents[1] / "docs" / "examples" / "cartpole.xml").robot
SMOOTH_CRANE = MjcfRobot("crane", re.sub('frictionloss="[0-9.]+"', "", ARM))
SERVO = MjcfRobot("servo", pendulum('damping="0.6"', drive='<position name="goal" joint="pivot" kp="60" kv="1"/>'))


@pytest.mark.parametrize("robot", [SMOOTH_CRANE, RIG, CARTPOLE, SERVO], ids=lambda robot: robot.name)
def test_accelerations_are_those_of_mujoco(robot: MjcfRobot) -> None:
    found, rng, own = eq.accelerations(eq.Model(robot)), np.random.default_rng(3), robot.mujoco_model()
    own.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_LIMIT
    at = [own.joint(name) for name in robot.joint_names]
    drives = [own.actuator(name).id for name in robot.actuator_names]
    for _ in range(5):
        data = mujoco.MjData(own)
        q, v, u = (rng.uniform(-0.9, 0.9, size=n) for n in (len(at), len(at), len(drives)))
        for joint, angle, rate in zip(at, q, v, strict=True):
            data.qpos[joint.qposadr[0]], data.qvel[joint.dofadr[0]] = angle, rate
        data.ctrl[drives] = u
        mujoco.mj_forward(own, data)
        np.testing.assert_allclose(
            np.array(found(q, v, u)).ravel(), [data.qacc[joint.dofadr[0]] for joint in at], rtol=1e-6, atol=1e-6
        )


def test_limits_of_commands_and_forces_are_left_to_the_solver() -> None:
    for robot, u in ((CARTPOLE, np.ones(1)), (SMOOTH_CRANE, np.array([25.0, 1.5, 0.0]))):
        found, still = eq.accelerations(eq.Model(robot)), np.zeros(2)
        once, twice, none = (np.array(found(still, still, k * u)) for k in (1, 2, 0))
        np.testing.assert_allclose(twice - once, once - none, rtol=1e-9)
        assert np.abs(once - none).max() > 1.0


def test_dry_friction_acts_against_motion_and_has_a_slope() -> None:
    rubbing = MjcfRobot("rubbing", pendulum('frictionloss="0.05"'))
    a = eq.accelerations(eq.Model(rubbing))
    free = eq.accelerations(eq.Model(MjcfRobot("free", pendulum())))
    q, u = np.array([0.3]), np.zeros(1)
    for way in (-1.0, 1.0):
        v = np.array([2.0 * way])
        assert way * float(a(q, v, u) - free(q, v, u)) < -1e-3
    slope = ca.Function("slope", *_slope(a))
    assert np.isfinite(np.array(slope(q, np.zeros(1), u))).all()


def _slope(a: ca.Function) -> tuple[list[ca.SX], list[ca.SX]]:
    given = [ca.SX.sym(name, *a.size_in(name)) for name in a.name_in()]
    return given, [ca.jacobian(a(*given), given[1])]
