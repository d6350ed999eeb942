"""A torque-driven arm of two joints that rests under no constant command but hanging, and rivals of it."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
from rival_legs import by_hand, part_of

from equimus_ctrl.diagnosis.rivals import Rivals
from equimus_ctrl.effects import CoulombFriction, SensorDelay, TransportDelay, ViscousFriction
from equimus_ctrl.experiments.limits import Limits
from equimus_ctrl.models.model import Model
from equimus_ctrl.robots.mjcf.robot import MjcfRobot

XML = """<mujoco model="swinger"><compiler angle="radian"/><option timestep="0.002" integrator="implicitfast"/>
  <worldbody><body name="upper"><inertial pos="0.14 0 0" mass="1.2" diaginertia="0.002 0.011 0.011"/>
  <joint name="shoulder" axis="0 1 0" armature="0.02" range="-2.5 2.5" damping="0.002"/>
  <body name="fore" pos="0.3 0 0"><inertial pos="0.11 0 0" mass="0.8" diaginertia="0.001 0.006 0.006"/>
  <joint name="elbow" axis="0 1 0" armature="0.01" range="-2.5 2.5" damping="0.001"/><site name="hand" pos="0.25 0 0"/>
  </body></body></worldbody>
  <actuator><motor name="lift" joint="shoulder" ctrlrange="-15 15"/>
  <motor name="bend" joint="elbow" gear="2" ctrlrange="-3 3"/></actuator></mujoco>"""
ARM = Model(MjcfRobot("swinger", XML, source="swinger.xml"))
POSE = np.array([0.4, -0.7])


@cache
def arm_frictions() -> Rivals:
    """Dry or viscous friction at the elbow, recordings at 125 Hz cut into intervals of half a second."""
    found = by_hand(
        ARM,
        (part_of(CoulombFriction, ("elbow",), friction=0.15),),
        (part_of(ViscousFriction, ("elbow",), damping=0.15),),
        names=("upper.mass", "fore.mass"), known=0.05, start=(0.4, -0.7), rest=(0.0, 0.0),
    )  # fmt: skip
    return replace(found, rate=125.0, interval=0.5)


@cache
def arm_delays() -> Rivals:
    """Late sensors or a late drive of the elbow: nothing damps the arm, so it rests under no command."""
    found = by_hand(
        ARM,
        (part_of(SensorDelay, ("elbow",), delay=0.01),),
        (part_of(TransportDelay, ("bend",), delay=0.01),),
        names=("fore.mass",), known=0.05, start=(0.4, -0.7), rest=(0.0, 0.0),
    )  # fmt: skip
    return replace(found, rate=125.0, interval=0.5)


def arm_limits(**more: str) -> Limits:
    given = {"duration": "2.4", "shoulder.rate": "6", "elbow.rate": "6"}
    return Limits.read(ARM.robot, None, {**given, **{key.replace("_", "."): value for key, value in more.items()}})
