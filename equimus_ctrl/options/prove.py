"""Options of ``prove``."""
# ruff: noqa: RUF009 – options are fields, made as ``dataclasses.field`` makes them

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from equimus_ctrl.errors import ConfigError, unknown_name
from equimus_ctrl.options.fields import at_least, check_where, counted, scheduler_option, slurm_option, workers_option
from equimus_ctrl.options.offers import option

KINDS = ("none", "single", "pair", "outside", "all_joints", "triple")
"""Of ground truths; see ``proof.drawing.Kind``."""
LEAST_DURATION = 2.0
"""Of a proof's trial; a shorter one does not move the leg enough [s]."""


@dataclass(frozen=True)
class Shard:
    """A part of the cases: every so many-th, from one of the first on.

    Attributes:
        index: from 1 on.
        of: how many parts there are.

    Raises:
        ConfigError: where there is no such part.
    """

    index: int
    of: int

    def __post_init__(self) -> None:
        if not 1 <= self.index <= self.of:
            raise ConfigError(f"shard is {self}, expected i/n with i from 1 to n, such as 2/5")

    def __str__(self) -> str:
        return f"{self.index}/{self.of}"

    @classmethod
    def read(cls, text: str) -> Shard:
        """Of ``2/5``."""
        index, slash, of = text.partition("/")
        if not (slash and index.isdecimal() and of.isdecimal()):
            raise ConfigError(f"shard is {text!r}, expected i/n with i from 1 to n, such as 2/5")
        return cls(int(index), int(of))

    def cases(self, count: int) -> range:
        """Numbers of its cases, of so many."""
        return range(self.index - 1, count, self.of)


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
        scheduler: address of a Dask cluster that does the work in their place.
        slurm: file that says how jobs of a Slurm cluster are asked for, which do it in their place.
        shard: the part of the cases that is done; all by default.
        merge: folders with shards that are done, to be made one proof.
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
    workers: int | None = workers_option()
    scheduler: str | None = scheduler_option()
    slurm: Path | None = slurm_option()
    shard: Shard | None = option(
        None,
        str | None,
        "Do every N-th case from the I-th on; other machines do the others, into the same folder or to be merged.",
        metavar="I/N",
        read=Shard.read,
    )
    merge: Sequence[Path] = option(
        (), list[Path] | None, "Folder with shards that are done; may be repeated. All become one proof.", metavar="DIR"
    )
    baselines: bool | None = option(
        None,
        bool | None,
        "Give simpler methods the same recordings; with legs they are by default.",
        shown=False,
    )

    def __post_init__(self) -> None:
        """Check the values."""
        counted("cases", self.cases)
        at_least("seed", self.seed, 0)
        counted("trials", self.trials)
        check_where(self.workers, self.scheduler, self.slurm)
        if self.shard is not None and self.merge:
            raise ConfigError("--shard and --merge are given, expected one: what is merged is the whole")
        if self.shard is not None and not self.shard.cases(self.cases):
            raise ConfigError(f"shard {self.shard} of {self.cases} cases has none; expected no more shards than cases")
        if self.kind is not None and self.kind not in KINDS:
            raise ConfigError(unknown_name("kind of ground truth", self.kind, KINDS))
        if self.duration is not None and not LEAST_DURATION <= self.duration < math.inf:
            raise ConfigError(f"duration is {self.duration:g} s, expected at least {LEAST_DURATION:g} s")
