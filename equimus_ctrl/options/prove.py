"""Options of ``prove``."""

from __future__ import annotations

import math
from dataclasses import dataclass

from equimus_ctrl.errors import ConfigError, unknown_name
from equimus_ctrl.options.fields import at_least
from equimus_ctrl.options.offers import option

KINDS = ("none", "single", "pair", "outside", "all_joints", "triple")
"""Of ground truths; see ``proof.drawing.Kind``."""
LEAST_DURATION = 2.0
"""Of a proof's trial; a shorter one does not move the leg enough [s]."""


@dataclass(frozen=True)
class ProveOptions:
    """How the diagnosis is put to the proof.

    Attributes:
        cases: how many robots.
        seed: of everything random.
        kind: of all ground truths, one of ``proof.drawing.Kind``; drawn for each by default.
        trials: of each leg; ``proof.designs.TRIALS`` by default.
        duration: of each leg's trials; ``proof.designs.DURATION`` by default [s].
        track: frequency of controllers that keep an MJCF robot near the recorded motion [Hz]; by default its commands
            are given as recorded.
        workers: processes at a time; as many as there are processors by default.
        baselines: whether simpler methods are given the same cases; by default those of legs, for which alone they are.

    Raises:
        ConfigError: for a value that cannot be.
    """

    cases: int = option(100, int, "How many robots.")
    seed: int = option(0, int, "Of everything random.")
    kind: str | None = option(
        None,
        str | None,
        "none, single, pair, outside, all_joints (friction in each) or triple (three effects) for all; by default a "
        "mixture of the first four.",
        metavar="KIND",
    )
    trials: int | None = option(None, int | None, "Recorded of each leg; 8 by default.", shown=False)
    duration: float | None = option(
        None, float | None, "Of each leg's trials; 12 by default.", metavar="SECONDS", shown=False
    )
    track: float | None = option(
        None,
        float | None,
        "With --model: controllers of this frequency keep robots near the recorded motion, as the one that gave the "
        "recorded torques did; 2 or so.",
        metavar="HZ",
    )
    workers: int | None = option(None, int | None, "Processes at a time; one a processor by default.")
    baselines: bool | None = option(
        None,
        bool | None,
        "Give simpler methods the same recordings; with legs they are by default.",
        shown=False,
    )

    def __post_init__(self) -> None:
        """Check the values."""
        at_least("cases", self.cases, 1)
        at_least("seed", self.seed, 0)
        at_least("trials", self.trials, 1)
        at_least("workers", self.workers, 1)
        if self.kind is not None and self.kind not in KINDS:
            raise ConfigError(unknown_name("kind of ground truth", self.kind, KINDS))
        if self.duration is not None and not LEAST_DURATION <= self.duration < math.inf:
            raise ConfigError(f"duration is {self.duration:g} s, expected at least {LEAST_DURATION:g} s")
