"""Where a search over hypotheses is, and what it has tried."""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

from equimus_ctrl.diagnosis.fitting import Fitted
from equimus_ctrl.diagnosis.hypothesis import Candidate, Hypothesis, Part
from equimus_ctrl.diagnosis.screening import Screened
from equimus_ctrl.diagnosis.thresholds import Thresholds
from equimus_ctrl.identification.fit import Begin

Outdone = Literal[
    "a residual force explains more", "gains do not stand out from the scatter", "validation trials get worse"
]
"""What speaks against the part that a round adds."""
StopReason = Outdone | Literal["no effect accepted", "no part needed", "most rounds", "no more parts asked for"]
"""Why no more parts were added:

- no effect accepted: none gains as much as the acceptance threshold, or scores better.
- a residual force explains more: far more than the next effect, in more rounds than ``SearchSettings.patience``.
- gains do not stand out from the scatter: of the residuals, likewise, see ``block_scatter``.
- validation trials get worse: with what is added, likewise, see ``Extensions.spoils``.
- no part needed: the model without any effect fits as well as the hypothesis of this round.
- most rounds: as many as there can be, see ``SearchSettings.rounds_per_part``.
- no more parts asked for: only the present ones were exchanged.
"""

Law = tuple[str, frozenset[str]]
"""An effect and places: where it has the same parameters at several, all of them."""
RivalDeviance = Callable[[Thresholds], float]
"""Deviance that extensions have to come near to, for what they are compared with is listed by some thresholds."""


def no_rival(t: Thresholds) -> float:
    """Of extensions that are compared with nothing."""
    return math.inf


def laws_of(candidate: Candidate) -> frozenset[Law]:
    """What a candidate says: its law, at each place by itself where each has parameters of its own."""
    places = [{place} for place in candidate.locations] if candidate.each else [candidate.locations]
    return frozenset((candidate.effect.name, frozenset(own)) for own in places)


@dataclass(frozen=True, eq=False)
class Extended:
    """A hypothesis whose extensions are known.

    Attributes:
        base: the fit that was extended.
        options: hypotheses with one more part, fitted.
        rival: deviance that the options had to come near to, by some thresholds; inf without one.
    """

    base: Fitted
    options: tuple[Fitted, ...]
    rival: RivalDeviance = no_rival


@dataclass(frozen=True, eq=False)
class SearchHistory:
    """What a search has tried so far.

    Attributes:
        fitted: all hypotheses fitted, converged or not.
        first: what every candidate that was simulated would do to the refitted model, alone; of a robot with a torque
            domain not those that it ruled out.
        rejected: laws that are not to be part of a hypothesis any more, in whatever groups of trials. With the same
            parameters at further places a law is another one: that it fails at one may be for what it lacks there.
        extended: by a hypothesis' labels, and that of a candidate to replace or "".
        refits: by the fit that each began at, and the labels and initial values of its parts.
        converged: by a fit, the same fitted until converged, where it had to be before held-out trials judge it.
        united: by a hypothesis, and what was rejected then, those fitted with one law in the place of several.
        imitations: fits in the place of a part that it outdoes: they may be listed beside it. Where held-out trials
            reject it they are not tried on these, for each try may be confirmed by chance.
    """

    fitted: tuple[Fitted, ...] = ()
    first: tuple[Screened, ...] = ()
    rejected: frozenset[Law] = frozenset()
    extended: Mapping[tuple[frozenset[str], str], Extended] = field(default_factory=dict)
    refits: Mapping[tuple[Fitted, tuple[Hashable, ...]], Fitted] = field(default_factory=dict)
    converged: Mapping[Fitted, Fitted] = field(default_factory=dict)
    united: Mapping[tuple[Fitted, frozenset[Law]], tuple[Fitted, ...]] = field(default_factory=dict)
    imitations: tuple[Fitted, ...] = ()

    def allows(self, candidates: Iterable[Candidate]) -> bool:
        """Whether none of some candidates says a law that was rejected."""
        return all(self.allowed_places(candidate) == candidate.locations for candidate in candidates)

    def allowed_places(self, candidate: Candidate) -> tuple[str, ...]:
        """Where a candidate may be part of a hypothesis: all of its places or none, or those that are left of each."""
        name, places = candidate.effect.name, candidate.locations
        if not candidate.each:
            return () if (name, frozenset(places)) in self.rejected else places
        return tuple(place for place in places if (name, frozenset({place})) not in self.rejected)

    def having(self, *fitted: Fitted) -> SearchHistory:
        """The same with more fits."""
        return replace(self, fitted=(*self.fitted, *fitted))


@dataclass(frozen=True, eq=False)
class Undecided:
    """A richer law that fits better than the one named in its place, of which held-out trials say nothing.

    Attributes:
        simple: label of the one named.
        rich: the other, as it was fitted.
    """

    simple: str
    rich: Part


@dataclass(frozen=True, eq=False)
class SearchState:
    """Where a search is.

    Attributes:
        base: the model without any effect, refitted.
        best: the hypothesis accepted.
        without: for each of its parts the best fit without it.
        alternatives: for each of its parts the converged hypotheses with another in its place.
        tried: all that was tried on the way.
        stopped: why no more parts were added by the last search that ended; None before one has.
        undecided: richer laws in the place of those named, of which held-out trials say nothing.
    """

    base: Fitted
    best: Fitted
    without: tuple[Fitted, ...] = ()
    alternatives: tuple[tuple[Fitted, ...], ...] = ()
    tried: SearchHistory = field(default_factory=SearchHistory)
    stopped: StopReason | None = None
    undecided: tuple[Undecided, ...] = ()

    def rejecting(self, candidates: Iterable[Candidate]) -> SearchState:
        """The same, what some candidates say to be no part of it any more, see ``SearchHistory.allows``."""
        laws = frozenset[Law]().union(*map(laws_of, candidates))
        tried = replace(self.tried, rejected=self.tried.rejected | laws)
        alternatives = tuple(tuple(a for a in fits if tried.allows(a.candidates)) for fits in self.alternatives)
        return replace(self, alternatives=alternatives, tried=tried)


def begun_at(base: Fitted) -> SearchState:
    """Where a search begins: at the model without any effect."""
    return SearchState(base, base, tried=SearchHistory((base,)))


@dataclass(frozen=True, eq=False)
class Proposal:
    """A hypothesis to be fitted.

    Attributes:
        hypothesis: with initial values.
        begins: (θ, initial states) of which its fit takes the best.
        hope: fall of the deviance to expect to first order; inf where nothing is known of it.
    """

    hypothesis: Hypothesis
    begins: tuple[Begin, ...]
    hope: float = math.inf


@dataclass(frozen=True, eq=False)
class Choice:
    """Which candidates are fitted as one more part.

    Attributes:
        pool: the candidates.
        most: how many of them for each ranking.
        keep_all: whether also those without a gain to first order.
    """

    pool: Sequence[Candidate]
    most: int
    keep_all: bool
