"""What is true of all MJCF robots."""

from __future__ import annotations

import math

from equimus_ctrl.robots.base import RobotTraits

TRAITS = RobotTraits(
    catalogue="mjcf",
    starts_at_rest=False,
    held_in_place=False,
    stops_give_way=False,
    smooth_motion=False,
    forces_along_actuators=False,
    commands_are_pressures=False,
    same_kind_of_trials=False,
    keeps_states_of_laws=False,
    has_stance=False,
    damping_known_within=None,
    bounds_of_any_size=True,
    least_command=0.0,
    least_motion=1e-4,
    most_angle=math.inf,
    usual_lag=0.0,
    usual_delay=0.02,
)
"""Motors drive hinges and slides that nothing need hold in place; recordings are what somebody has. Their commands go
over a bus, which takes some 20 ms."""
