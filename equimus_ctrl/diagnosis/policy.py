"""How a diagnosis fits and searches, and each threshold that decides a verdict: meaning, unit and origin."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, fields, replace
from typing import Any, Literal

from equimus_ctrl.engines.base import Engine
from equimus_ctrl.identification.noise import COLOUR
from equimus_ctrl.robots.base import RobotTraits

Basis = Literal["theory", "convention", "calibration"]
"""Where a number comes from: what follows from statistics, what a field agrees on, or what proofs showed to work."""


@dataclass(frozen=True)
class Origin:
    """Where a threshold comes from.

    Attributes:
        basis: what kind of reason there is.
        why: the reason, with its source or the script that reproduces it.
    """

    basis: Basis
    why: str


@dataclass(frozen=True)
class Threshold:
    """One number that decides.

    Attributes:
        name: in ``Thresholds``.
        value: by default.
        unit: of it; "" for a ratio.
        meaning: what it decides.
        origin: where it comes from.
    """

    name: str
    value: float
    unit: str
    meaning: str
    origin: Origin


PROOFS = "rates of `prove` over it: benchmarks/thresholds.py, docs/proof.md"
"""Of what is calibrated: how the proof's answers move when the number is halved and doubled."""
DEVIANCE = "−2Δln L"


def _decides(value: float, unit: str, meaning: str, basis: Basis, why: str) -> Any:
    return field(default=value, metadata={"unit": unit, "meaning": meaning, "origin": Origin(basis, why)})


