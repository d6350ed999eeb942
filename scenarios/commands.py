"""Commands from a file are played in open loop; references from a file are tracked by the feedback law that it says."""

import equimus_ctrl as eq
from equimus_ctrl.scenarios.playing import begins, in_its_condition, resting, tracked

KNOTS = 240
"""Instants at which it is worked out where the robot would rest."""


def build(context: eq.ScenarioContext, file: str = "", duration: float = 0.0) -> eq.Scenario:
    """A CSV with ``time`` and ``cmd.<actuator>`` in SI units, as recordings have; other columns do not count.

    The robot begins at rest under the command before the first row (note ``before.cmd.<actuator>``, else the first
    row's), or in the pose that notes ``start.pos.<joint>`` give [rad or m]. Time in seconds, by default until the last
    row. The reference is where the robot would rest under each command, if it would; else where it begins.

    Where notes say a feedback law (``track.…``), joints track the columns ``ref.<joint>`` and the commands are fed
    forward.
    """
    if not file:
        raise eq.ConfigError("there are no commands to play; expected file=FILE.csv with time and cmd.<actuator>")
    own = context.read_commands(file)
    profile = context.profile(own.times, own.values, own.linear)
    here = in_its_condition(context, file, own)
    law = tracked(own)
    reference = resting(here, profile, begins(here, file, own), KNOTS) if law is None else law.reference
    return eq.Scenario(
        name="commands",
        summary=f"plays {file}",
        duration=duration or float(own.times[-1]),
        reference=reference,
        start=eq.Start(command=own.before, position=own.position),
        commands=profile,
        controller=law or "open_loop",
        different=own.different,
    )
