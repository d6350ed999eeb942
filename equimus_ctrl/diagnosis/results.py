"""What a diagnosis found, for people, for figures and as plain data (``equimus-ctrl/diagnosis/2``)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from equimus_ctrl.diagnosis.differences import AnotherUnit, Difference
from equimus_ctrl.diagnosis.estimates import Estimate as Estimate
from equimus_ctrl.diagnosis.estimates import Named as Named
from equimus_ctrl.diagnosis.fitting import Fitted
from equimus_ctrl.diagnosis.hypothesis import Hypothesis, Part
from equimus_ctrl.diagnosis.residuals import ResidualLocation, Residuals, Unexplained
from equimus_ctrl.diagnosis.rivals import Rivals
from equimus_ctrl.diagnosis.split_comparison import SplitComparison
from equimus_ctrl.engines.base import Engine
from equimus_ctrl.errors import ConfigError, unknown_name
from equimus_ctrl.frames import dataframe
from equimus_ctrl.identification.estimates import Covariance, TrialResiduals, covariance_of, residuals_by_trial
from equimus_ctrl.identification.noise import Noise
from equimus_ctrl.identification.results import FittedChannel, fitted_channels, small_units
from equimus_ctrl.identification.segments import Segment
from equimus_ctrl.models.model import Model, model_to_dict
from equimus_ctrl.shown import Short, by_name, counted
from equimus_ctrl.types import Array

if TYPE_CHECKING:
    from pandas import DataFrame

SCHEMA = "equimus-ctrl/diagnosis/2"
Verdict = Literal["consistent", "explained", "partly_explained", "unexplained", "unfinished"]
Set = Literal["train", "validation", "test"]
SETS: tuple[Set, ...] = ("train", "validation", "test")
"""Of the trials: fitted, by which effects were confirmed or rejected, and not simulated before the report."""
STATES = ("nominal", "refitted", "corrected")
"""The nominal model, the refitted (re-identified) model, and the augmented model with the effects found."""

CONFIRMATION = "confirmation"
"""The stage in which held-out trials judge the effects of the search's end; they judge what was fitted by then where it
was not carried out."""


@dataclass(frozen=True, eq=False, repr=False)
class Equivalent(Short):
    """An effect that fits as well in the place of a part of a hypothesis, or better.

    Attributes:
        named: what and where.
        fitted: the hypothesis with it, fitted.
        better: by how much more than what is not distinguishable its −2 log likelihood is lower, less Schwarz's cost
            of parameters that it has less; 0 where it fits as well.
    """

    named: Named
    fitted: Fitted
    better: float = 0.0


@dataclass(frozen=True)
class Evidence:
    """The evidence for a finding.

    Attributes:
        gain: by how much −2 log likelihood of the trials fitted falls with it, all other parameters free without it.
        threshold: acceptance threshold of the gain.
        log10_p_value: log₁₀ of the p-value: of such a gain where no physics is missing, corrected for all candidates.
        validation_gain: the same fall on validation trials, the noise being the same.
        share: of the excess residual variance that it explains beside the other effects, on the trials fitted.
        validation_share: the same on validation trials.
        share_alone: what it explains as the only effect, all other parameters free; nan where the search has not
            fitted that.
        validation_share_alone: the same on validation trials.
    """

    gain: float
    threshold: float
    log10_p_value: float
    validation_gain: float
    share: float
    validation_share: float
    share_alone: float = math.nan
    validation_share_alone: float = math.nan

    def to_dict(self) -> dict[str, Any]:
        """As JSON data."""
        return {key: _finite(value) for key, value in vars(self).items()}


@dataclass(frozen=True, eq=False, repr=False)
class Finding(Short):
    """A piece of missing physics.

    Attributes:
        part: the effect, its places and values.
        parameters: with intervals.
        evidence: for it.
        equivalent: effects that these recordings do not distinguish from it.
        law: the part at all its places where each has its own parameters: the evidence is of all of them together.
        undetermined: why its parameters are not identifiable from these recordings; "" where they are.
        by_group: where they differ between groups of trials, the parameters in each; none where it does not act.
    """

    part: Part
    parameters: Mapping[str, Estimate]
    evidence: Evidence
    equivalent: tuple[Named, ...] = ()
    law: Part | None = None
    undetermined: str = ""
    by_group: Mapping[str, Mapping[str, Estimate]] = field(default_factory=dict)

    def told(self) -> str:
        """The effect, its places and parameters."""
        values = ", ".join(f"{key} {own.value:.4g} {own.unit}" for key, own in self.parameters.items())
        return f" {self.named.effect} at {' and '.join(self.named.locations)}: {values}"

    @property
    def named(self) -> Named:
        """The effect and its places."""
        return Named(self.part.candidate.effect.name, self.part.candidate.locations)

    @property
    def also_at(self) -> tuple[str, ...]:
        """Further places of the same law, each with its own parameters."""
        places = () if self.law is None else self.law.candidate.locations
        return tuple(place for place in places if place not in self.part.candidate.locations)

    def to_dict(self) -> dict[str, Any]:
        """As JSON data."""
        same = self.part.candidate.effect.as_sum({key: own.value for key, own in self.parameters.items()})
        return {
            **self.named.to_dict(),
            "parameters": _estimates(self.parameters),
            "evidence": self.evidence.to_dict(),
            "equivalent": [other.to_dict() for other in self.equivalent],
            **({"same_as": {name: dict(own) for name, own in same.items()}} if same else {}),
            **({"also_at": list(self.also_at)} if self.also_at else {}),
            **({"undetermined": self.undetermined} if self.undetermined else {}),
            **({"by_group": {group: _estimates(own) for group, own in self.by_group.items()}} if self.by_group else {}),
        }

    def in_group(self, group: str) -> Finding:
        """The same with its parameters in a group of trials."""
        return replace(self, parameters=self.by_group[group], by_group={})


@dataclass(frozen=True)
class Ranked:
    """A candidate and its gain as the only effect added to the refitted model.

    Attributes:
        named: what and where.
        screened: fall of χ² expected to first order.
        fitted: fall of −2 log likelihood when fitted, None where it was not worth a fit.
        threshold: acceptance threshold of its fall.
    """

    named: Named
    screened: float
    fitted: float | None
    threshold: float

    def to_dict(self) -> dict[str, Any]:
        """As JSON data."""
        gains = {"screened_gain": self.screened, "fitted_gain": self.fitted, "threshold": self.threshold}
        return {**self.named.to_dict(), **gains}


@dataclass(frozen=True)
class Detectable:
    """The smallest detectable size of an effect.

    Attributes:
        named: what and where.
        parameter: whose size it is, the others at median values.
        size: SI.
        unit: SI.
    """

    named: Named
    parameter: str
    size: float
    unit: str

    def to_dict(self) -> dict[str, Any]:
        """As JSON data."""
        return {**self.named.to_dict(), "parameter": self.parameter, "size": _finite(self.size), "unit": self.unit}


@dataclass(frozen=True)
class Decision:
    """What a stage of a diagnosis decided, and why.

    Attributes:
        stage: its name, see ``stages.STAGES``; before and after these ``refit`` and ``report``.
        decision: in words.
        reason: in words and figures.
        other_holdout: whether it is of the second diagnosis, with other trials held out.
    """

    stage: str
    decision: str
    reason: str
    other_holdout: bool = False

    def to_dict(self) -> dict[str, Any]:
        """As JSON data."""
        said = {"stage": self.stage, "decision": self.decision, "reason": self.reason}
        return said | ({"other_holdout": True} if self.other_holdout else {})


@dataclass(frozen=True)
class Rejected:
    """An effect that was part of a hypothesis and is none of the end's.

    Attributes:
        named: what and where.
        stage: that rejected it, see ``stages.STAGES``.
        reason: in words and figures.
    """

    named: Named
    stage: str
    reason: str

    def to_dict(self) -> dict[str, Any]:
        """As JSON data."""
        return {**self.named.to_dict(), "stage": self.stage, "reason": self.reason}


@dataclass(frozen=True, eq=False, repr=False)
class Diagnosis(Short):
    """The missing physics of a model of a robot.

    Attributes:
        verdict: in one word.
        model: the nominal model.
        refitted: without any effect, its parameters fitted.
        corrected: the augmented model, with the effects found; where groups of trials differ see ``Model.in_group``.
        base: the fit of the refitted model.
        best: the fit of the augmented one.
        train: segments fitted.
        validation: segments that were not fitted, and by which effects were confirmed or rejected.
        test: segments whose errors took no part in any fit or choice.
        residuals: of each of ``STATES``.
        sigma: (nj,) standard deviation of each joint's noise [rad or m], see ``noise_size.noise_sizes``.
        where: the refitted model's residuals are, largest first.
        findings: strongest first.
        unexplained: what none of them explains, strongest first.
        undetermined: effects that fit, but whose parameters these recordings do not identify: they are not named.
        rejected: effects that were part of a hypothesis until held-out trials, a residual force or the engine's step
            spoke against them; none that is found, undetermined or not distinguishable all the same.
        ranking: all candidates, alone, best first.
        detectable: smallest detectable sizes of effects beside what was found, where nothing is left unexplained.
        excess_variance: for each state of STATES the excess residual variance on the trials fitted: mean squared
            residual over the noise's variance, minus 1.
        notes: warnings, as sentences.
        seconds: how long it took.
        decisions: of the stages, in order; where others were held out, those of the second diagnosis after the first's.
        not_done: stages that it was ended before or in, by its budget or by whoever asked for its best so far.
        groups: of trials, such as units of the robot; none where all are of one.
        differences: between them, the strongest evidence first.
        another_unit: what of the model's parameters is not nominal; None where the nominal values fit as well.
        splits: what other splits of the trials say; None where nobody asked.
        explanations: that these recordings leave beside ``best``, see ``explanations.left_by``.
        nearest: what comes nearest to what has no name, see ``explanations.nearest_to``.
        below: what may hide beside ``best``, see ``explanations.hidden``; where nothing is left unexplained.
    """

    verdict: Verdict
    model: Model
    refitted: Model
    corrected: Model
    base: Fitted
    best: Fitted
    train: tuple[Segment, ...]
    validation: tuple[Segment, ...]
    test: tuple[Segment, ...]
    residuals: Mapping[str, Residuals]
    sigma: Array
    where: tuple[ResidualLocation, ...]
    findings: tuple[Finding, ...]
    unexplained: tuple[Unexplained, ...]
    rejected: tuple[Rejected, ...]
    ranking: tuple[Ranked, ...]
    detectable: tuple[Detectable, ...]
    excess_variance: Mapping[str, float]
    notes: tuple[str, ...]
    seconds: float
    decisions: tuple[Decision, ...] = ()
    not_done: tuple[str, ...] = ()
    undetermined: tuple[Finding, ...] = ()
    groups: tuple[str, ...] = ()
    differences: tuple[Difference, ...] = ()
    another_unit: AnotherUnit | None = None
    splits: SplitComparison | None = None
    explanations: tuple[Fitted, ...] = ()
    nearest: tuple[Fitted, ...] = ()
    below: tuple[Hypothesis, ...] = ()

    def told(self) -> str:
        """The verdict, what was found, and how much less the errors are."""
        found = ", ".join(f"{own.named.effect} at {' and '.join(own.named.locations)}" for own in self.findings)
        part: Set = "test" if self.test else "validation" if self.validation else "train"
        before, after = (by_name(self.joints, 1e3 * self.rmse(state, part)) for state in STATES[1:])
        fell = f"{before} → {after}" if self.findings else before
        return (
            f" of {self.model.name}: {self.verdict}" + (f", {found}" if found else "")
            + f"; {part} RMSE {fell} {small_units(self.model.robot)}, "
            f"{counted(len(self.train), 'segment')} fitted, {len(self.validation) + len(self.test)} held out"
        )  # fmt: skip

    @property
    def covariance(self) -> Covariance:
        """Of all parameters of the augmented model that were estimated, those of effects last.

        Intervals of effects that are curved are by profile likelihood, see ``Finding.parameters``.
        """
        return covariance_of(self.best.fit.parameters, self.best.fit.uncertainty)

    def trial_residuals(self, state: str = "corrected", part: str | None = None) -> tuple[TrialResiduals, ...]:
        """Measured − predicted with times, of each trial.

        Args:
            state: of the model, one of ``STATES``.
            part: of the trials, one of ``SETS``; all by default.

        Raises:
            ConfigError: for a state or a part that there is not.
        """
        for what, name, known in (("state of the model", state, STATES), ("set of trials", part, (None, *SETS))):
            if name not in known:
                raise ConfigError(unknown_name(what, str(name), [own for own in known if own]))
        sets = SETS if part is None else (part,)
        segments = [own for name in sets for own in getattr(self, name)]
        residuals = [own for name in sets for own in getattr(self.residuals[state], name)]
        return residuals_by_trial(self.model.robot, segments, residuals)

    def to_dataframe(self) -> DataFrame:
        """A row for each parameter of each effect found: value, interval, evidence.

        Raises:
            NotAvailable: where pandas is not installed.
        """
        columns = ("effect", "locations", "parameter", "unit", "value", "low", "high", "gain", "threshold", "share")
        rows = [
            (own.named.effect, ", ".join(own.named.locations), key, e.unit, e.value, e.low, e.high, own.evidence.gain,
             own.evidence.threshold, own.evidence.share)
            for own in self.findings
            for key, e in own.parameters.items()
        ]  # fmt: skip
        return dataframe({name: [row[k] for row in rows] for k, name in enumerate(columns)})

    @property
    def joints(self) -> tuple[str, ...]:
        """Their names."""
        return self.model.robot.joint_names

    @property
    def engine(self) -> Engine:
        """That simulated."""
        return self.best.fit.problem.simulator.engine

    @property
    def noise(self) -> Noise:
        """Of the joints' positions."""
        return self.best.noise[: len(self.joints)]

    @property
    def channels(self) -> tuple[FittedChannel, ...]:
        """What was compared beside the joints' positions, on the trials fitted: refitted and augmented model."""
        return fitted_channels(self.best.fit, self.best.noise, self.base.fit.residuals)

    def rmse(self, state: str, part: Set) -> Array:
        """(nj,) root mean square error of a state of the model [rad or m]; nan where there are no such trials."""
        residuals = getattr(self.residuals[state], part)
        if not residuals:
            return np.full(len(self.joints), np.nan)
        return np.asarray(np.sqrt((np.concatenate(residuals) ** 2).mean(axis=0)))

    def explained(self, part: Set) -> float:
        """Share of the excess residual variance that all effects together explain; nan where there are no trials."""
        before, after = (
            float(np.maximum((self.rmse(state, part) / self.sigma) ** 2 - 1.0, 0.0).mean()) for state in STATES[1:]
        )
        return (before - after) / before if before > 0 else math.nan if math.isnan(before) else 0.0

    @property
    def interval(self) -> float | None:
        """Length of the shooting intervals that are fitted, most of them [s]; None where trials are simulated whole.

        One interval may be all that is fitted of a recording; those of held-out ones tell then that they are cut.
        """
        sets = (self.train, self.validation, self.test)
        if all(len(own) == len({s.recording for s in own}) for own in sets):
            return None
        return float(np.median([s.trial.sample_times[-1] - s.trial.start for s in self.train]))

    @cached_property
    def rivals(self) -> Rivals:
        """The explanations that these recordings leave, for experiments to decide between; some are fitted for it."""
        return Rivals.of(self)

    def to_dict(self) -> dict[str, Any]:
        """As JSON data: schema ``equimus-ctrl/diagnosis/2``."""
        return {
            "schema": SCHEMA,
            "verdict": self.verdict,
            "engine": self.engine.to_dict(),
            "where": [place.to_dict() for place in self.where],
            "findings": [finding.to_dict() for finding in self.findings],
            "undetermined": [finding.to_dict() for finding in self.undetermined],
            "unexplained": [residual.to_dict() for residual in self.unexplained],
            "rejected": [own.to_dict() for own in self.rejected],
            "noise_rad": self._by_joint(self.sigma),
            "noise_correlation_s": {
                j: n.time if n.coloured > 0 else 0.0 for j, n in zip(self.joints, self.noise, strict=True)
            },
            "channels": [asdict(channel) for channel in self.channels],
            "rmse_rad": {part: {state: self._by_joint(self.rmse(state, part)) for state in STATES} for part in SETS},
            "excess_residual_variance": dict(self.excess_variance),
            "explained_share": {part: _finite(self.explained(part)) for part in SETS},
            "parameters": self._parameters(),
            "models": self._models(),
            "zeros": [asdict(zero) for zero in self.best.fit.zeros],
            "detectable": [smallest.to_dict() for smallest in self.detectable],
            "ranking": [ranked.to_dict() for ranked in self.ranking],
            "another_unit": self.another_unit.to_dict() if self.another_unit else None,
            "rivals": self.rivals.to_dict(),
            **self._groups(),
            "trials": {part: [s.trial.name for s in getattr(self, part)] for part in SETS},
            "shooting_interval_s": self.interval,
            **({"splits": self.splits.to_dict()} if self.splits else {}),
            "decisions": [decision.to_dict() for decision in self.decisions],
            "not_done": list(self.not_done),
            "notes": list(self.notes),
            "seconds": self.seconds,
        }

    def _models(self) -> dict[str, Any]:
        """As model files hold them."""
        grouped = bool(self.corrected.by_group)
        return {
            "refitted": model_to_dict(self.refitted),
            "corrected": None if grouped else model_to_dict(self.corrected),
        }

    def _groups(self) -> dict[str, Any]:
        """What differs between groups of trials; empty where there are none."""
        if not self.groups:
            return {}
        whole = (*self.train, *self.validation, *self.test)
        names = {g: list(dict.fromkeys(s.recording_name for s in whole if s.group == g)) for g in self.groups}
        return {"groups": names, "differences": [difference.to_dict() for difference in self.differences]}

    def _parameters(self) -> dict[str, dict[str, Any]]:
        """Of the augmented model those that were estimated, with intervals."""
        fit = self.best.fit
        return {
            name: {
                "value": float(value),
                "low": _finite(float(value - width)),
                "high": _finite(float(value + width)),
                "unit": free.unit,
            }
            for free, name, value, width in zip(
                fit.parameters.free, fit.parameters.names, fit.theta, fit.uncertainty.half_width, strict=True
            )
        }

    def _by_joint(self, values: Sequence[float] | Array) -> dict[str, float | None]:
        return {joint: _finite(float(v)) for joint, v in zip(self.joints, values, strict=True)}


def _estimates(parameters: Mapping[str, Estimate]) -> dict[str, Any]:
    return {key: estimate.to_dict() for key, estimate in parameters.items()}


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
