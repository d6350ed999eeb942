"""How well something does a task, on robots that are the same for all that are judged."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from equimus_ctrl.learning.episodes import ROBOT, Episodes
from equimus_ctrl.types import Array

Act = Callable[[NDArray[np.float32], int], Array]
"""(n, na) actions within ±1 of observations (n, size) after so many control periods."""


@dataclass(frozen=True, eq=False)
class Judged:
    """How episodes ended, one row each.

    Attributes:
        returns: (n,) sums of rewards.
        info: (n,) each, what the task says at the end.
        success: (n,) whether they did what they should; None where only the return counts.
    """

    returns: Array
    info: dict[str, Array]
    success: NDArray[np.bool_] | None

    def to_dict(self) -> dict[str, Any]:
        """Means, as JSON data."""
        rest = {key: float(np.mean(values)) for key, values in self.info.items() if key != ROBOT}
        share = None if self.success is None else float(np.mean(self.success))
        return {"return": float(np.mean(self.returns)), "least": float(np.min(self.returns)), "success": share, **rest}


def judge(episodes: Episodes, act: Act, seed: int, robots: Array | None = None) -> Judged:
    """One episode of each row, from robots, starts and noise that the seed alone decides.

    Args:
        episodes: row i is on robot i, or ``robots[i]``, of those that can be drawn.
        act: what is judged.
        seed: of starts and noise.
        robots: (n,) by number; by default all in turn.
    """
    rows = np.arange(episodes.n)
    own = rows % episodes.count if robots is None else np.asarray(robots)
    for row in rows:
        episodes.begin(int(row), np.random.default_rng([seed, int(row)]), {ROBOT: int(own[row])})
    returns, going = np.zeros(episodes.n), np.ones(episodes.n, dtype=bool)
    info: dict[str, Array] = {}
    for period in range(episodes.periods):
        left = rows[going]
        if not len(left):
            break
        done = episodes.step(left, act(episodes.observation(rows), period)[left])
        returns[left] += done.reward
        for key, values in episodes.info(left).items():
            info.setdefault(key, np.zeros(episodes.n, dtype=values.dtype))[left] = values
        going[left] = ~(done.terminated | done.truncated)
    return Judged(returns, info, episodes.task.success(info))
