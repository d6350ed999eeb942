"""What a design of an experiment is: commands, what they are expected to decide, and how they were found."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from equimus_ctrl.diagnosis.rivals import Rivals
from equimus_ctrl.experiments.conditions import KnownCondition
from equimus_ctrl.experiments.limits import Excess, Limits
from equimus_ctrl.experiments.power import Power
from equimus_ctrl.experiments.predicted import Commands
from equimus_ctrl.experiments.sensors import Remedy
from equimus_ctrl.shown import Short
from equimus_ctrl.types import FeedbackLaw

FORMAT = "equimus-ctrl/design/1"
Ending = Literal["settled", "one trial", "repeats", "another trial", "inseparable"]
"""What becomes of a pair: the recordings settle it already; one trial or some repeats of it do; this one does not, but
another that was tried would; none that was tried would, however often it is repeated."""


@dataclass(frozen=True, eq=False, repr=False)
class Pair(Short):
    """Two rivals, and how the designed trial tells one from the other, whichever is true.

    Attributes:
        powers: with the first and with the second for true.
        ending: see ``Ending``.
    """

    powers: tuple[Power, Power]
    ending: Ending

    @property
    def places(self) -> tuple[int, int]:
        """Of the rivals."""
        return self.powers[0].first, self.powers[0].second

    @property
    def harder(self) -> Power:
        """Of the two the one that is told with more trials, or with less chance."""
        return max(self.powers, key=lambda own: (own.repeats, -own.chance, -own.gap))

    def to_dict(self) -> dict[str, Any]:
        """As JSON data."""
        return {"rivals": list(self.places), "ending": self.ending, "powers": [own.to_dict() for own in self.powers]}


@dataclass(frozen=True)
class TriedFamily:
    """How far the search came with a family under a condition.

    Attributes:
        family: of commands.
        condition: as it was given; "" for none.
        evaluations: of designs.
        divergence: of the best one within the limits; None where there was none.
    """

    family: str
    condition: str
    evaluations: int
    divergence: float | None

    def to_dict(self) -> dict[str, Any]:
        """As JSON data."""
        return dict(vars(self))


@dataclass(frozen=True, eq=False, repr=False)
class Designed(Short):
    """An experiment.

    Attributes:
        rivals: between which it is to decide.
        limits: that it keeps.
        condition: that is known to be different in it.
        family: of its commands.
        commands: at each instant.
        amplitude: what was left of the search's design by the limits, 1 for all of it.
        pairs: of rivals.
        excess: how near any of the motions that were looked at comes to the limits.
        draws: of each rival among these.
        tried: families and conditions.
        refused: conditions under which nothing could be tried, and why.
        seed: of search and draws.
        evaluations: of designs.
        timed_out: whether time ended the search.
        remedies: inseparable pair → what would tell it apart, best first, see ``sensors.remedies``.
    """

    rivals: Rivals
    limits: Limits
    condition: KnownCondition
    family: str
    commands: Commands
    amplitude: float
    pairs: tuple[Pair, ...]
    excess: Excess
    draws: int
    tried: tuple[TriedFamily, ...]
    refused: tuple[tuple[str, str], ...]
    seed: int
    evaluations: int
    timed_out: bool
    remedies: Mapping[tuple[int, int], tuple[Remedy, ...]] = field(default_factory=dict)

    def told(self) -> str:
        """The family, and how many pairs it tells apart."""
        done = sum(own.ending in ("one trial", "repeats") for own in self.pairs)
        under = f" under {self.condition.text}" if self.condition.text else ""
        return f" {self.family}{under} of {self.commands.duration:g} s: separates {done} of {len(self.pairs)} pairs"

    @property
    def leaves_with(self) -> float:
        """The chance at most that the true robot, if it is one of the rivals, leaves the limits."""
        return 1.0 / (self.draws + 1)

    @property
    def inseparable(self) -> tuple[Pair, ...]:
        """Pairs that nothing tells apart that was tried."""
        return tuple(own for own in self.pairs if own.ending == "inseparable")

    @property
    def separates(self) -> tuple[Pair, ...]:
        """Pairs that it tells apart, repeated or not."""
        return tuple(own for own in self.pairs if own.ending in ("one trial", "repeats"))

    def settles(self, remedy: Remedy) -> bool:
        """Whether a trial with a remedy is expected to settle its pair, which none without it is.

        What is to first order says nothing where it finds a gap that refitting does not.
        """
        power = next(own for own in self.pairs if own.places == remedy.pair).harder
        return remedy.gap > power.needed - power.ahead > remedy.without

    def to_dict(self) -> dict[str, Any]:
        """As JSON data, schema ``equimus-ctrl/design/1``."""
        return {
            "schema": FORMAT,
            "robot": self.rivals.model.name,
            "rivals": [own.label for own in self.rivals.rivals],
            "condition": self.condition.text,
            "family": self.family,
            "duration_s": self.commands.duration,
            "law": None if self.commands.law is None else _told(self.commands.law),
            "amplitude": self.amplitude,
            "pairs": [own.to_dict() for own in self.pairs],
            "nearest_to_a_limit": str(self.excess),
            "excess": self.excess.worst,
            "draws": self.draws,
            "leaves_limits_with_at_most": self.leaves_with,
            "remedies": [
                {**own.to_dict(), "settles": self.settles(own)} for several in self.remedies.values() for own in several
            ],
            "tried": [own.to_dict() for own in self.tried],
            "refused": [{"condition": text, "reason": why} for text, why in self.refused],
            "seed": self.seed,
            "evaluations": self.evaluations,
            "timed_out": self.timed_out,
        }


def _told(law: FeedbackLaw) -> dict[str, Any]:
    """A feedback law as JSON data."""
    return {"stiffness": law.stiffness.tolist(), "damping": law.damping.tolist(), "smoothing": law.smoothing}
