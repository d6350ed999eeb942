"""Which set of effects: forward from the refitted model, backward where one is not needed, sideways where another fits.

A hypothesis is judged by its deviance (−2 log likelihood, its own noise included) and the numbers it needs. A part
is believed when the deviance falls by more than chance gives to the best of all candidates, and by more than two
simulations of one leg differ.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

from equimus_ctrl.diagnosis.alternatives import contested, narrowed, simplified
from equimus_ctrl.diagnosis.fitting import Fitted, whitened
from equimus_ctrl.diagnosis.hypothesis_moves import Moves, Searched
from equimus_ctrl.diagnosis.residual_force import flexible, linear
from equimus_ctrl.diagnosis.screening import screen

OUTDONE = 0.5
"""Least share of what the best flexible push would explain that the next effect has to."""
BESIDE, SECOND = 0.7, 2
"""Least share of the best first part's gain, and how many others with as much are given a second part as well."""


class Search(Moves):
    """A search over sets of candidates, from where one begins to where it ends."""

    @cached_property
    def _compared(self) -> dict[tuple[Fitted, Fitted], bool]:
        return {}

    def run(self, base: Fitted) -> Searched:
        """Search from a model without effects that was refitted."""
        return self.go_on(Searched(base, base, (), (), (), ()))

    def beginning(self, base: Fitted, start: Fitted) -> Searched:
        """A hypothesis to go on from, less what is not needed and with what fits better in its parts' places."""
        self._first = tuple(screen(self.data, base, self.pool))
        best, without, rivals = self.exchanged(start)
        return simplified(self, Searched(base, best, without, rivals, self._first, tuple(self.fitted)))

    def go_on(self, found: Searched, barred: Sequence[str] = (), further: bool = True) -> Searched:
        """Search from where one ended.

        Args:
            found: there.
            barred: labels of candidates that are not to be part of it.
            further: whether more parts are looked for, or only others in the places of those that are there.
        """
        self.barred |= set(barred)
        base, best, without = found.base, found.best, found.without
        rivals = tuple(tuple(r for r in own if self.allows(r.labels)) for own in found.rivals)
        sure, outdone = (best, without, rivals) if further else self.exchanged(best), 0
        for depth in range(2 * self.settings.most_parts if further else 0):
            self.notify(f"what could be missing, round {depth + 1}", best.label)
            options = [o for o in self.challenge(best) if len(o.hypothesis) <= self.settings.most_parts]
            if self._may_try_all(best) and self._leads_nowhere(sure[0], best, options):
                self.notify("what could be missing, all there is", best.label)
                options += self._options(best, "", [o.hypothesis[-1].candidate.label for o in options])
            if not options:
                break
            top = min(options, key=self.score)
            if not self._better(best, top):
                break
            if self._outdone(sure[0], top):
                outdone += 1
                if outdone > self.settings.patience:
                    break
            else:
                outdone = 0
            if len(best.hypothesis) == 1:
                options += self._beside(base, best, rivals[0])
                top = min(options, key=self.score)
            others = tuple(o for o in options if o is not top)
            before, best = best, top
            if self.settings.many_minima and not before.hypothesis:
                # The first fit of the model alone may have ended in a worse minimum than it has.
                plain = self.refit(best, ())
                if plain.deviance < before.deviance:
                    base = before = plain
                if not self.believed(plain, best):
                    best, without, rivals = plain, (), ()
                    sure = best, without, rivals
                    continue
            without, rivals = (before,), (others,)
            if before.hypothesis:
                best, without, rivals = self.exchanged(best)
            if self.settings.many_minima:
                least = simplified(self, Searched(base, best, without, rivals, (), ()))
                best, without, rivals = least.best, least.without, least.rivals
            if not outdone:
                sure = best, without, rivals
            if not best.hypothesis:
                break
        best, without, rivals = contested(self, *sure)
        return narrowed(self, Searched(base, best, without, rivals, self._first, tuple(self.fitted)))

    def _better(self, best: Fitted, top: Fitted) -> bool:
        return self.believed(best, top) and self.score(top) < self.score(best)

    def _leads_nowhere(self, sure: Fitted, best: Fitted, options: Sequence[Fitted]) -> bool:
        """Whether none of some options is one to go on with."""
        top = min(options, key=self.score, default=None)
        return top is None or not self._better(best, top) or self._outdone(sure, top)

    def _may_try_all(self, best: Fitted) -> bool:
        return self.settings.many_minima and len(best.hypothesis) < self.settings.most_parts and self.data.strong(best)

    def _beside(self, base: Fitted, best: Fitted, rivals: Sequence[Fitted]) -> list[Fitted]:
        """What the second part could be beside others than the best first one: of two together the lesser may lead."""
        least = BESIDE * (self.score(base) - self.score(best))
        near = [r for r in sorted(rivals, key=self.score) if self.score(base) - self.score(r) > least]
        found = []
        for rival in near[:SECOND]:
            self.notify("what could be missing beside another", rival.label)
            found += [o for o in self.challenge(rival) if len(o.hypothesis) <= self.settings.most_parts]
        return found

    def _outdone(self, best: Fitted, top: Fitted) -> bool:
        """Whether a flexible push would explain far more than the next effect: then that is not what is missing."""
        if (best, top) not in self._compared:
            self._compared[best, top] = self._is_outdone(best, top)
        return self._compared[best, top]

    def _is_outdone(self, best: Fitted, top: Fitted) -> bool:
        at = linear(self.data, best, best.noise)
        if at is None:
            return False
        before, after = (
            sum(float((w**2).sum()) for w in whitened(self.data, best.noise, f.fit.residuals)) for f in (best, top)
        )
        push = flexible(at)[0].found
        return before - after < OUTDONE * (push.held_out if at.folds else push.gain)
