"""How a diagnosis fits and searches.

``SearchPolicy`` is how searches differ; most of what differs between robots is asked of ``RobotTraits`` where it
matters. The numbers that accept or reject are ``thresholds.Thresholds``.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from equimus_ctrl.engines.base import Engine
from equimus_ctrl.robots.base import RobotTraits


@dataclass(frozen=True)
class SearchSettings:
    """How much a search looks at. Of the numbers that only say what is fitted, more takes longer and misses less.

    Four say more. ``most_parts`` bounds the answer. ``patience`` ends a search. ``unconfirmed`` is how many hypotheses
    may try held-out trials, and each may be confirmed by chance. ``many_minima`` adds ``Thresholds.minima_scatter`` to
    what an effect has to gain.

    Attributes:
        most_parts: largest number of effects in a hypothesis.
        rounds_per_part: rounds for each of them, at most: each adds a part, and may drop another beside it.
        tried: candidates fitted at each step, for each whitening of the residuals.
        tried_in_place: the same of candidates that are to take a part's place.
        kept: of them, how many are fitted until converged, if they are close to the best one, see ``kept_share``. Where
            fits have few minima others too that are as close and still gain.
        kept_share: close is what lacks at most this share of the best one's gain in −2 ln L, and ``kept_gain`` more.
        kept_gain: see ``kept_share`` [−2Δln L].
        rival_share: in the place of a part, only what lacks at most this share of its gain, and ``kept_gain`` more, is
            fitted until converged.
        optimism: beside other parts, fits gain at most so many times what is expected to first order, and converged
            fits so many times what quick ones gain: what then gains less than the best one, or than the acceptance
            threshold, is not fitted further. Gains to first order were exceeded up to 1.7 times on the real leg's
            recordings.
        coarse_steps: iterations of a first fit.
        long_steps: iterations of the next fit, of the few that are best by then.
        runners_up: so many others than the best first part, of those with about as much gain, are given a second too.
        exchanges: rounds in which parts are exchanged, at most.
        contests: how often each part's alternatives are fitted beside the other parts.
        contenders: how many of its alternatives are.
        unconfirmed: hypotheses tried in the place of one that held-out trials do not confirm.
        again: how often a search goes on beside the accepted effects where residual forces made others redundant. If
            it comes to such effects again, the residuals stay unexplained.
        patience: how many effects in a row may explain far less than a residual force before the search ends: of two
            missing effects each alone may.
        many_minima: whether fits have many local minima because errors grow along a trial. Deviances then scatter, and
            first-order gains predict little; ``search`` has all that differs.
    """

    most_parts: int = 4
    rounds_per_part: int = 2
    tried: int = 5
    tried_in_place: int = 3
    kept: int = 3
    kept_share: float = 0.5
    kept_gain: float = 50.0
    rival_share: float = 0.3
    optimism: float = 3.0
    coarse_steps: int = 5
    long_steps: int = 15
    runners_up: int = 2
    exchanges: int = 8
    contests: int = 2
    contenders: int = 2
    unconfirmed: int = 3
    again: int = 1
    patience: int = 0
    many_minima: bool = False


@dataclass(frozen=True)
class SearchPolicy:
    """How a diagnosis of a robot on an engine fits and searches, beside the user's settings.

    Attributes:
        coarse_derivatives: quick fits take derivatives from the coarser engine and end at small gains, for a
            simulation is costly.
        rescaled_guesses: guesses whose change far exceeds the residuals are tried rescaled too. Errors add up along a
            trial, so a large change predicts little of a smaller one.
        many_minima: see ``SearchSettings``.
    """

    coarse_derivatives: bool = False
    rescaled_guesses: bool = False
    many_minima: bool = False

    @classmethod
    def of(cls, traits: RobotTraits, engine: Engine) -> SearchPolicy:
        """The policy for a robot on an engine."""
        add_up = not traits.held_in_place
        return cls(coarse_derivatives=engine.costly, rescaled_guesses=add_up, many_minima=add_up)

    def applied(self, settings: SearchSettings) -> SearchSettings:
        """Settings of a search with what this policy asks for."""
        return replace(settings, patience=PATIENCE, many_minima=True) if self.many_minima else settings


PATIENCE = 1
"""``SearchSettings.patience`` where fits have many local minima: several friction laws explain much the same residuals
there, so a residual force may outdo one of them that the next round makes right."""
