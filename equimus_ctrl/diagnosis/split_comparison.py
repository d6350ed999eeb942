"""What diagnoses of the same trials find, others held out in each: what all say, and what hangs on the split."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from equimus_ctrl.diagnosis.estimates import Estimate

Place = tuple[str, str]
"""An effect's name and one of its places."""


@dataclass(frozen=True)
class HeldOutError:
    """Errors at a joint on the held-out trials of one kind, those of the validation and of the test set.

    Attributes:
        kind: the trials' names up to their first digit.
        joint: its name.
        refitted: RMSE of the refitted model [rad or m].
        corrected: the same of the augmented one.
    """

    kind: str
    joint: str
    refitted: float
    corrected: float

    @property
    def ratio(self) -> float:
        """Of the second to the first."""
        return self.corrected / self.refitted if self.refitted > 0 else math.nan


@dataclass(frozen=True)
class SplitAnswer:
    """What one split's diagnosis found.

    Attributes:
        number: of the split, 0 for the default one.
        fitted: names of the trials that were fitted, whole or in part.
        verdict: in one word.
        named: for each effect that is named, at each of its places, the parameters; a place "knee in unit_b" where
            these differ between groups of trials.
        as_well: effects and places that fit as well in the place of one that is named.
        errors: on what was held out.
        seconds: that it took [s].
    """

    number: int
    fitted: tuple[str, ...]
    verdict: str
    named: Mapping[Place, Mapping[str, Estimate]]
    as_well: frozenset[Place]
    errors: tuple[HeldOutError, ...]
    seconds: float

    def to_dict(self) -> dict[str, Any]:
        """As JSON data."""
        return {
            "split": self.number,
            "fitted": list(self.fitted),
            "verdict": self.verdict,
            "findings": [
                {"effect": effect, "location": place, "parameters": {key: own.to_dict() for key, own in values.items()}}
                for (effect, place), values in self.named.items()
            ],
            "not_distinguishable": [{"effect": effect, "location": place} for effect, place in sorted(self.as_well)],
            "held_out_rmse_rad": [vars(error) for error in self.errors],
            "seconds": self.seconds,
        }


@dataclass(frozen=True)
class OverSplits:
    """An effect at one of its places, over all splits.

    Attributes:
        effect: its name.
        place: where.
        named: the numbers of the splits that name it.
        as_well: of those in which it fits as well in the place of what is named.
        estimates: for each parameter what those say that name it.
    """

    effect: str
    place: str
    named: tuple[int, ...]
    as_well: tuple[int, ...]
    estimates: Mapping[str, tuple[Estimate, ...]]

    def to_dict(self) -> dict[str, Any]:
        """As JSON data."""
        return {
            "effect": self.effect,
            "location": self.place,
            "named_in": list(self.named),
            "not_distinguishable_in": list(self.as_well),
            "parameters": {
                key: {"least": min(e.value for e in own), "most": max(e.value for e in own), "unit": own[0].unit}
                for key, own in self.estimates.items()
            },
        }


@dataclass(frozen=True)
class SplitComparison:
    """The answers of several splits.

    Attributes:
        answers: the default split's, then those of the random ones.
        asked: how many random splits were asked for.
        fewer: why there are no more, in sentences without an end; none where there are as many.
    """

    answers: tuple[SplitAnswer, ...]
    asked: int
    fewer: tuple[str, ...] = ()

    @property
    def effects(self) -> tuple[OverSplits, ...]:
        """What any of them names, what most name first."""
        order = dict.fromkeys(place for answer in self.answers for place in answer.named)
        return tuple(sorted((self._of(*place) for place in order), key=lambda own: -len(own.named)))

    def _of(self, effect: str, place: str) -> OverSplits:
        own = effect, place
        those = [answer for answer in self.answers if own in answer.named]
        named = tuple(answer.number for answer in those)
        as_well = tuple(answer.number for answer in self.answers if own in answer.as_well)
        values = {key: tuple(answer.named[own][key] for answer in those) for key in those[0].named[own]}
        return OverSplits(effect, place, named, as_well, values)

    @property
    def undecided(self) -> tuple[OverSplits, ...]:
        """Those that not all splits name."""
        return tuple(own for own in self.effects if len(own.named) < len(self.answers))

    @property
    def worst(self) -> HeldOutError | None:
        """Where the augmented model does least for the error on held-out trials; None where it is the refitted one."""
        errors = [e for a in self.answers for e in a.errors if math.isfinite(e.ratio) and e.corrected != e.refitted]
        return max(errors, key=lambda e: e.ratio, default=None)

    def to_dict(self) -> dict[str, Any]:
        """As JSON data."""
        return {
            "asked": self.asked,
            "effects": [own.to_dict() for own in self.effects],
            "answers": [answer.to_dict() for answer in self.answers],
            "fewer": list(self.fewer),
        }
