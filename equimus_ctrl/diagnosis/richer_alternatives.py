"""Laws that hold as a special case what was fitted in a part's place, at the end of a search.

A law with a place and a free length of its own has many local minima, and no guess lies near each: fitted by itself it
may end far behind a law that it holds. So where such a law comes near to what is named, or is, the richer one is fitted
from it, from each beginning by itself (``Effect.begun_at``): which of them leads to the best minimum, the error before
the first step does not tell.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace

from equimus_ctrl.diagnosis.alternatives import replacement
from equimus_ctrl.diagnosis.fitting import Fitted
from equimus_ctrl.diagnosis.hypothesis import Hypothesis, Part
from equimus_ctrl.diagnosis.hypothesis_moves import EXCHANGE_MARGIN, HypothesisMoves
from equimus_ctrl.diagnosis.richer_laws import holds
from equimus_ctrl.diagnosis.search_state import SearchState
from equimus_ctrl.errors import SimulationDiverged
from equimus_ctrl.identification.noise import white_noise


def with_richer_alternatives(search: HypothesisMoves, state: SearchState) -> SearchState:
    """The end with richer laws among the alternatives of its parts, or with the best of these that fits better.

    Only where fits have many local minima.

    Args:
        search: that ended.
        state: the end.
    """
    if not search.settings.many_minima:
        return state
    for k in range(len(state.best.hypothesis)):
        found = [
            fitted for own in _beginnings(search, state, k) if (fitted := _fitted(search, state, *own)) is not None
        ]
        if not found:
            continue
        alternatives = (*state.alternatives[:k], (*state.alternatives[k], *found), *state.alternatives[k + 1 :])
        state = replace(state, alternatives=alternatives, tried=state.tried.having(*found))
        better = [f for f in found if search.score(f) < search.score(state.best) - EXCHANGE_MARGIN]
        top = min((f for f in better if not search.aliased(f)), key=search.score, default=None)
        if top is not None and search.accepts(state.without[k], top):
            return search.exchanged(replace(state, best=top, without=(), alternatives=()))
    return state


def _beginnings(search: HypothesisMoves, state: SearchState, k: int) -> Iterator[tuple[Fitted, list[Hypothesis]]]:
    """Fits with a simpler law in the k-th part's place, and hypotheses with a richer one in its place to begin at.

    The simpler law is the part, or an alternative that is near enough to be compared with it (``step_scatter``). Each
    richer one begins at the best of those that it holds.
    """
    best, thresholds = state.best, search.data.thresholds
    rest = (*best.hypothesis[:k], *best.hypothesis[k + 1 :])
    begun = {best.hypothesis[k].candidate.label}
    for fitted in sorted((best, *state.alternatives[k]), key=search.score):
        lack = search.score(fitted) - search.score(best)
        if not thresholds.decides(lambda t, lack=lack: lack < search.equally_good(t) + t.step_scatter):  # type: ignore[misc]
            return
        part = best.hypothesis[k] if fitted is best else replacement(fitted, state.without[k])
        if part is None:
            continue
        for rich in search.allowed_candidates(state.tried):
            if rich.label in begun or rich.absent or rich.own or not holds(rich, part.candidate):
                continue
            begun.add(rich.label)
            values = {tuple(own.values()): own for own in rich.effect.begun_at(part.values, rich.guesses)}
            yield fitted, [(*rest, Part(rich, own)) for own in values.values()]


def _fitted(search: HypothesisMoves, state: SearchState, simple: Fitted, hypotheses: list[Hypothesis]) -> Fitted | None:
    """The best of a law's fits from some beginnings, each fitted for some steps; None where all diverge."""
    data, noise, options = search.data, white_noise(simple.fit.residuals), list[Fitted]()
    search.notify(f"{hypotheses[0][-1].candidate.label} in the place of what it holds", state.best.label)
    for hypothesis in hypotheses:
        with suppress(SimulationDiverged):  # so it cannot be what happened
            begin = data.theta_of(simple.fit.theta, hypothesis), simple.fit.starts
            options.append(data.coarse_fit(hypothesis, [begin], noise, search.settings.long_steps))
    best = min(options, key=lambda f: f.deviance, default=None)
    return None if best is None else data.converge(best)
