"""The thresholds that decide a verdict: each with its meaning, unit and origin, and where it is asked.

`equimus-ctrl list thresholds` shows them, and benchmarks/thresholds.py varies them. ``other_numbers`` lists the rest,
which stand where they are used: what bounds what is looked at, what belongs to a method, and what keeps arithmetic
sound.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, fields, replace

from equimus_ctrl.diagnosis.threshold import Threshold, decided_by
from equimus_ctrl.identification.noise import COLOUR, LONGEST

PROOFS = "rates of `prove` over it: benchmarks/thresholds.py, docs/proof.md"
"""Of what is calibrated: how the proof's answers move when the number is halved and doubled."""
DEVIANCE = "−2Δln L"


@dataclass(frozen=True)
class Thresholds:
    """The thresholds that decide findings and unexplained residuals.

    Each is a field with its unit, meaning and origin; ``listed`` gives them all. Decisions are asked of ``decides``,
    but for the few that are ``Threshold.read``.
    """

    significance: float = decided_by(
        1e-3,
        "",
        "probability of accepting any effect where none is missing, over all candidates (false alarm): by −2Δln L, by "
        "how its gain stands out from the scatter of blocks, and of what a search in the torque domain begins with",
        "theory",
        "likelihood-ratio test, Wilks (1938), with Bonferroni's correction for the number of candidates",
        where="block_scatter scoring simulated torque_start",
    )
    simulation_error: float = decided_by(
        1.5e-3,
        "noise variances",
        "least share of the noise's variance that an effect or a residual force has to explain, for as many "
        "samples as there are: two simulators of one robot differ by some of that. Alternatives that differ by no more "
        "fit as well",
        "calibration",
        PROOFS,
        where="scoring unexplained",
    )
    colour: float = decided_by(
        COLOUR,
        DEVIANCE,
        "a joint's noise is taken to be correlated over time from this gain over white noise on",
        "theory",
        "likelihood-ratio test (Wilks, 1938) of two more parameters, size and time, at the level 0.0025",
        where="fitting",
    )
    longest_noise: float = decided_by(
        LONGEST,
        "s",
        "longest correlation of noise: residuals that last longer are not taken for noise, but for missing physics",
        "convention",
        "noise of measurements that were low-passed both ways at 6 Hz, as of motion capture, counts as noise, a swing "
        "of a second does not",
        where="fitting noise_size",
        read=True,
    )
    minima_scatter: float = decided_by(
        20.0,
        DEVIANCE,
        "by so much deviances scatter with where a fit ends, where it has many local minima: an effect has to gain so "
        "much more there, and alternatives that differ by so much more fit as well",
        "calibration",
        PROOFS,
        where="scoring",
    )
    indistinguishable: float = decided_by(
        10.0,
        DEVIANCE,
        "hypotheses whose scores differ by less fit as well (BIC, whatever the number of parameters): alternatives are "
        "listed, and one at fewer places, or one in the place of several or of one that is not confirmed, is taken. "
        "Predictions that differ by less in χ² are alike: a second effect is tried beside one of the two, and a "
        "direction of a law's parameters along which no more changes does not count; so a law of more parameters has "
        "to be better by as much to take another's place by its dimensions",
        "convention",
        "evidence above 10 is very strong, a Bayes factor of 150: Kass & Raftery (1995), 3.2",
        where="alternatives fitting imitators scoring search",
    )
    indistinguishable_share: float = decided_by(
        0.05,
        "of the gain",
        "where something stays unexplained, alternatives are listed that lack less than this share of an effect's own "
        "gain, if that is more than indistinguishable",
        "calibration",
        PROOFS,
        where="findings",
    )
    fewer_places_share: float = decided_by(
        0.05,
        "of the gain",
        "an effect that loses less than this share of its gain at one place less is not sure to be at that place: "
        "other effects are exchanged beside it at fewer, too",
        "calibration",
        PROOFS,
        where="alternatives",
    )
    generalised_share: float = decided_by(
        0.05,
        "of the gain",
        "a law is another one where a force left at its joint, which depends on more than the law, gains more than "
        "this share of what the law gains: by residuals, and in the torque domain, which else keeps the law; or where "
        "friction over the angle gains that more in its place, and the law less beside it",
        "calibration",
        PROOFS,
        where="smooth_laws unexplained friction_over_angle",
    )
    exchange: float = decided_by(
        1.0,
        DEVIANCE,
        "least difference of score for which an effect is exchanged for another",
        "theory",
        "either fit may end fitting.CONVERGED_GAIN above its minimum, so less than twice that ranks nothing",
        where="scoring",
    )
    as_simulated: float = decided_by(
        0.1,
        "",
        "recordings are taken for MuJoCo's where they show its discretisation error once, give or take this share of "
        "it or what noise leaves open",
        "convention",
        "the error is known to first order, at parameters that have taken up some of it; a robot shows it 0 times",
        where="simulated",
    )
    step_unsure: float = decided_by(
        0.01,
        "of the discretisation error",
        "where MuJoCo made the recordings, residuals below this share of its discretisation error are no physics: what "
        "it is depends on the motion, and is known to first order",
        "convention",
        "after the last round it changes by far less; where friction stops a joint it changes by steps",
        where="simulated",
        read=True,
    )
    step_scatter: float = decided_by(
        60.0,
        DEVIANCE,
        "alternatives within so much more are fitted whole, and simulated again with finer steps, before they are "
        "compared",
        "calibration",
        PROOFS,
        where="extensions findings",
    )
    validation_share: float = decided_by(
        0.25,
        "",
        "least gain on validation trials for each sample, over that on the trials fitted, or over what these can show, "
        "of an effect that is confirmed, and of all departures from the nominal parameters together",
        "theory",
        "a gain Δ expected there is normal with variance 4Δ; at the least gain that is accepted, about 20, 5 % of true "
        "effects gain less than 20 − 1.64·2·√20 = 5.3, a quarter",
        where="confirmation units_compared",
    )
    torque_share: float = decided_by(
        0.25,
        "",
        "least share of what a smooth force at a joint would explain of the forces along the measured motion, at the "
        "size that simulation found, that it does explain there: else the search does not take it, and it is not "
        "confirmed",
        "convention",
        "the sizes found in the two ways then differ by a factor of two",
        where="confirmation torque_agreement",
    )
    uninformative: float = decided_by(
        16.0,
        "χ²",
        "validation trials, or forces along the measured motion, on which two models differ by less do not decide "
        "between them, and half of a kind of validation trials whose χ² rises by less gets no worse",
        "theory",
        "the gain of the true one, 16 in the mean, is then two of its standard deviations, 2·√16, above nothing",
        where="confirmation extensions torque_agreement",
    )
    evident: float = decided_by(
        5.0,
        "least gains",
        "an effect that validation trials cannot show is accepted from so many times the least gain on",
        "calibration",
        PROOFS,
        where="confirmation",
    )
    residual_gain: float = decided_by(
        40.0,
        "χ²",
        "least fall of χ² in cross-validation for a residual force that is reported; what one has to explain more than "
        "an effect that it replaces, and what an effect beside one has to explain",
        "theory",
        "with 8 spline coefficients and some 40 forces, χ² exceeds 37 on noise with probability 1e-3 (Bonferroni)",
        where="confounding unexplained",
    )
    residual_price: float = decided_by(
        2.0,
        "χ² a coefficient",
        "what a residual force has to explain more than an effect, for each coefficient, to replace it",
        "theory",
        "Akaike (1974)",
        where="confounding",
    )
    residual_price_alone: float = decided_by(
        3.0,
        "χ² a coefficient",
        "the same of residual forces among each other, where one trial alone allows no cross-validation",
        "theory",
        "on noise a coefficient gains 1 on what is fitted and costs 1 on what is not (Akaike, 1974); one more is for "
        "the choice among forces",
        where="residual_force",
        read=True,
    )
    trace: float = decided_by(
        0.01,
        "",
        "a residual force is not reported below this share of all that the effects and it explain",
        "calibration",
        PROOFS,
        where="unexplained",
    )
    smooth_trace: float = decided_by(
        0.01,
        "of the gain",
        "a smooth force beside named laws is not reported below this share of −2Δln L of all that these and it explain",
        "convention",
        "a hundredth of the evidence; each of the two is judged by the noise that it leaves itself",
        where="smooth_laws",
    )
    smooth_asked: float = decided_by(
        0.05,
        "",
        "a smooth force beside named laws is simulated where the torque domain explains by it what chance would with "
        "at most this probability, over all that are asked for; one that is not is not reported",
        "convention",
        "mild, for simulation accepts it or not at the level of significance",
        where="forces_beside",
    )
    replaces_one: float = decided_by(
        0.85,
        "",
        "a residual force stands in for an effect and what remains from this share of what both explain on",
        "calibration",
        PROOFS,
        where="unexplained",
    )
    replaces_restated: float = decided_by(
        1.1,
        "",
        "the same for a residual force that depends on more than the effect's own law",
        "calibration",
        PROOFS,
        where="unexplained",
    )
    replaces_all: float = decided_by(
        0.97,
        "",
        "one residual force stands in for several effects from this share of what they explain on",
        "calibration",
        PROOFS,
        where="unexplained",
    )
    drawn: float = decided_by(
        0.03,
        "of a force's square",
        "a smooth force beside a friction law could be that law where it leaves less of it: then its gain says nothing "
        "of the law",
        "theory",
        "of evenly spread speeds six cubic splines leave 0.0001 of v|v|, 0.004 of |v| and 0.08 of sign(v)",
        where="smooth_laws",
    )
    no_constant: float = decided_by(
        0.05,
        "of a force's square",
        "damping is another law than viscous friction where more of the speed times a function of the angle is not the "
        "speed times a constant, and dry friction over the angle another than a friction law where more of it is no "
        "multiple of that",
        "convention",
        "the damping's standard deviation is then 23 % of its mean",
        where="forces_beside",
    )
    linear_share: float = decided_by(
        0.3,
        "",
        "a linear model that reproduces less of the rise of χ² without an effect does not decide on it",
        "calibration",
        PROOFS,
        where="confounding",
    )
    far_off: float = decided_by(
        3.0,
        "noise variances",
        "excess residual variance of a joint from which on it is unexplained, whatever it depends on",
        "convention",
        "a normalised RMSE of 2",
        where="unexplained",
    )
    noise_bound: float = decided_by(
        1e-3,
        "",
        "probability that a joint's noise is larger than the second differences of its residuals are taken to allow",
        "theory",
        "upper confidence limit of a variance: χ² of as many second differences as share no samples",
        where="noise_size",
        read=True,
    )
    blocks: float = decided_by(
        24.0,
        "",
        "so many blocks of the recordings, with equal shares of what an effect changes, tell how residuals scatter",
        "convention",
        "few, so that each outlasts what residuals remember; with 24 an effect of one parameter has to gain 1.5 times "
        "what it would if their scatter were known (F over χ² at the level 1e-3 of 40 candidates)",
        where="scoring",
    )
    scattered: float = decided_by(
        1e-3,
        "",
        "probability that residuals that are noise alone are taken to scatter more over blocks than their noise",
        "theory",
        "upper confidence limit of a variance: χ² of as many blocks less one",
        where="block_scatter",
    )
    outdone: float = decided_by(
        0.5,
        "",
        "an effect that explains less of what a residual force would, or of all that there is, is not what is missing",
        "calibration",
        PROOFS,
        where="search",
    )
    runner_up: float = decided_by(
        0.7,
        "",
        "a first effect with this share of the best one's gain is given a second effect as well; where minima are "
        "many, at the end too, where the best one has more parameters",
        "calibration",
        PROOFS,
        where="imitators search",
    )
    step_matters: float = decided_by(
        1e-3,
        "noise variances",
        "a finer physics step that changes less than this is not looked at",
        "convention",
        "below what an effect has to explain (simulation_error)",
        where="discretization",
    )
    step_explains: float = decided_by(
        4.0,
        "",
        "an effect that gains less than so many times what a finer step changes may be the discretisation error",
        "theory",
        "two standard deviations of the change",
        where="discretization",
    )
    refit_far_above_noise: float = decided_by(
        1.5,
        "noise",
        "from this RMSE on more is left than noise: other local minima are looked for",
        "calibration",
        PROOFS,
        where="fitting",
    )
    refit_strong: float = decided_by(
        4.0,
        "noise",
        "from this RMSE on derivatives at the refitted model predict little: the nominal one is screened at too, and "
        "where minima are many all candidates are fitted, if none of the promising ones is accepted",
        "calibration",
        PROOFS,
        where="fitting",
    )
    absorbed: float = decided_by(
        20.0,
        "",
        "a change of which free parameters undo all but one part in so many is looked at with them moved along",
        "calibration",
        PROOFS,
        where="moved_parameters",
    )
    covered: float = decided_by(
        0.9,
        "of the bounds",
        "an effect is not named where the interval of a parameter covers so much of what the parameter can be",
        "convention",
        "such an interval says nothing: of an even spread over the bounds, 95 % would cover 0.95 of them",
        where="findings",
    )
    worse: float = decided_by(
        0.1,
        "of χ²",
        "an effect is rejected where the first or second half of a kind of held-out trials gets worse by more than "
        "this share of what the refitted model leaves",
        "convention",
        "5 % of the error: residuals of real robots differ by so much without any reason to prefer one model",
        where="confirmation",
    )
    worse_by_chance: float = decided_by(
        1.64,
        "standard deviations",
        "and by more than so many of what it would get worse by chance",
        "theory",
        "5 % of a normal distribution; χ² of two models that are as good differs by 2·√(χ² of their difference)",
        where="confirmation",
    )
    failed: float = decided_by(
        10.0,
        "",
        "a fit whose error on validation trials is so many times that on the fitted ones failed; it names nothing",
        "convention",
        "what was fitted says nothing of other trials then",
        where="stages",
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
