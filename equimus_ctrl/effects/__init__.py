"""Physics that can be attached to a model."""

from equimus_ctrl.effects.base import REGISTRY, Effect, make, parameter, parse, register
from equimus_ctrl.effects.bodies import BodyEffect, GravityTilt, JointStop, PayloadMass
from equimus_ctrl.effects.force import (
    CoulombFriction,
    Creep,
    ForceEffect,
    Hysteresis,
    NonlinearStiffness,
    ParallelSpring,
    StribeckFriction,
)
from equimus_ctrl.effects.sensors import Backlash, SensorDelay, SensorEffect, SensorOffset, SensorScale
from equimus_ctrl.effects.valves import (
    AsymmetricLag,
    Cutoff,
    DeadZone,
    FillingFlow,
    FirstOrderLag,
    RateLimit,
    Saturation,
    ShapingEffect,
    SupplyCoupling,
    TransportDelay,
    ValveEffect,
)

__all__ = [
    "REGISTRY",
    "AsymmetricLag",
    "Backlash",
    "BodyEffect",
    "CoulombFriction",
    "Creep",
    "Cutoff",
    "DeadZone",
    "Effect",
    "FillingFlow",
    "FirstOrderLag",
    "ForceEffect",
    "GravityTilt",
    "Hysteresis",
    "JointStop",
    "NonlinearStiffness",
    "ParallelSpring",
    "PayloadMass",
    "RateLimit",
    "Saturation",
    "SensorDelay",
    "SensorEffect",
    "SensorOffset",
    "SensorScale",
    "ShapingEffect",
    "StribeckFriction",
    "SupplyCoupling",
    "TransportDelay",
    "ValveEffect",
    "make",
    "parameter",
    "parse",
    "register",
]
