"""Joints step from a pose to another at once, and stay there."""

import numpy as np

import equimus_ctrl as eq


def build(
    context: eq.ScenarioContext,
    size: float = 10.0,
    joint: str = "",
    begins: float = 1.0,
    duration: float = 4.0,
    keyframe: str = "",
    **joints: float,
) -> eq.Scenario:
    """One joint, or each, steps by ``size`` (degrees, slides mm) away from a pose; times in seconds.

    The pose is a keyframe, the first by default, with joints that differ from it. A step that would leave a joint's
    range goes the other way.
    """
    robot = context.robot
    if joint and joint not in robot.joint_names:
        raise eq.ConfigError(f"joint is {joint!r}, expected one of {', '.join(robot.joint_names)}")
    if not 0 < begins < duration:
        raise eq.ConfigError(f"begins is {begins:g} s, expected between 0 and the duration, {duration:g} s")
    first = context.pose(joints, keyframe)
    moved = [joint] if joint else [name for name, own in zip(robot.joint_names, context.driven, strict=True) if own]
    way = context.pose(dict.fromkeys(moved, size)) - context.pose(dict.fromkeys(moved, 0.0))
    low, high = robot.joint_range
    way = np.where((first + way > high) | (first + way < low), -way, way)
    for pose in (first, first + way):
        context.check_held(pose)
    return eq.Scenario(
        name="step",
        summary=f"{joint or 'each joint'} steps by {size:g} at {begins:g} s",
        duration=duration,
        reference=eq.FunctionReference(lambda time: first if time < begins else first + way),
        start=context.start(first),
        step_at=begins,
        score_window=(begins, duration),
    )
