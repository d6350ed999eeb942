"""Joints go along a path of poses from rest to rest at each, or so that a site goes along a path, or as a file says."""

import numpy as np

import equimus_ctrl as eq
from equimus_ctrl.scenarios.site_path import SitePath, along_file, along_shape

LEAD = 2.0
"""Time in which the robot goes to where the path begins [s]."""


def build(
    context: eq.ScenarioContext,
    waypoints: str = "",
    file: str = "",
    site: str = "",
    shape: str = "",
    size: float = 0.0,
    plane: str = "",
    centre: str = "",
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

    With a site (or a body: its centre of mass) or a shape, that point goes round a line, triangle, square or circle of
    a size across, in metres, or along the ``time``, ``x``, ``y``, ``z`` of a CSV file. Joints follow by inverse
    kinematics. The middle is where the point is in the pose within ``swing`` of the keyframe in which it moves best,
    the plane that in which it moves farthest; or ``centre`` as ``'0.3 0 0.2'`` in metres, ``plane`` as ``xz``.
    """
    if not (0 < leg_time < 1e4 and rounds >= 1):
        raise eq.ConfigError(f"leg_time is {leg_time:g} s, rounds {rounds}; expected more than 0, and at least 1")
    at_site = site or shape
    if waypoints and (at_site or file):
        raise eq.ConfigError("waypoints stand for the whole path; expected no site, shape or file beside them")
    if shape and file:
        raise eq.ConfigError(f"shape is {shape!r}, but the path is that of {file}; expected one of both")
    for key, value in (("size", size), ("plane", plane), ("centre", centre)):
        if value and (file or not at_site):
            raise eq.ConfigError(f"{key} is that of a shape; expected a shape or a site beside it, and no file")
    if at_site:
        point = context.point(site)
        own = (
            along_file(context, point, file)
            if file
            else along_shape(
                context,
                point,
                shape,
                size,
                plane,
                centre,
                context.pose({}, keyframe) if keyframe else context.middle,
                swing,
                leg_time,
                rounds,
            )
        )
        times, values, what = own.times, own.values, f"{point} goes along {own.what}"
        wanted = SitePath(point, eq.SampledReference(LEAD + times, own.places), context.points)
    else:
        times, values, what = _of_joints(context, waypoints, file, leg_time, rounds, swing, keyframe)
        wanted = None
    first = context.home
    lead = np.arange(0.0, LEAD, 1 / 120)
    way = first + eq.minimum_jerk(lead / LEAD)[:, None] * (values[0] - first)
    whole = eq.SampledReference(np.r_[lead, LEAD + times], np.vstack([way, values]))
    return eq.Scenario(
        name="track",
        summary=what,
        duration=duration or LEAD + float(times[-1]),
        reference=whole,
        start=context.start(first),
        score_window=(LEAD, LEAD + float(times[-1])),
        site=wanted,
    )


def _of_joints(
    context: eq.ScenarioContext, waypoints: str, file: str, leg_time: float, rounds: int, swing: float, keyframe: str
) -> tuple[np.ndarray, np.ndarray, str]:
    """Times (n,) [s] and positions (n, nj) [rad or m] of a path of poses, and that path in words."""
    if file:
        times, values = context.path_file(file)
    else:
        middle, corners = _corners(context, waypoints, keyframe, swing)
        around = np.vstack([*[corners] * rounds, corners[:1]])
        times, values = eq.joint_path(around, leg_time)
        if not waypoints:
            _, values = context.within_means(times, middle, values - middle)
    for pose in (values[0], values[-1]) if file else (corners if waypoints else [middle]):
        context.check_held(pose)
    what = f"{file}" if file else f"{len(corners)} poses, {leg_time:g} s each"
    return times, values, f"the joints of {context.robot.name} follow {what}"


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
