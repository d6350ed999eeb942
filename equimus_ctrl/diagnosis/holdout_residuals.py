"""What models leave of held-out trials, and what they gain there."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cached_property

import numpy as np

from equimus_ctrl.diagnosis.fitting import Data, Fitted, chi_squared
from equimus_ctrl.diagnosis.holdout import Split, kind_of
from equimus_ctrl.diagnosis.hypothesis import parameters_of
from equimus_ctrl.diagnosis.localization import excess_variances
from equimus_ctrl.diagnosis.noise_size import noise_sizes
from equimus_ctrl.diagnosis.search_state import SearchState
from equimus_ctrl.identification.noise import log_likelihood, whiten
from equimus_ctrl.identification.residuals import residuals_of
from equimus_ctrl.models.model import Model
from equimus_ctrl.types import Array


class HoldoutResiduals:
    """Residuals of models on held-out trials and on fitted ones, and what they gain there.

    Args:
        data: the fitted trials.
        split: these and the held-out ones.
        state: a search's, whose best hypothesis tells the noise.
    """

    def __init__(self, data: Data, split: Split, state: SearchState) -> None:
        self.data, self.split, self.noise = data, split, state.best.noise
        self._best = state.best
        self._known: dict[Model, list[Array]] = {}

    @property
    def _times(self) -> list[Array]:
        """For each validation segment (m,) [s]."""
        return [s.trial.sample_times for s in self.split.validation]

    def residuals(self, model: Model) -> list[Array]:
        """For each validation segment (m, nj + ne) measured − predicted, of joints [rad or m] and channels [own unit].

        Where nothing is predicted they are ``residuals.DIVERGED``.
        """
        if model not in self._known:
            self._known[model] = residuals_of(model, self.split.validation, self.data.simulator)
        return self._known[model]

    @cached_property
    def halves(self) -> tuple[list[str], list[list[tuple[int, slice]]]]:
        """Halves in time of each kind of validation recordings: their names, and which rows of which segments they are.

        Recordings whose names are alike up to a digit are of one kind. A single recording differs from others by
        chance, and by what no effect explains; a kind of recordings shows what an effect does in it.
        """
        kinds: dict[str, dict[int, list[int]]] = {}
        for k, segment in enumerate(self.split.validation):
            kinds.setdefault(kind_of(segment.recording_name), {}).setdefault(segment.recording, []).append(k)
        names, halves = list[str](), list[list[tuple[int, slice]]]()
        for kind, recordings in kinds.items():
            cuts = [cut for members in recordings.values() for cut in self._at_the_middle(members)]
            only = self.split.validation[next(iter(recordings.values()))[0]].recording_name
            for half, which in enumerate(("first", "second")):
                whose = only if len(recordings) == 1 else f"each {kind or 'recording'}"
                names.append(f"the {which} half of {whose}")
                halves.append([(k, slice(at, None) if half else slice(0, at)) for k, at in cuts])
        return names, halves

    def _at_the_middle(self, members: Sequence[int]) -> list[tuple[int, int]]:
        """Segments of one recording, and the row of each at which the second half of the recording begins."""
        middle = float(self._times[members[0]][0] + self._times[members[-1]][-1]) / 2
        return [(k, int(np.searchsorted(self._times[k], middle))) for k in members]

    def squares(self, model: Model) -> list[float]:
        """For each of ``halves`` χ² of a model's residuals."""
        return self._squares(self.residuals(model))

    def squares_between(self, first: Model, second: Model) -> list[float]:
        """For each of ``halves`` χ² of what two models' predictions differ by."""
        pairs = zip(self.residuals(first), self.residuals(second), strict=True)
        return self._squares([a - b for a, b in pairs])

    def _squares(self, values: Sequence[Array]) -> list[float]:
        whitened = [whiten(self.noise, time, value) for time, value in zip(self._times, values, strict=True)]
        return [float(sum((whitened[k][rows] ** 2).sum() for k, rows in half)) for half in self.halves[1]]

    def gain(self, simple: Fitted, rich: Fitted) -> float:
        """−2Δln L on validation trials, under one noise; nan where nothing is held out."""
        if not self.split.validation:
            return math.nan
        before, after = (log_likelihood(self.noise, self._times, self.residuals(f.fit.model)) for f in (simple, rich))
        return 2.0 * (after - before)

    def carried_over(self, simple: Fitted, rich: Fitted) -> float:
        """The gain on validation trials, over that on as many samples of the fitted ones."""
        share = sum(s.outputs.size for s in self.split.validation) / self.data.n
        return self.gain(simple, rich) / max((simple.deviance - rich.deviance) * share, 1e-300)

    def distance(self, simple: Fitted, rich: Fitted) -> float:
        """χ² by which two models differ on validation trials: what the better one would gain there if it were true."""
        return self._distance(simple.fit.model, rich.fit.model)

    def own_distance(self, simple: Fitted, rich: Fitted) -> float:
        """The same of what a hypothesis has more than another, other parameters being as the richer one has them."""
        rest = tuple(part for part in rich.hypothesis if part.candidate.label in simple.labels)
        without = parameters_of(self.data.free, rest).model_at(self.data.theta_of(rich.fit.theta, rest))
        return self._distance(without, rich.fit.model)

    def _distance(self, first: Model, second: Model) -> float:
        before, after = self.residuals(first), self.residuals(second)
        return chi_squared(self.noise, self._times, [a - b for a, b in zip(before, after, strict=True)])

    def share(self, simple: Sequence[Array], rich: Sequence[Array], base: Sequence[Array]) -> float:
        """Share of the excess residual variance of ``base`` by which ``rich`` has less than ``simple``."""
        if not simple:
            return math.nan
        sigma = noise_sizes(self.data, self._best)
        before, after, whole = (float(excess_variances(r, sigma).mean()) for r in (simple, rich, base))
        return float(np.clip((before - after) / whole, -1.0, 1.0)) if whole > 0 else 0.0
