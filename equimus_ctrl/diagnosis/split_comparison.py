"""What diagnoses of the same trials find, others held out in each: what all say, and what hangs on the split."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from equimus_ctrl.diagnosis.estimates import Estimate, Named
from equimus_ctrl.diagnosis.holdout import kind_of
from equimus_ctrl.types import Array

if TYPE_CHECKING:
    from equimus_ctrl.diagnosis.results import Diagnosis

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
        fitted: names of the trials that were fitted, whole or in part.
        verdict: see ``results.Diagnosis``.
        named: for each effect that is named, at each of its places, the parameters.
        as_well: effects and places that fit as well in the place of one that is named.
        errors: on what was held out.
        seconds: that it took [s].
    """

    fitted: tuple[str, ...]
    verdict: str
    named: Mapping[Place, Mapping[str, Estimate]]
    as_well: frozenset[Place]
    errors: tuple[HeldOutError, ...]
    seconds: float

    @classmethod
    def of(cls, diagnosis: Diagnosis, seconds: float) -> SplitAnswer:
        """That of a diagnosis that took so long [s]."""
        named: dict[Place, Mapping[str, Estimate]] = {}
        as_well = set[Place]()
        for finding in diagnosis.findings:
            named |= dict.fromkeys(_places(finding.named), finding.parameters)
            as_well.update(place for other in finding.equivalent for place in _places(other))
        fitted = tuple({s.recording: s.recording_name for s in diagnosis.train}.values())
        errors = tuple(_errors(diagnosis))
        return cls(fitted, diagnosis.verdict, named, frozenset(as_well) - named.keys(), errors, seconds)

    def to_dict(self) -> dict[str, Any]:
        """As JSON data."""
        return {
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
class Law:
    """An effect at one of its places, over all splits.

    Attributes:
        effect: its name.
        place: where.
        named: in which of the answers, by their places, it is named.
        as_well: in which it fits as well in the place of what is named.
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
    def laws(self) -> tuple[Law, ...]:
        """What any of them names, what most name first."""
        order = dict.fromkeys(place for answer in self.answers for place in answer.named)
        return tuple(sorted((self._law(*place) for place in order), key=lambda law: -len(law.named)))

    def _law(self, effect: str, place: str) -> Law:
        own = effect, place
        named = tuple(k for k, answer in enumerate(self.answers) if own in answer.named)
        as_well = tuple(k for k, answer in enumerate(self.answers) if own in answer.as_well)
        first = self.answers[named[0]].named[own]
        values = {key: tuple(self.answers[k].named[own][key] for k in named) for key in first}
        return Law(effect, place, named, as_well, values)

    @property
    def undecided(self) -> tuple[Law, ...]:
        """Those that not all splits name."""
        return tuple(law for law in self.laws if len(law.named) < len(self.answers))

    @property
    def worst(self) -> HeldOutError | None:
        """Where the augmented model does least for the error on held-out trials; None where nothing was found."""
        errors = [e for answer in self.answers if answer.named for e in answer.errors if math.isfinite(e.ratio)]
        return max(errors, key=lambda e: e.ratio, default=None)

    def to_dict(self) -> dict[str, Any]:
        """As JSON data."""
        return {
            "asked": self.asked,
            "laws": [law.to_dict() for law in self.laws],
            "answers": [answer.to_dict() for answer in self.answers],
            "fewer": list(self.fewer),
        }


def _places(named: Named) -> Iterable[Place]:
    return ((named.effect, location) for location in named.locations)


def _errors(diagnosis: Diagnosis) -> Iterable[HeldOutError]:
    """For each kind of held-out trials and each joint."""
    segments = (*diagnosis.validation, *diagnosis.test)
    left = {
        state: (*diagnosis.residuals[state].validation, *diagnosis.residuals[state].test)
        for state in ("refitted", "corrected")
    }
    for kind in dict.fromkeys(kind_of(s.recording_name) for s in segments):
        own = [k for k, s in enumerate(segments) if kind_of(s.recording_name) == kind]
        sizes = {state: _rmse([residuals[k] for k in own]) for state, residuals in left.items()}
        for j, joint in enumerate(diagnosis.joints):
            yield HeldOutError(kind, joint, sizes["refitted"][j], sizes["corrected"][j])


def _rmse(residuals: Sequence[Array]) -> list[float]:
    return [float(size) for size in np.sqrt(np.mean(np.concatenate(residuals) ** 2, axis=0))]
