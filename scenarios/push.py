"""Hold a pose while something pushes."""

import math

import equimus_ctrl as eq


def build(
    context: eq.ScenarioContext,
    hip: float = 85.0,
    knee: float = 35.0,
    torque: float = 0.4,
    begins: float = 4.0,
    lasts: float = 1.0,
    duration: float = 10.0,
) -> eq.Scenario:
    """Pose in degrees; the same torque in N·m on both joints, from when and for how long in seconds."""
    context.require(("hip", "knee"), ("maa", "baa"), "push")
    return eq.Scenario(
        name="push",
        summary=f"hold a pose while {torque:g} N·m push both joints for {lasts:g} s",
        duration=duration,
        reference=eq.HoldReference([math.radians(hip), math.radians(knee)]),
        events=(eq.Push(begins, lasts, [torque, torque]),),
        score_window=(begins - 0.5, duration),
    )
