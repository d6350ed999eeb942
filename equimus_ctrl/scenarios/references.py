"""References: where the joints should be, over time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import least_squares

from equimus_ctrl.errors import ConfigError
from equimus_ctrl.models.kinematics import Kinematics
from equimus_ctrl.types import Array, frozen_array


@dataclass(frozen=True, eq=False)
class HoldReference:
    """One pose for ever.

    Attributes:
        pose: (nj,) [rad].
    """

    pose: Array

    def __post_init__(self) -> None:
        object.__setattr__(self, "pose", frozen_array(self.pose, 1, "reference pose"))
        if not np.all(np.isfinite(self.pose)):
            raise ConfigError(f"reference pose is {self.pose.tolist()}, expected finite angles in rad")

    def position(self, time: float) -> Array:
        """(nj,) [rad]."""
        return self.pose


@dataclass(frozen=True, eq=False)
class SampledReference:
    """Samples joined by straight lines; before the first and after the last, the end values hold.

    Attributes:
        times: (n,) ascending [s].
        values: (n, nj) [rad].
    """

    times: Array
    values: Array

    def __post_init__(self) -> None:
        object.__setattr__(self, "times", frozen_array(self.times, 1, "reference times"))
        object.__setattr__(self, "values", frozen_array(self.values, 2, "reference values"))
        if len(self.times) != len(self.values) or len(self.times) == 0:
            raise ConfigError(f"reference: {len(self.times)} times for {len(self.values)} values")
        if not np.all(np.diff(self.times) > 0):
            raise ConfigError("reference: times must ascend")
        if not (np.all(np.isfinite(self.times)) and np.all(np.isfinite(self.values))):
            raise ConfigError("reference: times and values must be finite numbers")

    def position(self, time: float) -> Array:
        """(nj,) [rad]."""
        k = int(np.searchsorted(self.times, time, side="right")) - 1
        if k < 0:
            return np.asarray(self.values[0])
        if k >= len(self.times) - 1:
            return np.asarray(self.values[-1])
        share = (time - self.times[k]) / (self.times[k + 1] - self.times[k])
        return np.asarray((1 - share) * self.values[k] + share * self.values[k + 1])


@dataclass(frozen=True)
class FunctionReference:
    """A reference computed by a function of time.

    Attributes:
        function: time [s] → joint angles (nj,) [rad].
    """

    function: Callable[[float], ArrayLike]

    def position(self, time: float) -> Array:
        """(nj,) [rad]."""
        return np.asarray(self.function(time), dtype=np.float64)


def minimum_jerk(share: ArrayLike) -> Array:
    """10s³ − 15s⁴ + 6s⁵ for s clipped to 0…1: from rest to rest with the least jerk (Flash & Hogan, 1985)."""
    s = np.clip(np.asarray(share, dtype=np.float64), 0.0, 1.0)
    return s**3 * (10 - 15 * s + 6 * s**2)


THERE, ADJACENT = 1e-11, 0.3
"""Of poses that followed one another: by what the foot may be off [m], and what may lie between two of them [rad]."""


def pose_of_foot(kinematics: Kinematics, foot: ArrayLike, near: ArrayLike) -> Array:
    """(nj,) the pose closest to ``near`` [rad] that puts the foot at ``foot`` (2,) [m], within the joint ranges.

    Args:
        kinematics: of the robot.
        foot: where the foot is to be.
        near: (nj,) the search begins there.

    Raises:
        ConfigError: where no pose in the joint ranges reaches it to a micrometre.
    """
    target, guess = np.asarray(foot, dtype=np.float64), np.asarray(near, dtype=np.float64)
    low, high = kinematics.morphology.joint_range
    near_low, near_high = (np.clip(side, -np.pi, np.pi) for side in (low, high))
    inside = [np.clip(guess, low + 1e-6, high - 1e-6)]
    # A guess outside the ranges may be stuck at their edge; then places within them are tried too.
    inside += [near_low + share * (near_high - near_low) for share in (0.5, 0.25, 0.75)]
    for first in inside:
        found = least_squares(
            lambda q: kinematics.foot(q) - target,
            first,
            jac=lambda q: kinematics.foot_jacobian(q),
            bounds=(low, high),
            xtol=1e-14,
            ftol=1e-14,
            gtol=1e-14,
        )
        if np.linalg.norm(kinematics.foot(found.x) - target) <= 1e-6:
            break
    miss = float(np.linalg.norm(kinematics.foot(found.x) - target))
    if miss > 1e-6:
        raise ConfigError(
            f"the foot cannot reach ({target[0]:.3f}, {target[1]:.3f}) m within the joint ranges: "
            f"the nearest pose misses it by {miss * 1e3:.1f} mm"
        )
    return np.asarray(found.x, dtype=np.float64)


def poses_of_foot(kinematics: Kinematics, feet: ArrayLike, near: ArrayLike) -> Array:
    """(n, nj) poses that put the foot at ``feet`` (n, 2) [m], one close to the other, the first to ``near`` [rad].

    Args:
        kinematics: of the robot.
        feet: where the foot is to be, one after the other.
        near: (nj,) the search begins there.

    Raises:
        ConfigError: where no pose in the joint ranges reaches one of them to a micrometre, or for another shape.
    """
    targets, first = np.asarray(feet, dtype=np.float64), np.asarray(near, dtype=np.float64)
    if targets.ndim != 2 or targets.shape[1] != 2:
        raise ConfigError(f"places of the foot have shape {targets.shape}, expected (n, 2)")
    if not len(targets):
        return np.empty((0, len(first)))
    low, high = kinematics.morphology.joint_range
    found = kinematics.follow_foot(targets, first)
    steps = np.abs(np.diff(np.vstack([first, found]), axis=0)).max(axis=1)
    there = np.linalg.norm(kinematics.feet(found) - targets, axis=1) <= THERE
    good = there & (steps < ADJACENT) & np.all((found > low) & (found < high), axis=1)
    poses = list(found[: len(good) if good.all() else int(np.argmin(good))])
    for target in targets[len(poses) :]:
        poses.append(pose_of_foot(kinematics, target, poses[-1] if poses else first))
    return np.array(poses)


def foot_path(
    kinematics: Kinematics, corners: ArrayLike, leg_time: float, duration: float, rate: float = 120.0
) -> SampledReference:
    """The foot goes round the corner poses along straight lines, from rest to rest on each.

    Args:
        kinematics: of the robot.
        corners: (n, nj) poses at the corners [rad]; the path starts at the first and closes.
        leg_time: time from corner to corner [s].
        duration: of the whole [s].
        rate: samples a second.
    """
    poses = np.asarray(corners, dtype=np.float64)
    feet = np.array([kinematics.foot(pose) for pose in poses])
    period = leg_time * len(poses)
    per_leg = max(round(rate * leg_time), 2)
    shares = minimum_jerk(np.arange(1, per_leg + 1) / per_leg)[:, None]
    way = [a + shares * (b - a) for a, b in zip(feet, np.roll(feet, -1, axis=0), strict=True)]
    one = np.vstack([poses[:1], poses_of_foot(kinematics, np.concatenate(way), poses[0])[:-1]])
    repeats = int(np.ceil(duration / period)) + 1
    values = np.concatenate([one] * repeats)
    return SampledReference(np.arange(len(values)) * leg_time / per_leg, values)


def joint_path(corners: ArrayLike, leg_time: float, rate: float = 120.0) -> tuple[Array, Array]:
    """Times (n,) [s] and positions (n, nj) of a path through poses, from rest to rest with the least jerk.

    Args:
        corners: (m, nj) poses [rad or m].
        leg_time: from each to the next [s].
        rate: samples a second.
    """
    poses = np.asarray(corners, dtype=np.float64)
    per_leg = max(round(rate * leg_time), 2)
    shares = minimum_jerk(np.arange(1, per_leg + 1) / per_leg)[:, None]
    legs = [a + shares * (b - a) for a, b in pairwise(poses)]
    values = np.vstack([poses[:1], *legs])
    return np.arange(len(values)) * leg_time / per_leg, values
