"""The EquiMus leg: two joints, a mono-articular and a bi-articular pneumatic actuator.

Numbers: Zhu et al., "EquiMus: Energy-Equivalent Dynamic Modeling and Simulation of Musculoskeletal Robots Driven
by Linear Elastic Actuators" (author accepted manuscript, 2025).
"""

from __future__ import annotations

import math

from equimus_ctrl.robots.elastic.morphology import BUILT_IN, Morphology
from equimus_ctrl.robots.elastic.parts import ElasticActuator, Joint, JointStop, Link, Point

HIP_STOPS = (math.pi / 6, 5 * math.pi / 6)
KNEE_STOPS = (-0.035, 2.0)
POSES = {"stretched": (math.pi / 2, 0.0)}
SCENARIOS = {
    "push": {"hip": 85.0, "knee": 35.0, "torque": 0.4},
    "payload": {"hip": 85.0, "knee": 35.0, "mass": 0.1},
}


def _leg(
    name: str,
    thigh: Link,
    calf: Link,
    damping: tuple[float, float],
    maa: tuple[float, float, float, float],
    baa: tuple[float, float, float, float],
) -> Morphology:
    """The leg's geometry with given inertia, joint damping and (stiffness, damping, rest_length, area) of each."""
    keys = ("stiffness", "damping", "rest_length", "area")
    return Morphology(
        name=name,
        links=(thigh, calf),
        joints=(
            Joint("hip", "base", "thigh", damping[0], JointStop(HIP_STOPS[0]), JointStop(HIP_STOPS[1])),
            Joint("knee", "thigh", "calf", damping[1], JointStop(KNEE_STOPS[0]), JointStop(KNEE_STOPS[1])),
        ),
        actuators=(
            ElasticActuator(
                "maa",
                origin=Point("base", 0.06),
                insertion=Point("thigh", 0.21213, math.radians(-8.13)),
                mass=0.1865,
                **dict(zip(keys, maa, strict=True)),
            ),
            ElasticActuator(
                "baa",
                origin=Point("base", 0.10, math.pi),
                insertion=Point("calf", 0.10, math.radians(30.0)),
                mass=0.2727,
                **dict(zip(keys, baa, strict=True)),
            ),
        ),
        foot="calf",
        base_mass=0.155,
        gravity=9.8,
        poses=POSES,
        scenarios=SCENARIOS,
    )


def nominal_leg() -> Morphology:
    """The real leg's inertia with the parameters identified from its motion."""
    return _leg(
        "nominal_leg",
        thigh=Link("thigh", 0.25, 0.086, 0.1267, 5.46e-4),
        calf=Link("calf", 0.25, 0.1033, 0.139, 6.52e-4),
        damping=(0.524, 0.062),
        maa=(265.82, 12.48, 0.1803, 0.000403),
        baa=(110.36, 24.79, 0.2565, 0.000436),
    )


def ideal_leg() -> Morphology:
    """Uniform rods with the actuators as measured alone on the bench, joints without damping."""
    return _leg(
        "ideal_leg",
        thigh=Link("thigh", 0.25, 0.086, 0.125, 4.73e-4),
        calf=Link("calf", 0.25, 0.1033, 0.125, 5.68e-4),
        damping=(0.0, 0.0),
        maa=(367.8, 10.8, 0.1744, 6.54e-4),
        baa=(291.8, 11.3, 0.2536, 6.37e-4),
    )


MORPHOLOGIES = {"nominal_leg": nominal_leg, "ideal_leg": ideal_leg}
BUILT_IN.update(MORPHOLOGIES)
