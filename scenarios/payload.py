"""Hold a pose while a site or body takes up a load that nobody told of."""

import equimus_ctrl as eq


def build(
    context: eq.ScenarioContext,
    mass: float = 0.0,
    site: str = "",
    begins: float = 4.0,
    duration: float = 12.0,
    keyframe: str = "",
    **joints: float,
) -> eq.Scenario:
    """Mass in kg, from when in seconds, 0 for from the start; at the end of the robot, or a site or body (its centre).

    The mass is by default a fifth of what the actuators can bear there beside holding the pose; where nothing limits
    them or gravity does not move the joints, what adds a fifth to the inertia of the joint that feels it most. The pose
    is a keyframe, the first by default, with joints that differ from it in degrees, slides in mm.
    """
    pose = context.pose(joints, keyframe)
    context.check_held(pose)
    point = context.point(site)
    mass = mass or context.usual_mass(point, pose)
    return eq.Scenario(
        name="payload",
        summary=f"hold a pose while the {point} takes up {1e3 * mass:.4g} g",
        duration=duration,
        reference=eq.HoldReference(pose),
        events=(eq.Load(begins, mass, point),),
        score_window=(max(begins - 0.5, 0.0), duration),
    )
