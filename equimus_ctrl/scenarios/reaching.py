"""Inverse kinematics: poses that put a named point of a robot along a path, and where it can go at all.

Damped least squares (Levenberg and Marquardt; Wampler, 1986; Siciliano et al., *Robotics*, chapter 3.5) with the
joints' ranges as an active set. Each pose is looked for from the one before, by steps of least size, so that joints
move as little as they can and never jump to another branch; joints that turn on and on are not wrapped.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from equimus_ctrl.errors import ConfigError
from equimus_ctrl.models.points import Points
from equimus_ctrl.robots.base import Robot
from equimus_ctrl.robots.reading import reading
from equimus_ctrl.types import Array

THERE = 1e-6
"""By what a point may miss its place [m]."""
TRIES = 300
"""Steps towards a place, at most."""
STALLED = 1e-8
"""Share of its distance by which a step has to bring a point nearer."""
JUMP = 0.3
"""Between one sample of a path and the next a joint moves no farther than this [rad or m]."""
OTHERS = 4
"""Poses beside the first from which a path is tried that cannot be followed from there."""
COARSE = 12
"""Of so many places of a path one is looked at first: most paths that cannot be followed fail there."""
WALK = 24
"""Places on the way from where a point is to where its path begins."""
SHARES = (-1.0, -0.5, 0.0, 0.5, 1.0)
"""Of its swing by which a joint is moved in the search for a pose in which a point moves well."""
BOTH_WAYS = 1e-6
"""Least share of how far a point moves one way that it has to move across, so that the two span a plane."""


@dataclass(frozen=True, eq=False)
class Mobility:
    """How far a point moves from a pose by swings of the joints: the ellipsoid of J W z, |z| ≤ 1 (Yoshikawa, 1985).

    Attributes:
        pose: (nj,) [rad or m].
        place: (3,) of the point there [m].
        axes: (3, 3) columns: unit vectors along the ellipsoid's axes, the longest first.
        reach: (3,) half of their lengths [m].
    """

    pose: Array
    place: Array
    axes: Array
    reach: Array


@dataclass(frozen=True, eq=False)
class Reacher:
    """A named point of a robot, and the joints that are there to move it.

    Attributes:
        robot: the robot.
        points: of it.
        name: of the point.
        moved: (nj,) the joints that may move.
    """

    robot: Robot
    points: Points
    name: str
    moved: NDArray[np.bool_]

    def place(self, pose: Array) -> Array:
        """(3,) where the point is in a pose (nj,) [m]."""
        return self.points.at(self.name, pose)[0]

    def mobility(self, pose: Array, swings: Array) -> Mobility:
        """How far the point moves about a pose (nj,) by swings (nj,) [rad or m]."""
        place, slope = self.points.at(self.name, pose)
        axes, reach, _ = np.linalg.svd(slope * swings * self.moved)
        reach = np.append(reach, np.zeros(3))[:3]
        signs = np.sign(axes[np.abs(axes).argmax(axis=0), np.arange(3)])
        return Mobility(pose, place, axes * signs, reach)

    def nimblest(self, pose: Array, swings: Array, held: Callable[[Array], bool]) -> Mobility:
        """About the pose within swings (nj,) of one (nj,) in which the point moves farthest in its two best directions.

        Of poses that can be held, as far as there are such.

        A robot is often described in a pose in which its arms are stretched: there its end moves one way alone. The
        product of both reaches is Yoshikawa's manipulability in a plane. Joint after joint is tried, twice over.
        """
        low, high = self.robot.joint_range
        best = self.mobility(pose, swings)
        for _ in range(2):
            for j in np.flatnonzero(self.moved & (swings > 0)):
                for share in SHARES:
                    other = best.pose.copy()
                    other[j] = np.clip(pose[j] + share * swings[j], low[j], high[j])
                    found = self.mobility(other, swings)
                    if _both(found) > _both(best) * (1 + BOTH_WAYS) and held(other):
                        best = found
        return best

    def reach(self, place: Array, near: Array) -> tuple[Array, float]:
        """The pose (nj,) towards which least steps lead from one (nj,), and by what the point misses a place [m].

        Args:
            place: (3,) [m].
            near: (nj,) [rad or m].
        """
        low, high = self.robot.joint_range
        pose = np.where(self.moved, np.clip(near, low, high), near)
        there, slope = self.points.at(self.name, pose)
        off = place - there
        miss, damping = float(np.linalg.norm(off)), 1e-6
        for _ in range(TRIES):
            if miss <= THERE * 1e-3:
                break
            down = slope.T @ off
            free = self.moved & ~(((pose <= low) & (down < 0)) | ((pose >= high) & (down > 0)))
            own = slope * free
            scale = float(np.sum(own**2))
            if scale == 0.0:
                break
            step = own.T @ np.linalg.solve(own @ own.T + damping * scale * np.eye(3), off)
            other = np.where(free, np.clip(pose + step, low, high), pose)
            there, its_slope = self.points.at(self.name, other)
            its_miss = float(np.linalg.norm(place - there))
            if its_miss < miss:
                stalled = miss - its_miss <= STALLED * miss
                pose, slope, off, miss = other, its_slope, place - there, its_miss
                damping = max(damping / 10, 1e-12)
                if stalled:
                    break
            elif damping > 1e6:
                break
            else:
                damping *= 10
        return pose, miss

    def follow(self, times: Array, places: Array, near: Array, elsewhere: bool = True) -> Array:
        """(n, nj) poses that put the point along a path, the first as near to one (nj,) as least steps lead.

        Args:
            times: (n,) of the path, for messages [s].
            places: (n, 3) [m].
            near: (nj,) [rad or m].
            elsewhere: whether other poses are tried where the path cannot be followed from there.

        Raises:
            ConfigError: where it cannot be followed within the joints' ranges; the sentence says where the point comes
                nearest.
        """
        least: tuple[int, float, str] | None = None
        some = np.unique(np.r_[np.arange(0, len(times), COARSE), len(times) - 1])
        for first in (near, *(self._others(near) if elsewhere else ())):
            poses, wrong, miss = self._followed(times[some], places[some], first, np.inf)
            if not wrong:
                poses, wrong, miss = self._followed(times, places, first, JUMP)
            if not wrong:
                return poses
            if least is None or (-len(poses), miss) < least[:2]:
                least = -len(poses), miss, wrong
        assert least is not None
        raise ConfigError(f"{self.robot.name}: {least[2]}")

    def _others(self, near: Array) -> list[Array]:
        low, high = self.robot.joint_range
        low, high = np.where(np.isfinite(low), low, near - np.pi), np.where(np.isfinite(high), high, near + np.pi)
        draws = np.random.default_rng(0).random((OTHERS, len(near)))
        return [np.where(self.moved, low + draw * (high - low), near) for draw in draws]

    def _followed(self, times: Array, places: Array, first: Array, most: float) -> tuple[Array, str, float]:
        """The poses as far as it goes, why it ends, or nothing, and what the point misses there [m]."""
        poses: list[Array] = []
        begins, pose = self.place(first), first
        for share in np.linspace(0, 1, WALK, endpoint=False)[1:]:
            pose, _ = self.reach(begins + share * (places[0] - begins), pose)
        for time, place in zip(times.tolist(), places, strict=True):
            before = pose
            pose, miss = self.reach(place, before)
            if miss > THERE:
                return np.array(poses), self._out_of_reach(time, place, pose, miss), miss
            if poses and (far := float(np.abs(pose - before).max())) > most:
                j = int(np.abs(pose - before).argmax())
                joint, text = self.robot.joint_names[j], reading(self.robot.joint_units[j]).text
                wrong = (
                    f"on its path {self.name} passes {_shown(place)} at {time:.2f} s, where {joint} would have to jump "
                    f"by {text(far, '.3g')}; expected a path that keeps away from there"
                )
                return np.array(poses), wrong, far
            poses.append(pose)
        return np.array(poses), "", 0.0

    def _out_of_reach(self, time: float, place: Array, pose: Array, miss: float) -> str:
        low, high = self.robot.joint_range
        ended = [
            name for j, name in enumerate(self.robot.joint_names)
            if self.moved[j] and (pose[j] <= low[j] or pose[j] >= high[j])
        ]  # fmt: skip
        whose = "its" if len(ended) == 1 else "their"
        at = f", with {' and '.join(ended)} at the end of {whose} range" if ended else ""
        return (
            f"{self.name} cannot reach {_shown(place)}, where its path has it at {time:.2f} s; it comes as near as "
            f"{_shown(self.place(pose))}, {1e3 * miss:.4g} mm away{at}"
        )


def _both(mobility: Mobility) -> float:
    return float(mobility.reach[0] * mobility.reach[1])


def _shown(place: Array) -> str:
    return "(" + ", ".join(f"{part + 0.0:.4g}" for part in np.round(place, 6)) + ") m"
