"""Rivals: the explanations that a diagnosis leaves, reduced to what predictions of further trials need.

A rival is a model with its effects, the estimates of all that is free in it, and what the recordings so far say of
these: the Fisher information A = Σ (W ∂y/∂θ)ᵀ(W ∂y/∂θ), W whitening the noise, the free numbers of each start
eliminated with their prior. Neither recordings nor fits are needed any more, so a record holds it.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from itertools import permutations
from typing import Any, Protocol

import numpy as np
from scipy.linalg import solve_triangular
from scipy.optimize import lsq_linear

from equimus_ctrl.diagnosis.estimates import Named
from equimus_ctrl.diagnosis.fitting import Data, Fitted
from equimus_ctrl.diagnosis.hypothesis import Candidate, Hypothesis, given_names, parameters_of
from equimus_ctrl.diagnosis.policy import SearchPolicy
from equimus_ctrl.diagnosis.residuals import Unexplained
from equimus_ctrl.diagnosis.scoring import equally_good
from equimus_ctrl.diagnosis.thresholds import Thresholds
from equimus_ctrl.effects import base as effects_base
from equimus_ctrl.engines.base import EngineName
from equimus_ctrl.engines.choice import engine_for
from equimus_ctrl.engines.predict import FREE, ZERO
from equimus_ctrl.errors import ConfigError, SimulationDiverged
from equimus_ctrl.identification.channels import ALSO, Channels
from equimus_ctrl.identification.information import information, root_of_inverse
from equimus_ctrl.identification.noise import JointNoise, Noise
from equimus_ctrl.identification.parameters import FreeParameter, FreeParameters, unit_of
from equimus_ctrl.identification.segments import Segment
from equimus_ctrl.identification.simulators import Simulator
from equimus_ctrl.models.model import Model
from equimus_ctrl.shown import Short
from equimus_ctrl.types import Array

UNIFORM = 12.0
"""Of a uniform distribution, the square of its range over its variance."""
NOTHING = "no missing physics"
STEPS = 20
"""Of a fit of a rival to other trials, or of another size, from where it was."""
MOST_HIDDEN = 4
"""So many effects that may hide beside what was found."""
TIGHT = 1e-12
"""Room for what is at a bound, in units of its scale."""


@dataclass(frozen=True, eq=False, repr=False)
class Rival(Short):
    """An explanation of the recordings so far: effects, maybe none, and a model with them that is fitted.

    Attributes:
        effects: what is taken to be missing from the nominal model.
        parameters: the model with the effects in it, and what is free.
        theta: (p,) estimates [unit of each].
        information: (p, p) of the recordings so far, of parameters in units of their scale.
        deviance: −2 log likelihood of the recordings so far, without constant terms.
        noise: that its residuals have there, of every joint and other channel.
        accepted: whether the diagnosis takes it for possible; else it is the nearest that there is to what has no name,
            or fits better than what is named, though held-out trials do not confirm it.
        given: dotted names of parameters of its last effect that are given rather than estimated: it may hide beside
            what was found, at that size.
    """

    effects: tuple[Named, ...]
    parameters: FreeParameters
    theta: Array
    information: Array
    deviance: float
    noise: Noise
    accepted: bool = True
    given: tuple[str, ...] = ()

    def told(self) -> str:
        """Its effects."""
        return f" {self.label}"

    @property
    def label(self) -> str:
        """Its effects and their places, for people."""
        return " and ".join(map(str, self.effects)) or NOTHING

    @cached_property
    def model(self) -> Model:
        """With the estimates."""
        return self.model_at(self.theta)

    def model_at(self, theta: Array) -> Model:
        """The model with other values (p,) of what is free."""
        return self.parameters.model_at(theta)

    @cached_property
    def precision(self) -> Array:
        """(p, p) the inverse covariance of the parameters in units of their scale: A + diag(12 (scale/range)²).

        A weak prior, of the variance that a uniform distribution over its bounds has, holds what the recordings do not
        show within what it can be.
        """
        parameters = self.parameters
        share = parameters.scale / (parameters.high - parameters.low)
        whole: Array = self.information + np.diag(UNIFORM * share**2)
        return whole

    @cached_property
    def spread(self) -> Array:
        """(p, p) L with LLᵀ the covariance of the parameters in units of their scale."""
        return root_of_inverse(self.precision)

    def draws(self, rng: np.random.Generator, count: int) -> Array:
        """(count, p) parameters from their normal distribution, within their bounds [unit of each].

        What the recordings do not show varies by no more than its scale, its own size mostly: the information is that
        of small changes, and says too little of large ones, which the recordings would have shown. A draw that leaves
        the bounds is taken to where, within them, it is the least standard deviations away: to clip it would break
        what is known of combinations.
        """
        free = self.parameters
        share = free.scale / (free.high - free.low)
        precision = self.information + np.diag(np.maximum(UNIFORM * share**2, 1.0))
        root = np.linalg.cholesky(precision).T
        low, high = (free.low - self.theta) / free.scale, (free.high - self.theta) / free.scale
        low, high = np.minimum(low, -TIGHT), np.maximum(high, TIGHT)  # estimates at a bound
        found = []
        for own in rng.standard_normal((count, len(self.theta))):
            change = solve_triangular(root, own)
            if np.any(change < low) or np.any(change > high):
                change = lsq_linear(root, own, (low, high), method="bvls").x
            found.append(np.clip(self.theta + free.scale * change, free.low, free.high))
        return np.array(found)

    @property
    def n_effect_parameters(self) -> int:
        """How many free parameters are of effects: those that Schwarz's criterion counts."""
        own = self.parameters.model.effect_parameters()
        return sum(free.name in own for free in self.parameters.free)

    @property
    def given_sizes(self) -> tuple[tuple[str, float, str], ...]:
        """(parameter, value, SI unit) of what is given, each once; of an effect all given its size alone."""
        model, found = self.model, list[tuple[str, float, str]]()
        own = model.effect_parameters()
        for name in self.given:
            effect, key = own[name]
            all_given = all(name.removesuffix(key) + other in self.given for other in effect.parameter_info())
            if not all_given or key == next(iter(effect.parameter_info())):
                found.append((key, float(getattr(effect, key)), unit_of(model, name)))
        return tuple(dict.fromkeys(found))

    def score(self, n: int) -> float:
        """Bayesian information criterion of the recordings so far, of n numbers, see ``diagnosis.scoring``."""
        return self.deviance + self.n_effect_parameters * float(np.log(n))

    def to_dict(self, nominal: Model) -> dict[str, Any]:
        """As JSON data, beside a nominal model."""
        model, known = self.parameters.model, nominal.robot.parameters()
        own = model.robot.parameters()
        return {
            "effects": [named.to_dict() for named in self.effects],
            "accepted": self.accepted,
            "given": list(self.given),
            "deviance": self.deviance,
            "noise": [asdict(own) for own in self.noise],
            "model": {
                "parameters": {name: value for name, value in own.items() if value != known[name]},
                "effects": [{"effect": e.name, "location": e.location, **e.parameters()} for e in model.effects],
                "by_group": {group: dict(values) for group, values in model.by_group},
            },
            "free": [{**asdict(free), "also": list(free.also)} for free in self.parameters.free],
            "theta": self.theta.tolist(),
            "information": [row[: k + 1] for k, row in enumerate(self.information.tolist())],
        }

    @classmethod
    def from_dict(cls, data: Mapping[str, Any], nominal: Model) -> Rival:
        """What ``to_dict`` wrote down."""
        own = data["model"]
        effects = tuple(
            effects_base.make(e["effect"], e["location"], {k: v for k, v in e.items() if k not in PLACED}, "rivals")
            for e in own["effects"]
        )
        model = Model(nominal.robot.with_parameters(own["parameters"]), effects, nominal.phase)
        model = model.with_groups(own["by_group"]) if own["by_group"] else model
        free = tuple(FreeParameter(**{**f, "also": tuple(f["also"])}) for f in data["free"])
        lower = np.zeros((len(free), len(free)))
        for k, row in enumerate(data["information"]):
            lower[k, : k + 1] = row
        return cls(
            tuple(Named(e["effect"], tuple(e["locations"]), e.get("each", False)) for e in data["effects"]),
            FreeParameters(model, free),
            np.array(data["theta"], dtype=np.float64),
            lower + np.tril(lower, -1).T,
            float(data["deviance"]),
            tuple(JointNoise(**own) for own in data["noise"]),
            bool(data["accepted"]),
            tuple(data.get("given", ())),
        )


