"""The foot goes round a circle."""

import math

import numpy as np

import equimus_ctrl as eq


def build(
    context: eq.ScenarioContext,
    hip: float = 85.0,
    knee: float = 40.0,
    radius: float = 0.03,
    period: float = 4.0,
    duration: float = 14.0,
) -> eq.Scenario:
    """Its centre is where the foot is at a pose, in degrees; radius in metres, times in seconds.

    The radius grows from nothing in half a round, so that the robot starts at rest in the middle.
    """
    context.require(("hip", "knee"), ("maa", "baa"), "foot_circle")
    kinematics = context.kinematics
    pose = np.radians([hip, knee])
    times = np.arange(0.0, duration + period, 1 / 120)
    turn, grown = 2 * math.pi * times / period, radius * eq.minimum_jerk(2 * times / period)
    feet = kinematics.foot(pose) + (grown * [np.cos(turn), np.sin(turn)]).T
    return eq.Scenario(
        name="foot_circle",
        summary=f"the foot goes round a circle of {100 * radius:g} cm in {period:g} s",
        duration=duration,
        reference=eq.SampledReference(times, eq.poses_of_foot(kinematics, feet, near=pose)),
        score_window=(period, duration),
    )
