"""Which set of effects: forward from the refitted model, backward where one is not needed, sideways where another fits.

A hypothesis is scored by its deviance (−2 log likelihood, its own noise included) and its number of parameters. A part
is accepted where the deviance falls by more than the acceptance threshold, see ``Scoring.threshold``.

The moves:

    add        one more candidate                                          ``challenge``, ``extensions``
    remove     a part whose gain is not accepted                           ``exchanged``, ``without_parts``
    exchange   another candidate in a part's place                         ``exchanged``, ``contested``, ``in_place``
    split      a law alike at several places → one at each                 ``extensions``, of what it extends
    merge      laws at single places → one alike at several                ``extensions``: it drops what it excludes
    enrich     a law → one that holds it as a special case                 ``extensions``, where minima are many
    widen      a law at some places → at all, each with its own parameters ``wider``
    narrow     a law alike at several places → at one place less           ``narrowed``, ``exchanged_beside_fewer``
    prune      a law with its own parameters at each place → where needed  ``pruned``
    unite      several laws → one that explains as much                    ``with_fewer_laws``, then pruned, simplified
    imitate    other laws in a part's place, from where they imitate it    ``with_imitators``, where minima are many
    simplify   Stribeck → Coulomb friction, and such, where that will do   ``simplified``

A search of an MJCF robot begins with the laws that its measured torques ask for (``begun_in_torques``), each enriched
where a richer one fits better; every other search with the refitted model alone.

Where errors grow along a trial, fits have many local minima (``SearchSettings.many_minima``): deviances scatter, and
first-order gains predict little. What differs:

                                        few local minima              many local minima
    acceptance threshold                max(χ² quantile, ε·n)         the same + ``minima_scatter``
    candidates fitted as one more       the promising ones            all others too, if residuals are large and none is
                                                                      accepted or a residual force explains far more
    their initial guesses               as they are                   also rescaled (``rescaled_guesses``)
    what seems to gain too little       is not fitted further         is fitted (``SearchSettings.optimism``)
    fits still gaining after few steps  go on where they are close    by their rank alone (``SearchSettings.kept``)
    a law with a size of either sign    the best one also fitted      as its guesses have it
                                        from the other sign
    rounds outdone by a residual force  none                          one (``PATIENCE``)
    rounds whose gain does not stand    as any others                 one, likewise: no such part is confirmed
    out from the residuals' scatter,                                  but nothing is exchanged beside it
    or makes validation trials worse
    the model without effects           fitted once                   refitted from the first effect's fit
    after each addition                 exchanged, from two parts on  the same, then pruned and simplified
    where a part is left out            from the others' values           also from what makes up for it to first order
    at the end                          contested, narrowed, united   united, imitated
    what else fits in a part's place    fitted beside the other parts also what did beside any others (``in_place``)
    what held-out trials do not confirm is dropped; the only part is  exchanged for another hypothesis fitted, if one
                                        exchanged for one that fits   is confirmed; else the same
                                        as well, if it is confirmed
    where they confirm none             nothing is named              the best effects alone are judged
    a law richer than they confirm      stays                         a simpler one takes its place
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache
from itertools import islice

from equimus_ctrl.diagnosis.alternatives import contested, exchanged_beside_fewer, narrowed, pruned, simplified
from equimus_ctrl.diagnosis.fewer_laws import with_fewer_laws
from equimus_ctrl.diagnosis.fitting import Fitted, chi_squared
from equimus_ctrl.diagnosis.hypothesis import Candidate
from equimus_ctrl.diagnosis.hypothesis_moves import HypothesisMoves
from equimus_ctrl.diagnosis.imitators import with_imitators
from equimus_ctrl.diagnosis.residual_force import force_candidates, linearise_fit
from equimus_ctrl.diagnosis.richer_laws import richer
from equimus_ctrl.diagnosis.screening import screen
from equimus_ctrl.diagnosis.search_state import Outdone, SearchHistory, SearchState, StopReason, begun_at
from equimus_ctrl.diagnosis.torque_start import laws_asked_for, worth_simulating
from equimus_ctrl.errors import SimulationDiverged
from equimus_ctrl.identification.noise import white_noise

LOST: Outdone = "gains do not stand out from the scatter"
SPOILS: Outdone = "validation trials get worse"
DOUBTFUL = (LOST, SPOILS)
"""Of a part that will not be confirmed as things are, but may be beside one more."""


@dataclass(frozen=True, eq=False)
class _Options:
    """Hypotheses with one more part than another.

    Attributes:
        fitted: all of them.
        best: the best one, if its gain is accepted and its score is better; None otherwise.
        outdone: what speaks against its last part; None where nothing does.
    """

    fitted: tuple[Fitted, ...]
    best: Fitted | None
    outdone: Outdone | None


@dataclass(frozen=True, eq=False)
class _Forward:
    """A forward search under way.

    Attributes:
        state: with the hypothesis that is extended next.
        last_accepted: the last one whose last part nothing spoke against.
        rounds_outdone: how many rounds in a row, up to the last one, added a part that something spoke against.
        stop: why it is at its end; None where it goes on.
    """

    state: SearchState
    last_accepted: SearchState
    rounds_outdone: int = 0
    stop: StopReason | None = None


class Search(HypothesisMoves):
    """A search over sets of candidates, from where one begins to where it ends."""

    def run(self, base: Fitted, imitated: bool = True) -> SearchState:
        """Search from a model without effects that was refitted; see ``steps``."""
        return self.go_on(begun_at(base), imitated=imitated)

    def beginning(self, base: Fitted, start: Fitted) -> SearchState:
        """A hypothesis without the parts that are not needed, and with better fitting ones in its parts' places."""
        *_, begun = self.beginnings(base, start)
        return begun

    def beginnings(self, base: Fitted, start: Fitted) -> Iterator[SearchState]:
        """The same step by step: at first without the parts that are not needed."""
        pool, domain = self.pool, self.torque_domain
        if domain is not None:
            pool = worth_simulating(self.data, domain, base, pool)
        begun = begun_at(base)
        first = replace(begun.tried, first=tuple(screen(self.data, base, pool)))
        state = self.needed(replace(begun, best=start, tried=first))
        yield state
        # Several may be what one law is: exchanged one by one, each takes a round of fits.
        yield simplified(self, pruned(self, self.exchanged(with_fewer_laws(self, state))))

    def begun_in_torques(self, state: SearchState) -> Iterator[SearchState]:
        """A search that begins with the laws that measured torques ask for, step by step; none where they ask for none.

        Of many joints that all rub, laws come together or not at all: one by one each is hidden by the others.
        """
        domain, most = self.torque_domain, self.settings.most_parts
        asked = None if domain is None else laws_asked_for(self.data, domain, self.pool, most)
        if domain is None or asked is None:
            return
        hypothesis, theta = asked
        self.notify("what the measured torques ask for", state.best.label)
        data, base = self.data, state.base
        begins = [
            (data.theta_of(theta, hypothesis), [s.start for s in data.segments]),
            (data.theta_of(base.fit.theta, hypothesis), base.fit.starts),
        ]
        try:
            noise = white_noise(base.fit.residuals)
            start = data.coarse_fit(hypothesis, begins, noise, self.settings.long_steps)
            if start.deviance > base.deviance:  # far from any minimum: it holds the model without effects too
                return
            start = data.converge(self._enriched(start, self.pool))
        except SimulationDiverged:  # so it cannot be what happened
            return
        if self.accepts(base, start):
            yield from self.beginnings(base, start)

    def _enriched(self, fitted: Fitted, pool: Sequence[Candidate]) -> Fitted:
        """A hypothesis, or a better one with a richer law in a part's place: too simple a law makes others look needed.

        Raises:
            BudgetSpent: where the budget ends.
        """
        options, noise = [fitted], white_noise(fitted.fit.residuals)
        for hypothesis, begins in richer(self.data, fitted, pool):
            with suppress(SimulationDiverged):  # so it cannot be what happened
                options.append(self.data.coarse_fit(hypothesis, begins, noise, self.settings.long_steps))
        return min(options, key=self.score)

    def go_on(self, state: SearchState, further: bool = True, imitated: bool = True) -> SearchState:
        """Search from where one ended; see ``steps``."""
        for after in self.steps(state, further, imitated):
            state = after
        return state

    def steps(self, state: SearchState, further: bool = True, imitated: bool = True) -> Iterator[SearchState]:
        """Search from where one ended, step by step; the last step is the end, and says why it is.

        Args:
            state: there.
            further: whether more parts are tried, or only alternatives of the present ones.
            imitated: whether at the end other laws are fitted from where they imitate a part.
        """
        if not further:
            yield self._finished(replace(self.exchanged(state), stopped="no more parts asked for"), imitated)
            return
        forward = _Forward(state, state)
        for depth in range(self.settings.rounds_per_part * self.settings.most_parts):
            self.notify(f"what could be missing, round {depth + 1}", forward.state.best.label)
            forward = self._round(forward)
            if forward.stop is not None:
                break
            yield replace(forward.last_accepted, tried=forward.state.tried)
        last, stopped = forward.state, forward.stop or "most rounds"
        yield self._finished(
            replace(forward.last_accepted, base=last.base, tried=last.tried, stopped=stopped), imitated
        )

    def _finished(self, state: SearchState, imitated: bool) -> SearchState:
        """The end: each part the best in its place, at the fewest places, and as few of them as explain as much."""
        state = narrowed(self, exchanged_beside_fewer(self, contested(self, state)))
        united = with_fewer_laws(self, state)
        if united.best is not state.best:
            united = narrowed(self, simplified(self, pruned(self, united)))
        return with_imitators(self, united) if imitated else united

    def _round(self, forward: _Forward) -> _Forward:
        """One more part, or the reason to stop."""
        options, tried = self._options(forward)
        self.reached(self.data, replace(forward.last_accepted, tried=tried))
        before = forward.rounds_outdone
        rounds_outdone = 0 if options.outdone is None else before + 1
        forward = replace(forward, state=replace(forward.state, tried=tried), rounds_outdone=rounds_outdone)
        if (stop := self._stop_reason(options, rounds_outdone)) is not None:
            return replace(forward, stop=stop)
        search = self if options.outdone is None else self._withholding(forward.last_accepted)
        return search._extended(forward, options, before)

    def _withholding(self, accepted: SearchState) -> Search:
        """The same search, of which only what it tries is told on the way: a budget is not to end it elsewhere."""
        return replace(self, reached=lambda data, way: self.reached(data, replace(accepted, tried=way.tried)))

    def _options(self, forward: _Forward) -> tuple[_Options, SearchHistory]:
        """Hypotheses with one more part: the promising ones; all others too where that may help."""
        best, accepted = forward.state.best, forward.last_accepted.best
        extended, tried = self.challenge(forward.state.tried, best)
        fitted = self._small(extended)
        top = self._top(best, fitted)
        force = cache(lambda: self._strongest_force(accepted))
        outdone = top is not None and self._outdone(accepted, top, force)
        if self._may_try_all(best) and (top is None or outdone):
            self.notify("what could be missing, all there is", best.label)
            known = [option.hypothesis[-1].candidate.label for option in fitted]
            others, tried = self.extensions(tried, best, known=known)
            fitted = [*fitted, *others]
            if (better := self._top(best, fitted)) is not top:
                top, outdone = better, better is not None and self._outdone(accepted, better, force)
        return _Options(tuple(fitted), top, self._against(best, top, outdone)), tried

    def _against(self, best: Fitted, top: Fitted | None, outdone: bool) -> Outdone | None:
        """Why what a larger hypothesis adds may not be what is missing; None where nothing speaks against it."""
        if top is not None and best.hypothesis and (doubtful := self._doubtful([best], top)):
            return doubtful
        return "a residual force explains more" if outdone else None

    def _doubtful(self, without: Sequence[Fitted], best: Fitted) -> Outdone | None:
        """Why some part will not be confirmed as things are; None where none is doubtful, or minima are few.

        Its gain does not stand out from the scatter of the residuals, or validation trials get worse with it. But of
        two that are missing each may be lost in what the other leaves, or stand for it.
        """
        if not self.settings.many_minima:
            return None
        if any(self.lost(rest, best) for rest in without):
            return LOST
        return SPOILS if any(self.spoils(rest, best) for rest in without) else None

    def _stop_reason(self, options: _Options, rounds_outdone: int) -> StopReason | None:
        """Why the search stops before any of some options; None where it takes one."""
        if options.best is None:
            return "no effect accepted"
        if options.outdone in DOUBTFUL and len(options.best.hypothesis) >= self.settings.most_parts:
            return options.outdone  # so nothing can come beside it
        return options.outdone if rounds_outdone > self.settings.patience else None

    def _extended(self, forward: _Forward, options: _Options, before: int) -> _Forward:
        """A search with the best of some options, which a round that something speaks against does not accept yet.

        Args:
            forward: the search.
            options: of which one is accepted by itself.
            before: how many rounds in a row had come to what something spoke against.
        """
        state, fitted = forward.state, options.fitted
        if options.best is not None and options.outdone in DOUBTFUL:
            # Looked at is only what comes next, beside which it may stand out: nothing is exchanged until it does.
            return replace(forward, state=replace(state, best=options.best, without=(), alternatives=()))
        if len(state.best.hypothesis) == 1:
            more, tried = self._beside_runners_up(state)
            fitted, state = (*fitted, *more), replace(state, tried=tried)
        after = self._with_one_more(state, fitted)
        had, has = bool(forward.state.best.hypothesis), bool(after.best.hypothesis)
        if had and has and options.outdone is None and (doubtful := self._doubtful(after.without, after.best)):
            rounds_outdone = before + 1
            stop: StopReason | None = doubtful if rounds_outdone > self.settings.patience else None
            return replace(forward, state=after, rounds_outdone=rounds_outdone, stop=stop)
        # Without parts before and after, the model alone was refitted, and fits as well as any option.
        accepted = not forward.rounds_outdone or not (had or has)
        stop = "no part needed" if had and not has else None
        return replace(forward, state=after, last_accepted=after if accepted else forward.last_accepted, stop=stop)

    def _with_one_more(self, state: SearchState, options: Sequence[Fitted]) -> SearchState:
        """A search with the best of some larger hypotheses, its parts exchanged where others fit better."""
        simple, best = state.best, next(o for o in sorted(options, key=self.score) if not self.aliased(o))
        if self.settings.many_minima and not simple.hypothesis:
            # The first fit of the model alone may have ended in a worse minimum than it has.
            plain, tried = self.refit(state.tried, best, ())
            state = replace(state, tried=tried)
            if plain.deviance < simple.deviance:
                simple, state = plain, replace(state, base=plain)
            if not self.accepts(plain, best):
                return replace(state, best=plain, without=(), alternatives=())
        others = tuple(option for option in options if option is not best)
        state = replace(state, best=best, without=(simple,), alternatives=(others,))
        if simple.hypothesis:
            state = self.exchanged(state)
        return simplified(self, pruned(self, state)) if self.settings.many_minima else state

    def _small(self, options: Sequence[Fitted]) -> list[Fitted]:
        """Options that have no more parts than are looked for."""
        return [option for option in options if len(option.hypothesis) <= self.settings.most_parts]

    def _top(self, best: Fitted, options: Sequence[Fitted]) -> Fitted | None:
        """The best of some options, if it is better than what they extend; none that stands for other parameters."""
        for top in sorted(options, key=self.score):
            if not (self.accepts(best, top) and self.score(top) < self.score(best)):
                return None
            if not self.aliased(top):
                return top
        return None

    def _may_try_all(self, best: Fitted) -> bool:
        """Whether first-order gains beside a hypothesis predict little, and it may have more parts."""
        return self.settings.many_minima and len(best.hypothesis) < self.settings.most_parts and self.data.strong(best)

    def _beside_runners_up(self, state: SearchState) -> tuple[list[Fitted], SearchHistory]:
        """Two parts of which the first is not the best one alone, but gains about as much.

        Of two missing effects the one that matters less may fit better alone, and hide the other. Not where the first
        leaves the same residuals as the best one, such as a law that holds it as a special case: the second would be
        the same.
        """
        tried, base = state.tried, self.score(state.base)

        def near_the_best(alternative: Fitted) -> bool:
            gain, most = base - self.score(alternative), base - self.score(state.best)
            return self.data.thresholds.decides(lambda t: gain > t.runner_up * most)

        close = [option for option in sorted(state.alternatives[0], key=self.score) if near_the_best(option)]
        options: list[Fitted] = []
        others = (option for option in close if not self._leaves_the_same(state.best, option))
        for alternative in islice(others, self.settings.runners_up):
            self.notify("a second effect beside another", alternative.label)
            more, tried = self.challenge(tried, alternative)
            options += self._small(more)
        return options, tried

    def _leaves_the_same(self, best: Fitted, other: Fitted) -> bool:
        """Whether the predictions of two fits differ by less than what makes hypotheses distinguishable.

        Never where fits have many minima: what each is extended to depends on where it ended.
        """
        if self.settings.many_minima:
            return False
        apart = [a - b for a, b in zip(best.fit.residuals, other.fit.residuals, strict=True)]
        distance = chi_squared(best.noise, self.data.times, apart)
        return self.data.thresholds.decides(lambda t: distance < t.indistinguishable)

    def _outdone(self, best: Fitted, top: Fitted, force: Callable[[], float | None]) -> bool:
        """Whether a residual force explains far more than what a larger hypothesis adds: then that is not missing.

        The addition explains χ²(best) − χ²(top), both whitened by the noise of ``best``. No force gains more than there
        is, χ²(best), so it is not asked for where the addition explains enough of that.

        Args:
            best: the hypothesis accepted.
            top: the larger one.
            force: what the strongest residual force of ``best`` explains, see ``_strongest_force``.
        """
        before, after = (chi_squared(best.noise, self.data.times, f.fit.residuals) for f in (best, top))
        if not self.data.thresholds.decides(lambda t: before - after < t.outdone * before):
            return False
        most = force()
        return most is not None and self.data.thresholds.decides(lambda t: before - after < t.outdone * most)

    def _strongest_force(self, fitted: Fitted) -> float | None:
        """Fall of χ² by the strongest residual force of a hypothesis; None where its motion cannot be followed.

        In cross-validation; of a single trial that on what was fitted.
        """
        linearised = linearise_fit(self.data, fitted, fitted.noise)
        if linearised is None:
            return None
        found = force_candidates(linearised)[0].found
        return found.held_out if linearised.folds else found.gain
