"""Bring a robot from where it rests into a pose, upright say, and balance it there."""

import equimus_ctrl as eq


def build(
    context: eq.ScenarioContext,
    keyframe: str = "upright",
    begins: str = "",
    within: float = 10.0,
    duration: float = 10.0,
    **joints: float,
) -> eq.Scenario:
    """To a keyframe of the robot's description, and joints that differ from it, in degrees, slides in mm.

    It begins at rest in the keyframe ``begins``, the first by default. It has arrived once every joint stays within so
    many degrees (mm) of the pose; hinges without range may have turned whole turns more. Times in seconds.
    """
    robot = context.robot
    if keyframe not in robot.keyframes and keyframe == "upright":
        keyframe = ""
        if not joints:
            named = ", ".join(robot.keyframes) or "none"
            raise eq.ConfigError(
                f"{robot.name} has no keyframe 'upright' (keyframes: {named}); name one with keyframe, or the pose by "
                f"joints, such as {robot.joint_names[-1]}=180"
            )
    pose = context.pose(joints, keyframe)
    first = context.pose({}, begins)
    context.check_held(pose)
    return eq.Scenario(
        name="swing_up",
        summary=f"from {eq.shown_pose(first, robot.joint_units)} to {eq.shown_pose(pose, robot.joint_units)}, and stay",
        duration=duration,
        reference=eq.HoldReference(pose),
        start=context.start(first),
        controller="sampling",
        arrival=eq.Arrival(within),
    )
