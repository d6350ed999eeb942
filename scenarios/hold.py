"""Reach a pose from rest and hold it."""

import equimus_ctrl as eq


def build(context: eq.ScenarioContext, duration: float = 6.0, keyframe: str = "", **joints: float) -> eq.Scenario:
    """Time in seconds; a keyframe of the robot's description, the first by default, and joints that differ from it.

    Joints are in degrees, slides in mm. A robot that springs hold starts from rest without command, others in the pose
    of their description.
    """
    pose = context.pose(joints, keyframe)
    context.check_held(pose)
    return eq.Scenario(
        name="hold",
        summary=f"reach {eq.shown_pose(pose, context.robot.joint_units)} from rest and hold it",
        duration=duration,
        reference=eq.HoldReference(pose),
        step_like=True,
    )
