"""What recordings show of a place, and what sizes go with it."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Excitation:
    """What recordings show of a place, from which sizes worth trying there follow.

    Attributes:
        low: lower end of what its coordinate covers: a hinge's angle [rad], a slide's way or an actuator's length [m].
        high: upper end.
        speed: what its rate seldom exceeds [rad/s or m/s].
        force: generalised force that moves it from one end to the other [N·m or N].
        command: largest command of the actuator, or of any where the place is none [Pa or unit of the command].
        interval: usual time between samples [s].
        duration: of a trial [s].
        mass: of what moves [kg].
        drive: largest force of the actuator, or of any, according to the model [N·m or N]; 0 where unknown.
        reach: about half the length of a link [m].
        middle: where a link's centre or a site is in the room, the median over the recordings [m].
        roams: how far from there it seldom is [m].
        lowest: how low it ever is, from the room's origin against the model's gravity [m].
        rises: how far above that it ever is [m].
        recorded: from the start of a recording to its last sample [s]; 0 where a trial is a whole recording.
    """

    low: float
    high: float
    speed: float
    force: float
    command: float
    interval: float
    duration: float
    mass: float
    drive: float = 0.0
    reach: float = 0.1
    middle: tuple[float, float, float] = (0.0, 0.0, 0.0)
    roams: float = 0.1
    lowest: float = 0.0
    rises: float = 0.1
    recorded: float = 0.0

    @property
    def span(self) -> float:
        """What the coordinate covers [rad or m]."""
        return self.high - self.low

    @property
    def lasts(self) -> float:
        """From the start of a recording to its last sample [s]: a trial may be a part of it."""
        return max(self.recorded, self.duration)

    def sizes(self, unit: str) -> tuple[float, ...]:
        """A few values from hardly visible to strong of something that has this unit; none for a unit unknown here."""
        joint, _, actuator = unit.partition(" | ")
        known: dict[str, tuple[float, ...]] = {
            "s": tuple(n * self.interval for n in (2.5, 8.0, 25.0)),
            "Pa": _shares(self.command, 0.03, 0.1, 0.3),
            "command": _shares(self.command, 0.03, 0.1, 0.3),
            "1/command": _shares(1.0 / self.command, 0.02, 0.08),
            "Pa/s": tuple(self.command / t for t in (0.1, 0.4, 1.5)),
            "kg": _shares(self.mass, 0.02, 0.1, 0.3),
            "rad/s": _shares(self.speed, 0.05, 0.2),
            "m/s": _shares(self.speed, 0.05, 0.2),
            "rad": _shares(self.span, 0.01, 0.05),
            "m": _shares(self.span, 0.01, 0.05),
            "1": (0.02, 0.1),
            **dict.fromkeys(("N·m", "N"), _shares(self.force, 0.005, 0.02, 0.08)),
            **dict.fromkeys(("N·m/rad", "N/m"), _shares(self.force / self.span, 0.05, 0.2)),
            **dict.fromkeys(("N·m·s/rad", "N·s/m"), _shares(self.force / self.speed, 0.05, 0.2)),
            **dict.fromkeys(("N·m·s²/rad²", "N·s²/m²"), _shares(self.force / self.speed**2, 0.05, 0.2)),
            **dict.fromkeys(("N·m·s/rad/s", "N·s/m/s"), _shares(self.force / self.speed / self.lasts, 0.05, 0.2)),
            **dict.fromkeys(("N·m/rad²", "N/m²"), _shares(self.force / self.span**2, 0.05, 0.2)),
            **dict.fromkeys(("N·m/rad³", "N/m³"), _shares(self.force / self.span**3, 0.05, 0.2)),
        }
        return known.get(joint, known.get(actuator, ()))

    def scale(self, unit: str) -> float:
        """What a size with this unit is compared with; 1 for a unit unknown here."""
        unit = unit.partition(" | ")[0]
        known = {
            "s": self.span / self.speed,
            "Hz": self.speed / self.span,
            "kg": self.mass,
            "kg·m²": self.force * self.span / self.speed**2,
            "command": self.command,
            "1/command": 1.0 / self.command,
            **dict.fromkeys(("rad", "m"), self.span),
            **dict.fromkeys(("rad/s", "m/s"), self.speed),
            **dict.fromkeys(("N·m", "N"), self.force),
            **dict.fromkeys(("N·m/rad", "N/m"), self.force / self.span),
            **dict.fromkeys(("N·m·s/rad", "N·s/m"), self.force / self.speed),
            **dict.fromkeys(("N·m·s²/rad²", "N·s²/m²"), self.force / self.speed**2),
            **dict.fromkeys(("N·m·s/rad/s", "N·s/m/s"), self.force / self.speed / self.lasts),
        }
        return known.get(unit, 1.0)


def _shares(whole: float, *shares: float) -> tuple[float, ...]:
    return tuple(whole * share for share in shares)
