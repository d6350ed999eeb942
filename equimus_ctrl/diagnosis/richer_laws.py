"""Laws that hold another as a special case, in its place: they begin with what was fitted of it.

Screened in its place by themselves they begin where a guess has them, and may end in another minimum: a spring of some
free length, of whose end in the room the spring without one tells nearly all, but no guess does.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from equimus_ctrl.diagnosis.fitting import Data, Fitted
from equimus_ctrl.diagnosis.hypothesis import Candidate, Hypothesis, Part
from equimus_ctrl.identification.fit import Begin


def richer(data: Data, fitted: Fitted, pool: Sequence[Candidate]) -> Iterator[tuple[Hypothesis, tuple[Begin, ...]]]:
    """Hypotheses with a richer law in the place of a part, as the last part, and where each can begin.

    Args:
        data: what was measured.
        fitted: the hypothesis.
        pool: the candidates.
    """
    for k, part in enumerate(fitted.hypothesis):
        others = (*fitted.hypothesis[:k], *fitted.hypothesis[k + 1 :])
        for candidate in pool:
            if not holds(candidate, part.candidate):
                continue
            begun = candidate.effect.begun_at(part.values, candidate.guesses)
            distinct = list({tuple(one.values()): one for one in begun}.values())
            parts = [(*others, Part(candidate, one)) for one in distinct]
            yield parts[0], tuple((data.theta_of(fitted.fit.theta, own), fitted.fit.starts) for own in parts)


def holds(rich: Candidate, simple: Candidate) -> bool:
    """Whether a law is another with further parameters, at the same place alone."""
    same = rich.effect.exclusive == simple.effect.exclusive is not None and rich.locations == simple.locations
    same = same and len(simple.locations) == 1
    names = {own.name for own in rich.parameters}
    return same and as_its_own(rich, simple) <= names and simple.n_parameters < rich.n_parameters


def as_its_own(rich: Candidate, simple: Candidate) -> set[str]:
    """What a simple law's parameters are called in a richer one."""
    alike = rich.effect.special_cases
    return {name for own in simple.parameters for name in alike.get(own.name, (own.name,))}
