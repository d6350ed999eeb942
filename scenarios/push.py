"""Hold a pose while something pushes: torques on joints, or a force at a site or body."""

import math

import numpy as np

import equimus_ctrl as eq
from equimus_ctrl.scenarios.shapes import vector_of


def build(
    context: eq.ScenarioContext,
    joint: str = "",
    torque: float = 0.0,
    site: str = "",
    force: float = 0.0,
    direction: str = "",
    begins: float = 4.0,
    lasts: float = 1.0,
    duration: float = 10.0,
    keyframe: str = "",
    **joints: float,
) -> eq.Scenario:
    """A torque in N·m (slides: force in N) on one joint or on each driven one, from when and for how long in seconds.

    Or, with a site (or a body: its centre of mass), a force in N there, in a ``direction`` such as ``'0 0 -1'`` of the
    room; by default that in which the joints give way most. The size is by default a fifth of what the actuators can
    bear beside holding the pose; where nothing limits them, what would speed up a free joint by 1 rad/s² (1 m/s²). The
    pose is a keyframe, the first by default, with joints that differ from it in degrees, slides in mm.
    """
    robot = context.robot
    if joint and joint not in robot.joint_names:
        raise eq.ConfigError(f"joint is {joint!r}, expected one of {', '.join(robot.joint_names)}")
    at_site = bool(site or force or direction)
    if at_site and (beside := {"joint", "torque"} & context.given):
        raise eq.ConfigError(
            f"{min(beside)} is that of a push on joints, but a force acts at a site; expected one of both"
        )
    pose = context.pose(joints, keyframe)
    context.check_held(pose)
    if not math.isfinite(force):
        raise eq.ConfigError(f"force is {force:g} N, expected a finite number")
    if at_site:
        point = context.point(site)
        way = context.free_way(point, pose) if not direction else vector_of("direction", direction)
        if not np.any(way):
            raise eq.ConfigError(f"direction is {direction!r}, expected other than 0")
        way = way / np.linalg.norm(way)
        size = force or context.usual_load(pose, context.points.at(point, pose)[1].T @ way)
        event = eq.PointForce(begins, lasts, size * way, point)
        what = f"{size:.3g} N push {point}"
    else:
        own = np.array([name == joint for name in robot.joint_names]) if joint else context.driven
        torques = torque * own if torque else context.usual_torques(pose, own)
        event = eq.Push(begins, lasts, torques)
        names = [name for name, pushed in zip(robot.joint_names, own, strict=True) if pushed]
        j = int(np.abs(torques).argmax())
        most = f"{torques[j]:.3g} {robot.place_unit('N·m', robot.joint_names[j])}"
        most = f"up to {most}" if len(set(torques[own])) > 1 else most
        what = f"{most} push {' and '.join(names) if len(names) < 3 else f'{len(names)} joints'}"
    return eq.Scenario(
        name="push",
        summary=f"hold a pose while {what} for {lasts:g} s",
        duration=duration,
        reference=eq.HoldReference(pose),
        events=(event,),
        score_window=(max(begins - 0.5, 0.0), duration),
    )
