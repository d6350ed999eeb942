"""Sensors with a delay inside a recording: a start is of what they show later, and motion goes on through it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from pendulum_runs import MOTOR, PENDULUM, recorded

from equimus_ctrl.diagnosis.fitting import Data
from equimus_ctrl.effects import SensorDelay, TransportDelay
from equimus_ctrl.effects.base import Effect
from equimus_ctrl.engines.base import EngineName
from equimus_ctrl.engines.choice import engine_for
from equimus_ctrl.identification.noise import white_noise
from equimus_ctrl.identification.parameters import free_parameters
from equimus_ctrl.identification.residuals import residuals_of
from equimus_ctrl.identification.segments import Segment, cut
from equimus_ctrl.identification.simulators import Simulator, reduced_simulator
from equimus_ctrl.models.model import Model
from equimus_ctrl.robots.mjcf.robot import MjcfRobot
from equimus_ctrl.types import Recording

ARM = Model(MjcfRobot("arm", PENDULUM.format(drive=MOTOR)))
LATE = 0.04
EFFECTS = {"sensor": SensorDelay("hinge", delay=LATE), "drive": TransportDelay("drive", delay=LATE)}


def segments(recordings: list[Recording], length: float) -> list[Segment]:
    """Intervals inside: at the first row the arm is let go, which a late sensor shows later and a late drive does not."""
    return [s for r in recordings for s in cut(ARM, [r], window=(length, np.inf), shoot=length, fit_start=True)]


@pytest.mark.parametrize("engine", ["reduced", "mujoco"])
def test_a_late_sensor_is_followed_through_intervals_as_a_late_drive_is(engine: EngineName) -> None:
    """In each its own recording, 3 rad wide, from starts that are read off it, and from those that fit it best."""
    largest = {}
    for name, effect in EFFECTS.items():
        true = replace(ARM, effects=(effect,))
        recordings, simulator = recorded(true, count=2, noise=0.0), Simulator(engine_for(true, engine), 1)
        for improved in (0, 1):
            residuals = residuals_of(true, segments(recordings, 1.0), simulator, improved)
            largest[name, improved] = float(np.abs(np.concatenate(residuals)).max())
    assert largest["sensor", 0] < 1.2 * largest["drive", 0] < 0.02
    exact = 1e-3 if engine == "reduced" else 3e-3  # MuJoCo's own step is coarser
    assert largest["sensor", 1] < exact and largest["drive", 1] < exact


@pytest.mark.parametrize("true", ["sensor", "drive"])
def test_shooting_intervals_do_not_tell_a_late_sensor_from_a_late_drive(true: str) -> None:
    """Both move everything later by the same time, so nothing tells them apart, whichever is there."""
    recordings = recorded(replace(ARM, effects=(EFFECTS[true],)), count=1, noise=2e-3)
    names = {"sensor": "hinge.sensor_delay.delay", "drive": "drive.transport_delay.delay"}

    def deviance(effect: Effect, name: str) -> float:
        free = free_parameters(replace(ARM, effects=(effect,)), ["arm.mass", name])
        own = segments(recordings, 1.0)
        data = Data(free, tuple(own), reduced_simulator(threads=1))
        noise = white_noise([np.full((9, 1), 2e-3)])
        return data.converge(data.coarse_fit((), [(free.start, [s.start for s in own])], noise, 20)).deviance

    late, lazy = (deviance(EFFECTS[key], names[key]) for key in ("sensor", "drive"))
    assert abs(late - lazy) < 2.0
