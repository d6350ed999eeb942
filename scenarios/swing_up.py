"""Bring a robot from where it rests into a pose, upright say, and balance it there."""

import equimus_ctrl as eq

UPRIGHT = "upright"


def build(
    context: eq.ScenarioContext,
    keyframe: str = "",
    begins: str = "",
    within: float = 10.0,
    slides_within: float = 100.0,
    duration: float = 10.0,
    **joints: float,
) -> eq.Scenario:
    """To a keyframe of the robot's description, ``upright`` by default, and joints that differ from it.

    Joints are in degrees, slides in mm. It begins at rest in the keyframe ``begins``, the first by default; a robot
    that springs hold begins at rest without command. It has arrived once every hinge stays within so many degrees of
    the pose and every slide within so many mm; hinges without range may have turned whole turns more. Times in seconds.
    """
    robot = context.robot
    held = robot.traits.held_in_place
    if not keyframe and UPRIGHT in robot.keyframes:
        keyframe = UPRIGHT
    if not keyframe and not joints and not held:
        named = ", ".join(robot.keyframes) or "none"
        raise eq.ConfigError(
            f"{robot.name} has no keyframe {UPRIGHT!r} (keyframes: {named}); name one with keyframe=, or the pose by "
            f"joints, such as {robot.joint_names[-1]}=180"
        )
    pose = context.pose(joints, keyframe)
    context.check_held(pose)
    if held and not begins:
        start, first = eq.Start(), "rest"
    else:
        begun = context.pose({}, begins)
        start, first = context.start(begun), eq.shown_pose(begun, robot.joint_units)
    return eq.Scenario(
        name="swing_up",
        summary=f"from {first} to {eq.shown_pose(pose, robot.joint_units)}, and stay there",
        duration=duration,
        reference=eq.HoldReference(pose),
        start=start,
        controller="sampling",
        arrival=eq.Arrival(within, slides_within),
    )
