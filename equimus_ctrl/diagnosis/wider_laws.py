"""A law found at some places with a size of its own at each of more, from the sizes that it has there.

Screened it would begin at the sizes of a guess: of joints that all rub, one more at a time would seem better.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from equimus_ctrl.diagnosis.fitting import Data, Fitted
from equimus_ctrl.diagnosis.hypothesis import Candidate, Hypothesis, Part, with_part
from equimus_ctrl.errors import ConfigError
from equimus_ctrl.identification.fit import Begin

MORE = 2
"""Places at least that are to be new: a single one is screened as a law by itself."""


def wider(data: Data, fitted: Fitted, pool: Sequence[Candidate]) -> Iterator[tuple[Hypothesis, tuple[Begin, ...]]]:
    """Hypotheses with a law at further places too, at least ``MORE``, as the last part, and where each begins.

    Args:
        data: what was measured.
        fitted: the hypothesis.
        pool: the candidates.
    """
    for wide in (c for c in pool if c.each and not c.own and not c.absent):
        parts = [part for part in fitted.hypothesis if part.candidate.effect is wide.effect]
        if not parts or any(part.candidate.own or part.candidate.absent for part in parts):
            continue
        known = {
            (place, own.key): part.values[own.name]
            for part in parts
            for own in part.candidate.parameters
            for place in own.places
        }
        if len(set(wide.locations) - {place for place, _ in known}) < MORE:
            continue
        values = {p.name: known.get((p.places[0], p.key), wide.guesses[-1][p.name]) for p in wide.parameters}
        rest = tuple(part for part in fitted.hypothesis if part not in parts)
        try:
            hypothesis = with_part(data.free.model, rest, Part(wide, values))
        except ConfigError:  # the robot's own effects exclude it
            continue
        yield hypothesis, ((data.theta_of(fitted.fit.theta, hypothesis), fitted.fit.starts),)