@dataclass(frozen=True)
class Thresholds:
    """The thresholds that decide findings and unexplained residuals.

    Each is a field with its unit, meaning and origin; ``listed`` gives them all. Decisions are asked of ``decides``.
    """

    significance: float = _decides(
        1e-3,
        "",
        "probability of accepting any effect where none is missing, over all candidates (false alarm)",
        "theory",
        "likelihood-ratio test, Wilks (1938), with Bonferroni's correction for the number of candidates",
    )
    simulation_error: float = _decides(
        1.5e-3,
        "noise variances",
        "least share of the noise's variance that an effect or a residual force has to explain, for as many "
        "samples as there are: two simulators of one robot differ by some of that",
        "calibration",
        PROOFS,
    )
    colour: float = _decides(
        COLOUR,
        DEVIANCE,
        "a joint's noise is taken to be correlated over time from this gain over white noise on",
        "theory",
        "likelihood-ratio test (Wilks, 1938) of two more parameters, size and time, at the level 0.0025",
    )
    minima_scatter: float = _decides(
        20.0,
        DEVIANCE,
        "by so much deviances scatter with where a fit ends, where it has many local minima",
        "calibration",
        PROOFS,
    )
    indistinguishable: float = _decides(
        10.0,
        DEVIANCE,
        "hypotheses with as many parameters that differ by less are not distinguishable",
        "convention",
        "evidence above 10 is very strong, a Bayes factor of 150: Kass & Raftery (1995), 3.2",
    )
    indistinguishable_share: float = _decides(
        0.05,
        "of the gain",
        "the same as a share of an effect's own gain, where something stays unexplained",
        "calibration",
        PROOFS,
    )
    step_scatter: float = _decides(
        60.0,
        DEVIANCE,
        "alternatives within so much more are simulated again with finer steps before they are compared",
        "calibration",
        PROOFS,
    )
    validation_share: float = _decides(
        0.25,
        "",
        "least gain on validation trials for each sample, over that on the trials fitted, of an effect that is "
        "confirmed",
        "theory",
        "a gain Δ expected there is normal with variance 4Δ; at the least gain that is accepted, about 20, 5 % of true "
        "effects gain less than 20 − 1.64·2·√20 = 5.3, a quarter",
    )
    torque_share: float = _decides(
        0.25,
        "",
        "least share of what a smooth force at a joint would explain of the forces along the measured motion, at the "
        "size that simulation found, that it does explain there",
        "convention",
        "the sizes found in the two ways then differ by a factor of two",
    )
    uninformative: float = _decides(
        16.0,
        "χ²",
        "validation trials, or measured forces, on which two models differ by less do not decide between them",
        "theory",
        "the gain of the true one, 16 in the mean, is then two of its standard deviations, 2·√16, above nothing",
    )
    evident: float = _decides(
        5.0,
        "least gains",
        "an effect that validation trials cannot show is accepted from so many times the least gain on",
        "calibration",
        PROOFS,
    )
    residual_gain: float = _decides(
        40.0,
        "χ²",
        "least fall of χ² in cross-validation for a residual force; what an effect beside one has to explain",
        "theory",
        "with 8 spline coefficients and some 40 forces, χ² exceeds 37 on noise with probability 1e-3 (Bonferroni)",
    )
    residual_price: float = _decides(
        2.0,
        "χ² a coefficient",
        "what a residual force has to explain more than an effect, for each coefficient, to replace it",
        "theory",
        "Akaike (1974)",
    )
    residual_price_alone: float = _decides(
        3.0,
        "χ² a coefficient",
        "the same of residual forces among each other, where one trial alone allows no cross-validation",
        "theory",
        "on noise a coefficient gains 1 on what is fitted and costs 1 on what is not (Akaike, 1974); one more is for "
        "the choice among forces",
    )
    trace: float = _decides(
        0.01,
        "",
        "a residual force is not reported below this share of all that the effects and it explain",
        "calibration",
        PROOFS,
    )
    smooth_trace: float = _decides(
        0.01,
        "of the gain",
        "a smooth force beside named laws is not reported below this share of −2Δln L of all that these and it explain",
        "convention",
        "a hundredth of the evidence; each of the two is judged by the noise that it leaves itself",
    )
    replaces_one: float = _decides(
        0.85,
        "",
        "a residual force stands in for an effect and what remains from this share of what both explain on",
        "calibration",
        PROOFS,
    )
    replaces_restated: float = _decides(
        1.1,
        "",
        "the same for a residual force that depends on more than the effect's own law",
        "calibration",
        PROOFS,
    )
    replaces_all: float = _decides(
        0.97,
        "",
        "one residual force stands in for several effects from this share of what they explain on",
        "calibration",
        PROOFS,
    )
    drawn: float = _decides(
        0.03,
        "of a force's square",
        "a smooth force beside a friction law could be that law where it leaves less of it: then its gain says nothing "
        "of the law",
        "theory",
        "of evenly spread speeds six cubic splines leave 0.0001 of v|v|, 0.004 of |v| and 0.08 of sign(v)",
    )
    no_constant: float = _decides(
        0.05,
        "of a force's square",
        "damping is another law than viscous friction where more of the speed times a function of the angle is not the "
        "speed times a constant",
        "convention",
        "the damping's standard deviation is then 23 % of its mean",
    )
    linear_share: float = _decides(
        0.3,
        "",
        "a linear model that reproduces less of the rise of χ² without an effect does not decide on it",
        "calibration",
        PROOFS,
    )
    far_off: float = _decides(
        3.0,
        "noise variances",
        "excess residual variance of a joint from which on it is unexplained, whatever it depends on",
        "convention",
        "a normalised RMSE of 2",
    )
    noise_bound: float = _decides(
        1e-3,
        "",
        "probability that a joint's noise is larger than the second differences of its residuals are taken to allow",
        "theory",
        "upper confidence limit of a variance: χ² of as many second differences as share no samples",
    )
    blocks: float = _decides(
        24.0,
        "",
        "so many blocks of the recordings, with equal shares of what an effect changes, tell how residuals scatter",
        "convention",
        "few, so that each outlasts what residuals remember; with 24 an effect of one parameter has to gain 1.5 times "
        "what it would if their scatter were known (F over χ² at the level 1e-3 of 40 candidates)",
    )
    scattered: float = _decides(
        1e-3,
        "",
        "probability that residuals that are noise alone are taken to scatter more over blocks than their noise",
        "theory",
        "upper confidence limit of a variance: χ² of as many blocks less one",
    )
    outdone: float = _decides(
        0.5,
        "",
        "an effect that explains less of what a residual force would is not what is missing",
        "calibration",
        PROOFS,
    )
    runner_up: float = _decides(
        0.7,
        "",
        "a first effect with this share of the best one's gain is given a second effect as well",
        "calibration",
        PROOFS,
    )
    step_matters: float = _decides(
        1e-3,
        "noise variances",
        "a finer physics step that changes less than this is not looked at",
        "convention",
        "below what an effect has to explain (simulation_error)",
    )
    step_explains: float = _decides(
        4.0,
        "",
        "an effect that gains less than so many times what a finer step changes may be the step's error",
        "theory",
        "two standard deviations of the change",
    )
    refit_far_above_noise: float = _decides(
        1.5,
        "noise",
        "from this RMSE on more is left than noise: other local minima are looked for",
        "calibration",
        PROOFS,
    )
    refit_strong: float = _decides(
        4.0,
        "noise",
        "from this RMSE on derivatives at the refitted model predict little: the nominal one is screened at too",
        "calibration",
        PROOFS,
    )
    absorbed: float = _decides(
        20.0,
        "",
        "a change of which free parameters undo all but one part in so many is looked at with them moved along",
        "calibration",
        PROOFS,
    )
    covered: float = _decides(
        0.9,
        "of the bounds",
        "an effect is not named where the interval of a parameter covers so much of what the parameter can be",
        "convention",
        "such an interval says nothing: of an even spread over the bounds, 95 % would cover 0.95 of them",
    )
    worse: float = _decides(
        0.1,
        "of χ²",
        "an effect is rejected where the first or second half of a kind of held-out trials gets worse by more than "
        "this share of what the refitted model leaves",
        "convention",
        "5 % of the error: residuals of real robots differ by so much without any reason to prefer one model",
    )
    failed: float = _decides(
        10.0,
        "",
        "a fit whose error on validation trials is so many times that on the fitted ones failed; it names nothing",
        "convention",
        "what was fitted says nothing of other trials then",
    )
    watch: Callable[[Callable[[Thresholds], bool], bool], None] | None = field(default=None, compare=False, repr=False)
    """Called with every decision and its outcome, to vary the thresholds."""

    @classmethod
    def listed(cls) -> Iterator[Threshold]:
        """All of them."""
        for own in fields(cls):
            if own.metadata:
                yield Threshold(own.name, own.default, **own.metadata)  # type: ignore[arg-type]

    def decides(self, condition: Callable[[Thresholds], bool]) -> bool:
        """Whether a condition on these thresholds holds."""
        holds = bool(condition(self))
        if self.watch is not None:
            self.watch(condition, holds)
        return holds

    def scaled(self, name: str, factor: float) -> Thresholds:
        """The same with one of them times a factor."""
        return replace(self, **{name: getattr(self, name) * factor})


