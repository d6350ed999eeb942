"""What drifts while a recording lasts is seen in shooting intervals cut from it."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from pendulum_runs import MOTOR, NOISE, PENDULUM

from equimus_ctrl.diagnosis.fitting import Data
from equimus_ctrl.diagnosis.residual_force import force_candidates, linearise_fit
from equimus_ctrl.identification.noise import JointNoise
from equimus_ctrl.identification.parameters import free_parameters
from equimus_ctrl.identification.segments import cut
from equimus_ctrl.identification.simulators import reduced_simulator
from equimus_ctrl.models.model import Model
from equimus_ctrl.robots.mjcf.robot import MjcfRobot
from equimus_ctrl.types import Recording

BEGIN, STEP, FIRST, LAST = 3.0, 1e-3, 0.02, 0.12
"""Of the recordings' clock and the physics [s], and the damping at a recording's start and end [N·m·s/rad]."""


def warming_up(robot: MjcfRobot, seed: int) -> Recording:
    """A pendulum whose damping grows in proportion to the time, on a clock that does not begin at 0."""
    rng, model = np.random.default_rng(seed), robot.mujoco_model(STEP)
    data, time = mujoco.MjData(model), np.arange(0, 6, 0.01)
    command = np.sin(2 * np.pi * rng.uniform(0.5, 0.9) * time + rng.uniform(0, 6))[:, None]
    angles = []
    for row, now in zip(command, time, strict=True):
        angles.append(data.qpos.copy())
        for k in range(round(0.01 / STEP)):
            model.dof_damping[0] = FIRST + (LAST - FIRST) * (now + k * STEP) / 6
            data.ctrl[:] = row
            mujoco.mj_step(model, data)
    noisy = np.array(angles) + rng.normal(0, NOISE, (len(time), 1))
    return Recording(f"run_{seed}", BEGIN + time, command, noisy, robot.actuator_names, robot.joint_names)


def test_damping_that_drifts_depends_on_the_time_since_the_recording_began() -> None:
    robot = MjcfRobot(
        "arm", PENDULUM.format(drive=MOTOR).replace('armature="0.004"', 'armature="0.004" damping="0.07"')
    )
    nominal = Model(robot)
    segments = cut(nominal, [warming_up(robot, seed) for seed in range(2)], shoot=0.5)
    data = Data(free_parameters(nominal, ["arm.mass", "hinge.damping"]), list(segments), reduced_simulator(threads=1))
    found = linearise_fit(data, data.base(), (JointNoise(NOISE),))
    assert found is not None
    best = force_candidates(found)[0]
    assert best.family.depends_on == "time·vel.hinge" and best.found.share > 0.8
    (axis,) = best.family.axes
    assert axis.knots[[0, -1]] == pytest.approx([0.0, 6.0], abs=0.05)
    # The force beside the mean damping: none in the middle, and of either sign at the ends.
    ends = best.family.curve(best.found.coefficients, np.array([0.5, 3.0, 5.5]))
    assert ends[0] > 0.02 and abs(ends[1]) < 0.01 and ends[2] < -0.02
