"""What drifts while a recording lasts is seen in shooting intervals cut from it."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from pendulum_runs import MOTOR, NOISE, PENDULUM

from equimus_ctrl.diagnosis import unexplained
from equimus_ctrl.diagnosis.fitting import Data
from equimus_ctrl.diagnosis.residual_force import force_candidates, judged, linearise_fit
from equimus_ctrl.identification.noise import JointNoise
from equimus_ctrl.identification.parameters import free_parameters
from equimus_ctrl.identification.segments import cut
from equimus_ctrl.identification.simulators import reduced_simulator
from equimus_ctrl.models.model import Model
from equimus_ctrl.robots.mjcf.robot import MjcfRobot
from equimus_ctrl.types import Recording

BEGIN, STEP, FIRST, LAST = 3.0, 1e-3, 0.02, 0.12
"""Of the recordings' clock and the physics [s], and the damping at a recording's start and end [N·m·s/rad]."""


def warming_up(robot: MjcfRobot, seed: int, first: float = FIRST, last: float = LAST) -> Recording:
    """A pendulum whose damping grows in proportion to the time, on a clock that does not begin at 0."""
    rng, model = np.random.default_rng(seed), robot.mujoco_model(STEP)
    data, time = mujoco.MjData(model), np.arange(0, 6, 0.01)
    command = np.sin(2 * np.pi * rng.uniform(0.5, 0.9) * time + rng.uniform(0, 6))[:, None]
    angles = []
    for row, now in zip(command, time, strict=True):
        angles.append(data.qpos.copy())
        for k in range(round(0.01 / STEP)):
            model.dof_damping[0] = first + (last - first) * (now + k * STEP) / 6
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


@pytest.mark.parametrize("last", [0.073, 0.07], ids=["a drift that hardly shows", "none"])
def test_noise_is_estimated_again_with_what_a_force_explains_taken_off(last: float) -> None:
    """What a model leaves out makes the estimated noise larger and slower, and weighs less then."""
    robot = MjcfRobot(
        "arm", PENDULUM.format(drive=MOTOR).replace('armature="0.004"', 'armature="0.004" damping="0.07"')
    )
    nominal = Model(robot)
    recordings = [warming_up(robot, seed, 0.14 - last, last) for seed in range(2)]
    data = Data(
        free_parameters(nominal, ["arm.mass", "hinge.damping"]), list(cut(nominal, recordings, shoot=0.5)),
        reduced_simulator(threads=1),
    )  # fmt: skip
    base = data.base()
    at = linearise_fit(data, base, base.noise)
    assert at is not None
    quieter = unexplained.taken_off(data, at, force_candidates(at)[0])
    if last == 0.07:
        assert quieter is None
        return
    assert quieter is not None
    (before,), (after,) = base.noise, quieter.noise
    assert before.sigma > 1.3 * NOISE and before.coloured > NOISE
    assert after.sigma == pytest.approx(NOISE, rel=0.1) and after.coloured == 0.0
    assert judged(force_candidates(quieter)[0].found, quieter) > 3 * judged(force_candidates(at)[0].found, at)
