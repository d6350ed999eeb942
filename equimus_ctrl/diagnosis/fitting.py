"""Hypotheses fitted to recordings: all parameters free, the noise estimated along."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import chain

import numpy as np
from scipy.special import chdtri

from equimus_ctrl import computer
from equimus_ctrl.diagnosis.budget import Budget
from equimus_ctrl.diagnosis.hypothesis import Candidate, Hypothesis, Part, parameters_of, refined
from equimus_ctrl.diagnosis.policy import SearchPolicy
from equimus_ctrl.diagnosis.thresholds import Thresholds
from equimus_ctrl.errors import SimulationDiverged
from equimus_ctrl.identification.fit import Begin, Fit, FitSettings, fit
from equimus_ctrl.identification.noise import (
    Noise,
    estimate_noise,
    log_likelihood,
    noise_of_differences,
    white_noise,
    whiten,
)
from equimus_ctrl.identification.parameters import FreeParameters
from equimus_ctrl.identification.projection import Nuisance
from equimus_ctrl.identification.residuals import followed
from equimus_ctrl.identification.segments import Segment, led_along
from equimus_ctrl.identification.simulators import Simulator
from equimus_ctrl.identification.whitened_fit import whiten_fit
from equimus_ctrl.shown import Short
from equimus_ctrl.types import Array

ROUNDS = 4
"""How often noise and parameters are estimated in turn, at most."""
GRID_NARROWER = 5.0
"""The factor by which each grid of a scan is narrower than the one before."""
PROFILE_STEPS = 1e-5 * 3.0 ** np.arange(11)
"""Changes of ln θ at which the profile likelihood of a discontinuous parameter is evaluated, to either side."""
PROFILE_FALL = 3.84
"""Fall of 2 log L at the ends of a 95 % interval: the 95 % quantile of χ²(1)."""


@dataclass(frozen=True)
class GridScan:
    """How a discontinuous parameter θ is scanned.

    Attributes:
        times: how often, going on from the best value, at most.
        count: of values in a grid.
        width: half width of the first grid in ln θ.
        levels: grids, each ``GRID_NARROWER`` times narrower than the one before.
        but: labels of parts whose parameters are not scanned.
    """

    times: int
    count: int
    width: float = 0.4
    levels: int = 4
    but: frozenset[str] = frozenset()


FULL_SCAN, QUICK_SCAN = GridScan(3, 47), GridScan(1, 15)
"""Of a full fit and of a quick one."""
AGAIN = GridScan(1, 15, 0.4 / GRID_NARROWER, 3)
"""Of a full fit that goes on from one, under a noise that is little else."""
COARSE_TOLERANCE = 10
"""Factor on the tolerance of a quick fit whose derivatives are those of the coarse engine."""
NO_STEP = FitSettings(1e-5, 0)
"""The parameters as they are."""
FROM_SHORT = FitSettings(1e-6, 60)
"""Of a search that begins at the fit to short shooting intervals, towards an ill-conditioned minimum."""
CONVERGED_GAIN = 0.5
"""Gain of 2 log L below which a fit counts as converged."""
BLIND = 1e-6
"""Change of the predictions over all that a parameter can be, by derivatives, over the largest of all parameters: below
it they are even in it there."""
BESIDE, BESIDE_STEPS = (0.005, 0.02, 0.05), 30
"""Shares of all that such a parameter can be, by which fits begin beside it, and their steps."""


@dataclass(frozen=True, eq=False, repr=False)
class Fitted(Short):
    """A fitted hypothesis.

    Attributes:
        hypothesis: with the estimates.
        fit: of all parameters.
        noise: that its residuals have.
        deviance: −2 log likelihood under that noise, without constant terms.
    """

    hypothesis: Hypothesis
    fit: Fit
    noise: Noise
    deviance: float

    @property
    def label(self) -> str:
        """The parts' labels."""
        return " ".join(part.candidate.label for part in self.hypothesis) or "no missing physics"

    @property
    def labels(self) -> frozenset[str]:
        """The same, whatever their order."""
        return frozenset(part.candidate.label for part in self.hypothesis)

    @property
    def candidates(self) -> tuple[Candidate, ...]:
        """Of the parts."""
        return tuple(part.candidate for part in self.hypothesis)

    @property
    def n_parameters(self) -> int:
        """Number of parameters of the effects alone."""
        return sum(part.candidate.n_parameters for part in self.hypothesis)

    @property
    def begin(self) -> Begin:
        """Where it ended, to go on from."""
        return self.fit.theta, self.fit.starts