PLACED = ("effect", "location")
"""Of an effect in a record, what are no parameters."""


class Diagnosed(Protocol):
    """What of a diagnosis its rivals are made of, see ``results.Diagnosis``."""

    @property
    def verdict(self) -> str: ...
    @property
    def model(self) -> Model: ...
    @property
    def best(self) -> Fitted: ...
    @property
    def train(self) -> tuple[Segment, ...]: ...
    @property
    def unexplained(self) -> tuple[Unexplained, ...]: ...
    @property
    def explanations(self) -> tuple[Fitted, ...]: ...
    @property
    def nearest(self) -> tuple[Fitted, ...]: ...
    @property
    def below(self) -> tuple[Hypothesis, ...]: ...
    @property
    def base(self) -> Fitted: ...
    @property
    def interval(self) -> float | None: ...


@dataclass(frozen=True)
class Missing:
    """Where something is missing that has no name, and on what it depends.

    Attributes:
        location: joint.
        depends_on: the coordinates as text; "" where none is known.
        places: actuators or joints at which it acts.
    """

    location: str
    depends_on: str
    places: tuple[str, ...]


@dataclass(frozen=True, eq=False, repr=False)
class Rivals(Short):
    """The explanations that a diagnosis leaves, the one that it names first, and how the robot is measured.

    Attributes:
        model: the nominal one.
        rivals: see ``Rival``.
        noise: of every joint, and of every other channel that was compared.
        rate: samples per second.
        n: how many numbers have been measured.
        channels: what is compared beside joint positions.
        zeros: joints whose sensors' zeros are unknown in each recording.
        linear: whether commands go along a line from each row to the next.
        start: (nj,) where the joints were when recordings began [rad or m].
        rest: (na,) commands in force before them.
        interval: length of the shooting intervals that are fitted [s]; None where trials are simulated whole.
        trust: (2 nj,) in starts that are read off, see ``Segment.trust``; None where they are simulated whole.
        engine: that simulates.
        step: physics step [s]; None for the engine's own choice.
        unexplained: what has no name.
        verdict: of the diagnosis.
        fitted: share of a further trial that will be fitted: its end may be held out.
    """

    model: Model
    rivals: tuple[Rival, ...]
    noise: Noise
    rate: float
    n: int
    channels: Channels
    zeros: tuple[int, ...]
    linear: bool
    start: Array
    rest: Array
    interval: float | None
    trust: Array | None
    engine: EngineName
    step: float | None
    unexplained: tuple[Missing, ...]
    verdict: str
    fitted: float = 1.0

    def told(self) -> str:
        """How they are called."""
        return f" of {self.model.name}: {'; '.join(rival.label for rival in self.rivals)}"

    @property
    def notes(self) -> dict[str, str]:
        """That recordings of the robot have which are to be fitted as those so far."""
        robot = self.model.robot
        names = self.channels.names(robot)
        notes = {f"{ZERO}{robot.joint_names[j]}": FREE for j in self.zeros}
        notes |= {ALSO: " ".join(names)} if names else {}
        return notes | ({"interpolation": "linear"} if self.linear else {})

    @property
    def pairs(self) -> list[tuple[int, int]]:
        """(i, j) of all pairs, each both ways round: how a trial tells j from i where i is true."""
        return list(permutations(range(len(self.rivals)), 2))

    @property
    def named(self) -> tuple[Rival, ...]:
        """Those without what may only hide beside the first, see ``Rival.given``."""
        return tuple(rival for rival in self.rivals if not (rival.given and rival.accepted))

    def simulator(self, threads: int | None = None) -> Simulator:
        """The engine that fits have, at the same step."""
        return Simulator(engine_for(self.model, self.engine, self.step), threads)

    def ahead(self, first: int, second: int) -> float:
        """By how much the recordings so far favour a rival over another, −2Δln L less the cost of parameters (BIC)."""
        return self.rivals[second].score(self.n) - self.rivals[first].score(self.n)

    @classmethod
    def of(cls, diagnosis: Diagnosed) -> Rivals:
        """The rivals that a diagnosis leaves.

        They are the end of its search, what fits as well, and the end without effects whose parameters are not
        identified. Where something has no name, also what comes nearest to it; else what may hide beside the end, at
        sizes that are given, all else that is free refitted, as far as these recordings do not exclude that size.
        """
        best, problem = diagnosis.best, diagnosis.best.fit.problem
        fits = {fitted.labels: (fitted, True) for fitted in reversed((best, *diagnosis.explanations))}
        first = fits.pop(best.labels)
        fits = {best.labels: first} | dict(reversed(fits.items()))
        for fitted in diagnosis.nearest:
            fits.setdefault(fitted.labels, (fitted, False))
        noise, segments = best.noise, diagnosis.train
        found = [rival_of(fitted, noise, accepted) for fitted, accepted in fits.values()]
        found += _not_excluded(found[0], diagnosis)
        steps = np.concatenate([np.diff(s.trial.sample_times) for s in segments])
        robot, whole = diagnosis.model.robot, segments[0]
        at_rest = robot.traits.starts_at_rest
        nj = whole.measured.shape[1]
        read_off = () if at_rest else segments
        trusts = [np.repeat([1.0, s.slope_span / 2], nj) if s.trust is None else s.trust for s in read_off]
        return cls(
            diagnosis.model,
            tuple(found),
            noise,
            float(1.0 / np.median(steps)),
            sum(s.outputs.size for s in segments),
            whole.channels,
            whole.zeros,
            whole.trial.linear,
            np.array(whole.start[:nj]),
            np.array(whole.trial.before),
            diagnosis.interval,
            np.median(trusts, axis=0) if trusts else None,
            problem.simulator.engine.name,
            problem.simulator.engine.step,
            tuple(
                Missing(own.location, own.depends_on, getattr(own, "places", (own.location,)))
                for own in diagnosis.unexplained
            ),
            diagnosis.verdict,
        )

    def to_dict(self) -> dict[str, Any]:
        """As JSON data; the nominal model is not among them."""
        return {
            "verdict": self.verdict,
            "robot": identity(self.model),
            "explanations": [rival.to_dict(self.model) for rival in self.rivals],
            "noise": [asdict(own) for own in self.noise],
            "rate_hz": self.rate,
            "n": self.n,
            "channels": {
                "velocities": list(self.channels.velocities),
                "sites": [list(own) for own in self.channels.sites],
                "forces": list(self.channels.forces),
            },
            "zeros": list(self.zeros),
            "linear": self.linear,
            "start": self.start.tolist(),
            "rest": self.rest.tolist(),
            "interval_s": self.interval,
            "trust": None if self.trust is None else self.trust.tolist(),
            "engine": self.engine,
            "step_s": self.step,
            "unexplained": [{**asdict(own), "places": list(own.places)} for own in self.unexplained],
        }

    @classmethod
    def from_dict(cls, data: Mapping[str, Any], model: Model) -> Rivals:
        """What ``to_dict`` wrote down.

        Args:
            data: the key ``rivals`` of a diagnosis' record.
            model: the nominal model that was diagnosed.

        Raises:
            ConfigError: where the model is another one.
        """
        if data["robot"] != identity(model):
            raise ConfigError(
                f"{model.name} is not the model that was diagnosed: its joints, actuators, parameters or XML are "
                "others; expected the one that the record is of"
            )
        return cls(
            model,
            tuple(Rival.from_dict(own, model) for own in data["explanations"]),
            tuple(JointNoise(**own) for own in data["noise"]),
            data["rate_hz"],
            data["n"],
            Channels(
                tuple(data["channels"]["velocities"]),
                tuple((name, axis) for name, axis in data["channels"]["sites"]),
                tuple(data["channels"]["forces"]),
            ),
            tuple(data["zeros"]),
            data["linear"],
            np.array(data["start"], dtype=np.float64),
            np.array(data["rest"], dtype=np.float64),
            data["interval_s"],
            None if data["trust"] is None else np.array(data["trust"], dtype=np.float64),
            data["engine"],
            data["step_s"],
            tuple(Missing(o["location"], o["depends_on"], tuple(o["places"])) for o in data["unexplained"]),
            data["verdict"],
        )


