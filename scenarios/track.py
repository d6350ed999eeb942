"""Joints go along a path of poses, from rest to rest at each, or along what a file says."""

import numpy as np

import equimus_ctrl as eq

LEAD = 2.0
"""Time in which the robot goes to where the path begins [s]."""


def build(
    context: eq.ScenarioContext,
    waypoints: str = "",
    file: str = "",
    leg_time: float = 2.0,
    rounds: int = 1,
    swing: float = 15.0,
    keyframe: str = "",
    duration: float = 0.0,
) -> eq.Scenario:
    """Way points as ``shoulder=30 elbow=-20; shoulder=0``, in degrees, slides in mm, other joints as in a keyframe.

    Or a CSV file with ``time`` and ``pos.<joint>`` in SI units. Without either the joints swing about the keyframe, the
    first by default, by less where a robot cannot do as much. Times in seconds, the duration that of the path by
    default; what comes before it is not scored.
    """
    robot = context.robot
    if file:
        times, values = context.path_file(file)
    else:
        if not (0 < leg_time < 1e4 and rounds >= 1):
            raise eq.ConfigError(f"leg_time is {leg_time:g} s, rounds {rounds}; expected more than 0, and at least 1")
        middle, corners = _corners(context, waypoints, keyframe, swing)
        around = np.vstack([*[corners] * rounds, corners[:1]])
        times, values = eq.joint_path(around, leg_time)
        if not waypoints:
            _, values = context.within_means(times, middle, values - middle)
    for pose in (values[0], values[-1]) if file else (corners if waypoints else [middle]):
        context.check_held(pose)
    first = context.home
    lead = np.arange(0.0, LEAD, 1 / 120)
    way = first + eq.minimum_jerk(lead / LEAD)[:, None] * (values[0] - first)
    whole = eq.SampledReference(np.r_[lead, LEAD + times], np.vstack([way, values]))
    what = f"{file}" if file else f"{len(corners)} poses, {leg_time:g} s each"
    return eq.Scenario(
        name="track",
        summary=f"the joints of {robot.name} follow {what}",
        duration=duration or LEAD + float(times[-1]),
        reference=whole,
        start=context.start(first),
        score_window=(LEAD, LEAD + float(times[-1])),
    )


def _corners(context: eq.ScenarioContext, waypoints: str, keyframe: str, swing: float) -> tuple[np.ndarray, np.ndarray]:
    """A pose (nj,) to swing about, and (n, nj) the corners of the path [rad or m]."""
    if waypoints:
        poses = [context.pose(context.joints_of(text), keyframe) for text in waypoints.split(";") if text.strip()]
        if not poses:
            raise eq.ConfigError(f"waypoints are {waypoints!r}, expected poses such as 'elbow=30; elbow=0'")
        return poses[0], np.array(poses)
    middle, most = context.swings(swing, context.pose({}, keyframe))
    signs = np.array([[(-1) ** (j * k // 2 + k) for j in range(len(middle))] for k in range(3)])
    return middle, np.asarray(middle + signs * most)
