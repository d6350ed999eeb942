"""The stages of a diagnosis that tell units of a robot apart, and from the nominal model."""

from __future__ import annotations

from dataclasses import replace

from equimus_ctrl.diagnosis.alternatives import simplified
from equimus_ctrl.diagnosis.findings import ranking
from equimus_ctrl.diagnosis.groups import Apart, rebuilt, told_apart
from equimus_ctrl.diagnosis.holdout import Split
from equimus_ctrl.diagnosis.search import Search
from equimus_ctrl.diagnosis.search_state import SearchState
from equimus_ctrl.diagnosis.state import State
from equimus_ctrl.diagnosis.units_compared import another_unit, differences
from equimus_ctrl.identification.parameters import in_group
from equimus_ctrl.identification.segments import groups_of


def tell_apart(state: State) -> State:
    """What differs between groups of trials, such as units of a robot."""
    split, search, end = state.inputs.split, state.search, state.end
    if not groups_of(split.train):
        return state
    known = ranking(search, end)  # fits with other parameters free say nothing of it
    search, end = _told_apart(search, end, split)
    state = replace(state, search=search, end=end, ranking=known)
    own = [own.label(end.best.hypothesis) for own in Apart(search, end.best).own]
    reason = "−2Δln L exceeds the threshold, and held-out trials confirm it"
    for label in own:
        state = state.decided("groups", f"{label} has a value of its own", reason)
    for part in end.best.hypothesis:
        for group in part.candidate.absent:
            state = state.decided("groups", f"{part.candidate.effect.name} not in {group}", "it fits as well without")
    return state


def still_apart(search: Search, end: SearchState, split: Split) -> tuple[Search, SearchState]:
    """A search and its end without values of groups that other effects have made unnecessary; as it is without any."""
    differ = Apart(search, end.best).own or any(part.candidate.absent for part in end.best.hypothesis)
    return _told_apart(search, end, split) if differ else (search, end)


def _told_apart(search: Search, end: SearchState, split: Split) -> tuple[Search, SearchState]:
    """A search and its end with the values of groups that are needed."""
    apart = told_apart(Apart(search, end.best), split)
    if apart.best is end.best:
        return search, end
    after = rebuilt(apart, end)
    simple = simplified(apart.search, after) if search.settings.many_minima else after
    if simple.best is after.best:
        return apart.search, after
    return _told_apart(apart.search, simple, split)  # of a simpler law, fewer values may differ


def compare_units(state: State) -> State:
    """What differs between groups of trials, with evidence; what of the model's parameters is not nominal."""
    split, search, end = state.inputs.split, state.search, state.end
    told = differences(search, end, split)
    other = None if state.analysis.unexplained or state.failed else another_unit(search, end, split)
    state = replace(state, differences=told, another_unit=other)
    if other is not None:
        reason = f"−2Δln L {other.gain:.4g}, at least {other.threshold:.4g}"
        names = ", ".join(in_group(d.parameter, d.group) for d in other.departures) or "only several together"
        state = state.decided("units", f"parameters differ from the nominal ones: {names}", reason)
    return state
