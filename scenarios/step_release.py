"""Both pressures step up from rest, hold for five seconds and are released."""

import numpy as np

import equimus_ctrl as eq


def build(
    context: eq.ScenarioContext, maa: float = 40.0, baa: float = 30.0, hold: float = 5.0, duration: float = 10.0
) -> eq.Scenario:
    """Pressures in kPa, times in seconds; scored beside the recorded group of these pressures where there is one."""
    context.require(("hip", "knee"), ("maa", "baa"), "step_release")
    pressure = np.array([maa, baa]) * 1e3
    trials = context.recording("step_release")
    recorded = next((trial for trial in trials if np.allclose(trial.command.max(axis=0), pressure, atol=1.0)), None)
    missing = None
    if not trials:
        missing = context.missing
    elif recorded is None:
        groups = ", ".join("/".join(f"{p / 1e3:g}" for p in trial.command.max(axis=0)) for trial in trials)
        missing = f"no group of {maa:g}/{baa:g} kPa was recorded (recorded: {groups} kPa)"
    if recorded is not None:
        profile = context.profile(recorded.time - recorded.time[0], recorded.command)
        start = eq.Start(command=recorded.command_before, position=recorded.position[0])
    else:
        profile = context.profile([0.0, hold], [pressure, np.zeros(2)])
        start = eq.Start()
    poses = [context.kinematics.equilibrium(p) for p in (pressure, np.zeros(2))]
    return eq.Scenario(
        name="step_release",
        summary=f"step to {maa:g} and {baa:g} kPa, release after {hold:g} s",
        duration=duration,
        reference=eq.FunctionReference(lambda time: poses[0] if time < hold else poses[1]),
        start=start,
        commands=profile,
        controller="open_loop",
        recorded=recorded,
        missing=missing,
    )
