"""The stage of the search: what effects fit best, before held-out trials judge them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import chain

from equimus_ctrl.diagnosis.budget import BudgetSpent
from equimus_ctrl.diagnosis.confirmation import best_as_fitted
from equimus_ctrl.diagnosis.fitting import Data
from equimus_ctrl.diagnosis.known import Known, with_known
from equimus_ctrl.diagnosis.refit import searched_from_short
from equimus_ctrl.diagnosis.search import Search
from equimus_ctrl.diagnosis.search_state import SearchState
from equimus_ctrl.diagnosis.simulated import Simulated, simulated
from equimus_ctrl.diagnosis.state import State
from equimus_ctrl.errors import SimulationDiverged

SEARCH_BUDGET = 0.75
"""Share of a budget after which the search ends: what it has come to is worth little before held-out trials have judged
it."""


def find_effects(state: State) -> State:
    """The hypothesis that fits best, of those whose gain exceeds the threshold.

    A search begins with what measured torques ask for, where they say anything. Where residuals are large, a second
    search begins at the fit to short shooting intervals. After each step it is asked whether MuJoCo made the recordings
    (``simulated``): then the search goes on without the error of its step. Where something is known from before that
    fits better than the end, it goes on there (``known``). Of a budget it may take ``SEARCH_BUDGET``; where that ends,
    what the search had come to is kept.
    """
    whole, reached = state.data.budget, _Reached()
    state = state.within(whole.share(SEARCH_BUDGET))
    search, end, made = replace(state.search, reached=reached), state.end, None
    known = state.inputs.settings.known
    try:
        steps = _and_known(search, chain([end], _begun_in_torques(search, end)), known)
        while (now := next(steps, None)) is not None:
            end = now
            reached.forget()
            found = simulated(search, end) if made is None else made.holding(end)
            if found is not None:
                made, search, end = found, found.search, found.end
                steps = _and_known(search, search.steps(end), known)
                reached.forget()
        if made is not None:
            made = replace(made, end=end).settled()
            search, end = made.search, made.end
        elif state.short is not None and state.data.far_above_noise(end.best):
            search, end = searched_from_short(search, end, state.inputs.split, state.short)
    except BudgetSpent:
        end = _better(search, end, reached.states.get(search.data, end))
        reached.over = True
        state = _without_step(replace(state, search=search, end=end), made).within(whole).ended("search")
        return _accepted(_with_fits_without(state))
    reached.over = True
    return _accepted(_without_step(replace(state, search=search, end=end), made).within(whole))


class _Reached:
    """Where a search has come to on the way, until it is over.

    Attributes:
        states: by the data that each is fitted to.
        over: whether nothing is kept any more.
    """

    def __init__(self) -> None:
        self.states: dict[Data, SearchState] = {}
        self.over = False

    def __call__(self, data: Data, state: SearchState) -> None:
        if not self.over:
            self.states[data] = state

    def forget(self) -> None:
        """What was before is of no use, for the search has come farther."""
        self.states.clear()


def _better(search: Search, end: SearchState, way: SearchState) -> SearchState:
    """The better of two ends, with what was fitted for both: a second search may not have come as far as the first."""
    best = way if search.score(way.best) < search.score(end.best) else end
    fitted = tuple(dict.fromkeys((*end.tried.fitted, *way.tried.fitted)))
    return replace(best, tried=replace(best.tried, fitted=fitted))


def _with_fits_without(state: State) -> State:
    """With fits without each part, where time is left for them; a search that was ended may lack some."""
    end = state.end
    if state.ended_in or len(end.without) == len(end.best.hypothesis):
        return state
    try:
        return replace(state, end=state.search.moved(end, end.best))
    except BudgetSpent:
        return replace(state, ended_in="search")
    except SimulationDiverged:
        return replace(state, end=best_as_fitted(state.search, end))


def _begun_in_torques(search: Search, end: SearchState) -> Iterator[SearchState]:
    """The steps of a search that begins with what measured torques ask for."""
    begun = end
    for begun in search.begun_in_torques(end):
        yield begun
    yield from search.steps(begun)


def _and_known(search: Search, steps: Iterator[SearchState], known: Sequence[Known]) -> Iterator[SearchState]:
    """The steps of a search, and of one that goes on from its end at what is known, see ``with_known``."""
    end: SearchState | None = None
    for end in steps:
        yield end
    if end is not None and known:
        yield from with_known(search, end, known)


def _without_step(state: State, made: Simulated | None) -> State:
    """What is known where MuJoCo made the recordings: what was held out without the error of its step, too."""
    if made is None:
        return state
    inputs = replace(state.inputs, split=made.without_error(state.inputs.split))
    search = replace(state.search, held_out=inputs.split)
    state = replace(state, inputs=inputs, search=search, notes=(*state.notes, made.sentence))
    return state.decided("search", "the error of MuJoCo's physics step taken off the recordings", made.sentence)


def _accepted(state: State) -> State:
    """With a decision for each part of the hypothesis."""
    best = state.end.best
    for part, without in zip(best.hypothesis, state.end.without, strict=not state.ended_in):
        gain, least = without.deviance - best.deviance, state.search.threshold(part.candidate.n_parameters)
        reason = f"−2Δln L {gain:.4g}, at least {least:.4g}"
        state = state.decided("search", f"{part.candidate.label} accepted", reason)
    if not best.hypothesis:
        reason = "no gain exceeds the threshold and the scatter of deviances"
        return state.decided("search", "no effect accepted", reason)
    if state.end.stopped is not None:
        state = state.decided("search", "no further effect", state.end.stopped)
    return state