@dataclass(frozen=True, eq=False)
class Data:
    """What hypotheses are fitted to, and how: all that a fit needs beside the hypothesis.

    Attributes:
        free: the parameters to estimate without any effect.
        segments: what was measured.
        simulator: the engine.
        coarse: a faster one, see ``screening_simulator`` and ``derivative_simulator``; the same by default. Its
            predictions are compared with its own alone.
        fine: a slower one with a smaller discretisation error; the same by default.
        policy: how they are fitted and searched.
        budget: after each step of a fit it is asked whether to go on.
        thresholds: by which fits are compared.
        least_noise: (nj + ne,) below which residuals say nothing; None where that is known of the measurements alone.
    """

    free: FreeParameters
    segments: Sequence[Segment]
    simulator: Simulator
    coarse: Simulator | None = None
    fine: Simulator | None = None
    policy: SearchPolicy = field(default_factory=SearchPolicy)
    budget: Budget = field(default_factory=Budget)
    thresholds: Thresholds = field(default_factory=Thresholds)
    least_noise: Array | None = None

    @property
    def times(self) -> list[Array]:
        """For each segment (m,) [s]."""
        return [s.trial.sample_times for s in self.segments]

    @property
    def n(self) -> int:
        """How many numbers are compared, of all joints, other channels and samples."""
        return sum(s.outputs.size for s in self.segments)

    @property
    def screening_simulator(self) -> Simulator:
        """The engine of first-order responses: of candidates, and along profiles."""
        return self.coarse or self.simulator

    @property
    def derivative_simulator(self) -> Simulator | None:
        """The engine of a quick fit's derivatives; None where it is that of its residuals."""
        return self.coarse if self.policy.coarse_derivatives else None

    @property
    def threads(self) -> int:
        """Threads among which fits, and simulations of each, are shared out."""
        return computer.worker_count(self.simulator.threads)

    def theta_of(self, theta: Array, hypothesis: Hypothesis) -> Array:
        """(p,) θ = (model parameters, effect values).

        Args:
            theta: any θ of this model, of which the model parameters are taken; effects' values may follow them.
            hypothesis: whose values are taken, part by part.
        """
        values = [value for part in hypothesis for value in part.values.values()]
        whole: Array = np.concatenate([theta[: len(self.free.free)], values])
        return whole

    def coarse_fit(
        self,
        hypothesis: Hypothesis,
        begin: Sequence[Begin],
        noise: Noise,
        steps: int,
        tolerance: float = 1e-4,
        settled: Collection[str] = (),
    ) -> Fitted:
        """A few steps of a fit under a noise that is given; the deviance is under the noise estimated at its end.

        Args:
            hypothesis: what is fitted.
            begin: the best of these is where it begins.
            noise: of the residuals.
            steps: at most.
            tolerance: of the cost, relative.
            settled: labels of parts that begin where a fit has them: discontinuous parameters of these stay there.

        Raises:
            BudgetSpent: where the budget ends.
            SimulationDiverged: where the model diverges on every segment wherever it begins.
        """
        factor = COARSE_TOLERANCE if self.policy.coarse_derivatives else 1
        settings, scan = FitSettings(tolerance * factor, steps), replace(QUICK_SCAN, but=frozenset(settled))
        after = self._fit(hypothesis, begin, noise, settings, scan, quick=True)
        return self._with_noise(hypothesis, after)

    def converge(self, fitted: Fitted, noise: Noise | None = None, settled: bool = False) -> Fitted:
        """Estimate noise and parameters in turn until the likelihood has converged.

        Where predictions may be even in a parameter (``Effect.even``), it goes on beside where that ends, if that fits
        better.

        Args:
            fitted: where it begins.
            noise: of the first iteration; by default estimated from the residuals of ``fitted``.
            settled: whether a fit has had all its discontinuous parameters where they are.

        Raises:
            BudgetSpent, SimulationDiverged: as of ``coarse_fit``.
        """
        best = self._converged(fitted, noise, settled)
        if (beside := self._beside(best)) is None:
            return best
        return min(best, self._converged(beside, None, settled=True), key=lambda f: f.deviance)

    def _beside(self, fitted: Fitted) -> Fitted | None:
        """A hypothesis fitted from beside a value in which it is even, where that fits better; None where none does."""
        even = self._effects_own(fitted.hypothesis, lambda candidate, key: key in candidate.effect.even)
        if not even:
            return None
        own, (theta, starts), first = fitted.fit.parameters, fitted.begin, len(self.free.free)
        seen = np.sqrt(sum((slope**2).sum(axis=(0, 1)) for slope in fitted.fit.jacobians)) * (own.high - own.low)
        options = [fitted]
        for k in (k for k in even if seen[k] < BLIND * seen.max()):
            for share in BESIDE:
                step = share * (own.high[k] - own.low[k])
                moved = np.where(np.arange(len(theta)) == k, theta + step, theta)
                if moved[k] > own.high[k]:
                    moved[k] = theta[k] - step
                hypothesis = refined(fitted.hypothesis, moved[first:])  # steps are in units of where it begins
                with suppress(SimulationDiverged):  # so it cannot be what happened
                    begin, labels = [(moved, starts)], fitted.labels
                    options.append(self.coarse_fit(hypothesis, begin, fitted.noise, BESIDE_STEPS, settled=labels))
        best = min(options, key=lambda f: f.deviance)
        return best if fitted.deviance - best.deviance > CONVERGED_GAIN else None

    def _converged(self, fitted: Fitted, noise: Noise | None, settled: bool) -> Fitted:
        """The same from where it begins, see ``converge``."""
        best, scan = fitted, QUICK_SCAN if settled else FULL_SCAN
        for _ in range(ROUNDS):
            steps = FitSettings(1e-5, 12)
            refitted = self._fit(best.hypothesis, [best.begin], noise or best.noise, steps, scan, earlier=best.fit)
            scan = AGAIN
            after = self._with_noise(best.hypothesis, refitted)
            gain, noise = best.deviance - after.deviance, None
            if gain > 0:
                best = after
            if gain < CONVERGED_GAIN:
                break
        return best

    def converge_finely(self, fitted: Fitted) -> Fitted:
        """The same with the fine engine, from where it is.

        Raises:
            BudgetSpent, SimulationDiverged: as of ``coarse_fit``.
        """
        if self.fine is None:
            return fitted
        finely = replace(self, simulator=self.fine, coarse=None, fine=None)
        start = finely._fit(fitted.hypothesis, [fitted.begin], fitted.noise, NO_STEP)
        return finely.converge(finely._with_noise(fitted.hypothesis, start))

    def led_by_fit(self, fitted: Fitted) -> tuple[Data, Fitted]:
        """A fit in which the motion that it predicts leads to what no sensor shows at starts, where that fits better.

        Measured motion brings its noise there, which no interval of the parameters counts. With it the data that it was
        fitted to, whose segments that motion leads. Both as they are where nothing hangs on the motion before a start.

        Args:
            fitted: to these data.

        Raises:
            BudgetSpent, SimulationDiverged: as of ``coarse_fit``.
        """
        best, own = fitted, self
        for _ in range(ROUNDS if any(s.trial.led is not None for s in self.segments) else 0):
            data, hypothesis = replace(self, segments=led_along(self.segments, best.fit.residuals)), best.hypothesis
            begun = data._fit(hypothesis, [best.begin], best.noise, NO_STEP, GridScan(0, 0))
            if all(map(np.array_equal, begun.residuals, best.fit.residuals)):
                break
            after = data.converge(data._with_noise(hypothesis, begun), settled=True)
            gain = best.deviance - after.deviance
            if gain > 0:
                best, own = after, data
            if gain < CONVERGED_GAIN:
                break
        return own, best

    def _fit(
        self,
        hypothesis: Hypothesis,
        begin: Sequence[Begin],
        noise: Noise,
        settings: FitSettings,
        scan: GridScan = FULL_SCAN,
        quick: bool = False,
        earlier: Fit | None = None,
    ) -> Fit:
        """Least squares from the best of some beginnings, with grid scans of discontinuous parameters."""
        self.budget.check()
        parameters = parameters_of(self.free, hypothesis)
        inside = [(np.clip(theta, parameters.low, parameters.high), starts) for theta, starts in begin]
        coarse = self.derivative_simulator if quick else None
        best = fit(
            parameters, self.segments, simulator=self.simulator, settings=settings, noise=noise, begin=inside,
            coarse=coarse, earlier=earlier, notify=self._after_step,
        )  # fmt: skip
        discontinuous = self.discontinuous(hypothesis, scan.but)
        for _ in range(scan.times if discontinuous else 0):
            theta = self._grid_scan(discontinuous, best, noise, scan)
            if np.array_equal(theta, best.theta):
                break
            after = fit(
                parameters, self.segments, simulator=self.simulator, settings=settings, noise=noise,
                begin=[(theta, best.starts)], coarse=coarse, notify=self._after_step,
            )  # fmt: skip
            if after.cost >= best.cost:
                break
            best = after
        return best

    def _after_step(self, evaluations: int, rmse: float) -> None:
        self.budget.check()

    def discontinuous(self, hypothesis: Hypothesis, but: Collection[str] = ()) -> list[int]:
        """Indices in θ of the discontinuous parameters, see ``Effect.discontinuous``, but those of some parts."""

        def scanned(candidate: Candidate, key: str) -> bool:
            return key in candidate.effect.discontinuous and candidate.label not in but

        return self._effects_own(hypothesis, scanned)

    def _effects_own(self, hypothesis: Hypothesis, which: Callable[[Candidate, str], bool]) -> list[int]:
        """Indices in θ of parameters of effects, by their candidates and their own names in the effects."""
        added = [(part.candidate, own.key) for part in hypothesis for own in part.candidate.parameters]
        return [len(self.free.free) + k for k, one in enumerate(added) if which(*one)]

    def aliased(self, fitted: Fitted, k: int, names: Collection[str] | None = None) -> bool:
        """Whether no direction of a part's parameters is seen beside all others: then it stands for these.

        Such as a gain for masses that are all free: it gains where bounds hold these back, and says nothing. Of a
        discontinuous parameter derivatives say nothing.

        Args:
            fitted: the hypothesis.
            k: place of the part.
            names: of those of its parameters that count, as free ones; all by default.
        """
        first = len(self.free.free) + sum(p.candidate.n_parameters for p in fitted.hypothesis[:k])
        last = first + fitted.hypothesis[k].candidate.n_parameters
        if any(first <= place < last for place in self.discontinuous(fitted.hypothesis)):
            return False
        own = fitted.fit.parameters.free[first:last]
        counted = {free.label for free in own} if names is None else set(names)
        blind = (t for t in fitted.fit.uncertainty.trade_offs if t.correlation is None)
        return sum(bool(counted & t.weights.keys()) for t in blind) >= len(counted)

    def dimensions(self, fitted: Fitted, k: int, most: int) -> int:
        """In how many directions a part's parameters change what is seen, beside all that others can do.

        The rank of their Fisher information: Schwarz's cost is of dimensions, not of names. Looked at is the law as
        fits of it begin, for where one ended it may have degenerated to a simpler one. A direction counts along which
        parameters as large as there change −2 log likelihood by what makes hypotheses distinguishable. Of discontinuous
        parameters derivatives say nothing, nor of a law that diverges wherever it begins; they all count.

        Args:
            fitted: the hypothesis.
            k: place of the part.
            most: counted are so many and one more, no larger numbers.
        """
        part, found = fitted.hypothesis[k], 0
        candidate, seen = part.candidate, False
        if self.discontinuous((part,)):
            return candidate.n_parameters
        others = (*fitted.hypothesis[:k], *fitted.hypothesis[k + 1 :])
        for values in chain([part.values], map(candidate.in_each_group, candidate.guesses)):
            hypothesis = (*others, Part(candidate, values))
            begin = (self.theta_of(fitted.fit.theta, hypothesis), fitted.fit.starts)
            with suppress(SimulationDiverged):  # so nothing is seen there
                at = self._fit(hypothesis, [begin], fitted.noise, NO_STEP, GridScan(0, 0))
                slopes = whiten_fit(self.times, at, fitted.noise).slopes
                first, seen = slopes.shape[1] - candidate.n_parameters, True
                own = Nuisance.of(slopes[:, :first]).project_out(slopes[:, first:])
                gains = np.linalg.svd(own, compute_uv=False) ** 2
                found = max(found, sum(self.thresholds.decides(partial(_distinguishable, gain)) for gain in gains))
            if found > most:
                break
        return found if seen else candidate.n_parameters

    def may_be_nothing(self, fitted: Fitted, k: int) -> bool:
        """Whether what is known of a part's sizes, at all its places, holds that it does nothing.

        Then its gain comes of bounds that hold other parameters back, not of it: without it these would go further; or
        of residuals so coloured that the sizes are not known for all their gain. Several sizes are judged together, by
        Wald's statistic. Of a law with one size and further parameters, a mass and where it is, nothing is said: what
        the data determine may be their product.
        """
        candidate = fitted.hypothesis[k].candidate
        nothing, effect = candidate.fades_to(), candidate.effect
        if not nothing or len(effect.fades_to()) < min(2, len(effect.parameter_info())):
            return False
        first = len(self.free.free) + sum(p.candidate.n_parameters for p in fitted.hypothesis[:k])
        places = [(first + i, own.name) for i, own in enumerate(candidate.parameters) if own.name in nothing]
        away = np.array([fitted.fit.theta[i] - nothing[name] for i, name in places])
        rows = [i for i, _ in places]
        if len(effect.parameter_info()) == 1:
            return bool(np.all(np.abs(away) < fitted.fit.uncertainty.half_width[rows]))
        return fitted.fit.uncertainty.statistic(rows, away) < float(chdtri(len(rows), 1 - FitSettings().confidence))

    def span(self, fitted: Fitted, place: int) -> tuple[float, float]:
        """95 % profile-likelihood interval of a discontinuous parameter; ±inf at a side where it has no end.

        Each end is the nearest of the values evaluated, see ``PROFILE_STEPS``, at which 2 log L has fallen by more than
        ``PROFILE_FALL``. So the interval holds all values that fit as well, and is somewhat too wide.

        Args:
            fitted: the hypothesis.
            place: index of the parameter in θ.
        """
        ends, value = [], fitted.fit.theta[place]
        for side in (-1.0, 1.0):
            values = value * np.exp(side * PROFILE_STEPS)
            costs = self._profile(fitted.fit, fitted.noise, place, np.append(value, values))
            beyond = values[np.flatnonzero(costs[1:] > costs[0] + PROFILE_FALL)]
            ends.append(float(beyond[0]) if len(beyond) else math.inf * side)
        return ends[0], ends[1]

    def _grid_scan(self, discontinuous: Sequence[int], start: Fit, noise: Noise, scan: GridScan) -> Array:
        """(p,) θ with each discontinuous parameter, one after the other, at the best of values θᵢ·exp(±w), w shrinking.

        Args:
            discontinuous: indices in θ.
            start: the fit whose other parameters are refitted to first order.
            noise: of the residuals.
            scan: of how many values and grids.
        """
        theta = start.theta.copy()
        for place in discontinuous:
            width = scan.width
            for _ in range(scan.levels):
                values = theta[place] * np.exp(np.append(0.0, np.linspace(-width, width, scan.count)))
                theta[place] = values[int(np.argmin(self._profile(start, noise, place, values)))]
                width /= GRID_NARROWER
        return np.clip(theta, start.parameters.low, start.parameters.high)

    def _profile(self, start: Fit, noise: Noise, place: int, values: Array) -> Array:
        """(k,) min over the other parameters of χ² to first order, ‖(I − QQᵀ)(r − Δy(v))‖², for values v (k,) of one.

        Δy(v) is simulated, Q spans the other parameters' Jacobian; inf where a prediction is not finite.
        """
        self.budget.check()
        parameters = start.parameters
        inside = np.clip(values, parameters.low[place], parameters.high[place])
        models = [parameters.model_at(np.where(np.arange(len(start.theta)) == place, v, start.theta)) for v in inside]
        starts = [np.tile(state, (len(models) + 1, 1)) for state in start.starts]
        predicted = self.screening_simulator([start.model, *models], self.segments, starts)
        changes = [np.moveaxis(p.position[1:] - p.position[0], 0, -1) for p in predicted]
        whitened_fit = whiten_fit(self.times, start, noise)
        residuals = whitened_fit.residual[:, None] - whitened_fit.columns(self.times, changes)
        others = np.delete(whitened_fit.slopes, place, axis=1)
        beyond = Nuisance.of(others).project_out(residuals)
        return np.where(np.isfinite(beyond).all(axis=0), (beyond**2).sum(axis=0), np.inf)

    def _with_noise(self, hypothesis: Hypothesis, after: Fit) -> Fitted:
        """A hypothesis with its estimates, the noise estimated from its residuals, and its deviance under that."""
        noise = self.noise_of(after.residuals)
        deviance = -2.0 * log_likelihood(noise, self.times, after.residuals)
        return Fitted(refined(hypothesis, after.theta[len(self.free.free) :]), after, noise, deviance)

    def noise_of(self, residuals: Sequence[Array]) -> Noise:
        """The noise that makes residuals, for each segment (m, nj + ne), most likely."""
        longest = self.thresholds.longest_noise
        return estimate_noise(self.times, residuals, longest, self._correlated, self.least_noise)

    def _correlated(self, gain: float) -> bool:
        return not self.thresholds.decides(lambda t: gain < t.colour)

    def base(self) -> Fitted:
        """The model without any hypothesis, refitted.

        Raises:
            BudgetSpent: where the budget ends.
            SimulationDiverged: where it diverges on every trial.
        """
        start = [s.start for s in self.segments]
        point = self._fit((), [(self.free.start, start)], self._first_noise(), FitSettings(1e-3, 20))
        again = self._fit((), [(point.theta, point.starts)], white_noise(point.residuals), FitSettings(1e-4, 20))
        if not np.all(np.isfinite(np.concatenate(again.residuals))):
            raise SimulationDiverged(f"{self.free.model.name}: the refitted model diverges")
        return self.converge(self._with_noise((), again))

    def base_from(self, short: Fitted, base: Fitted) -> Fitted:
        """The model without any effect, refitted from the fit to short shooting intervals, if that fits better.

        Args:
            short: the same fitted to shooting intervals so short that errors do not grow in them. Initial states are
                then carried on along the measurements.
            base: the fit so far.

        Raises:
            BudgetSpent: where the budget ends.
        """
        starts, _ = followed(short.fit.model, self.segments, self.simulator)
        try:
            refitted = self._fit((), [(short.fit.theta, starts)], short.noise, FROM_SHORT)
            other = self.converge(self._with_noise((), refitted))
        except SimulationDiverged:  # so the fit to short intervals is of no use
            return base
        return min(base, other, key=lambda f: f.deviance)

    def nominal_fit(self) -> Fitted:
        """The nominal model: without any effect, its parameters as they are."""
        start = [s.start for s in self.segments]
        nominal = self._fit((), [(self.free.start, start)], self._first_noise(), FitSettings(1e-3, 0))
        return self._with_noise((), nominal)

    def strong(self, fitted: Fitted) -> bool:
        """Whether a joint's residuals are so large that derivatives say little of what would remove them."""
        return self._beyond(fitted, lambda t: t.refit_strong)

    def far_above_noise(self, fitted: Fitted) -> bool:
        """Whether a joint's residuals are larger than noise."""
        return self._beyond(fitted, lambda t: t.refit_far_above_noise)

    def _beyond(self, fitted: Fitted, times: Callable[[Thresholds], float]) -> bool:
        """Whether RMSE/σ of a joint exceeds a threshold, σ of white noise by second differences of the measurements."""
        rough = noise_of_differences([s.measured for s in self.segments])
        largest = max(rmse / noise.sigma for rmse, noise in zip(fitted.fit.rmse, rough, strict=True))
        return self.thresholds.decides(lambda t: largest > times(t))

    def _first_noise(self) -> Noise:
        """White, as large as the motion: each joint or channel counts in units of how far it moves."""
        return white_noise([s.outputs - s.outputs.mean(axis=0) for s in self.segments])


def _distinguishable(gain: float, t: Thresholds) -> bool:
    return gain > t.indistinguishable


def chi_squared(noise: Noise, times: Sequence[Array], values: Sequence[Array]) -> float:
    """χ² = Σ w² of the whitened values w, for each segment (m, nj + ne) at times (m,) [s]."""
    whitened_values = (whiten(noise, t, v) for t, v in zip(times, values, strict=True))
    return sum(float((w**2).sum()) for w in whitened_values)
