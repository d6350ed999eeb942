"""Moves from one hypothesis to another: add an effect, remove one, exchange one."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from scipy.stats import chi2

from equimus_ctrl.diagnosis.candidates import Candidate, Part, model_of
from equimus_ctrl.diagnosis.fitting import CONVERGED_GAIN, Data, Fitted
from equimus_ctrl.diagnosis.policy import SearchSettings, Thresholds
from equimus_ctrl.diagnosis.screening import Screened, screen
from equimus_ctrl.errors import ConfigError, SimulationDiverged
from equimus_ctrl.identification.fit import Begin
from equimus_ctrl.identification.noise import white_noise
from equimus_ctrl.types import Array


@dataclass(frozen=True, eq=False)
class SearchHistory:
    """What a search has tried so far.

    Attributes:
        fitted: all hypotheses fitted, to whatever end.
        first: what every candidate would do to the refitted model, alone.
        rejected: labels of candidates that are not to be part of a hypothesis any more.
        extended: for a hypothesis' labels, and that of a candidate to replace or "", the fit that was extended and
            those with one more part.
    """

    fitted: tuple[Fitted, ...] = ()
    first: tuple[Screened, ...] = ()
    rejected: frozenset[str] = frozenset()
    extended: Mapping[tuple[frozenset[str], str], tuple[Fitted, tuple[Fitted, ...]]] = field(default_factory=dict)

    def allows(self, labels: Iterable[str]) -> bool:
        """Whether none of some candidates was rejected."""
        return self.rejected.isdisjoint(labels)

    def having(self, *fitted: Fitted) -> SearchHistory:
        """The same with more fits."""
        return replace(self, fitted=(*self.fitted, *fitted))


@dataclass(frozen=True, eq=False)
class SearchState:
    """Where a search is.

    Attributes:
        base: the model without any effect, refitted.
        best: the hypothesis accepted.
        without: for each of its parts the best fit without it.
        alternatives: for each of its parts the converged hypotheses with another in its place.
        tried: all that was tried on the way.
    """

    base: Fitted
    best: Fitted
    without: tuple[Fitted, ...] = ()
    alternatives: tuple[tuple[Fitted, ...], ...] = ()
    tried: SearchHistory = field(default_factory=SearchHistory)

    def rejecting(self, labels: Iterable[str]) -> SearchState:
        """The same, some candidates to be no part of it any more."""
        tried = replace(self.tried, rejected=self.tried.rejected | set(labels))
        return replace(
            self,
            alternatives=tuple(tuple(r for r in own if tried.allows(r.labels)) for own in self.alternatives),
            tried=tried,
        )


Notify = Callable[[str, str], None]
"""Called with the stage and the best hypothesis so far."""
WITHIN, CLOSE = 0.5, 50.0
"""Share of the best gain of deviance, and deviance, that a hypothesis may lack to be fitted to the end."""
COARSE_STEPS, LONG = 5, 15
"""Iterations of a coarse fit, and of a fit of the few that are best by then."""
FEW_ALTERNATIVES = 3
"""Candidates fitted, for each whitening of the residuals, to take the place of a part."""
MOST_ROUNDS = 8
"""How often parts are exchanged at most."""


@dataclass(frozen=True, eq=False)
class HypothesisMoves:
    """The moves of a search over hypotheses (sets of candidates).

    Attributes:
        data: what was measured.
        pool: the candidates.
        settings: how it goes.
        notify: see ``Notify``.
        fits_on_short_intervals: hypotheses with these candidates, fitted to short shooting intervals of the same
            trials, to start from.
        fits_with_other_engine: those fitted to the same segments with another engine, as further alternatives.
    """

    data: Data
    pool: Sequence[Candidate]
    settings: SearchSettings = field(default_factory=SearchSettings)
    notify: Notify = lambda stage, best: None
    fits_on_short_intervals: Sequence[Fitted] = ()
    fits_with_other_engine: Sequence[Fitted] = ()

    def allowed_candidates(self, tried: SearchHistory) -> list[Candidate]:
        """The candidates that were not rejected."""
        return [c for c in self.pool if tried.allows([c.label])]

    def score(self, fitted: Fitted) -> float:
        """Bayesian information criterion: deviance and a cost of each parameter (Schwarz, 1978)."""
        return fitted.deviance + fitted.n_parameters * float(np.log(self.data.n))

    def accepts(self, simple: Fitted, rich: Fitted) -> bool:
        """Whether the gain of the richer hypothesis exceeds the acceptance threshold on −2Δln L."""
        more, gain = max(rich.n_parameters - simple.n_parameters, 1), simple.deviance - rich.deviance
        return self.data.thresholds.decides(lambda t: gain > self.threshold(more, t))

    def threshold(self, parameters: int, thresholds: Thresholds | None = None) -> float:
        """Least gain of deviance for an effect with so many parameters, by the data's limits or others."""
        t = thresholds or self.data.thresholds
        by_chance = float(chi2.isf(t.significance / max(len(self.pool), 1), parameters))
        return max(by_chance, t.simulation_error * self.data.n) + self.scatter(t)

    def scatter(self, thresholds: Thresholds) -> float:
        """By how much deviances differ with where fits end."""
        return thresholds.minima_scatter if self.settings.many_minima else 0.0

    def challenge(
        self, tried: SearchHistory, fitted: Fitted, replacing: str = ""
    ) -> tuple[list[Fitted], SearchHistory]:
        """Hypotheses with one more part, the most promising ones fitted until converged.

        Args:
            tried: so far.
            fitted: what they add to.
            replacing: label of a candidate that is not tried, to find others in its place.
        """
        for replaced in ("", replacing):
            known = tried.extended.get((fitted.labels, replaced))
            if known and known[0].deviance <= fitted.deviance + CONVERGED_GAIN:
                return [o for o in known[1] if replacing not in o.labels and tried.allows(o.labels)], tried
        options, tried = self.extensions(tried, fitted, replacing)
        entry = {(fitted.labels, replacing): (fitted, tuple(options))}
        return options, replace(tried, extended={**tried.extended, **entry})

    def extensions(
        self, tried: SearchHistory, fitted: Fitted, replaced: str = "", known: Sequence[str] | None = None
    ) -> tuple[list[Fitted], SearchHistory]:
        """Hypotheses with one more part: the promising ones, or with some that are known all others.

        Args:
            tried: so far.
            fitted: what they add to.
            replaced: label of a candidate that is not tried.
            known: labels of those that are known; None where only promising ones are to be fitted.
        """
        pool = [c for c in self.allowed_candidates(tried) if c.label not in {replaced, *(known or ())}]
        most = min(self.settings.tried, FEW_ALTERNATIVES) if replaced else self.settings.tried
        most = most if known is None else len(pool)
        weights = white_noise(fitted.fit.residuals)
        screened = screen(self.data, fitted, pool)
        if not fitted.hypothesis and not tried.first:
            tried = replace(tried, first=tuple(screened))
        first = []
        for hypothesis, begin in self._promising(tried, fitted, pool, screened, most, known is not None):
            try:
                first.append(self.data.coarse_fit(hypothesis, begin, weights, COARSE_STEPS))
            except SimulationDiverged:  # so it cannot be what happened
                continue
        first.sort(key=self.score)
        ends = []
        for k, option in enumerate(first):
            # Only what is close to the best is continued.
            close = first[0].deviance + WITHIN * max(fitted.deviance - first[0].deviance, 0.0) + CLOSE
            if k < self.settings.kept and option.deviance <= close:
                weights = white_noise(option.fit.residuals)
                longer = self.data.coarse_fit(option.hypothesis, [option.begin], weights, LONG)
                option = self.data.converge(min(option, longer, key=lambda f: f.deviance))
            ends.append(option)
        return ends, tried.having(*ends)

    def _promising(
        self,
        tried: SearchHistory,
        fitted: Fitted,
        pool: Sequence[Candidate],
        screened: Sequence[Screened],
        most: int,
        hopeless: bool,
    ) -> list[tuple[tuple[Part, ...], list[Begin]]]:
        """Hypotheses with one more part, and where their fits can begin; those without a gain if they are wanted."""
        base = len(self.data.free.free)
        lists = [sorted(screened, key=_by_gain(way)) for way in range(2)]
        if not fitted.hypothesis and self.data.strong(fitted):
            # The missing physics may have biased the refitted model far.
            lists.append(sorted(screen(self.data, self.given, pool), key=lambda s: -s.gains[0]))
        chosen: dict[str, tuple[tuple[Part, ...], list[Begin]]] = {}
        for ranked in lists:
            for s in ranked[:most]:
                if hopeless or max(s.gains) > 0:
                    starts: list[Begin] = [(s.begin, fitted.fit.starts)]
                    if not fitted.hypothesis:
                        starts.append((np.concatenate([self.data.free.start, s.begin[base:]]), fitted.fit.starts))
                    old = chosen.get(s.candidate.label)
                    chosen[s.candidate.label] = (s.hypothesis, starts + (old[1] if old else []))
        for hypothesis, begin in self._from_elsewhere(fitted, {c.label for c in pool}, most):
            label = hypothesis[-1].candidate.label
            old = chosen.get(label)
            chosen[label] = (hypothesis, [begin, *(old[1] if old else [])])
        return [*chosen.values(), *((h, [b]) for h, b in self._splits(tried, fitted))]

    def _from_elsewhere(
        self, fitted: Fitted, labels: Collection[str], most: int
    ) -> Iterator[tuple[tuple[Part, ...], Begin]]:
        """Of what was fitted elsewhere the best that adds one of some candidates to a hypothesis."""
        base = len(self.data.free.free)
        own = [part.candidate.label for part in fitted.hypothesis]
        met: set[str] = set()
        for other in sorted(self.fits_on_short_intervals, key=self.score):
            parts = {part.candidate.label: part for part in other.hypothesis}
            more = parts.keys() - set(own)
            if len(parts) != len(own) + 1 or len(more) != 1 or more & met or not more <= set(labels):
                continue
            met |= more
            hypothesis = tuple(parts[label] for label in (*own, *more))
            values = [v for part in hypothesis for v in part.values.values()]
            yield hypothesis, (np.concatenate([other.fit.theta[:base], values]), fitted.fit.starts)
            if len(met) == most:
                return

    @cached_property
    def given(self) -> Fitted:
        """The nominal model."""
        return self.data.nominal_fit()

    def _splits(self, tried: SearchHistory, fitted: Fitted) -> list[tuple[tuple[Part, ...], Begin]]:
        """For each part that acts alike at several places, the same with separate parameters."""
        found: list[tuple[tuple[Part, ...], Begin]] = []
        base = len(self.data.free.free)
        for k, part in enumerate(fitted.hypothesis):
            sites = part.candidate.locations
            if len(sites) < 2:
                continue
            parts = tuple(Part(replace(part.candidate, locations=(site,)), part.values) for site in sites)
            if not tried.allows(p.candidate.label for p in parts):
                continue
            hypothesis = (*fitted.hypothesis[:k], *parts, *fitted.hypothesis[k + 1 :])
            values = [v for p in hypothesis for v in p.values.values()]
            theta: Array = np.concatenate([fitted.fit.theta[:base], values])
            found.append((hypothesis, (theta, fitted.fit.starts)))
        return found

    def exchanged(self, found: SearchState) -> SearchState:
        """Parts that are not needed dropped, parts for which others fit better exchanged."""
        best, tried = found.best, found.tried
        for _ in range(MOST_ROUNDS):
            moved = False
            withouts: list[Fitted] = []
            all_alternatives: list[tuple[Fitted, ...]] = []
            for k, part in enumerate(best.hypothesis):
                self.notify(f"without {part.candidate.label}", best.label)
                without, tried = self.refit(tried, best, best.hypothesis[:k] + best.hypothesis[k + 1 :])
                if not self.accepts(without, best):
                    best, moved = without, True
                    break
                alternatives, tried = self.challenge(tried, without, part.candidate.label)
                withouts.append(without)
                all_alternatives.append(tuple(alternatives))
                same_size = [r for r in alternatives if len(r.hypothesis) <= len(best.hypothesis)]
                better = [r for r in same_size if self.score(r) < self.score(best) - 1.0]
                if better:
                    best, moved = min(better, key=self.score), True
                    break
            if not moved or not best.hypothesis:
                return replace(
                    found, best=best, without=tuple(withouts), alternatives=tuple(all_alternatives), tried=tried
                )
        return self.moved(replace(found, tried=tried), best)

    def refitted(
        self, tried: SearchHistory, fitted: Fitted, hypothesis: tuple[Part, ...]
    ) -> tuple[list[Fitted], SearchHistory]:
        """As ``refit``; nothing where parts exclude each other or it cannot have happened."""
        try:
            found, tried = self.refit(tried, fitted, hypothesis)
        except (ConfigError, SimulationDiverged):
            return [], tried
        return [found], tried

    def moved(self, found: SearchState, best: Fitted) -> SearchState:
        """A search moved to another hypothesis, with what it would be without each part."""
        parts, tried = best.hypothesis, found.tried
        withouts: list[Fitted] = []
        for k in range(len(parts)):
            without, tried = self.refit(tried, best, parts[:k] + parts[k + 1 :])
            withouts.append(without)
        # The alternatives were fitted beside other parts, so they are found anew, see ``alternatives.listed``.
        return replace(found, best=best, without=tuple(withouts), alternatives=tuple(() for _ in parts), tried=tried)

    def refit(self, tried: SearchHistory, fitted: Fitted, hypothesis: tuple[Part, ...]) -> tuple[Fitted, SearchHistory]:
        """A part of a fitted hypothesis, fitted to the end from there.

        Where it diverges without the rest, with what the model came with.
        """
        base = len(self.data.free.free)
        values = [v for part in hypothesis for v in part.values.values()]
        theta: Array = np.concatenate([fitted.fit.theta[:base], values])
        model_of(self.data.free.model, hypothesis)
        weights = white_noise(fitted.fit.residuals)
        try:
            found = self.data.coarse_fit(hypothesis, [(theta, fitted.fit.starts)], weights, LONG)
        except SimulationDiverged:
            plain: Array = np.concatenate([self.data.free.start, values])
            found = self.data.coarse_fit(hypothesis, [(plain, [s.start for s in self.data.segments])], weights, LONG)
        found = self.data.converge(found)
        return found, tried.having(found)


def _by_gain(way: int) -> Callable[[Screened], float]:
    return lambda s: -s.gains[way]
