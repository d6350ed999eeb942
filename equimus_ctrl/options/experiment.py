"""Options of ``experiment design``."""
# ruff: noqa: RUF009 – options are fields, made as ``dataclasses.field`` makes them

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from equimus_ctrl.errors import ConfigError
from equimus_ctrl.options.fields import NAMES, at_least, counted, key_values, threads_option
from equimus_ctrl.options.offers import option

MOST_DRAWS = 10_000


def limit_of(items: Iterable[str]) -> dict[str, str]:
    """``--limit`` as a table."""
    return key_values(items, "--limit")


def noise_of(items: Iterable[str]) -> dict[str, float]:
    """``--sensor-noise`` as a table of numbers.

    Raises:
        ConfigError: where one is none.
    """
    found = {}
    for name, text in key_values(items, "--sensor-noise").items():
        try:
            found[name] = float(text)
        except ValueError:
            raise ConfigError(f"--sensor-noise {name} is {text!r}, expected a number") from None
    return found


@dataclass(frozen=True)
class DesignOptions:
    """How an experiment is designed.

    Attributes:
        limits: file that says what it must not leave, see docs/formats.md; the robot's own by default.
        limit: one of them by its name, before what the file says: ``{"knee.margin": "0.1"}``.
        can: known conditions that can be had, see ``experiments.conditions``.
        family: names of ``experiments.families.FAMILIES``; all by default.
        duration: of the trial [s]; that of the limits by default.
        seed: of the search, and of draws of parameters.
        budget: how long the search may take; its best so far is designed then [s].
        evaluations: of designs, in all; by default as many as the engine does in about half a minute.
        draws: of each explanation's parameters through which the design is taken: the true robot, if it is one of them,
            leaves the limits with a chance of at most 1/(draws + 1).
        track: natural frequency of the feedback by which joints track references, in place of commands that are played
            [Hz]; by default where the robot rests under no constant command.
        sensor_noise: channel → standard deviation that a sensor would have, where nothing tells explanations apart.
        threads: of the simulations; all cores by default.

    Raises:
        ConfigError: for a value that cannot be.
    """

    limits: Path | None = option(
        None,
        Path | None,
        "File (TOML) of ranges, rates and margins that it must not leave; the robot's own by default.",
        metavar="FILE",
    )
    limit: Mapping[str, str] | None = option(
        None,
        NAMES,
        "One of them by its name, in SI units, such as knee.margin=0.1 or maa.high=40e3; repeatable.",
        metavar="KEY=VALUE",
        read=limit_of,
    )
    can: Sequence[str] = option(
        (),
        NAMES,
        "A known condition that you can make: payload:SITE=KG, pose:JOINT=DEGREES, supply:all=SHARE, NAME=VALUE of a "
        "parameter, or times:NAME=FACTOR; repeatable.",
        metavar="CONDITION",
    )
    family: Sequence[str] = option(
        (), NAMES, "multisine, steps, triangle, hold or release; all by default.", metavar="NAME"
    )
    duration: float | None = option(None, float | None, "Of the trial, in s; 6 by default.")
    seed: int = option(0, int, "Of the search.")
    budget: float | None = option(None, float | None, "Design the best so far after this time.", metavar="SECONDS")
    evaluations: int | None = option(
        None, int | None, "Designs that are tried; by default as many as take about half a minute."
    )
    draws: int = option(99, int, "Of each explanation's parameters; the limits are left with at most 1/(draws + 1).")
    track: float | None = option(
        None,
        float | None,
        "Joints track references by feedback of this natural frequency, in Hz; by default where the robot rests under "
        "no constant command. Else commands are played.",
        metavar="HZ",
    )
    sensor_noise: Mapping[str, float] | None = option(
        None,
        NAMES,
        "Standard deviation of a sensor that you could have, such as pressure.maa=200 or vel.hip=0.01; by default 1 % "
        "of how far it goes.",
        metavar="NAME=VALUE",
        read=noise_of,
    )
    threads: int | None = threads_option()

    def __post_init__(self) -> None:
        """Check the values."""
        for name in ("budget", "duration"):
            value = getattr(self, name)
            if value is not None and not 0 < value < math.inf:
                raise ConfigError(f"the {name} is {value:g} s, expected a time above 0")
        if self.track is not None and not 0 < self.track < math.inf:
            raise ConfigError(f"track is {self.track:g} Hz, expected more than 0")
        for name, value in (self.sensor_noise or {}).items():
            if not 0 < value < math.inf:
                raise ConfigError(f"the noise of {name} is {value:g}, expected more than 0")
        counted("evaluations", self.evaluations)
        counted("draws", self.draws)
        if self.draws > MOST_DRAWS:
            raise ConfigError(f"draws is {self.draws}, expected at most {MOST_DRAWS:,}")
        counted("threads", self.threads)
        at_least("seed", self.seed, 0)
