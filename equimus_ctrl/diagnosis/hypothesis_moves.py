"""Moves from one hypothesis to another: without a part, with another in its place; see ``search`` for all of them."""

from __future__ import annotations

from dataclasses import dataclass, replace

from equimus_ctrl.diagnosis.compensation import compensated
from equimus_ctrl.diagnosis.extensions import Extensions
from equimus_ctrl.diagnosis.fitting import CONVERGED_GAIN, Fitted
from equimus_ctrl.diagnosis.hypothesis import Hypothesis, Part, model_of
from equimus_ctrl.diagnosis.search_state import (
    SearchHistory,
    SearchState,
)
from equimus_ctrl.errors import ConfigError, SimulationDiverged
from equimus_ctrl.identification.fit import Begin
from equimus_ctrl.identification.noise import white_noise


@dataclass(frozen=True, eq=False)
class HypothesisMoves(Extensions):
    """The moves of a search over hypotheses, adding a part included."""

    def exchanged(self, state: SearchState) -> SearchState:
        """Parts that are not needed dropped, parts for which others fit better exchanged.

        Raises:
            BudgetSpent: where the budget ends.
            SimulationDiverged: where a hypothesis without one of its parts diverges.
        """
        for _ in range(self.settings.exchanges):
            state, changed = self._dropped_or_exchanged(state)
            self.reached(self.data, state)
            if not changed:
                return state
        return self.moved(state, state.best)

    def _dropped_or_exchanged(self, state: SearchState) -> tuple[SearchState, bool]:
        """The first part that is not needed dropped, or the first that another outdoes exchanged; whether one was.

        Where none was, the state has all fits without a part and with another in its place. Nothing is tried in a
        part's place beside one that is not needed: that takes much longer than to find out which are.
        """
        needed = self._without_each(state)
        if needed.best is not state.best:
            return needed, True
        best, without, tried = state.best, needed.without, needed.tried
        alternatives: list[tuple[Fitted, ...]] = []
        for part, rest in zip(best.hypothesis, without, strict=True):
            self.notify(f"in the place of {part.candidate.label}", best.label)
            others, tried = self.challenge(tried, rest, part.candidate.label, best)
            self.reached(self.data, replace(needed, tried=tried))
            alternatives.append(tuple(others))
            no_larger = [o for o in others if len(o.hypothesis) <= len(best.hypothesis)]
            better = [o for o in no_larger if self.outdoes(o, best)]
            top = next((o for o in sorted(better, key=self.score) if not self.aliased(o)), None)
            if top is not None:
                return replace(state, best=top, without=(), alternatives=(), tried=tried), True
        return replace(state, best=best, without=without, alternatives=tuple(alternatives), tried=tried), False

    def needed(self, state: SearchState) -> SearchState:
        """Parts that are not needed dropped, one by one.

        Raises:
            BudgetSpent: where the budget ends.
            SimulationDiverged: where a hypothesis without one of its parts diverges.
        """
        while (after := self._without_each(state)).best is not state.best:
            state = after
            self.reached(self.data, state)
        return after

    def _without_each(self, state: SearchState) -> SearchState:
        """The first part that is not needed dropped; where all are, the same with the fits without each of them."""
        best, tried = state.best, state.tried
        without: list[Fitted] = []
        for k, part in enumerate(best.hypothesis):
            self.notify(f"without {part.candidate.label}", best.label)
            rest, tried = self.refit(tried, best, best.hypothesis[:k] + best.hypothesis[k + 1 :])
            self.reached(self.data, replace(state, without=(), alternatives=(), tried=tried))
            if not self.accepts(rest, best):
                return replace(state, best=rest, without=(), alternatives=(), tried=tried)
            without.append(rest)
        alternatives = tuple(() for _ in without)
        return replace(state, best=best, without=tuple(without), alternatives=alternatives, tried=tried)

    def refitted(
        self, tried: SearchHistory, fitted: Fitted, hypothesis: Hypothesis
    ) -> tuple[list[Fitted], SearchHistory]:
        """As ``refit``; nothing where parts exclude each other or it cannot have happened.

        Raises:
            BudgetSpent: where the budget ends.
        """
        try:
            after, tried = self.refit(tried, fitted, hypothesis)
        except (ConfigError, SimulationDiverged):
            return [], tried
        return [after], tried

    def moved(self, state: SearchState, best: Fitted) -> SearchState:
        """A search moved to another hypothesis, with what it would be without each part.

        Raises:
            BudgetSpent: where the budget ends.
            SimulationDiverged: where a hypothesis without one of its parts diverges.
        """
        parts, tried = best.hypothesis, state.tried
        without: list[Fitted] = []
        for k in range(len(parts)):
            rest, tried = self.refit(tried, best, parts[:k] + parts[k + 1 :])
            self.reached(self.data, replace(state, tried=tried))
            without.append(rest)
        # The alternatives were fitted beside other parts, so they are fitted anew, see ``alternatives.listed``.
        return replace(state, best=best, without=tuple(without), alternatives=tuple(() for _ in parts), tried=tried)

    def refit(self, tried: SearchHistory, fitted: Fitted, hypothesis: Hypothesis) -> tuple[Fitted, SearchHistory]:
        """A hypothesis fitted until converged, from the model parameters and initial states of another's fit.

        Where it diverges from there, it begins at the nominal parameters and the measured initial states. Where it ends
        above a simpler hypothesis that was fitted before, it begins again at that.

        Args:
            tried: the history so far.
            fitted: the other hypothesis.
            hypothesis: with initial values.

        Raises:
            ConfigError: where two parts exclude each other.
            SimulationDiverged: where it diverges from both.
            BudgetSpent: where the budget ends.
        """
        data = self.data
        model_of(data.free.model, hypothesis)  # raises where parts exclude each other
        key = (fitted, tuple((part.candidate.label, *part.values.values()) for part in hypothesis))
        if (known := tried.refits.get(key)) is not None:
            return known, tried
        noise, steps = white_noise(fitted.fit.residuals), self.settings.long_steps
        try:
            begins: list[Begin] = [(data.theta_of(fitted.fit.theta, hypothesis), fitted.fit.starts)]
            if self.settings.many_minima and (made_up := compensated(data, fitted, hypothesis)) is not None:
                begins.append((made_up, fitted.fit.starts))
            after = data.coarse_fit(hypothesis, begins, noise, steps, settled=fitted.labels)
        except SimulationDiverged:
            begins = [(data.theta_of(data.free.start, hypothesis), [s.start for s in data.segments])]
            after = data.coarse_fit(hypothesis, begins, noise, steps, settled=fitted.labels)
        after = data.converge(after, settled=self._settled(hypothesis, fitted.labels))
        if (poorer := self._poorer(tried, after)) is not None:
            after = min(after, poorer, key=lambda f: f.deviance)
        return after, replace(tried.having(after), refits={**tried.refits, key: after})

    def _poorer(self, tried: SearchHistory, fitted: Fitted) -> Fitted | None:
        """A hypothesis fitted from the best simpler one, where that fits better though it is held by it.

        So a fit has failed: of parts that some trial diverges with beside fewer others, say. None where it has not, or
        some further part has no value at which it does nothing.

        Raises:
            BudgetSpent: where the budget ends.
        """
        data, labels = self.data, fitted.labels
        simpler = min((f for f in tried.fitted if f.labels < labels), key=lambda f: f.deviance, default=None)
        if simpler is None or simpler.deviance > fitted.deviance - CONVERGED_GAIN:
            return None
        known = {part.candidate.label: part for part in simpler.hypothesis}
        further = [p for p in fitted.hypothesis if p.candidate.label not in known]
        if not all(p.candidate.sizes for p in further):
            return None
        faded = {p.candidate.label: Part(p.candidate, {**p.values, **p.candidate.grows_from()}) for p in further}
        hypothesis = tuple((known | faded)[part.candidate.label] for part in fitted.hypothesis)
        begin = (data.theta_of(simpler.fit.theta, hypothesis), simpler.fit.starts)
        noise, steps = white_noise(simpler.fit.residuals), self.settings.long_steps
        try:
            begun = data.coarse_fit(hypothesis, [begin], noise, steps, settled=simpler.labels)
        except SimulationDiverged:  # so nothing begins there
            return None
        return data.converge(begun, settled=self._settled(hypothesis, simpler.labels))
