"""Hypotheses fitted to recordings: all parameters free, the noise estimated along."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from equimus_ctrl.diagnosis.candidates import Hypothesis, parameters_of, refined
from equimus_ctrl.errors import SimulationDiverged
from equimus_ctrl.identification.fit import Begin, Fit, FitSettings, Simulator, fit
from equimus_ctrl.identification.noise import Noise, estimate_noise, log_likelihood, rough_noise, white_noise, whiten
from equimus_ctrl.identification.parameters import FreeParameters
from equimus_ctrl.identification.segments import Segment
from equimus_ctrl.types import Array

ROUNDS = 4
"""How often noise and parameters are estimated in turn, at most."""
STRONG = 4.0
"""So many times the noise."""
SETTLED = 0.5
"""Gain of 2 log L at which they are taken to have settled."""


@dataclass(frozen=True, eq=False)
class Fitted:
    """A hypothesis with everything that is free at its best.

    Attributes:
        hypothesis: with the values found.
        fit: of all parameters.
        noise: that its residuals have.
        deviance: −2 log likelihood under that noise, constants left out.
    """

    hypothesis: Hypothesis
    fit: Fit
    noise: Noise
    deviance: float

    @property
    def label(self) -> str:
        """The parts' labels."""
        return " ".join(part.candidate.label for part in self.hypothesis) or "nothing left out"

    @property
    def n_parameters(self) -> int:
        """Numbers of the effects alone."""
        return sum(part.candidate.n_parameters for part in self.hypothesis)

    @property
    def begin(self) -> Begin:
        """Where it ended, to go on from."""
        return self.fit.theta, self.fit.starts


@dataclass(frozen=True, eq=False)
class Data:
    """What hypotheses are fitted to.

    Attributes:
        free: what is free in the model without any of them.
        segments: what was measured.
        simulator: the engine.
        coarse: a faster one for what need not be exact, whose predictions are compared with its own alone; the same
            by default.
    """

    free: FreeParameters
    segments: Sequence[Segment]
    simulator: Simulator
    coarse: Simulator | None = None

    @property
    def times(self) -> list[Array]:
        """For each segment (m,) [s]."""
        return [s.trial.sample_times for s in self.segments]

    @property
    def n(self) -> int:
        """How many angles were measured."""
        return sum(s.measured.size for s in self.segments)

    def rough(
        self, hypothesis: Hypothesis, begin: Sequence[Begin], noise: Noise, steps: int, tolerance: float = 1e-4
    ) -> Fitted:
        """A few steps of a search under a noise that is given; the deviance is of the noise that is left."""
        found = self._fit(hypothesis, begin, noise, FitSettings(tolerance, steps))
        return self._judged(hypothesis, found)

    def settle(self, fitted: Fitted, noise: Noise | None = None) -> Fitted:
        """Noise and parameters in turn until neither changes the likelihood.

        Args:
            fitted: where it begins.
            noise: of the first turn; what is left by ``fitted`` by default.
        """
        best = fitted
        for _ in range(ROUNDS):
            steps = FitSettings(1e-5, 12)
            found = self._fit(best.hypothesis, [best.begin], noise or best.noise, steps)
            after = self._judged(best.hypothesis, found)
            gain, noise = best.deviance - after.deviance, None
            if gain > 0:
                best = after
            if gain < SETTLED:
                break
        return best

    def _fit(self, hypothesis: Hypothesis, begin: Sequence[Begin], noise: Noise, settings: FitSettings) -> Fit:
        parameters = parameters_of(self.free, hypothesis)
        inside = [(np.clip(theta, parameters.low, parameters.high), starts) for theta, starts in begin]
        return fit(parameters, self.segments, simulator=self.simulator, settings=settings, noise=noise, begin=inside)

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
        return self.settle(self._judged((), again))

    def as_it_came(self) -> Fitted:
        """The model without any hypothesis and with the numbers it has."""
        start = [s.start for s in self.segments]
        found = self._fit((), [(self.free.start, start)], self._first_noise(), FitSettings(1e-3, 0))
        return self._judged((), found)

    def strong(self, fitted: Fitted) -> bool:
        """Whether residuals are so much larger than the noise that derivatives say little of what would remove them."""
        rough = rough_noise([s.measured for s in self.segments])
        rmse = fitted.fit.rmse
        return bool(any(r > STRONG * own.sigma for r, own in zip(rmse, rough, strict=True)))

    def _first_noise(self) -> Noise:
        return white_noise([s.measured - s.measured.mean(axis=0) for s in self.segments])


def whitened(data: Data, noise: Noise, values: Sequence[Array]) -> list[Array]:
    """For each segment (m, nj, ...) values as the noise counts them."""
    return [whiten(noise, t, v) for t, v in zip(data.times, values, strict=True)]
