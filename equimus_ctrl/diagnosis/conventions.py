"""Joints that were recorded in another order, with another zero or the other way round than the model's.

One such mistake puts the equations of several joints wrong at once: gravity acts on all joints before one whose zero is
off. So the recordings are changed as each mistake would have it, and what the motion needs is compared with what the
drives exert once more. Missing physics is no such change: none of them makes up for it at several joints at once.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from equimus_ctrl.robots.mjcf.robot import MjcfRobot
from equimus_ctrl.types import Array, Recording

ALIKE = 0.9
"""Correlation from which on two forces are one, but for size."""
LEAST_MENDED = 2
"""Joints whose equations one change has to put right: one alone may lack physics that does the same."""
FALLS = 0.1
"""What is left then of the power of the force that a joint lacks, at most."""
SAME = 0.5
"""Changes of which so little more is left, in the logarithm of the powers' product, are told beside the best."""
LACKS = 0.02
"""Share of the power of a joint's drive below which nothing is looked for: masses off by a seventh lack as much."""
TURNS = -math.pi / 2, math.pi / 2, math.pi
"""By how much zeros differ by convention [rad]."""

Forces = Callable[[Sequence[Recording]], tuple[Array, Array]]
"""(m, nj) what the motion needs of the drives, and what they exert, of recordings."""


@dataclass(frozen=True, eq=False)
class Change:
    """One that recordings may need.

    Attributes:
        looks: what is wrong, in words.
        mend: what to do.
        positions: (nj, nj) what positions are multiplied with.
        zeros: (nj,) what is added to them [rad or m].
        commands: (na, na) what commands are multiplied with.
        goals: (na,) what is added to them.
    """

    looks: str
    mend: str
    positions: Array
    zeros: Array
    commands: Array
    goals: Array

    def of(self, recording: Recording) -> Recording:
        """The recording so changed."""
        position = recording.position @ self.positions.T + self.zeros
        return replace(recording, position=position, command=recording.command @ self.commands.T + self.goals)


def mistaken(robot: MjcfRobot, recordings: Sequence[Recording], forces: Forces) -> str:
    """A sentence on the one change of order, zero or direction that puts several joints right; empty without one.

    Args:
        robot: whose joints and actuators they have, in its order.
        recordings: of it.
        forces: what is compared.
    """
    as_recorded = forces(recordings)
    before, driven = _correlations(*as_recorded)
    lacked = _missing(*as_recorded)
    wrong = driven & (lacked > LACKS)
    if wrong.sum() < LEAST_MENDED:
        return ""
    tried = []
    for change in _changes(robot, np.flatnonzero(driven).tolist()):
        changed = forces([change.of(r) for r in recordings])
        left = _missing(*changed)
        alike = float(_correlations(*changed)[0][driven].min())
        mends = alike > ALIKE and (wrong & (left < FALLS * lacked)).sum() >= LEAST_MENDED
        tried.append((float(np.log(left[driven]).sum()), change, alike if mends else 0.0))
    least = min(size for size, _, _ in tried)
    best = [(change, alike) for size, change, alike in tried if size < least + SAME]
    if not all(alike for _, alike in best):
        return ""
    worst = int(np.argmin(np.where(driven, before, np.inf)))
    looks, mend = " or ".join(c.looks for c, _ in best), ", or ".join(c.mend for c, _ in best)
    return (
        f"{looks}: {mend}, and what moves each joint is what its drive exerts (correlation "
        f"{min(alike for _, alike in best):.2f} and more; as recorded {before[worst]:.2f} at "
        f"{robot.joint_names[worst]})"
    )


def _changes(robot: MjcfRobot, driven: Sequence[int]) -> Iterator[Change]:
    """Each of the changes looked at, of joints that drives move."""
    names, nj, na = robot.joint_names, len(robot.joint_names), len(robot.actuators)
    same = Change("", "", np.eye(nj), np.zeros(nj), np.eye(na), np.zeros(na))
    own = {j: [k for k, d in enumerate(robot.actuators) if d.at_joint and d.joint == names[j]] for j in driven}
    for j, k in combinations(driven, 2):
        order = np.arange(nj)
        order[[j, k]] = k, j
        exchanged = replace(same, positions=np.eye(nj)[order])
        pair = f"pos.{names[j]} and pos.{names[k]}"
        yield replace(exchanged, looks=f"{pair} look exchanged", mend="exchange these columns")
        if len(own[j]) == len(own[k]) == 1:
            order = np.arange(na)
            order[[own[j][0], own[k][0]]] = own[k][0], own[j][0]
            yield replace(
                exchanged,
                looks=f"{names[j]} and {names[k]} look exchanged",
                mend="exchange their columns, commands as well as positions",
                commands=np.eye(na)[order],
            )
    for j in driven:
        columns = " and ".join([f"pos.{names[j]}", *(f"cmd.{robot.actuator_names[k]}" for k in own[j])])
        signs, turned = np.ones(nj), np.ones(na)
        signs[j], turned[own[j]] = -1.0, -1.0
        yield replace(
            same,
            looks=f"{names[j]} looks as if it turned the other way round",
            mend=f"change the sign of {columns}, or of the joint's axis",
            positions=np.diag(signs),
            commands=np.diag(turned),
        )
        for turn in TURNS if not robot.slides(names[j]) else ():
            zeros = np.where(np.arange(nj) == j, turn, 0.0)
            goals = robot.goals_at(zeros) - robot.goals_at(np.zeros(nj))
            goal = " and to its drive's goal" if np.any(goals != 0) else ""
            yield replace(
                same,
                looks=f"the zero of {names[j]} looks off by {math.degrees(abs(turn)):.0f}°",
                mend=f"add {turn:.4f} rad to pos.{names[j]}{goal}, or give the model's joint that zero (ref)",
                zeros=zeros,
                goals=goals,
            )


def _correlations(needed: Array, exerted: Array) -> tuple[Array, NDArray[np.bool_]]:
    """(nj,) of what each joint needs with what its drive exerts, and which joints are driven."""
    size = np.sqrt((needed**2).mean(axis=0) * (exerted**2).mean(axis=0))
    alike = np.asarray((needed * exerted).mean(axis=0) / np.maximum(size, 1e-300))
    return alike, np.asarray((exerted**2).mean(axis=0) > 0)


def _missing(needed: Array, exerted: Array) -> Array:
    """(nj,) what is missing as a share of what drives exert, in power; no less than tells."""
    share = ((needed - exerted) ** 2).mean(axis=0) / np.maximum((exerted**2).mean(axis=0), 1e-300)
    return np.asarray(np.maximum(share, 1e-6))
