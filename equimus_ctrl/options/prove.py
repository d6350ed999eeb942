"""Options of ``prove``."""
# ruff: noqa: RUF009 – options are fields, made as ``dataclasses.field`` makes them

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, cast, get_args

from equimus_ctrl.errors import ConfigError, unknown_name
from equimus_ctrl.options.experiment import limit_of
from equimus_ctrl.options.fields import (
    NAMES,
    at_least,
    check_where,
    counted,
    scheduler_option,
    slurm_option,
    workers_option,
)
from equimus_ctrl.options.offers import option

KINDS = ("none", "single", "pair", "outside", "all_joints", "triple")
"""Of ground truths; see ``proof.drawing.Kind``."""
Excitation = Literal["rich", "poor"]
"""Of trials; see ``proof.legs.Excitation``."""
EXCITATIONS = get_args(Excitation)
MOST_EXPERIMENTS = 99
"""Designed trials of a case."""
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
        trials: of each leg; ``proof.designs.TRIALS`` by default, ``proof.chirps.TRIALS`` of poor ones.
        duration: of each leg's trials; ``proof.designs.DURATION`` by default, ``proof.chirps.DURATION`` of poor ones
            [s].
        excitation: ``rich`` trials over the whole workspace, or ``poor`` ones, small chirps; by default poor with
            ``experiments``, else rich.
        experiments: trials that are designed for each robot, one after the other, to distinguish what the diagnosis of
            those before leaves.
        limits: file that says what designed trials must not leave; the robot's own limits by default.
        limit: one of them by its name, before what the file says: ``{"knee.margin": "0.1"}``.
        can: known conditions that can be had in designed trials, see ``experiments.conditions``.
        evaluations: of designs of each; by default as many as the engine does in about half a minute.
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
    excitation: str | None = option(
        None,
        str | None,
        "rich (the whole workspace) or poor (small chirps) trials of each robot; poor with --experiments, else rich.",
        metavar="KIND",
        shown=False,
    )
    experiments: int = option(
        0,
        int,
        "Trials that are designed for each robot after that, one by one, to distinguish what its diagnosis leaves: "
        "counts how often they resolve what recordings did not.",
        metavar="COUNT",
    )
    limits: Path | None = option(
        None,
        Path | None,
        "With --experiments: file (TOML) of ranges, rates and margins that designed trials must not leave.",
        metavar="FILE",
    )
    limit: Mapping[str, str] | None = option(
        None,
        NAMES,
        "With --experiments: one of them by its name, in SI units, such as knee.margin=0.1; repeatable.",
        metavar="KEY=VALUE",
        read=limit_of,
    )
    can: Sequence[str] = option(
        (),
        NAMES,
        "With --experiments: a known condition that can be had in designed trials, as of experiment design; "
        "repeatable.",
        metavar="CONDITION",
    )
    evaluations: int | None = option(
        None, int | None, "With --experiments: designs that are tried for each trial.", shown=False
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
        at_least("experiments", self.experiments, 0)
        if self.experiments > MOST_EXPERIMENTS:
            raise ConfigError(f"experiments is {self.experiments}, expected at most {MOST_EXPERIMENTS}")
        counted("evaluations", self.evaluations)
        if self.excitation is not None and self.excitation not in EXCITATIONS:
            raise ConfigError(unknown_name("excitation", self.excitation, EXCITATIONS))
        check_where(self.workers, self.scheduler, self.slurm)
        if self.shard is not None and self.merge:
            raise ConfigError("--shard and --merge are given, expected one: what is merged is the whole")
        if self.shard is not None and not self.shard.cases(self.cases):
            raise ConfigError(f"shard {self.shard} of {self.cases} cases has none; expected no more shards than cases")
        if self.kind is not None and self.kind not in KINDS:
            raise ConfigError(unknown_name("kind of ground truth", self.kind, KINDS))
        if self.duration is not None and not LEAST_DURATION <= self.duration < math.inf:
            raise ConfigError(f"duration is {self.duration:g} s, expected at least {LEAST_DURATION:g} s")

    @property
    def excites(self) -> Excitation:
        """How much trials show, whether or not that was said."""
        usual: Excitation = "poor" if self.experiments else "rich"
        return usual if self.excitation is None else cast("Excitation", self.excitation)
