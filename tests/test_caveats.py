"""What a fit's numbers are not to be taken for, where it is known what made the recordings."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from pendulum_runs import MOTOR, PENDULUM, recorded

from equimus_ctrl.effects import CoulombFriction
from equimus_ctrl.engines.batch import simulate
from equimus_ctrl.engines.rest import rest_pose
from equimus_ctrl.engines.trials import Trial
from equimus_ctrl.identification.step_error import step_error
from equimus_ctrl.models.model import Model, nominal_model
from equimus_ctrl.robots.mjcf.robot import MjcfRobot
from equimus_ctrl.types import Recording
from equimus_ctrl.workflow import identify_recordings

MODEL = Model(MjcfRobot("arm", PENDULUM.format(drive=MOTOR)))
FREE = ["arm.mass", "arm.inertia"]


def said(trials: list[Recording], model: Model = MODEL, **options: Any) -> list[str]:
    found = identify_recordings(trials, model, **options)
    return [text for text in found.caveats if "Residuals are larger" in text]


@pytest.mark.slow
def test_what_the_physics_step_does_is_not_called_physics() -> None:
    """The model that made the recordings, with 20 times the step that made them, beside noise of 10 µrad."""
    trials = recorded(MODEL, seed=3, noise=1e-5, count=1, seconds=2.0)
    (text,) = said(trials, engine="mujoco", free=FREE)
    assert "physics is missing, or the physics step of 2 ms is too long (--dt), and these" in text
    assert not said(trials, engine="mujoco", free=FREE, dt=1e-4)
    assert not said(recorded(MODEL, seed=3, noise=5e-3), engine="mujoco", free=FREE), "below the noise"


def test_physics_that_is_missing_is_said_to_be_beside_a_smaller_error_of_the_step() -> None:
    rough = Model(MODEL.robot, (CoulombFriction("hinge", 0.2),))
    for noise in (1e-5, 5e-4):
        (text,) = said(recorded(rough, seed=3, noise=noise, count=1, seconds=2.0), engine="mujoco", free=FREE)
        assert "physics is missing, and these" in text and "step" not in text


def test_the_error_of_the_step_is_what_a_finer_one_changes() -> None:
    once: dict[str, Any] = {"seed": 3, "noise": 0.0, "count": 1, "seconds": 2.0}
    trials = recorded(MODEL, dt=None, **once)
    found = identify_recordings(trials, MODEL, engine="mujoco", free=FREE).fit
    finely = np.concatenate([r.position for r in recorded(MODEL, **once)])
    apart = np.sqrt(np.mean((finely - np.concatenate([r.position for r in trials])) ** 2))
    assert step_error(found)[0] == pytest.approx(apart, rel=0.1)
    assert step_error(identify_recordings(trials, MODEL, engine="reduced", free=FREE).fit).tolist() == [0.0]


def test_the_step_of_a_leg_is_never_blamed() -> None:
    """That of its equations of motion is chosen far below what sensors see."""
    leg = nominal_model()
    rough = Model(leg.morphology, (CoulombFriction("hip", 0.1),))
    time = np.arange(0.0, 3.0, 0.01)
    commands = 1e4 * np.column_stack([1 + np.sin(4 * time), 1 + np.sin(3 * time + 1)])
    trial = Trial("t", time, commands, commands[0], 0.0, rest_pose(rough, commands[0]), time)
    position = simulate([rough], [trial], threads=1)[0].position[0]
    position = position + np.random.default_rng(1).normal(0, 1e-5, position.shape)
    robot = leg.robot
    run = Recording("t", time, commands, position, robot.actuator_names, robot.joint_names)
    (text,) = said([run], leg, free=["calf.mass"])
    assert "physics is missing, and these" in text