def identity(model: Model) -> str:
    """Hexadecimal digits that tell a nominal model's robot from others."""
    robot = model.robot
    whole = [model.phase, robot.joint_names, robot.actuator_names, robot.parameters(), robot.fingerprint]
    return hashlib.sha256(json.dumps(whole, sort_keys=True).encode()).hexdigest()


def rival_of(fitted: Fitted, noise: Noise, accepted: bool = True) -> Rival:
    """What predictions need of a fitted hypothesis, under a noise."""
    return Rival(
        named_effects(fitted.candidates),
        fitted.fit.parameters,
        fitted.fit.theta,
        information(fitted.fit, noise),
        fitted.deviance,
        fitted.noise,
        accepted,
    )


def named_effects(candidates: Sequence[Candidate]) -> tuple[Named, ...]:
    """The effects of candidates and their places."""
    return tuple(Named(c.effect.name, c.locations, c.each) for c in candidates)


def refitted_to(rival: Rival, diagnosis: Diagnosed) -> Rival:
    """A rival fitted to what a diagnosis fitted, from where it is; its noise estimated along.

    Raises:
        SimulationDiverged: where it cannot follow these trials at all.
    """
    best, segments = diagnosis.best, diagnosis.train
    simulator = best.fit.problem.simulator
    policy = SearchPolicy.of(diagnosis.model.robot.traits, simulator.engine)
    data = Data(rival.parameters, segments, simulator, policy=policy)
    begin = (rival.theta, [segment.start for segment in segments])
    found = data.converge(data.coarse_fit((), [begin], best.noise, STEPS))
    return replace(
        rival,
        theta=found.fit.theta,
        information=information(found.fit, best.noise),
        deviance=found.deviance,
        noise=found.noise,
    )


