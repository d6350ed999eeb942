"""Steps from one set of effects to another: with one more, with one less, with another in the place of one."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.stats import chi2

from equimus_ctrl.diagnosis.candidates import Candidate, Part, model_of
from equimus_ctrl.diagnosis.fitting import SETTLED, Data, Fitted
from equimus_ctrl.diagnosis.policy import SearchSettings
from equimus_ctrl.diagnosis.screening import Screened, screen
from equimus_ctrl.errors import ConfigError, SimulationDiverged
from equimus_ctrl.identification.fit import Begin
from equimus_ctrl.identification.noise import white_noise
from equimus_ctrl.types import Array


@dataclass(frozen=True, eq=False)
class Searched:
    """Where a search ended.

    Attributes:
        base: the model without any effect, refitted.
        best: the hypothesis believed in.
        without: for each of its parts the best fit that does without it.
        rivals: for each of its parts the hypotheses with another in its place that were fitted to the end.
        first: what every candidate would do to the refitted model, alone.
        fitted: all hypotheses fitted on the way, to whatever end.
    """

    base: Fitted
    best: Fitted
    without: tuple[Fitted, ...]
    rivals: tuple[tuple[Fitted, ...], ...]
    first: tuple[Screened, ...]
    fitted: tuple[Fitted, ...]


Ended = tuple[Fitted, tuple[Fitted, ...], tuple[tuple[Fitted, ...], ...]]
"""The best hypothesis, what it is without each of its parts, and with others in their places."""
Notify = Callable[[str, str], None]
"""Called with the stage and the best hypothesis so far."""
NEAR, CLOSE = 0.5, 50.0
"""Share of the best gain of deviance, and deviance, that a hypothesis may lack to be fitted to the end."""
ROUGH, LONG = 5, 15
"""Steps of a first look, and of a search for the few that are best by then."""
INSTEAD = 3
"""Candidates fitted, for each way to weigh the residuals, to take the place of a part."""
MOVES = 8
"""How often parts are exchanged at most."""


class Moves:
    """What a search over sets of candidates can do.

    Args:
        data: what was measured.
        pool: the candidates.
        settings: how it goes.
        notify: see ``Notify``.
        elsewhere: hypotheses with these candidates that were fitted to other windows of the same trials, to begin from.
        otherwise: those that were fitted to the same trials with another engine, which tell what may fit as well.
    """

    def __init__(
        self,
        data: Data,
        pool: Sequence[Candidate],
        settings: SearchSettings | None = None,
        notify: Notify = lambda stage, best: None,
        elsewhere: Sequence[Fitted] = (),
        otherwise: Sequence[Fitted] = (),
    ) -> None:
        self.data = data
        self.pool = list(pool)
        self.settings = settings or SearchSettings()
        self.notify = notify
        self.elsewhere = sorted(elsewhere, key=self.score)
        self.otherwise = tuple(otherwise)
        self.fitted: list[Fitted] = []
        self.barred: set[str] = set()
        self._first: tuple[Screened, ...] = ()
        self._challenged: dict[tuple[frozenset[str], str], tuple[Fitted, list[Fitted]]] = {}

    @property
    def left(self) -> list[Candidate]:
        """The candidates that were not withdrawn."""
        return [c for c in self.pool if self.allows([c.label])]

    def allows(self, labels: Iterable[str]) -> bool:
        """Whether none of some candidates was withdrawn."""
        return self.barred.isdisjoint(labels)

    def score(self, fitted: Fitted) -> float:
        """Deviance and what the hypothesis' numbers cost (Schwarz, 1978)."""
        return fitted.deviance + fitted.n_parameters * float(np.log(self.data.n))

    def believed(self, simple: Fitted, rich: Fitted) -> bool:
        """Whether the richer hypothesis gains more than chance and other simulations' errors would."""
        more = max(rich.n_parameters - simple.n_parameters, 1)
        return simple.deviance - rich.deviance > self.threshold(more)

    def threshold(self, parameters: int) -> float:
        """Least gain of deviance for an effect with so many parameters."""
        chance = float(chi2.isf(self.settings.level / max(len(self.pool), 1), parameters))
        return max(chance, self.settings.least_share * self.data.n) + self.settings.valleys

    def challenge(self, fitted: Fitted, instead_of: str = "") -> list[Fitted]:
        """Hypotheses with one more part, the most promising ones fitted to the end.

        Args:
            fitted: what they add to.
            instead_of: label of a candidate that is left out, for what others could do in its place.
        """
        whole = fitted.labels
        for left_out in ("", instead_of):
            known = self._challenged.get((whole, left_out))
            if known and known[0].deviance <= fitted.deviance + SETTLED:
                return [o for o in known[1] if instead_of not in o.labels and self.allows(o.labels)]
        options = self._options(fitted, instead_of)
        self._challenged[whole, instead_of] = fitted, options
        return options

    def _options(self, fitted: Fitted, left_out: str, known: Sequence[str] | None = None) -> list[Fitted]:
        """Hypotheses with one more part: the promising ones, or with some that are known all others."""
        pool = [c for c in self.left if c.label not in {left_out, *(known or ())}]
        tried = min(self.settings.tried, INSTEAD) if left_out else self.settings.tried
        tried = tried if known is None else len(pool)
        weights = white_noise(fitted.fit.residuals)
        first = []
        for hypothesis, begin in self._promising(fitted, pool, tried, hopeless=known is not None):
            try:
                first.append(self.data.rough(hypothesis, begin, weights, ROUGH))
            except SimulationDiverged:  # so it cannot be what happened
                continue
        first.sort(key=self.score)
        ends = []
        for k, option in enumerate(first):
            # Only what comes near the best is worth going on with.
            near = first[0].deviance + NEAR * max(fitted.deviance - first[0].deviance, 0.0) + CLOSE
            if k < self.settings.kept and option.deviance <= near:
                longer = self.data.rough(option.hypothesis, [option.begin], white_noise(option.fit.residuals), LONG)
                option = self.data.settle(min(option, longer, key=lambda f: f.deviance))
            ends.append(option)
            self.fitted.append(option)
        return ends

    def _promising(
        self, fitted: Fitted, pool: Sequence[Candidate], tried: int, hopeless: bool = False
    ) -> list[tuple[tuple[Part, ...], list[Begin]]]:
        """Hypotheses with one more part, and where their fits can begin; those without a gain if they are wanted."""
        base = len(self.data.free.free)
        screened = screen(self.data, fitted, pool)
        if not fitted.hypothesis and not self._first:
            self._first = tuple(screened)
        lists = [sorted(screened, key=_by_gain(way)) for way in range(2)]
        if not fitted.hypothesis and self.data.strong(fitted):
            # What is missing may have led the refitted model far astray.
            lists.append(sorted(screen(self.data, self.given, pool), key=lambda s: -s.gains[0]))
        chosen: dict[str, tuple[tuple[Part, ...], list[Begin]]] = {}
        for ranked in lists:
            for s in ranked[:tried]:
                if hopeless or max(s.gains) > 0:
                    starts: list[Begin] = [(s.begin, fitted.fit.starts)]
                    if not fitted.hypothesis:
                        starts.append((np.concatenate([self.data.free.start, s.begin[base:]]), fitted.fit.starts))
                    old = chosen.get(s.candidate.label)
                    chosen[s.candidate.label] = (s.hypothesis, starts + (old[1] if old else []))
        for hypothesis, begin in self._from_elsewhere(fitted, {c.label for c in pool}, tried):
            label = hypothesis[-1].candidate.label
            old = chosen.get(label)
            chosen[label] = (hypothesis, [begin, *(old[1] if old else [])])
        return [*chosen.values(), *((h, [b]) for h, b in self._splits(fitted))]

    def _from_elsewhere(
        self, fitted: Fitted, labels: Collection[str], most: int
    ) -> Iterator[tuple[tuple[Part, ...], Begin]]:
        """Of what was fitted elsewhere the best that adds one of some candidates to a hypothesis."""
        base = len(self.data.free.free)
        own = [part.candidate.label for part in fitted.hypothesis]
        met: set[str] = set()
        for other in self.elsewhere:
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
        """The model as it came."""
        return self.data.as_it_came()

    def _splits(self, fitted: Fitted) -> list[tuple[tuple[Part, ...], Begin]]:
        """For each part that acts alike in several places the same with numbers of their own."""
        found: list[tuple[tuple[Part, ...], Begin]] = []
        base = len(self.data.free.free)
        for k, part in enumerate(fitted.hypothesis):
            sites = part.candidate.locations
            if len(sites) < 2:
                continue
            parts = tuple(Part(replace(part.candidate, locations=(site,)), part.values) for site in sites)
            if not self.allows(p.candidate.label for p in parts):
                continue
            hypothesis = (*fitted.hypothesis[:k], *parts, *fitted.hypothesis[k + 1 :])
            values = [v for p in hypothesis for v in p.values.values()]
            theta: Array = np.concatenate([fitted.fit.theta[:base], values])
            found.append((hypothesis, (theta, fitted.fit.starts)))
        return found

    def exchanged(self, best: Fitted) -> Ended:
        """Parts that are not needed dropped, parts for which others fit better exchanged."""
        for _ in range(MOVES):
            moved = False
            withouts: list[Fitted] = []
            all_rivals: list[tuple[Fitted, ...]] = []
            for k, part in enumerate(best.hypothesis):
                self.notify(f"without {part.candidate.label}", best.label)
                rest = best.hypothesis[:k] + best.hypothesis[k + 1 :]
                without = self.refit(best, rest)
                if not self.believed(without, best):
                    best, moved = without, True
                    break
                rivals = self.challenge(without, part.candidate.label)
                withouts.append(without)
                all_rivals.append(tuple(rivals))
                same_size = [r for r in rivals if len(r.hypothesis) <= len(best.hypothesis)]
                better = [r for r in same_size if self.score(r) < self.score(best) - 1.0]
                if better:
                    best, moved = min(better, key=self.score), True
                    break
            if not moved or not best.hypothesis:
                return best, tuple(withouts), tuple(all_rivals)
        found = [self.refit(best, best.hypothesis[:k] + best.hypothesis[k + 1 :]) for k in range(len(best.hypothesis))]
        return best, tuple(found), tuple(() for _ in found)

    def refitted(self, fitted: Fitted, hypothesis: tuple[Part, ...]) -> list[Fitted]:
        """As ``refit``; nothing where parts exclude each other or it cannot have happened."""
        try:
            return [self.refit(fitted, hypothesis)]
        except (ConfigError, SimulationDiverged):
            return []

    def moved(self, found: Searched, best: Fitted) -> Searched:
        """A search's end moved to another hypothesis, with what it would be without each part."""
        parts = best.hypothesis
        without = tuple(self.refit(best, parts[:k] + parts[k + 1 :]) for k in range(len(parts)))
        # What others were fitted beside is not what stays, so rivals are looked for anew, see ``alternatives.listed``.
        return Searched(found.base, best, without, tuple(() for _ in parts), found.first, tuple(self.fitted))

    def refit(self, fitted: Fitted, hypothesis: tuple[Part, ...]) -> Fitted:
        """A part of a fitted hypothesis, fitted to the end from there.

        Where it diverges without the rest, with what the model came with.
        """
        base = len(self.data.free.free)
        values = [v for part in hypothesis for v in part.values.values()]
        theta: Array = np.concatenate([fitted.fit.theta[:base], values])
        model_of(self.data.free.model, hypothesis)
        weights = white_noise(fitted.fit.residuals)
        try:
            found = self.data.rough(hypothesis, [(theta, fitted.fit.starts)], weights, LONG)
        except SimulationDiverged:
            plain: Array = np.concatenate([self.data.free.start, values])
            found = self.data.rough(hypothesis, [(plain, [s.start for s in self.data.segments])], weights, LONG)
        found = self.data.settle(found)
        self.fitted.append(found)
        return found


def _by_gain(way: int) -> Callable[[Screened], float]:
    return lambda s: -s.gains[way]
