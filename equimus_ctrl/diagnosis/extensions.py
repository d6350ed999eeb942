"""Hypotheses with one more part: which are fitted, from where, and how far; see ``search`` for all moves."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from equimus_ctrl import computer
from equimus_ctrl.diagnosis.fitting import CONVERGED_GAIN, Data, Fitted
from equimus_ctrl.diagnosis.group_splits import own_in_each_group, splits_by_group
from equimus_ctrl.diagnosis.guessed_changes import ESTIMATED, WHITE
from equimus_ctrl.diagnosis.holdout import Split
from equimus_ctrl.diagnosis.holdout_residuals import HoldoutResiduals
from equimus_ctrl.diagnosis.hypothesis import Candidate, Hypothesis, Part
from equimus_ctrl.diagnosis.richer_laws import richer
from equimus_ctrl.diagnosis.scoring import Scoring, extra_parameters
from equimus_ctrl.diagnosis.screening import Screened, screen
from equimus_ctrl.diagnosis.search_state import (
    Choice,
    Extended,
    Proposal,
    RivalDeviance,
    SearchHistory,
    SearchState,
    no_rival,
)
from equimus_ctrl.diagnosis.thresholds import Thresholds
from equimus_ctrl.diagnosis.torque_agreement import shown_in_torques
from equimus_ctrl.diagnosis.torque_screening import TorqueDomain, torque_domain
from equimus_ctrl.diagnosis.torque_start import worth_simulating
from equimus_ctrl.diagnosis.wider_laws import wider
from equimus_ctrl.errors import SimulationDiverged
from equimus_ctrl.identification.fit import Begin
from equimus_ctrl.identification.noise import white_noise
from equimus_ctrl.identification.segments import groups_of
from equimus_ctrl.types import Array

Notify = Callable[[str, str], None]
"""Called with the stage and the best hypothesis so far."""
Reached = Callable[[Data, SearchState], None]
"""Called with where a search has come to on the way, for where a budget ends it, and the data that it is fitted to.
Fits without each of its parts may not all have been made yet."""


@dataclass(frozen=True, eq=False)
class Extensions(Scoring):
    """What a search over hypotheses (sets of candidates) extends them by.

    Attributes:
        notify: see ``Notify``.
        reached: see ``Reached``.
        fits_on_short_intervals: hypotheses with these candidates, fitted to short shooting intervals of the same
            trials, to start from.
        fits_with_other_engine: those fitted to the same segments with another engine, as further alternatives.
        held_out: trials that judge what was found. Where validation trials get worse with a part, it is not looked for
            what else that could be, nor what else is missing beside it.
    """

    notify: Notify = lambda stage, best: None
    reached: Reached = lambda data, state: None
    fits_on_short_intervals: Sequence[Fitted] = ()
    fits_with_other_engine: Sequence[Fitted] = ()
    held_out: Split | None = None

    def spoils(self, simple: Fitted, rich: Fitted) -> bool:
        """Whether what a hypothesis has more than another makes validation trials worse; not where there are none.

        By more than what two models differ by that they do not decide between: what they do not show spoils nothing.
        """
        if self.held_out is None or not self.held_out.validation:
            return False
        gain = HoldoutResiduals(self.data, self.held_out, SearchState(simple, rich)).gain(simple, rich)
        return self.data.thresholds.decides(lambda t: gain < -t.uninformative)

    def allowed_candidates(self, tried: SearchHistory) -> list[Candidate]:
        """The candidates that were not rejected; of laws with parameters of their own at each place what is left."""
        allowed = [(candidate, tried.allowed_places(candidate)) for candidate in self.pool]
        whole = [candidate for candidate, places in allowed if places == candidate.locations]
        left = [candidate.narrowed(places) for candidate, places in allowed if () != places != candidate.locations]
        labels = {candidate.label for candidate in whole}
        return [*whole, *(candidate for candidate in left if candidate.label not in labels)]

    def challenge(
        self, tried: SearchHistory, fitted: Fitted, replacing: str = "", rival: Fitted | None = None
    ) -> tuple[list[Fitted], SearchHistory]:
        """Hypotheses with one more part, the most promising ones fitted until converged.

        They are those of the history where the same hypothesis was extended before, see ``_serves``.

        Args:
            tried: the history so far.
            fitted: what they add to.
            replacing: label of a candidate that is not tried, to find others in its place.
            rival: the hypothesis with that candidate: what stays far behind it need not be fitted whole.

        Raises:
            BudgetSpent: where the budget ends.
        """
        least = no_rival if rival is None or self.settings.many_minima else self._listed_from(fitted, rival)
        for replaced in ("", replacing):
            known = tried.extended.get((fitted.labels, replaced))
            if known is None or self._measured_against_less(known, least):
                continue
            options = [o for o in known.options if replacing not in o.labels and tried.allows(o.candidates)]
            if self._serves(known, options, fitted, least):
                return options, tried
        options, tried = self.extensions(tried, fitted, replacing, rival=least)
        entry = {(fitted.labels, replacing): Extended(fitted, tuple(options), least)}
        return options, replace(tried, extended={**tried.extended, **entry})

    def _listed_from(self, fitted: Fitted, rival: Fitted) -> RivalDeviance:
        """Deviance up to which another part of one parameter may fit as well as the rival's and is listed."""
        saved = (extra_parameters(fitted, rival) - 1) * float(np.log(self.data.n))
        return lambda t: rival.deviance + saved + self.equally_good(t) + t.step_scatter

    def _measured_against_less(self, known: Extended, rival: RivalDeviance) -> bool:
        """Whether known extensions had to come nearer than to a rival, so that some are not fitted far enough."""
        return self.data.thresholds.decides(lambda t: known.rival(t) < rival(t))

    def _serves(self, known: Extended, options: Sequence[Fitted], fitted: Fitted, rival: RivalDeviance) -> bool:
        """Whether extensions of an earlier fit do for one of the same hypothesis that ended lower.

        Extensions of the lower one may end lower too, by ``SearchSettings.optimism`` times as much. Where even then
        none reaches the rival, a deviance to come near to, they decide nothing.
        """
        lower = known.base.deviance - fitted.deviance
        if lower <= CONVERGED_GAIN:
            return True
        best, hoped = min((option.deviance for option in options), default=-math.inf), self.settings.optimism * lower
        return self.data.thresholds.decides(lambda t: rival(t) < math.inf and hoped < best - rival(t))

    def extensions(
        self,
        tried: SearchHistory,
        fitted: Fitted,
        replaced: str = "",
        known: Sequence[str] | None = None,
        rival: RivalDeviance = no_rival,
    ) -> tuple[list[Fitted], SearchHistory]:
        """Hypotheses with one more part: the promising ones, or with some that are known all others.

        Args:
            tried: the history so far.
            fitted: what they add to.
            replaced: label of a candidate that is not tried.
            known: labels of those that are known; None where only promising ones are to be fitted.
            rival: deviance that they have to come near to.

        Raises:
            BudgetSpent: where the budget ends.
        """
        pool = [c for c in self.allowed_candidates(tried) if c.label not in {replaced, *(known or ())}]
        most = min(self.settings.tried, self.settings.tried_in_place) if replaced else self.settings.tried
        if (domain := self.torque_domain) is not None:
            pool = worth_simulating(self.data, domain, fitted, pool)
        choice = Choice(pool, most if known is None else len(pool), known is not None)
        screened = screen(self.data, fitted, pool)
        if not fitted.hypothesis and not tried.first:
            tried = replace(tried, first=tuple(screened))
        proposals = [*self._promising(fitted, screened, choice), *self._splits(tried, fitted)]
        if known is None:
            proposals += (Proposal(*begun) for begun in wider(self.data, fitted, pool))
        if self.settings.many_minima and not replaced:
            proposals += (Proposal(*begun) for begun in richer(self.data, fitted, pool))
        coarse = self._coarse_fits(fitted, proposals, rival)
        options = self._best_converged(fitted, coarse, rival)
        options = self._best_of_its_own_converged(fitted, coarse, options, rival)
        return options, tried.having(*options)

    def _promising(self, fitted: Fitted, screened: Sequence[Screened], choice: Choice) -> list[Proposal]:
        """For each candidate among the best of a ranking the hypothesis with it, and where its fit can begin.

        The rankings are by first-order gain, one for each whitening of the residuals. Fits begin at the parameters that
        go with the guess to first order; beside no other part also at the nominal ones.
        """
        rankings = [sorted(screened, key=_by_gain(whitening)) for whitening in (WHITE, ESTIMATED)]
        if not fitted.hypothesis and self.data.strong(fitted):
            # The missing physics may have biased the refitted model far.
            rankings.append(sorted(screen(self.data, self.nominal, choice.pool), key=_by_gain(WHITE)))
        chosen: dict[str, Proposal] = {}
        hopes = {s.candidate.label: s.gains for s in screened}

        def add(hypothesis: Hypothesis, *begins: Begin) -> None:
            label = hypothesis[-1].candidate.label
            earlier = chosen[label].begins if label in chosen else ()
            begins = tuple(b for b in begins if not any(np.array_equal(b[0], e[0]) for e in earlier))
            known = label in hopes and fitted.hypothesis and not self.settings.many_minima
            hope = self._most_fall(fitted, max(hopes[label])) if known else math.inf
            chosen[label] = Proposal(hypothesis, (*begins, *earlier), hope)
            if (split := own_in_each_group(hypothesis, groups_of(self.data.segments))) is not None:
                wider = tuple((self._in_each_group(theta, hypothesis, split), starts) for theta, starts in begins)
                chosen.setdefault(split[-1].candidate.label, Proposal(split, wider))

        for ranking in rankings:
            for s in self._different(ranking)[: choice.most]:
                if choice.keep_all or max(s.gains) > 0:
                    thetas = s.begins(self.data, fitted, self.settings.many_minima)
                    if not fitted.hypothesis:
                        thetas.append(self.data.theta_of(self.data.free.start, s.hypothesis))
                    add(s.hypothesis, *((theta, fitted.fit.starts) for theta in thetas))
        for hypothesis, begin in self._fitted_on_short_intervals(fitted, {c.label for c in choice.pool}, choice.most):
            add(hypothesis, begin)
        return list(chosen.values())

    def _most_fall(self, fitted: Fitted, gain: float) -> float:
        """By how much the deviance falls at most where χ² of whitened residuals falls by a gain.

        The deviance is a sum of n_j ln σ_j² over joints and other channels, n_j samples each. It falls most where the
        whole gain is at one of them: by n_j ln(n_j/(n_j − gain)), without bound where nothing is left.
        """
        n = self.data.n / fitted.fit.residuals[0].shape[1]
        return math.inf if gain >= n else -n * math.log(1.0 - gain / n)

    def _in_each_group(self, theta: Array, hypothesis: Hypothesis, split: Hypothesis) -> Array:
        """θ of a hypothesis whose last part has sizes of its own in groups of trials, all like the common ones in θ."""
        values = hypothesis[-1].values
        common = dict(zip(values, theta[len(theta) - len(values) :], strict=True))
        own = split[-1].candidate.own
        return np.append(theta, [common[name] for name, _ in own])

    def _different(self, ranking: Sequence[Screened]) -> Sequence[Screened]:
        """Each effect once, where it is most promising, if it is tried in more ways than at this joint and that.

        These are with its own size at each joint, and in one group of trials alone. The most promising has the largest
        gain less the information criterion's price of its parameters. Else one effect in all ways would leave no other.
        """
        if not any(s.candidate.each or s.candidate.absent for s in ranking):
            return ranking
        price = float(np.log(self.data.n))
        best: dict[str, Screened] = {}
        for s in ranking:
            now = best.get(s.candidate.effect.name)
            if now is None or _net(s, price) > _net(now, price):
                best[s.candidate.effect.name] = s
        return [s for s in ranking if best[s.candidate.effect.name] is s]

    def _fitted_on_short_intervals(
        self, fitted: Fitted, labels: Collection[str], most: int
    ) -> Iterator[tuple[Hypothesis, Begin]]:
        """A hypothesis with one more part as it was fitted to short intervals, the best score first.

        Args:
            fitted: the hypothesis that is extended.
            labels: of candidates that may be added, each once.
            most: how many are added.
        """
        present = [part.candidate.label for part in fitted.hypothesis]
        added: set[str] = set()
        for other in sorted(self.fits_on_short_intervals, key=self.score):
            parts = {part.candidate.label: part for part in other.hypothesis}
            more = parts.keys() - set(present)
            if len(parts) != len(present) + 1 or len(more) != 1 or more & added or not more <= set(labels):
                continue
            added |= more
            hypothesis = tuple(parts[label] for label in (*present, *more))
            yield hypothesis, (self.data.theta_of(other.fit.theta, hypothesis), fitted.fit.starts)
            if len(added) == most:
                return

    @cached_property
    def nominal(self) -> Fitted:
        """The nominal model, see ``Data.nominal_fit``."""
        return self.data.nominal_fit()

    @cached_property
    def torque_domain(self) -> TorqueDomain | None:
        """The measurements in the torque domain; None where the robot has none."""
        return torque_domain(self.data, self.pool)

    def _splits(self, tried: SearchHistory, fitted: Fitted) -> list[Proposal]:
        """For each part that acts alike at several places, the same with separate parameters."""
        proposals = []
        for k, part in enumerate(fitted.hypothesis):
            sites = part.candidate.locations
            if len(sites) < 2 or part.candidate.each:
                continue
            parts = tuple(Part(replace(part.candidate, locations=(site,)), part.values) for site in sites)
            if not tried.allows(p.candidate for p in parts):
                continue
            hypothesis = (*fitted.hypothesis[:k], *parts, *fitted.hypothesis[k + 1 :])
            begin = (self.data.theta_of(fitted.fit.theta, hypothesis), fitted.fit.starts)
            proposals.append(Proposal(hypothesis, (begin,)))
        own = splits_by_group(fitted.hypothesis, groups_of(self.data.segments))
        begins = [(self.data.theta_of(fitted.fit.theta, split), fitted.fit.starts) for split in own]
        return [*proposals, *(Proposal(split, (begin,)) for split, begin in zip(own, begins, strict=True))]

    def _coarse_fits(self, fitted: Fitted, proposals: Sequence[Proposal], rival: RivalDeviance) -> list[Fitted]:
        """Those that can be simulated, after a few steps, the best score first.

        Not those whose hope, times ``SearchSettings.optimism``, is less than what the best one gains, or the rival, or
        than the acceptance threshold.
        """
        options, noise = list[Fitted](), white_noise(fitted.fit.residuals)
        most = -math.inf

        def hopeless(proposal: Proposal) -> bool:
            best, hoped = most, proposal.hope * self.settings.optimism
            too_little = self.data.thresholds.decides(lambda t: hoped < max(best, fitted.deviance - rival(t)))
            return too_little or self._cannot_be_accepted(fitted, proposal.hypothesis, proposal.hope)

        def after_some_steps(proposal: Proposal) -> Fitted | Exception:
            steps = self.settings.coarse_steps
            try:
                return self.data.coarse_fit(proposal.hypothesis, proposal.begins, noise, steps, settled=fitted.labels)
            except Exception as error:  # of what may turn out not to be worth fitting
                return error

        promising = (p for p in sorted(proposals, key=lambda p: -p.hope) if not hopeless(p))
        for proposal, option in computer.side_by_side(self.data.threads, after_some_steps, promising):
            # Dropped again here, so that the answer does not depend on how many were fitted at a time.
            if hopeless(proposal) or isinstance(option, SimulationDiverged):  # so it cannot be what happened
                continue
            if isinstance(option, Exception):
                raise option
            options.append(option)
            most = max(most, fitted.deviance - option.deviance)
        return sorted(options, key=self.score)

    def _cannot_be_accepted(self, fitted: Fitted, hypothesis: Hypothesis, gain: float) -> bool:
        """Whether a gain so far, times ``SearchSettings.optimism``, is less than a larger hypothesis has to gain.

        Never where fits have many minima.
        """
        if self.settings.many_minima:
            return False
        rich, simple = (sum(p.candidate.n_parameters for p in parts) for parts in (hypothesis, fitted.hypothesis))
        more, most = max(rich - simple, 1), self.settings.optimism * gain
        return not self.data.thresholds.decides(lambda t: most > self.threshold(more, t))

    def _best_converged(self, fitted: Fitted, options: Sequence[Fitted], rival: RivalDeviance) -> list[Fitted]:
        """Coarse fits, best first, of which the first few that are close to the best are fitted until converged.

        Where fits have few minima, also others close to it that were still gaining: their rank is not known yet. Not
        those that after some more steps lack more than a share of what the rival gains, or gain too little of what
        they have to, nor those that would even with ``SearchSettings.optimism``: they do not reach it.
        """
        settings, thresholds = self.settings, self.data.thresholds

        def needed(t: Thresholds) -> float:
            return (1 - settings.rival_share) * (fitted.deviance - rival(t)) - settings.kept_gain

        def out_of_reach(option: Fitted) -> bool:
            gain = fitted.deviance - option.deviance
            if option.fit.converged and self._cannot_be_accepted(fitted, option.hypothesis, gain):
                return True
            return not settings.many_minima and thresholds.decides(lambda t: settings.optimism * gain < needed(t))

        def converged(place: int) -> Fitted:
            option, best = options[place], options[0].deviance
            close = best + settings.kept_share * max(fitted.deviance - best, 0.0) + settings.kept_gain
            ranked = settings.many_minima or option.fit.converged
            if option.deviance > close or (place >= settings.kept and ranked):
                return option
            if not out_of_reach(option):
                noise = white_noise(option.fit.residuals)
                longer = self.data.coarse_fit(
                    option.hypothesis, [option.begin], noise, settings.long_steps, settled=fitted.labels
                )
                option = min(option, longer, key=lambda f: f.deviance)
            elif place:
                return option
            if place == 0:
                option = self._or_of_other_sign(fitted, option)
            gain = fitted.deviance - option.deviance
            if thresholds.decides(lambda t: gain >= needed(t)) and not self._cannot_be_accepted(
                fitted, option.hypothesis, gain
            ):
                return self.data.converge(option, settled=self._settled(option.hypothesis, fitted.labels))
            return option

        return [after for _, after in computer.side_by_side(self.data.threads, converged, range(len(options)))]

    def _best_of_its_own_converged(
        self, fitted: Fitted, coarse: Sequence[Fitted], options: Sequence[Fitted], rival: RivalDeviance
    ) -> list[Fitted]:
        """Options of which the best that does not stand for other parameters is converged too.

        It is taken where the best one is ``aliased``. A fit that is not at its minimum would seem to need fewer parts.

        Args:
            fitted: what was extended.
            coarse: the fits that options come from, in their order.
            options: of which those that differ from their coarse fits were fitted on.
            rival: see ``_best_converged``.
        """
        ranked = sorted(range(len(options)), key=lambda k: self.score(options[k]))
        found = list(options)
        if ranked and self.aliased(options[ranked[0]]):
            own = next((k for k in ranked if not self.aliased(options[k])), None)
            if own is not None and options[own] is coarse[own]:
                (found[own],) = self._best_converged(fitted, [options[own]], rival)
        return found

    def _or_of_other_sign(self, fitted: Fitted, option: Fitted) -> Fitted:
        """The best option, or the same law fitted from guesses of the other sign where that ends lower.

        A law with one size of either sign and a place or shape may have a minimum on each side. Fits begin at the guess
        that is best before any step, which may be on the wrong side of strong physics.

        Args:
            fitted: what was extended.
            option: by one part.
        """
        last = option.hypothesis[-1]
        nothing, sizes = last.candidate.grows_from(), last.candidate.sizes
        one_shape = len(sizes) == 1 and len(last.candidate.common) > 1 and not last.candidate.own
        if self.settings.many_minima or not one_shape:
            return option
        size, none = sizes[0], nothing[sizes[0]]
        others = [v for v in last.candidate.guesses if (v[size] - none) * (last.values[size] - none) < 0]
        thetas = [fitted.fit.theta] if fitted.hypothesis else [fitted.fit.theta, self.data.free.start]
        begins = [
            (self.data.theta_of(theta, (*option.hypothesis[:-1], Part(last.candidate, values))), fitted.fit.starts)
            for theta in thetas
            for values in others
        ]
        if not begins:
            return option
        noise, steps = white_noise(option.fit.residuals), self.settings.long_steps
        try:
            other = self.data.coarse_fit(option.hypothesis, begins, noise, steps, settled=fitted.labels)
        except SimulationDiverged:  # so it cannot be what happened
            return option
        return min(option, other, key=lambda f: f.deviance)

    def aliased(self, fitted: Fitted) -> bool:
        """Whether the last part of a hypothesis stands for other parameters, see ``Data.aliased``.

        Where bounds are wide and minima many, also where its size may be nothing, see ``Data.may_be_nothing``, or
        where the torque domain does not show it, see ``shown_in_torques``.
        """
        last = len(fitted.hypothesis) - 1
        if last < 0:
            return False
        if self.data.aliased(fitted, last) or (self.settings.many_minima and self.data.may_be_nothing(fitted, last)):
            return True
        return (domain := self.torque_domain) is not None and not shown_in_torques(self.data, domain, fitted, last)

    def _settled(self, hypothesis: Hypothesis, labels: Collection[str]) -> bool:
        """Whether no discontinuous parameter is of a part other than those with some labels, which were fitted."""
        return not self.data.discontinuous(hypothesis, labels)


def _net(screened: Screened, price: float) -> float:
    return max(screened.gains) - price * screened.candidate.n_parameters


def _by_gain(whitening: int) -> Callable[[Screened], float]:
    return lambda s: -s.gains[whitening]
