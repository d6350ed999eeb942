"""The foot goes round a triangle whose corners are the poses held by three pairs of pressures.

Open loop, the recorded commands are played on the simulated leg and scored against what the real leg did. Closed loop,
the foot follows straight lines between the corners.
"""

import numpy as np

import equimus_ctrl as eq

CORNERS_KPA = [(6.154, 2.728), (3.757, 7.261), (19.801, 8.520)]
"""Pressures of the two actuators at the corners (EquiMus, 2025)."""
LEG_TIME = 2.0
"""From corner to corner [s]."""


def build(context: eq.ScenarioContext, duration: float = 40.0) -> eq.Scenario:
    """Duration in seconds; the score is over the first 40 s at 100 Hz, as published."""
    context.require(("hip", "knee"), ("maa", "baa"), "triangle")
    kinematics = context.kinematics
    corners = [kinematics.equilibrium(np.array(pressure) * 1e3) for pressure in CORNERS_KPA]
    trials = context.recording("triangle")
    recorded = trials[0] if trials else None
    if recorded is not None:
        profile = context.profile(np.r_[0.0, recorded.time[1:]], recorded.command)
        start = eq.Start(command=recorded.command_before, position=recorded.position[0])
    else:
        # The recording begins with the leg at rest without pressure and the command of the second corner.
        times = np.arange(0.0, duration, LEG_TIME)
        profile = context.profile(times, [np.array(CORNERS_KPA[(k + 1) % 3]) * 1e3 for k in range(len(times))])
        start = eq.Start()
    return eq.Scenario(
        name="triangle",
        summary="the foot goes round a triangle, scored against the real leg",
        duration=duration,
        reference=eq.foot_path(kinematics, corners, LEG_TIME, duration),
        start=start,
        commands=profile,
        controller="open_loop",
        recorded=recorded,
        missing=None if recorded is not None else context.missing,
        score_window=(0.0, 40.0),
        published={"hip": 0.0915, "knee": 0.1748},
    )
