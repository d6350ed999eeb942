"""Robots and tasks for tests of learning environments."""

from __future__ import annotations

from equimus_ctrl.effects.base import parse
from equimus_ctrl.models.model import Model, nominal_model
from equimus_ctrl.robots.mjcf.robot import MjcfRobot

ARM = """<mujoco model="arm">
  <compiler angle="radian"/>
  <option timestep="0.002" integrator="implicitfast"/>
  <default><joint axis="0 1 0" damping="0.3" armature="0.01"/><geom contype="0" conaffinity="0"/></default>
  <worldbody><body name="upper" pos="0 0 0.6">
    <joint name="shoulder" range="-1.5 1.5"/>
    <geom type="capsule" fromto="0 0 0 0 0 -0.25" size="0.02" mass="0.4"/>
    <body name="lower" pos="0 0 -0.25">
      <joint name="elbow" range="-1.2 1.2"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.2" size="0.02" mass="0.3"/>
      <site name="hand" pos="0 0 -0.2"/>
    </body>
  </body></worldbody>
  <actuator>
    <position name="first" joint="shoulder" kp="20" ctrlrange="-1.4 1.4"/>
    <position name="second" joint="elbow" kp="15" ctrlrange="-1.1 1.1"/>
  </actuator>
</mujoco>"""

VALVES = ("transport_delay:baa:delay=0.03", "asymmetric_lag:maa:fill=0.05,vent=0.1", "dead_zone:baa:threshold=2000")
FORCES = ("stribeck_friction:hip:friction=0.05,breakaway=0.05,velocity=0.1", "hysteresis:maa:size=1,width=0.01")
SENSORS = ("sensor_delay:hip:delay=0.013", "backlash:knee:play=0.01", "sensor_offset:knee:offset=0.02")


def leg(*effects: str) -> Model:
    return Model(nominal_model().robot, tuple(map(parse, effects)))


def arm(*effects: str, xml: str = ARM) -> Model:
    return Model(MjcfRobot("arm", xml), tuple(map(parse, effects)))
