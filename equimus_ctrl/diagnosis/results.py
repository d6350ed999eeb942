"""What a diagnosis found, for people, for figures and as plain data (``equimus-ctrl/diagnosis/2``)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from equimus_ctrl.diagnosis.candidates import Part
from equimus_ctrl.diagnosis.fitting import Fitted
from equimus_ctrl.engines.base import Engine
from equimus_ctrl.identification.segments import Segment
from equimus_ctrl.models.model import Model
from equimus_ctrl.types import Array

SCHEMA = "equimus-ctrl/diagnosis/2"
Verdict = Literal["consistent", "explained", "partly_explained", "unexplained", "unfinished"]
PARTS: tuple[Literal["train"], Literal["validation"], Literal["test"]] = ("train", "validation", "test")
"""Of the trials: fitted, by which effects were confirmed or rejected, and not touched before the report."""
STATES = ("nominal", "refitted", "corrected")
"""The model as it came, all its parameters refitted, and with what was found."""


@dataclass(frozen=True)
class Estimate:
    """A parameter of an effect with its interval.

    Attributes:
        value: SI.
        low: lower end of the interval, −inf where there is none.
        high: upper end.
        unit: SI.
    """

    value: float
    low: float
    high: float
    unit: str

    def to_dict(self) -> dict[str, Any]:
        """As JSON data; null where an interval has no end."""
        ends = {key: v if math.isfinite(v) else None for key, v in (("low", self.low), ("high", self.high))}
        return {"value": self.value, **ends, "unit": self.unit}


@dataclass(frozen=True)
class Named:
    """An effect and where it acts.

    Attributes:
        effect: its name.
        locations: the places.
    """

    effect: str
    locations: tuple[str, ...]

    def __str__(self) -> str:
        """For people."""
        return f"{self.effect} at {' and '.join(self.locations)}"

    def to_dict(self) -> dict[str, Any]:
        """As JSON data."""
        return {"effect": self.effect, "locations": list(self.locations)}


@dataclass(frozen=True)
class Evidence:
    """Why a finding is believed.

    Attributes:
        gain: by how much −2 log likelihood of the trials fitted falls with it, all other parameters free without it.
        threshold: the least gain that would have been believed.
        log10_chance: log₁₀ of the chance of such a gain where nothing is left out, all candidates counted.
        validation_gain: the same fall on validation trials, the noise being the same.
        share: of the mean squared error in excess of the noise that it takes away, on the trials fitted.
        validation_share: the same on validation trials.
    """

    gain: float
    threshold: float
    log10_chance: float
    validation_gain: float
    share: float
    validation_share: float

    def to_dict(self) -> dict[str, Any]:
        """As JSON data."""
        return {key: _finite(value) for key, value in vars(self).items()}


@dataclass(frozen=True, eq=False)
class Finding:
    """A piece of physics that the model leaves out.

    Attributes:
        part: the effect, its places and values.
        parameters: with intervals.
        evidence: for it.
        equivalent: what these recordings cannot tell apart from it.
    """

    part: Part
    parameters: Mapping[str, Estimate]
    evidence: Evidence
    equivalent: tuple[Named, ...] = ()

    @property
    def named(self) -> Named:
        """The effect and its places."""
        return Named(self.part.candidate.effect.name, self.part.candidate.locations)

    def to_dict(self) -> dict[str, Any]:
        """As JSON data."""
        return {
            **self.named.to_dict(),
            "parameters": {key: estimate.to_dict() for key, estimate in self.parameters.items()},
            "evidence": self.evidence.to_dict(),
            "equivalent": [other.to_dict() for other in self.equivalent],
        }


@dataclass(frozen=True)
class Where:
    """A place where the refitted model is off.

    Attributes:
        location: joint.
        share: of the mean squared error in excess of the noise, over all joints.
        when: in what phase of a trial it is largest.
        region: in what region of angles, speeds or commands.
    """

    location: str
    share: float
    when: str
    region: str

    def to_dict(self) -> dict[str, Any]:
        """As JSON data."""
        return dict(vars(self))


@dataclass(frozen=True, eq=False)
class Unexplained:
    """Something real that no effect explains.

    Attributes:
        location: joint at which it acts.
        share: of all that flexible pushes explain of what the corrected model leaves.
        depends_on: coordinates that the push depends on, such as ``pos.hip``; "" for an error far above the noise that
            no push explains: then ``gain`` is its excess over the noise's variance.
        places: actuators or joints at which the push acts.
        gain: by how much χ² falls on trials left out in turn.
        threshold: the least fall that counts.
        unit: of the push.
        axis: the coordinate of the curve, "" where there is none.
        axis_unit: its unit.
        x: (n,) the coordinate.
        push: (n,) the push there.
        band: (n,) half width of its 95 % interval.
        on_validation: whether it is an error far above the noise on validation trials alone, whatever numbers the
            effects have.
    """

    location: str
    share: float
    depends_on: str
    places: tuple[str, ...]
    gain: float
    threshold: float
    unit: str
    axis: str
    axis_unit: str
    x: Array
    push: Array
    band: Array
    on_validation: bool = False

    def to_dict(self) -> dict[str, Any]:
        """As JSON data."""
        curve = {"coordinate": self.axis, "unit": self.axis_unit, "push_unit": self.unit} | {
            key: [float(v) for v in getattr(self, key)] for key in ("x", "push", "band")
        }
        return {
            "location": self.location,
            "share": self.share,
            "depends_on": self.depends_on,
            "acts_at": list(self.places),
            "gain": self.gain,
            "threshold": self.threshold,
            "curve": curve if self.axis else None,
            "on_validation": self.on_validation,
        }


@dataclass(frozen=True)
class Ranked:
    """A candidate and what it would do to the refitted model, alone.

    Attributes:
        named: what and where.
        screened: fall of χ² expected to first order.
        fitted: fall of −2 log likelihood when fitted, None where it was not worth a fit.
        threshold: the least fall that would be believed of it.
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
    """The smallest size of an effect that would have shown.

    Attributes:
        named: what and where.
        parameter: whose size it is, the others being middling.
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
class Experiment:
    """What to record in order to tell apart what could not be.

    Attributes:
        scenario: name of a scenario of ``equimus-ctrl run``, with settings.
        settings: of the scenario.
        separates: the two that it tells apart.
        distance: root mean square distance between their predictions, refitted to one another, over the noise.
    """

    scenario: str
    settings: Mapping[str, float]
    separates: tuple[Named, Named]
    distance: float

    def to_dict(self) -> dict[str, Any]:
        """As JSON data."""
        return {
            "scenario": self.scenario,
            "settings": dict(self.settings),
            "separates": [named.to_dict() for named in self.separates],
            "distance_over_noise": self.distance,
        }


@dataclass(frozen=True, eq=False)
class Residuals:
    """Measured − predicted of one state of the model.

    Attributes:
        train: for each segment fitted (m, nj) [rad].
        validation: for each validation segment (m, nj) [rad].
        test: for each test segment.
    """

    train: tuple[Array, ...]
    validation: tuple[Array, ...]
    test: tuple[Array, ...] = ()


@dataclass(frozen=True)
class Decision:
    """What a stage of a diagnosis decided, and why.

    Attributes:
        stage: its name, see ``stages``.
        decision: in words.
        reason: in words and figures.
    """

    stage: str
    decision: str
    reason: str

    def to_dict(self) -> dict[str, Any]:
        """As JSON data."""
        return dict(vars(self))


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """What a model leaves out of a robot.

    Attributes:
        verdict: in one word.
        model: as it came.
        refitted: without any effect, its parameters fitted.
        corrected: with what was found.
        base: the fit of the refitted model.
        best: the fit of the corrected one.
        train: segments fitted.
        validation: segments that were not fitted, and by which effects were confirmed or rejected.
        test: segments that took no part in any fit or choice.
        residuals: of each of ``STATES``.
        where: the refitted model is off, worst first.
        findings: strongest first.
        unexplained: what none of them explains, strongest first.
        doubtful: effects that fit best but not well enough to be named, see ``unexplained``.
        ranking: all candidates, alone, best first.
        detectable: smallest effects that would have shown; only where nothing was found.
        experiment: that would tell apart what could not be.
        excess: for each state of STATES, mean squared error in excess of the noise over the noise's variance, on the
            trials fitted.
        notes: what else a person ought to know.
        seconds: how long it took.
        decisions: of the stages, in order.
        not_done: stages that it was ended before or in, by its budget or by whoever asked for its best so far.
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
    where: tuple[Where, ...]
    findings: tuple[Finding, ...]
    unexplained: tuple[Unexplained, ...]
    doubtful: tuple[Named, ...]
    ranking: tuple[Ranked, ...]
    detectable: tuple[Detectable, ...]
    experiment: Experiment | None
    excess: Mapping[str, float]
    notes: tuple[str, ...]
    seconds: float
    decisions: tuple[Decision, ...] = ()
    not_done: tuple[str, ...] = ()

    @property
    def joints(self) -> tuple[str, ...]:
        """Their names."""
        return self.model.robot.joint_names

    @property
    def engine(self) -> Engine:
        """That simulated."""
        return self.best.fit.problem.simulator.engine

    def rmse(self, state: str, part: Literal["train", "validation", "test"]) -> Array:
        """(nj,) root mean square error of a state of the model [rad]; nan where there are no such trials."""
        residuals = getattr(self.residuals[state], part)
        if not residuals:
            return np.full(len(self.joints), np.nan)
        return np.asarray(np.sqrt((np.concatenate(residuals) ** 2).mean(axis=0)))

    def to_dict(self) -> dict[str, Any]:
        """As JSON data: schema ``equimus-ctrl/diagnosis/2``."""
        own = self.best.fit
        return {
            "schema": SCHEMA,
            "verdict": self.verdict,
            "engine": self.engine.to_dict(),
            "where": [place.to_dict() for place in self.where],
            "findings": [finding.to_dict() for finding in self.findings],
            "unexplained": [left.to_dict() for left in self.unexplained],
            "doubtful": [named.to_dict() for named in self.doubtful],
            "noise_rad": {j: n.sigma for j, n in zip(self.joints, self.best.noise, strict=True)},
            "noise_correlation_s": {
                j: n.time if n.coloured > 0 else 0.0 for j, n in zip(self.joints, self.best.noise, strict=True)
            },
            "rmse_rad": {part: {state: self._by_joint(self.rmse(state, part)) for state in STATES} for part in PARTS},
            "excess": dict(self.excess),
            "parameters": {
                name: {
                    "value": float(value),
                    "low": _finite(float(value - width)),
                    "high": _finite(float(value + width)),
                    "unit": free.unit,
                }
                for free, name, value, width in zip(
                    own.parameters.free, own.parameters.names, own.theta, own.uncertainty.half_width, strict=True
                )
            },
            "separating_experiment": self.experiment.to_dict() if self.experiment else None,
            "detectable": [smallest.to_dict() for smallest in self.detectable],
            "ranking": [ranked.to_dict() for ranked in self.ranking],
            "trials": {
                "train": [s.trial.name for s in self.train],
                "validation": [s.trial.name for s in self.validation],
                "test": [s.trial.name for s in self.test],
            },
            "decisions": [decision.to_dict() for decision in self.decisions],
            "not_done": list(self.not_done),
            "notes": list(self.notes),
            "seconds": self.seconds,
        }

    def _by_joint(self, values: Sequence[float] | Array) -> dict[str, float | None]:
        return {joint: _finite(float(v)) for joint, v in zip(self.joints, values, strict=True)}


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
