"""An arm of two hinges with a motor each, and what it does by MuJoCo alone."""

from __future__ import annotations

from collections.abc import Callable

import mujoco
import numpy as np

from equimus_ctrl.robots.mjcf.robot import MjcfRobot
from equimus_ctrl.types import Array, Recording

FINE, EVERY, NOISE = 1e-4, 0.01, 5e-4
STOPS_AT_ONCE = f'solreffriction="-1 {-1 / FINE:g}" solimpfriction="0.9999 0.9999 0.001"'
_XML = """<mujoco model="arm"><compiler angle="radian"/><option timestep="0.002" integrator="implicitfast"/>
  <worldbody><body name="upper"><joint name="shoulder" axis="0 1 0" armature="0.05" damping="0.3"/>
    <inertial mass="2" pos="0 0 -0.2" diaginertia="0.03 0.03 0.005"/>
    <body name="fore" pos="0 0 -0.4"><joint name="elbow" axis="0 1 0" armature="0.02" damping="0.1"/>
      <inertial mass="1" pos="0 0 -0.15" diaginertia="0.01 0.01 0.002"/><site name="tip" pos="0 0 -0.3"/></body></body>
  </worldbody>
  <actuator><motor name="m1" joint="shoulder"/><motor name="m2" joint="elbow"/></actuator>{tendons}</mujoco>"""


def gear(sign: int, **sizes: float) -> str:
    """A tendon over both joints with friction."""
    said = " ".join(f'{key}="{value:g}"' for key, value in sizes.items())
    return (
        f'<tendon><fixed name="gear" {said} {STOPS_AT_ONCE}><joint joint="shoulder" coef="1"/>'
        f'<joint joint="elbow" coef="{sign}"/></fixed></tendon>'
    )


def xml_of(tendons: str = "") -> str:
    return _XML.format(tendons=tendons)


ARM_OF_HINGES = MjcfRobot("arm", xml_of())


def stepped(model: mujoco.MjModel, start: Array, commands: Array, acts: Callable[[Array], Array] = np.array) -> Array:
    """(n, 2) positions as commands (n, 2) begin, each held; ``acts`` says what of a command the motors exert."""
    model.opt.timestep = FINE
    data, found = mujoco.MjData(model), []
    data.qpos[:] = start
    for row in commands:
        found.append(data.qpos.copy())
        data.ctrl[:] = acts(row)
        for _ in range(round(EVERY / FINE)):
            mujoco.mj_step(model, data)
    return np.array(found)


def driven(rng: np.random.Generator, seconds: float) -> tuple[Array, Array]:
    """(n,) times and (n, 2) torques: two sines each."""
    time = np.arange(0, seconds, EVERY)
    slow, fast, phase = rng.uniform(0.3, 0.8, 2), rng.uniform(0.9, 2.5, 2), rng.uniform(0, 6, (2, 2))
    size = np.array([5.0, 1.2]) * rng.uniform(0.6, 1.2, 2)
    turns = 2 * np.pi * time[:, None]
    return time, size * (np.sin(slow * turns + phase[0]) + 0.6 * np.sin(fast * turns + phase[1]))


def recorded_alone(
    count: int, seed: int, acts: Callable[[Array], Array] = np.array, tendons: str = "", seconds: float = 5.0
) -> list[Recording]:
    """Recordings of the arm, with noise."""
    rng, found, robot = np.random.default_rng(seed), [], ARM_OF_HINGES
    model = mujoco.MjModel.from_xml_string(xml_of(tendons))
    for k in range(count):
        start = rng.uniform(-0.4, 0.4, 2)
        time, commands = driven(rng, seconds)
        shown = stepped(model, start, commands, acts) + rng.normal(0, NOISE, (len(time), 2))
        found.append(Recording(f"run_{k}", time, commands, shown, robot.actuator_names, robot.joint_names))
    return found
