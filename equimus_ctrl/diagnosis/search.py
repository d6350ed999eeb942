"""Which set of effects: forward from the refitted model, backward where one is not needed, sideways where another fits.

A hypothesis is scored by its deviance (−2 log likelihood, its own noise included) and its number of parameters. A part
is accepted where the deviance falls by more than the best of all candidates does on noise, and by more than two
simulations of one leg differ.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

from equimus_ctrl.diagnosis.alternatives import contested, narrowed, simplified
from equimus_ctrl.diagnosis.fitting import Fitted, whitened
from equimus_ctrl.diagnosis.hypothesis_moves import HypothesisMoves, SearchHistory, SearchState
from equimus_ctrl.diagnosis.residual_force import force_candidates, linearise_fit
from equimus_ctrl.diagnosis.screening import screen

SECOND = 2
"""So many others than the best first part, of those with about as much gain, are given a second part as well."""


class Search(HypothesisMoves):
    """A search over sets of candidates, from where one begins to where it ends."""

    def run(self, base: Fitted) -> SearchState:
        """Search from a model without effects that was refitted."""
        return self.go_on(SearchState(base, base))

    def beginning(self, base: Fitted, start: Fitted) -> SearchState:
        """A hypothesis without the parts that are not needed, and with better fitting ones in its parts' places."""
        first = SearchHistory(first=tuple(screen(self.data, base, self.pool)))
        return simplified(self, self.exchanged(SearchState(base, start, tried=first)))

    def go_on(self, found: SearchState, rejected: Sequence[str] = (), further: bool = True) -> SearchState:
        """Search from where one ended; see ``steps``."""
        for now in self.steps(found, rejected, further):
            found = now
        return found

    def steps(self, found: SearchState, rejected: Sequence[str] = (), further: bool = True) -> Iterator[SearchState]:
        """Search from where one ended, step by step; the last step is the end.

        Args:
            found: there.
            rejected: labels of candidates that are not to be part of it.
            further: whether more parts are tried, or only alternatives of the present ones.
        """
        now = found.rejecting(rejected)
        now = now if further else self.exchanged(now)
        sure, outdone = now, 0
        for depth in range(2 * self.settings.most_parts if further else 0):
            self.notify(f"what could be missing, round {depth + 1}", now.best.label)
            options, tried = self._small(*self.challenge(now.tried, now.best))
            top = self._top(now.best, options)
            force = top is not None and self._outdone(sure.best, top)
            if self._may_try_all(now.best) and (top is None or force):
                self.notify("what could be missing, all there is", now.best.label)
                known = [o.hypothesis[-1].candidate.label for o in options]
                more, tried = self.extensions(tried, now.best, known=known)
                options += more
                before, top = top, self._top(now.best, options)
                force = force if top is before else top is not None and self._outdone(sure.best, top)
            now = replace(now, tried=tried)
            if top is None:
                break
            outdone = outdone + 1 if force else 0
            if outdone > self.settings.patience:
                break
            if len(now.best.hypothesis) == 1:
                more, tried = self._beside(now)
                options, now = [*options, *more], replace(now, tried=tried)
            had = bool(now.best.hypothesis)
            now = self._with_one_more(now, options)
            none = not now.best.hypothesis
            if not outdone or (none and not had):
                sure = now
            if none and had:
                break
            yield replace(sure, tried=now.tried)
        yield narrowed(self, contested(self, replace(sure, base=now.base, tried=now.tried)))

    def _with_one_more(self, now: SearchState, options: Sequence[Fitted]) -> SearchState:
        """A search with the best of some larger hypotheses, its parts exchanged where others fit better."""
        before, best = now.best, min(options, key=self.score)
        others = tuple(o for o in options if o is not best)
        if self.settings.many_minima and not before.hypothesis:
            # The first fit of the model alone may have ended in a worse minimum than it has.
            plain, tried = self.refit(now.tried, best, ())
            now = replace(now, tried=tried)
            if plain.deviance < before.deviance:
                before, now = plain, replace(now, base=plain)
            if not self.accepts(plain, best):
                return replace(now, best=plain, without=(), alternatives=())
        had = bool(before.hypothesis)
        now = replace(now, best=best, without=(before,), alternatives=(others,))
        now = self.exchanged(now) if had else now
        return simplified(self, now) if self.settings.many_minima else now

    def _small(self, options: Sequence[Fitted], tried: SearchHistory) -> tuple[list[Fitted], SearchHistory]:
        """Options that have no more parts than are looked for."""
        return [o for o in options if len(o.hypothesis) <= self.settings.most_parts], tried

    def _top(self, best: Fitted, options: Sequence[Fitted]) -> Fitted | None:
        """The best of some options, if it is better than what they extend."""
        top = min(options, key=self.score, default=None)
        better = top is not None and self.accepts(best, top) and self.score(top) < self.score(best)
        return top if better else None

    def _may_try_all(self, best: Fitted) -> bool:
        return self.settings.many_minima and len(best.hypothesis) < self.settings.most_parts and self.data.strong(best)

    def _beside(self, now: SearchState) -> tuple[list[Fitted], SearchHistory]:
        """What the second part could be beside others than the best first one: of two together the lesser may lead."""
        tried, base = now.tried, self.score(now.base)

        def near_the_best(alternative: Fitted) -> bool:
            gain, most = base - self.score(alternative), base - self.score(now.best)
            return self.data.thresholds.decides(lambda t: gain > t.runner_up * most)

        close = [r for r in sorted(now.alternatives[0], key=self.score) if near_the_best(r)]
        found: list[Fitted] = []
        for alternative in close[:SECOND]:
            self.notify("a second effect beside another", alternative.label)
            more, tried = self._small(*self.challenge(tried, alternative))
            found += more
        return found, tried

    def _outdone(self, best: Fitted, top: Fitted) -> bool:
        """Whether a residual force explains far more than the next effect: then that effect is not the missing one."""
        at = linearise_fit(self.data, best, best.noise)
        if at is None:
            return False
        before, after = (
            sum(float((w**2).sum()) for w in whitened(self.data, best.noise, f.fit.residuals)) for f in (best, top)
        )
        force = force_candidates(at)[0].found
        most = force.held_out if at.folds else force.gain
        return self.data.thresholds.decides(lambda t: before - after < t.outdone * most)
