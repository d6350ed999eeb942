"""Each effect as a sentence, with its parameters and intervals."""

from __future__ import annotations

from dataclasses import dataclass

from equimus_ctrl.diagnosis import display_units
from equimus_ctrl.diagnosis.results import Estimate, Finding
from equimus_ctrl.models.model import Model
from equimus_ctrl.report.diagnosis_words import estimate_text, listed, quantity
from equimus_ctrl.robots.base import Robot

NOT_SEEN = "It is not seen there."


@dataclass(frozen=True, eq=False)
class FoundEffect:
    """A finding as the sentence of its effect sees it, see ``effects.description.Description``."""

    finding: Finding
    model: Model

    @property
    def places(self) -> tuple[str, ...]:
        return self.finding.part.candidate.locations

    @property
    def at(self) -> str:
        return listed(self.places)

    @property
    def the(self) -> str:
        return listed([f"the {place}" for place in self.places])

    @property
    def noun(self) -> str:
        return display_units.noun(self.model, self.places[0])

    @property
    def actuation(self) -> str:
        if self.robot.traits.commands_are_pressures:
            return f"The {self.one_or('pressure', 'pressures')} of {self.at}"
        return f"The {self.one_or('force', 'forces')} of {self.at}"

    @property
    def numbers(self) -> str:
        info = self.finding.part.candidate.effect.parameter_info()
        return listed([f"{key} ({info[key]['doc']}) {self[key]}" for key in self.finding.parameters])

    @property
    def robot(self) -> Robot:
        return self.model.robot

    def one_or(self, one: str, several: str) -> str:
        return one if len(self.places) == 1 else several

    def __getitem__(self, key: str) -> str:
        return estimate_text(self.finding.parameters[key])

    def unit(self, key: str) -> str:
        return self.finding.parameters[key].unit

    def value(self, key: str) -> float:
        return self.finding.parameters[key].value

    def scaled(self, key: str, unit: str, factor: float, away: float = 0.0) -> str:
        estimate = self.finding.parameters[key]
        ends = sorted(factor * (v - away) for v in (estimate.low, estimate.high))
        return estimate_text(Estimate(factor * (estimate.value - away), ends[0], ends[1], unit))

    def quantity(self, value: float, unit: str) -> str:
        return quantity(value, unit)


def sentence(finding: Finding, model: Model) -> str:
    """The missing physics in words, with its parameters and intervals; where groups of trials differ, group by group.

    Args:
        finding: what.
        model: the nominal model.
    """
    return " ".join(sentences(finding, model))


def sentences(finding: Finding, model: Model) -> list[str]:
    """The same as a list, one for each group of trials where these differ."""
    if not finding.by_group:
        return [_sentence(finding, model)]
    own = {g: _sentence(finding.in_group(g), model) if values else NOT_SEEN for g, values in finding.by_group.items()}
    return [f"{group}: {text}" for group, text in own.items()]


def _sentence(finding: Finding, model: Model) -> str:
    return finding.part.candidate.effect.sentence(FoundEffect(finding, model))
