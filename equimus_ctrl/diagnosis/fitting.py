"""Hypotheses fitted to recordings: all parameters free, the noise estimated along."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from equimus_ctrl.diagnosis.budget import Budget
from equimus_ctrl.diagnosis.candidates import Hypothesis, parameters_of, refined
from equimus_ctrl.diagnosis.policy import SearchPolicy, Thresholds
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
from equimus_ctrl.identification.segments import Segment
from equimus_ctrl.identification.simulators import Simulator
from equimus_ctrl.identification.whitened_fit import whiten_fit
from equimus_ctrl.types import Array

ROUNDS = 4
"""How often noise and parameters are estimated in turn, at most."""
TURNS, GRID_SIZES, WIDTH, NARROWER, LEVELS = 3, (15, 47), 0.4, 5.0, 4
"""Grid scan of a discontinuous parameter: numbers of values in a quick fit and in a full one, half width of the grid in
its logarithm, and the factor by which grids around the best value shrink. It is repeated from where the fit goes."""
FACTORS = 1e-5 * 3.0 ** np.arange(11)
"""Logarithms of factors at which the profile likelihood of such a parameter is evaluated."""
WORSE = 3.84
"""Fall of 2 log L at the ends of a 95 % interval."""
NO_STEP = FitSettings(1e-5, 0)
FROM_SHORT = FitSettings(1e-6, 60)
"""Of a search that begins at the fit to short shooting intervals, towards an ill-conditioned minimum."""
CONVERGED_GAIN = 0.5
"""Gain of 2 log L below which a fit counts as converged."""


@dataclass(frozen=True, eq=False)
class Fitted:
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
    def n_parameters(self) -> int:
        """Number of parameters of the effects alone."""
        return sum(part.candidate.n_parameters for part in self.hypothesis)

    @property
    def begin(self) -> Begin:
        """Where it ended, to go on from."""
        return self.fit.theta, self.fit.starts


@dataclass(frozen=True, eq=False)
class Data:
    """What hypotheses are fitted to.

    Attributes:
        free: the parameters to estimate without any effect.
        segments: what was measured.
        simulator: the engine.
        coarse: a faster one for what need not be exact, whose predictions are compared with its own alone; the same
            by default.
        fine: a slower one with a smaller discretisation error; the same by default.
        policy: how they are fitted and searched.
        budget: after each step of a fit it is asked whether to go on.
        thresholds: that decide.
    """

    free: FreeParameters
    segments: Sequence[Segment]
    simulator: Simulator
    coarse: Simulator | None = None
    fine: Simulator | None = None
    policy: SearchPolicy = field(default_factory=SearchPolicy)
    budget: Budget = field(default_factory=Budget)
    thresholds: Thresholds = field(default_factory=Thresholds)

    @property
    def times(self) -> list[Array]:
        """For each segment (m,) [s]."""
        return [s.trial.sample_times for s in self.segments]

    @property
    def n(self) -> int:
        """How many angles were measured."""
        return sum(s.measured.size for s in self.segments)

    def coarse_fit(
        self, hypothesis: Hypothesis, begin: Sequence[Begin], noise: Noise, steps: int, tolerance: float = 1e-4
    ) -> Fitted:
        """A few steps of a search under a noise that is given; the deviance is of the noise that is left."""
        settings = FitSettings(tolerance * (10 if self.policy.coarse_derivatives else 1), steps)
        found = self._fit(hypothesis, begin, noise, settings, quick=True)
        return self._judged(hypothesis, found)

    def converge(self, fitted: Fitted, noise: Noise | None = None) -> Fitted:
        """Estimate noise and parameters in turn until the likelihood has converged.

        Args:
            fitted: where it begins.
            noise: of the first iteration; by default estimated from the residuals of ``fitted``.
        """
        best = fitted
        for _ in range(ROUNDS):
            steps = FitSettings(1e-5, 12)
            found = self._fit(best.hypothesis, [best.begin], noise or best.noise, steps, earlier=best.fit)
            after = self._judged(best.hypothesis, found)
            gain, noise = best.deviance - after.deviance, None
            if gain > 0:
                best = after
            if gain < CONVERGED_GAIN:
                break
        return best

    def converge_finely(self, fitted: Fitted) -> Fitted:
        """The same with the fine engine, from where it is."""
        if self.fine is None:
            return fitted
        own = replace(self, simulator=self.fine, coarse=None, fine=None)
        return own.converge(
            own._judged(fitted.hypothesis, own._fit(fitted.hypothesis, [fitted.begin], fitted.noise, NO_STEP))
        )

    def _fit(
        self,
        hypothesis: Hypothesis,
        begin: Sequence[Begin],
        noise: Noise,
        settings: FitSettings,
        quick: bool = False,
        earlier: Fit | None = None,
    ) -> Fit:
        self.budget.check()
        parameters = parameters_of(self.free, hypothesis)
        inside = [(np.clip(theta, parameters.low, parameters.high), starts) for theta, starts in begin]
        coarse = self.coarse if self.policy.coarse_derivatives and quick else None
        found = fit(
            parameters, self.segments, simulator=self.simulator, settings=settings, noise=noise, begin=inside,
            coarse=coarse, earlier=earlier, notify=self._after_step,
        )  # fmt: skip
        discontinuous = self.discontinuous(hypothesis)
        for _ in range((1 if quick else TURNS) if discontinuous else 0):
            after = self._grid_scan(discontinuous, found, noise, GRID_SIZES[not quick])
            if np.array_equal(after, found.theta):
                break
            again = fit(
                parameters, self.segments, simulator=self.simulator, settings=settings, noise=noise,
                begin=[(after, found.starts)], coarse=coarse, notify=self._after_step,
            )  # fmt: skip
            if again.cost >= found.cost:
                break
            found = again
        return found

    def _after_step(self, evaluations: int, rmse: float) -> None:
        self.budget.check()

    def discontinuous(self, hypothesis: Hypothesis) -> list[int]:
        """Where parameters that act in steps stand among all that are free."""
        keys = [(part.candidate.effect.discontinuous, key) for part in hypothesis for key in part.values]
        return [len(self.free.free) + k for k, (discontinuous, key) in enumerate(keys) if key in discontinuous]

    def span(self, fitted: Fitted, place: int) -> tuple[float, float]:
        """Between what a parameter that acts in steps fits nearly as well, from outside; ±inf where there is no end."""
        found, value = [], fitted.fit.theta[place]
        for side in (-1.0, 1.0):
            values = value * np.exp(side * FACTORS)
            costs = self._profile(fitted.fit, fitted.noise, place, np.append(value, values))
            beyond = values[np.flatnonzero(costs[1:] > costs[0] + WORSE)]
            found.append(float(beyond[0]) if len(beyond) else math.inf * side)
        return found[0], found[1]

    def _grid_scan(self, discontinuous: Sequence[int], found: Fit, noise: Noise, looks: int) -> Array:
        theta = found.theta.copy()
        for place in discontinuous:
            width = WIDTH
            for _ in range(LEVELS):
                values = theta[place] * np.exp(np.append(0.0, np.linspace(-width, width, looks)))
                theta[place] = values[int(np.argmin(self._profile(found, noise, place, values)))]
                width /= NARROWER
        return np.clip(theta, found.parameters.low, found.parameters.high)

    def _profile(self, found: Fit, noise: Noise, place: int, values: Array) -> Array:
        """(k,) profile of the sum of squares over one parameter, all others refitted to first order."""
        self.budget.check()
        own = found.parameters
        inside = np.clip(values, own.low[place], own.high[place])
        models = [own.model_at(np.where(np.arange(len(found.theta)) == place, v, found.theta)) for v in inside]
        starts = [np.tile(start, (len(models) + 1, 1)) for start in found.starts]
        predicted = (self.coarse or self.simulator)([found.model, *models], self.segments, starts)
        changes = [np.moveaxis(p.position[1:] - p.position[0], 0, -1) for p in predicted]
        whitened_fit = whiten_fit(self.times, found, noise)
        left = whitened_fit.residual[:, None] - whitened_fit.columns(self.times, changes)
        remaining = np.delete(whitened_fit.slopes, place, axis=1)
        left = Nuisance.of(remaining).project_out(left)
        return np.where(np.isfinite(left).all(axis=0), (left**2).sum(axis=0), np.inf)

    def _judged(self, hypothesis: Hypothesis, found: Fit) -> Fitted:
        noise = estimate_noise(self.times, found.residuals)
        deviance = -2.0 * log_likelihood(noise, self.times, found.residuals)
        values = found.theta[len(self.free.free) :]
        return Fitted(refined(hypothesis, values), found, noise, deviance)

    def base(self) -> Fitted:
        """The model without any hypothesis, refitted.

        Raises:
            SimulationDiverged: where it diverges on every trial.
        """
        start = [s.start for s in self.segments]
        point = self._fit((), [(self.free.start, start)], self._first_noise(), FitSettings(1e-3, 20))
        again = self._fit((), [(point.theta, point.starts)], white_noise(point.residuals), FitSettings(1e-4, 20))
        if not np.all(np.isfinite(np.concatenate(again.residuals))):
            raise SimulationDiverged(f"{self.free.model.name}: the refitted model diverges")
        return self.converge(self._judged((), again))

    def base_from(self, short: Fitted, found: Fitted) -> Fitted:
        """The model without any effect, refitted from the fit to short shooting intervals, if that fits better.

        Args:
            short: the same fitted to shooting intervals so short that errors do not grow in them. Initial states are
                then carried on along the measurements.
            found: the fit so far.
        """
        starts, _ = followed(short.fit.model, self.segments, self.simulator)
        try:
            other = self.converge(self._judged((), self._fit((), [(short.fit.theta, starts)], short.noise, FROM_SHORT)))
        except SimulationDiverged:  # so the fit to short intervals is of no use
            return found
        return min(found, other, key=lambda f: f.deviance)

    def nominal_fit(self) -> Fitted:
        """The model without any effect, with its present parameters."""
        start = [s.start for s in self.segments]
        found = self._fit((), [(self.free.start, start)], self._first_noise(), FitSettings(1e-3, 0))
        return self._judged((), found)

    def strong(self, fitted: Fitted) -> bool:
        """Whether residuals are so much larger than the noise that derivatives say little of what would remove them."""
        return self._beyond(fitted, lambda t: t.refit_strong)

    def far_above_noise(self, fitted: Fitted) -> bool:
        """Whether more is left than noise that has no colour."""
        return self._beyond(fitted, lambda t: t.refit_far_above_noise)

    def _beyond(self, fitted: Fitted, times: Callable[[Thresholds], float]) -> bool:
        rough = noise_of_differences([s.measured for s in self.segments])
        largest = max(r / own.sigma for r, own in zip(fitted.fit.rmse, rough, strict=True))
        return self.thresholds.decides(lambda t: largest > times(t))

    def _first_noise(self) -> Noise:
        return white_noise([s.measured - s.measured.mean(axis=0) for s in self.segments])


def whitened(data: Data, noise: Noise, values: Sequence[Array]) -> list[Array]:
    """For each segment (m, nj, ...) values as the noise counts them."""
    return [whiten(noise, t, v) for t, v in zip(data.times, values, strict=True)]
