"""Confirmation on held-out trials: whether they improve by as much as the fitted trials let expect."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from equimus_ctrl.diagnosis.alternatives import indistinguishable, listed
from equimus_ctrl.diagnosis.fitting import Data, Fitted
from equimus_ctrl.diagnosis.holdout import Split
from equimus_ctrl.diagnosis.hypothesis_moves import SearchState
from equimus_ctrl.diagnosis.localization import excess_variances
from equimus_ctrl.diagnosis.search import Search
from equimus_ctrl.identification.noise import Noise, log_likelihood, whiten
from equimus_ctrl.identification.residuals import residuals_of
from equimus_ctrl.models.model import Model
from equimus_ctrl.types import Array

OTHERS = 3
"""So many hypotheses are tried in the place of one that is not confirmed."""


def confirmed(search: Search, found: SearchState, split: Split) -> SearchState:
    """The hypothesis without the parts that held-out trials do not confirm.

    Where an alternative fits as well in such a part's place and is confirmed, it is accepted.
    """
    if not split.validation:
        return found
    while found.best.hypothesis:
        holdout = HoldoutResiduals(search.data, split, found)
        ratios = [_carried_over(search, holdout, without, found.best) for without in found.without]
        place = int(np.argmin(ratios))
        if _confirms(search, ratios[place]):
            return found
        if search.settings.many_minima:
            found, confirms = _another(search, found, place, split)
            if confirms:
                return found
        if len(found.best.hypothesis) == 1:
            found = listed(search, found)
            if (other := _confirmed_alternative(search, holdout, found)) is not None:
                return other
        found = search.moved(found, found.without[place])
    return found


def _confirmed_alternative(search: Search, holdout: HoldoutResiduals, found: SearchState) -> SearchState | None:
    """The end with another part in the only one's place, that fits as well and that what was held out bears out."""
    score = search.score(found.best)
    for alternative in sorted(
        (r for r in found.alternatives[0] if indistinguishable(search, r, score)), key=search.score
    ):
        if _confirms(search, _carried_over(search, holdout, found.without[0], alternative)):
            others = (found.best, *(r for r in found.alternatives[0] if r is not alternative))
            return replace(found, best=alternative, alternatives=(others,))
    return None


def _another(search: Search, found: SearchState, place: int, split: Split) -> tuple[SearchState, bool]:
    """The best hypothesis that fits better than the one less a part, all of whose parts are confirmed; whether one is.

    Validation trials may reject one part too many of a kind alone: an asymmetric friction that took an
    offset's place, say.
    """
    known = {found.best.labels}
    limit = search.score(found.without[place])
    for fitted in sorted(found.tried.fitted, key=search.score):
        if len(known) > OTHERS or search.score(fitted) >= limit:
            break
        if fitted.labels in known or not found.tried.allows(fitted.labels):
            continue
        if len(fitted.hypothesis) > search.settings.most_parts:
            continue
        known.add(fitted.labels)
        moved = search.moved(found, search.data.converge(fitted))
        found = replace(found, tried=moved.tried)
        holdout = HoldoutResiduals(search.data, split, moved)
        if all(
            search.accepts(without, moved.best)
            and _confirms(search, _carried_over(search, holdout, without, moved.best))
            for without in moved.without
        ):
            return moved, True
    return found, False


def _carried_over(search: Search, holdout: HoldoutResiduals, simple: Fitted, rich: Fitted) -> float:
    """As ``HoldoutResiduals.carried_over``; where trials differ, relative to what held-out ones can show if less.

    In some recordings a drive's limit is never reached, say. An effect that held-out trials cannot show at all is
    accepted where its gain on the fitted trials is large.
    """
    ratio = holdout.carried_over(simple, rich)
    thresholds = search.data.thresholds
    if _confirms(search, ratio) or search.data.free.model.robot.traits.same_kind_of_trials:
        return ratio
    distance = holdout.distance(simple, rich)
    if thresholds.decides(lambda t: distance >= t.uninformative):
        return max(ratio, holdout.gain(simple, rich) / distance)
    gain, more = simple.deviance - rich.deviance, max(rich.n_parameters - simple.n_parameters, 1)
    evident = thresholds.decides(lambda t: gain > t.evident * search.threshold(more, t))
    return math.inf if evident else ratio


def _confirms(search: Search, ratio: float) -> bool:
    """Whether a gain on validation trials, over that on the trials fitted, is enough."""
    return search.data.thresholds.decides(lambda t: ratio >= t.validation_share)


class HoldoutResiduals:
    """Models judged on what was held out, and on what was fitted."""

    def __init__(self, data: Data, split: Split, found: SearchState) -> None:
        self.data, self.split, self.found = data, split, found
        self._known: dict[Model, list[Array]] = {}

    @property
    def noise(self) -> Noise:
        """That of the best hypothesis."""
        return self.found.best.noise

    def residuals(self, model: Model) -> list[Array]:
        """For each validation segment (m, nj) measured − predicted [rad]."""
        if model not in self._known:
            self._known[model] = residuals_of(model, self.split.validation, self.data.simulator)
        return self._known[model]

    def nominal(self) -> list[Array]:
        """For each segment fitted, of the nominal model."""
        return residuals_of(self.data.free.model, self.split.train, self.data.simulator)

    def gain(self, simple: Fitted, rich: Fitted) -> float:
        """Fall of the deviance of what was held out, under one noise; nan where nothing was."""
        if not self.split.validation:
            return math.nan
        times = [s.trial.sample_times for s in self.split.validation]
        before, after = (log_likelihood(self.noise, times, self.residuals(f.fit.model)) for f in (simple, rich))
        return 2.0 * (after - before)

    def carried_over(self, simple: Fitted, rich: Fitted) -> float:
        """The fall of the deviance of what was held out, over that of what was fitted for as many samples."""
        share = sum(s.measured.size for s in self.split.validation) / self.data.n
        return self.gain(simple, rich) / max((simple.deviance - rich.deviance) * share, 1e-300)

    def distance(self, simple: Fitted, rich: Fitted) -> float:
        """χ² by which two models differ on what was held out: what the better one would gain there if it were true."""
        before, after = (self.residuals(f.fit.model) for f in (simple, rich))
        times = [s.trial.sample_times for s in self.split.validation]
        moved = (whiten(self.noise, t, a - b) for t, a, b in zip(times, before, after, strict=True))
        return sum(float((w**2).sum()) for w in moved)

    def share(self, simple: Sequence[Array], rich: Sequence[Array], base: Sequence[Array]) -> float:
        """Share of the excess residual variance of ``base`` by which ``rich`` has less than ``simple``."""
        if not simple:
            return math.nan
        before, after, whole = (float(excess_variances(r, self.noise).mean()) for r in (simple, rich, base))
        return float(np.clip((before - after) / whole, -1.0, 1.0)) if whole > 0 else 0.0