def _not_excluded(first: Rival, diagnosis: Diagnosed) -> list[Rival]:
    """What may hide beside the end and fits as well, by the rule by which a diagnosis distinguishes explanations.

    Of sizes of the same effect it is the first; of effects more they are the first ``MOST_HIDDEN``.
    """
    engine = diagnosis.best.fit.problem.simulator.engine
    many_minima = SearchPolicy.of(diagnosis.model.robot.traits, engine).many_minima
    n, found = sum(s.outputs.size for s in diagnosis.train), dict[tuple[Named, ...], Rival]()
    for hypothesis in diagnosis.below:
        effects = named_effects([part.candidate for part in hypothesis])
        several = sum(len(labels) > len(first.effects) for labels in found)
        if effects in found or (len(effects) > len(first.effects) and several == MOST_HIDDEN):
            continue
        parameters = parameters_of(diagnosis.base.fit.parameters, hypothesis)
        values = [value for part in hypothesis for value in part.values.values()]
        theta = np.concatenate([first.theta[: len(parameters.free) - len(values)], values])
        given = given_names(diagnosis.base.fit.parameters.model, hypothesis)
        begun = replace(first, effects=effects, parameters=parameters, theta=theta, given=given)
        try:
            rival = refitted_to(begun, diagnosis)
        except SimulationDiverged:  # of that size it is not there
            continue
        if rival.score(n) - first.score(n) <= equally_good(Thresholds(), n, many_minima):
            found[effects] = rival
    return list(found.values())
