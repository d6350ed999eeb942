"""A pendulum and a carriage as MuJoCo's XML, and what they do under sums of sines."""

from __future__ import annotations

import numpy as np

from equimus_ctrl.engines.mjcf import simulate_mjcf
from equimus_ctrl.engines.trials import Trial
from equimus_ctrl.models.model import Model
from equimus_ctrl.types import Recording

PENDULUM = """<mujoco model="arm">
  <compiler boundmass="1e-12" boundinertia="1e-15"/>
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody><body name="arm">
    <joint name="hinge" type="hinge" axis="0 -1 0" armature="0.004"/>
    <inertial pos="0 0 -0.4" mass="0.6" diaginertia="0.002 0.002 0.001"/>
    <site name="tip" pos="0 0 -0.5"/>
  </body></worldbody>
  <actuator>{drive}</actuator>
</mujoco>"""
MOTOR, SERVO = '<motor name="drive" joint="hinge"/>', '<position name="drive" joint="hinge" kp="12" kv="0.4"/>'
CARRIAGE = """<mujoco model="carriage">
  <option timestep="0.002" gravity="0 0 0"/>
  <worldbody><body name="table">
    <joint name="rail" type="slide" axis="1 0 0"/><inertial pos="0 0 0" mass="4" diaginertia="1 1 1"/>
  </body></worldbody>
  <actuator><motor name="drive" joint="rail"/></actuator>
</mujoco>"""
NOISE = 5e-4
FINE = 1e-4


def recorded(
    real: Model, *, count: int = 3, seconds: float = 4.0, size: float = 1.0, seed: int = 0, noise: float = NOISE,
    push: float = 0.0, dt: float | None = FINE,
) -> list[Recording]:  # fmt: skip
    """What a robot does under sums of two sines, by MuJoCo with a fine step, or with the XML's own where that is None.

    ``push`` grows with the cube of the angle, which no effect has.
    """
    rng = np.random.default_rng(seed)
    time = np.arange(0, seconds, 0.01)
    found = []
    m = real.robot
    for k in range(count):
        columns = [
            size * rng.uniform(0.6, 1.2) * np.sin(2 * np.pi * rng.uniform(0.3, 1.0) * time + rng.uniform(0, 6))
            + 0.3 * size * np.sin(2 * np.pi * rng.uniform(1.5, 3.0) * time)
            for _ in m.actuator_names
        ]
        command = np.column_stack(columns)
        start = rng.uniform(-0.5, 0.5, len(m.joint_names))
        trial = Trial(f"t{k}", time, command, command[0], 0.0, start, time)
        angle = simulate_mjcf([real], [trial], threads=1, dt=dt)[0].position[0]
        angle = angle + push * angle**3 + rng.normal(0, noise, angle.shape)
        found.append(Recording(f"t{k}", time, command, angle, m.actuator_names, m.joint_names))
    return found
