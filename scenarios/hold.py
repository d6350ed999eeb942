"""Reach a pose from rest and hold it."""

import math

import equimus_ctrl as eq


def build(context: eq.ScenarioContext, hip: float = 90.0, knee: float = 0.0, duration: float = 6.0) -> eq.Scenario:
    """Angles in degrees, time in seconds; from rest without pressure."""
    context.require(("hip", "knee"), ("maa", "baa"), "hold")
    return eq.Scenario(
        name="hold",
        summary=f"reach ({hip:g}°, {knee:g}°) from rest and hold it",
        duration=duration,
        reference=eq.HoldReference([math.radians(hip), math.radians(knee)]),
        step_like=True,
    )