@dataclass(frozen=True)
class SearchSettings:
    """How much a search looks at. None of these numbers accepts anything: more of each takes longer and misses less.

    Attributes:
        most_parts: largest number of effects in a hypothesis.
        rounds_per_part: rounds for each of them, at most: each adds a part, and may drop another beside it.
        tried: candidates fitted at each step, for each whitening of the residuals.
        tried_in_place: the same of candidates that are to take a part's place.
        kept: of them, how many are fitted until converged, where fits have few minima others too that still gain,
        kept_share: where they lack less than this share of the best one's gain in −2 ln L,
        kept_gain: and this much.
        rival_share: in the place of a part, only what lacks less than this share of its gain is fitted until converged.
        optimism: beside other parts, fits gain at most so many times what is expected to first order, and converged
            fits so many times what quick ones gain: what then gains less than the best one, or than the acceptance
            threshold, is not fitted further. Gains to first order
            were exceeded up to 1.7 times on the real leg's recordings.
        coarse_steps: iterations of a first fit.
        long_steps: iterations of the next fit, of the few that are best by then.
        runners_up: so many others than the best first part, of those with about as much gain, are given a second too.
        exchanges: rounds in which parts are exchanged, at most.
        contests: how often each part's alternatives are fitted beside the other parts.
        contenders: how many of its alternatives are.
        unconfirmed: hypotheses tried in the place of one that held-out trials do not confirm.
        again: how often a search goes on beside the accepted effects where residual forces made others redundant. If
            it comes to such effects again, the residuals stay unexplained.
        patience: how many effects in a row may explain far less than a residual force: of two missing effects each
            alone may.
        many_minima: whether fits have many local minima because errors grow along a trial. First-order gains then
            predict little. So all candidates are tried where the promising ones are not accepted and residuals are
            large, and a part's alternatives are taken from all hypotheses fitted.
    """

    most_parts: int = 4
    rounds_per_part: int = 2
    tried: int = 5
    tried_in_place: int = 3
    kept: int = 3
    kept_share: float = 0.5
    kept_gain: float = 50.0
    rival_share: float = 0.3
    optimism: float = 3.0
    coarse_steps: int = 5
    long_steps: int = 15
    runners_up: int = 2
    exchanges: int = 8
    contests: int = 2
    contenders: int = 2
    unconfirmed: int = 3
    again: int = 1
    patience: int = 0
    many_minima: bool = False


@dataclass(frozen=True)
class SearchPolicy:
    """What a diagnosis does beside the user's settings.

    Attributes:
        coarse_derivatives: quick fits take derivatives from the coarser engine and end at small gains, for a
            simulation is costly.
        rescaled_guesses: guesses whose change far exceeds the residuals are tried rescaled too. Errors add up along a
            trial, so a large change predicts little of a smaller one.
        many_minima: see ``SearchSettings``.
    """

    coarse_derivatives: bool = False
    rescaled_guesses: bool = False
    many_minima: bool = False

    @classmethod
    def of(cls, traits: RobotTraits, engine: Engine) -> SearchPolicy:
        """The policy for a robot on an engine."""
        add_up = not traits.held_in_place
        return cls(coarse_derivatives=engine.costly, rescaled_guesses=add_up, many_minima=add_up)

    def applied(self, settings: SearchSettings) -> SearchSettings:
        """Settings of a search with what this policy asks for."""
        return replace(settings, patience=PATIENCE, many_minima=True) if self.many_minima else settings


PATIENCE = 1
"""Where fits have many local minima, see ``SearchSettings``: forces at joints do much alike there, and rub."""
