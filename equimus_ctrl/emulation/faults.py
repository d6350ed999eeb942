"""Faults to order: what goes wrong, when, and for how long."""

from __future__ import annotations

import math
from dataclasses import dataclass

from equimus_ctrl.errors import ConfigError, unknown_name

KINDS = {
    "stall": "no measurement is sent; those due come all at once afterwards",
    "silent": "no measurement is sent",
    "nan": "angles are no numbers",
    "jump": "angles are a radian off",
    "clock": "stamps are two seconds ahead",
    "back": "stamps are two seconds behind",
    "repeat": "every measurement is sent twice",
    "reorder": "every other measurement comes after the one that follows it",
    "second_publisher": "a second publisher sends the same measurements",
    "deaf": "commands are not heard",
    "crash": "the process ends at once",
}
"""Name → one line."""


@dataclass(frozen=True)
class Fault:
    """One fault.

    Attributes:
        kind: of ``KINDS``.
        time: when it begins, after the emulator does [s].
        duration: how long it lasts [s].

    Raises:
        ConfigError: for a kind that there is not, or times that are none.
    """

    kind: str
    time: float
    duration: float = math.inf

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise ConfigError(unknown_name("fault", self.kind, KINDS))
        if not (math.isfinite(self.time) and self.time >= 0):
            raise ConfigError(f"fault {self.kind}: time is {self.time:g} s, expected at least 0")
        if not self.duration > 0:
            raise ConfigError(f"fault {self.kind}: duration is {self.duration:g} s, expected more than 0")

    def acts(self, time: float) -> bool:
        """Whether it does at a time [s]."""
        return self.time <= time < self.time + self.duration

    @classmethod
    def parse(cls, text: str) -> Fault:
        """From ``KIND:TIME`` or ``KIND:TIME:DURATION``.

        Raises:
            ConfigError: where the text is not of that form.
        """
        kind, *numbers = text.split(":")
        try:
            values = [float(number) for number in numbers]
        except ValueError:
            values = []
        if len(values) != len(numbers) or not 1 <= len(values) <= 2:
            raise ConfigError(f"fault {text!r}: expected KIND:TIME or KIND:TIME:DURATION, such as stall:3:0.2")
        return cls(kind, *values)
