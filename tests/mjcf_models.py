"""MJCF robots for tests, and runs of them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from equimus_ctrl.effects import Effect
from equimus_ctrl.engines.mjcf import simulate_mjcf
from equimus_ctrl.engines.trials import Trial
from equimus_ctrl.errors import EquimusError
from equimus_ctrl.models.model import Model
from equimus_ctrl.robots.mjcf.robot import MjcfRobot
from equimus_ctrl.types import Array
from equimus_ctrl.workflow.exports import mjcf_of_model

ARM = """<mujoco model="crane">
  <compiler angle="radian"/>
  <option timestep="0.001"/>
  <worldbody>
    <site name="floor"/>
    <body name="arm" pos="0 0 1">
      <joint name="shoulder" type="hinge" axis="0 1 0" damping="0.1" armature="0.02" stiffness="1.5" springref="0.2"
        frictionloss="0.05" range="-1.5 1.6"/>
      <inertial mass="2" pos="0.1 0.02 -0.3" diaginertia="0.03 0.02 0.01"/>
      <body name="rod" pos="0 0 -0.5">
        <joint name="reach" type="slide" axis="0 0 -1" damping="3" armature="0.1" stiffness="40" springref="0.05"
          frictionloss="0.4"/>
        <inertial mass="0.5" pos="0.01 0 -0.1" quat="0.8 0.6 0 0" diaginertia="0.002 0.003 0.004"/>
        <site name="tip" pos="0.03 0.01 -0.2"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor name="push" joint="reach" forcerange="-20 20"/>
    <position name="servo" joint="shoulder" kp="30" kv="1.5" ctrlrange="-1 1"/>
    <general name="drive" joint="shoulder" gainprm="5" biastype="affine" biasprm="1 -3 -0.5"/>
  </actuator>
</mujoco>"""
CRANE = MjcfRobot("crane", ARM, source="crane.xml")


def pendulum(
    joint: str = "", inertial: str = 'mass="1" pos="0 0 -0.3" diaginertia="0.01 0.01 0.01"', *, head: str = "",
    option: str = "", body: str = "", drive: str = '<motor name="motor" joint="pivot"/>', tail: str = "",
) -> str:  # fmt: skip
    """One hinge about a horizontal axis, with more of this and that."""
    return f"""<mujoco model="pendulum"><compiler angle="radian"/>{head}<option timestep="0.001">{option}</option>
      <worldbody><body name="arm"><joint name="pivot" axis="0 1 0" armature="0.02" {joint}/><inertial {inertial}/>
      <site name="tip" pos="0.2 0 -0.5"/>{body}</body></worldbody>
      <actuator>{drive}</actuator>{tail}</mujoco>"""


PENDULUM = MjcfRobot("pendulum", pendulum(), source="pendulum.xml")


def slider(drive: str = '<motor name="motor" joint="way"/>') -> str:
    return f"""<mujoco><worldbody><body name="cart"><joint name="way" type="slide" axis="1 0 0"/>
      <inertial mass="2" pos="0 0 0" diaginertia="0.1 0.1 0.1"/></body></worldbody><actuator>{drive}</actuator></mujoco>"""


def corrected_xml(model: Model) -> tuple[str, tuple[str, ...]]:
    """The XML of a model, and what it does not hold."""
    written = mjcf_of_model(model)
    return written.xml, written.missing


def refusal(make: Callable[[], Any]) -> str:
    """The sentence with which something is refused."""
    with pytest.raises(EquimusError) as caught:
        make()
    assert "\n" not in str(caught.value)
    return str(caught.value)


M = 2.0
"""Mass of the cart [kg]."""
DT = 1e-3


def cart(
    joint: str = "", *, dt: float = DT, option: str = "", drive: str = '<motor name="motor" joint="way"/>',
    flags: str = "", head: str = "", mass: float = M,
) -> MjcfRobot:  # fmt: skip
    """A mass on a level slide."""
    return MjcfRobot(
        "cart",
        f"""<mujoco>{head}<option timestep="{dt}" gravity="0 0 0" {option}>{flags}</option><worldbody>
        <body name="box"><joint name="way" type="slide" axis="1 0 0" {joint}/>
        <inertial mass="{mass}" pos="0 0 0" diaginertia="0.1 0.1 0.1"/></body></worldbody>
        <actuator>{drive}</actuator></mujoco>""",
    )


RK4 = 'integrator="RK4"'


@dataclass(frozen=True, eq=False)
class Ran:
    """A path at its sample times."""

    t: Array
    x: Array


def trial_of(
    u: float | Sequence[tuple[float, float]] = 0.0, *, q: float = 0.0, v: float = 0.0, until: float = 1.0,
    every: float = DT,
) -> Trial:  # fmt: skip
    """One joint: a constant command, or (from, value) rows after none, sampled on the physics' grid by default."""
    rows = [(0.0, u)] if isinstance(u, int | float) else list(u)
    times, values = (np.array(column, dtype=float) for column in zip(*rows, strict=True))
    before = values[:1] if isinstance(u, int | float) else np.zeros(1)
    samples = every * np.arange(round(until / every) + 1)
    return Trial("t", times, values[:, None], before, 0.0, np.array([q]), samples, np.array([v]))


def run(robot: MjcfRobot, *effects: Effect, dt: float | None = None, trial: Trial | None = None, **of: object) -> Ran:
    one = trial or trial_of(**of)  # type: ignore[arg-type]
    (found,) = simulate_mjcf([Model(robot, effects)], [one], threads=1, dt=dt)
    assert found.sound.all()
    return Ran(one.sample_times, found.position[0, :, 0])


RIG = MjcfRobot(
    "rig",
    f"""<mujoco><compiler angle="radian"/><option timestep="{DT}"/><worldbody><body name="arm">
    <joint name="shoulder" axis="0 1 0" damping="0.3" armature="0.05"/>
    <inertial mass="1.5" pos="0.02 0 -0.2" diaginertia="0.02 0.02 0.01"/>
    <body name="rod" pos="0 0 -0.4"><joint name="reach" type="slide" axis="0 0 -1" damping="4" armature="0.2"
      stiffness="120"/><inertial mass="0.5" pos="0 0 -0.1" diaginertia="0.002 0.002 0.001"/>
    <site name="tip" pos="0.05 0 -0.2"/></body></body></worldbody>
    <actuator><motor name="lift" joint="shoulder"/><motor name="push" joint="reach"/></actuator></mujoco>""",
)


BARE = MjcfRobot("bare", RIG.xml.replace('armature="0.05"', "").replace('armature="0.2"', ""))
"""The rig without rotors."""
HINGES = MjcfRobot("hinges", RIG.xml.replace('type="slide" axis="0 0 -1"', 'axis="0 1 0"'))
"""The rig with a second hinge, behind a spring, in the place of its slide."""


def swinging(index: int = 0, until: float = 2.0) -> Trial:
    times = np.arange(0.0, until, 0.25)
    commands = np.column_stack([4 * np.sin(2.1 * times + index), 8 * np.cos(3.3 * times - index)])
    samples = np.arange(0.0, until + 1e-9, 0.01)
    return Trial(f"t{index}", times, commands, commands[0], 0.0, np.array([0.5, 0.02]), samples, np.array([0.3, -0.1]))
