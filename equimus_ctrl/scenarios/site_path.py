"""A path of a named point of a robot, and the joints' motion along it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from equimus_ctrl.errors import ConfigError
from equimus_ctrl.models.points import Points
from equimus_ctrl.scenarios.context import ScenarioContext
from equimus_ctrl.scenarios.reaching import BOTH_WAYS, Mobility
from equimus_ctrl.scenarios.references import SampledReference
from equimus_ctrl.scenarios.shapes import plane_of, resampled, shape_path, vector_of
from equimus_ctrl.types import Array

SMALLER, SIZES = 0.8, 16
"""By how much a path is made smaller that a robot cannot do, where nobody said its size, and how often at most."""
WIDER = (1.0, 2.0, 4.0, 6.0)
"""Times the swing within which a pose is looked for about which a path of a given size can be followed."""
HELD = 24
"""Poses along a path that have to be held."""
USUAL = "triangle"
"""The shape of a path where nobody says it."""


@dataclass(frozen=True, eq=False)
class SitePath:
    """Where a named point of a robot should be.

    Attributes:
        name: of the point.
        wanted: (3,) over time [m].
        points: of the robot.
    """

    name: str
    wanted: SampledReference
    points: Points

    def places(self, poses: Array) -> Array:
        """(n, 3) where the point is in poses (n, nj) [m]."""
        return np.array([self.points.at(self.name, pose)[0] for pose in poses])

    def wanted_at(self, times: Array) -> Array:
        """(n, 3) where it should be at times (n,) [m]."""
        return np.array([self.wanted.position(float(time)) for time in times])


@dataclass(frozen=True, eq=False)
class JointsAlong:
    """What joints do so that a point goes along a path.

    Attributes:
        times: (n,) from 0 on [s].
        values: (n, nj) of the joints [rad or m].
        places: (n, 3) of the point [m].
        what: the path, in words.
    """

    times: Array
    values: Array
    places: Array
    what: str


def along_file(context: ScenarioContext, site: str, file: str) -> JointsAlong:
    """Along the rows of a CSV with ``time``, ``x``, ``y`` and ``z`` in SI units, joined by straight lines.

    Raises:
        ConfigError, RecordingError: for a file that is none of these, or where the path cannot be followed.
    """
    reacher = context.reacher(site)
    times, places = resampled(*context.read_columns(file, ("x", "y", "z")))
    values = reacher.follow(times, places, context.home)
    return JointsAlong(times, values, places, file)


def along_shape(
    context: ScenarioContext,
    site: str,
    shape: str,
    size: float,
    plane: str,
    centre: str,
    about: Array,
    swing: float,
    leg_time: float,
    rounds: int,
) -> JointsAlong:
    """Round a shape.

    Its middle is, by default, where the point is in the pose within a swing of ``about`` in which it moves best (two,
    four or six where a path of a given size asks for it), in the plane in which it can move farthest there. By
    default it is as large as swings of the joints can make it both ways, or as large as the robot can do if that is
    less.

    Args:
        context: of the robot.
        site: the point; the end by default.
        shape: of ``shapes.SHAPES``; ``USUAL`` by default.
        size: across [m]; 0 for the default.
        plane: two axes such as ``xz``.
        centre: three numbers [m].
        about: (nj,) the pose that it is near to [rad or m].
        swing: of the joints for the defaults [° or mm].
        leg_time: from corner to corner [s].
        rounds: how often.

    Raises:
        ConfigError: where the path cannot be followed, a pose along it not be held, or the actuators are too weak.
    """
    shape = shape or USUAL
    if not 0 <= size < np.inf:
        raise ConfigError(f"size is {size:g} m, expected more than 0")
    times, flat = shape_path(shape, 1.0, leg_time, rounds)
    reacher = context.reacher(site)

    def middle(wider: float) -> Mobility:
        near, swings = context.swings(wider * swing, about)
        best = reacher.nimblest(near, swings, context.can_hold)
        if not centre:
            return best
        (pose,) = reacher.follow(np.zeros(1), vector_of("centre", centre)[None], best.pose)
        return reacher.mobility(pose, swings)

    def along(diameter: float, best: Mobility, elsewhere: bool) -> JointsAlong:
        places = best.place + diameter * flat @ (plane_of(plane) if plane else best.axes[:, :2]).T
        values = reacher.follow(times, places, best.pose, elsewhere)
        for k in np.unique(np.linspace(0, len(values) - 1, HELD).astype(int)):
            context.check_held(values[k])
        return JointsAlong(times, values, places, f"a {shape} of {1e3 * diameter:.3g} mm")

    best = middle(1.0)
    context.check_held(best.pose)
    if not plane and best.reach[1] <= BOTH_WAYS * best.reach[0] and shape != "line":
        raise ConfigError(
            f"{context.robot.name}: {reacher.name} moves along one line alone, so that there is no plane for a "
            f"{shape}; expected shape=line, way points of joints, or a plane"
        )
    way = float(best.reach[0] if shape == "line" and not plane else best.reach[1])
    usual = 2 * (way or float(best.reach[0]))
    wider = WIDER[:1] if centre or not size else WIDER
    choices = [(size, own) for own in wider] if size else [(usual * SMALLER**k, 1.0) for k in range(SIZES)]
    kept: JointsAlong | None = None
    for k, (diameter, own) in enumerate(choices):
        last = k == len(choices) - 1
        try:
            found = along(diameter, best if own == 1.0 else middle(own), bool(size) and last)
        except ConfigError:
            if last and kept is None:
                raise
            continue
        if context.can_do(times, found.values):
            return found
        kept = found if kept is None or not size else kept
    assert kept is not None
    if not context.robot.traits.held_in_place:
        raise ConfigError(
            f"{context.robot.name}: its actuators cannot move {reacher.name} along {kept.what}, {leg_time:g} s from "
            "corner to corner; expected a longer leg_time or a smaller size"
        )
    return kept
