"""What is true of all robots with elastic actuators."""

from __future__ import annotations

from equimus_ctrl.robots.base import RobotTraits

TRAITS = RobotTraits(
    catalogue="elastic",
    starts_at_rest=True,
    held_in_place=True,
    stops_give_way=True,
    smooth_motion=True,
    forces_along_actuators=True,
    commands_are_pressures=True,
    same_kind_of_trials=True,
    keeps_states_of_laws=True,
    has_stance=True,
    damping_known_within=4.0,
    bounds_of_any_size=False,
    least_command=500.0,
    least_motion=5e-3,
    most_angle=12.6,
    usual_lag=0.1,
    usual_delay=0.1,
)
"""Pneumatic muscles pull a robot with end stops to one pose; it is driven by valves, from rest, on a test bench."""
