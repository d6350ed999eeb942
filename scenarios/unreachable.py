"""A reference that leaves what the actuators can reach, and comes back."""

import math

import numpy as np

import equimus_ctrl as eq


def build(
    context: eq.ScenarioContext, hip: float = 85.0, knee: float = 35.0, away: float = 45.0, duration: float = 12.0
) -> eq.Scenario:
    """Both joints go from a pose by ``away`` degrees, stay for three seconds and come back; the return is scored."""
    context.require(("hip", "knee"), ("maa", "baa"), "unreachable")
    pose = np.radians([hip, knee])
    far = pose + math.radians(away) * np.array([-1.0, 1.0])
    times = np.arange(0.0, duration + 1.0, 1 / 120)
    share = eq.minimum_jerk((times - 3.0) / 1.5) - eq.minimum_jerk((times - 7.0) / 1.5)
    return eq.Scenario(
        name="unreachable",
        summary=f"a reference that goes {away:g}° out of reach and comes back",
        duration=duration,
        reference=eq.SampledReference(times, pose + share[:, None] * (far - pose)),
        score_window=(8.5, duration),
    )
