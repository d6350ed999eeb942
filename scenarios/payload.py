"""Hold a pose while the foot takes up a load."""

import math

import equimus_ctrl as eq


def build(
    context: eq.ScenarioContext,
    hip: float = 85.0,
    knee: float = 35.0,
    mass: float = 0.1,
    begins: float = 4.0,
    duration: float = 12.0,
) -> eq.Scenario:
    """Pose in degrees; mass in kg, from when in seconds."""
    context.require(("hip", "knee"), ("maa", "baa"), "payload")
    return eq.Scenario(
        name="payload",
        summary=f"hold a pose while the foot takes up {1e3 * mass:g} g",
        duration=duration,
        reference=eq.HoldReference([math.radians(hip), math.radians(knee)]),
        events=(eq.Load(begins, mass),),
        score_window=(begins - 0.5, duration),
    )
