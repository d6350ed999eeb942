"""In what errors, rates and efforts of any robot are counted, from its own ranges and its equations of motion.

Positions in half the range of their joints, half a turn where a hinge has none; rates in as much a natural rate ω;
commands in half their range. ω is that of the slowest motion about a pose that is no drift: what falls or swings there
does so in 2π/ω, which is how far a plan has to look ahead.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from equimus_ctrl.models.dynamics import Dynamics
from equimus_ctrl.predictive.forward import Forward
from equimus_ctrl.types import Array, PlantSpec

DRIFT = 0.02
"""Share of the fastest rate about a pose below which a motion counts as drift."""
USUAL_RATE = 2 * np.pi
"""Natural rate where no equations of motion tell of one: a second there and back [1/s]."""
QUICKEST, SLOWEST = 40.0, 2.0
"""Between what natural rates plans are made for [1/s]: horizons of 0.16 to 3.1 s."""
ALIKE = 1e-9
"""Share by which motions may differ that are the same but for rounding."""


@dataclass(frozen=True, eq=False)
class Measures:
    """Scales of one robot about a pose.

    Attributes:
        position: (nj,) [rad or m].
        rate: ω [1/s].
        middle: (na,) of the commands, 0 where nothing limits them.
        command: (na,) half their range, or what accelerates a joint by ω² times its own scale.
        turning: (nj,) hinges of which a whole turn changes nothing.
        fastest: rate of the fastest motion about the pose [1/s].
    """

    position: Array
    rate: float
    middle: Array
    command: Array
    turning: NDArray[np.bool_]
    fastest: float

    @property
    def state(self) -> Array:
        """(2 nj,) of positions and rates."""
        return np.concatenate([self.position, self.rate * self.position])

    def errors(self, states: Array, wanted: Array) -> Array:
        """(…, 2 nj) by how much states are off, angles of hinges that turn freely by the shorter way."""
        off, nj = states - wanted, len(self.position)
        turns = off[..., :nj] - 2 * np.pi * np.round(off[..., :nj] / (2 * np.pi))
        return np.concatenate([np.where(self.turning, turns, off[..., :nj]), off[..., nj:]], axis=-1)


def measures_of(spec: PlantSpec, pose: Array, forward: Forward, dynamics: Dynamics | None) -> Measures:
    """The scales of a robot about a pose (nj,) [rad or m].

    Args:
        spec: of its plant.
        pose: that it is to be brought to.
        forward: the robot a period on.
        dynamics: its equations of motion where they hold it.
    """
    low, high = np.array(spec.joint_low), np.array(spec.joint_high)
    bounded = np.isfinite(high - low) & (high > low)
    hinges = np.array([unit == "rad" for unit in spec.joint_units])
    position = np.where(bounded, np.where(bounded, high - low, 0.0) / 2, np.where(hinges, np.pi, 1.0))
    rates = np.empty(0)
    if dynamics is not None:
        sizes = np.abs(np.linalg.eigvals(dynamics.linear(pose).matrices()[0]))
        rates = sizes[sizes > DRIFT * sizes.max(initial=0.0)]
    fastest = float(rates.max(initial=0.0)) or USUAL_RATE
    rate = float(np.clip(rates.min() if len(rates) else USUAL_RATE, SLOWEST, QUICKEST))
    least, most = np.array(spec.command_low), np.array(spec.command_high)
    limited = np.isfinite(most - least) & (most > least)
    middle = np.where(limited, (np.where(limited, most, 0.0) + np.where(limited, least, 0.0)) / 2, 0.0)
    command = np.where(limited, np.where(limited, most - least, 2.0) / 2, 1.0)
    if dynamics is not None and not limited.all():
        still = np.zeros_like(pose)
        held = dynamics.commands(pose, still, dynamics.needed(pose, still, still))
        moving = dynamics.commands(pose, still, dynamics.needed(pose, still, position * rate**2))
        size = np.maximum(np.abs(moving - held), np.abs(held))
        command = np.where(limited | (size == 0), command, size)
    return Measures(position, rate, middle, command, _turning(pose, middle, hinges & ~bounded, forward), fastest)


def _turning(pose: Array, command: Array, able: NDArray[np.bool_], forward: Forward) -> NDArray[np.bool_]:
    """(nj,) of hinges that are able to whether a whole turn changes nothing of how the robot moves."""
    still, found = np.zeros_like(pose), able.copy()
    for j in np.flatnonzero(able):
        # About a pose that is no rest, where springs and weights show.
        moved = [pose + 0.3 + turns * 2 * np.pi * (np.arange(len(pose)) == j) for turns in (0, 1)]
        after = [forward.joints(forward(forward.begin(q, still, command)[None], command[None]))[0] for q in moved]
        change = [own - np.concatenate([q, still]) for own, q in zip(after, moved, strict=True)]
        size = max(float(np.abs(change[0]).max()), 1.0)
        found[j] = bool(np.abs(change[0] - change[1]).max() <= ALIKE * size)
    return found
