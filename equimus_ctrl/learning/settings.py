"""What learning environments can be asked for."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field
from typing import Any

from equimus_ctrl.errors import ConfigError
from equimus_ctrl.models.ball import Ball

MOST_HISTORY, MOST_ROBOTS = 1000, 10_000


@dataclass(frozen=True)
class KickSettings:
    """How a ball is kicked.

    Attributes:
        ball: what it is like.
        kicker: site or body that kicks; the first end of the robot by default.
        direction: towards the target, from the room's x axis about the vertical [°].
        place: (3,) of the ball's centre; by default before the place where the kicker is while the robot rests under
            the middle of its commands [m].
        gap: between that place and the ball [m].
        scatter: by how much the ball lies elsewhere along the direction, evenly to either side [m].
        gone: how far the ball has to come from where it lay for an episode to end [m].
        duration: of an episode that does not end before [s].
        seen: whether policies see where the ball is; a robot without a camera does not.

    Raises:
        ConfigError: for a value that cannot be.
    """

    ball: Ball = field(default_factory=Ball)
    kicker: str = ""
    direction: float = 0.0
    place: tuple[float, float, float] | None = None
    gap: float = 0.02
    scatter: float = 0.0
    gone: float = 0.5
    duration: float = 1.5
    seen: bool = False

    def __post_init__(self) -> None:
        if self.place is not None and not (len(self.place) == 3 and all(map(math.isfinite, self.place))):
            raise ConfigError(f"kick: place is {self.place}, expected three finite numbers of metres")
        for key in ("gone", "duration"):
            if not 0 < getattr(self, key) < math.inf:
                raise ConfigError(f"kick: {key} is {getattr(self, key):g}, expected more than 0")
        for key in ("gap", "scatter"):
            if not 0 <= getattr(self, key) < math.inf:
                raise ConfigError(f"kick: {key} is {getattr(self, key):g} m, expected at least 0")
        if not math.isfinite(self.direction):
            raise ConfigError(f"kick: direction is {self.direction:g}°, expected a finite angle")


@dataclass(frozen=True)
class EnvSettings:
    """What a policy sees, how fast it acts, and how robots differ.

    Attributes:
        control: commands and measurements a second; the plant's own by default [Hz].
        noise: standard deviation of white noise on each measured position [rad or m]; by default none, or as diagnosed.
        history: measurements and commands so far that are observed, the latest among them.
        privileged: whether true positions, rates and what has arrived of commands are observed, too.
        randomise: None, every episode has the nominal robot; a number, its stiffnesses, areas, damping and masses are
            off by that share at most; ``"diagnosis"``, robots are drawn from what a diagnosis leaves open.
        robots: different ones in all; every episode has one of them.
        robot_seed: of these draws.
        integrator: of MuJoCo's, for robots whose description names none.

    Raises:
        ConfigError: for a value that cannot be.
    """

    control: float | None = None
    noise: float | None = None
    history: int = 3
    privileged: bool = False
    randomise: float | str | None = None
    robots: int = 64
    robot_seed: int = 0
    integrator: str = "implicitfast"

    def __post_init__(self) -> None:
        if self.control is not None and not 0 < self.control < math.inf:
            raise ConfigError(f"control is {self.control:g} Hz, expected more than 0")
        if self.noise is not None and not 0 <= self.noise <= 1:
            raise ConfigError(f"noise is {self.noise:g} rad or m, expected 0 to 1")
        for key, most in (("history", MOST_HISTORY), ("robots", MOST_ROBOTS)):
            if not 1 <= getattr(self, key) <= most:
                raise ConfigError(f"{key} is {getattr(self, key)}, expected 1 to {most:,}")
        if self.robot_seed < 0:
            raise ConfigError(f"robot_seed is {self.robot_seed}, expected at least 0")
        known = "expected a share above 0 and below 1, 'diagnosis' or None"
        if isinstance(self.randomise, str):
            if self.randomise != DIAGNOSIS:
                raise ConfigError(f"randomise is {self.randomise!r}, {known}")
        elif self.randomise is not None and not 0 < self.randomise < 1:
            raise ConfigError(f"randomise is {self.randomise:g}, {known}")

    def to_dict(self) -> dict[str, Any]:
        """As JSON data."""
        return asdict(self)


DIAGNOSIS = "diagnosis"
