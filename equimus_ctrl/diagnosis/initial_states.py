"""What effects with a memory begin trials with, where no recording shows the way before: the stage ``initial_states``.

A hysteresis keeps what the last reversals left of it however long the robot rests. In the search each trial begins
without a memory; a robot that was moved before the recording does not. Where a hypothesis has such an effect
(``ForceEffect.begins_anywhere``), its states at the start become free in each trial, as the first angles are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from equimus_ctrl.diagnosis.findings import named_part
from equimus_ctrl.diagnosis.holdout import Split
from equimus_ctrl.diagnosis.search_state import SearchHistory
from equimus_ctrl.diagnosis.state import State
from equimus_ctrl.errors import SimulationDiverged
from equimus_ctrl.identification.segments import Segment
from equimus_ctrl.models.augmented import unknown_starts

NAME = "initial_states"


def free_initial_states(state: State) -> State:
    """The hypothesis with free initial states of its effects, where they gain what as many parameters have to gain.

    From here on they are free in all fits, and found in trials that are held out, by these trials themselves.

    Raises:
        BudgetSpent: where the budget ends.
    """
    search, end = state.search, state.end
    count = unknown_starts(end.best.fit.model.effects)
    if not count or not search.data.free.model.robot.traits.starts_at_rest:
        return state
    data, fitted = replace(search.data, segments=_remembering(search.data.segments)), end.best
    try:
        begun = data.coarse_fit(fitted.hypothesis, [fitted.begin], fitted.noise, search.settings.long_steps)
        best = data.converge(begun)
    except SimulationDiverged:
        return state
    more, gain = count * len(data.segments), fitted.deviance - best.deviance
    reason = f"−2Δln L {gain:.4g}, at least {search.threshold(more):.4g}"
    if not search.data.thresholds.decides(lambda t: gain > search.threshold(more, t)):
        return state.decided(NAME, "trials begin without a memory", reason)
    search = replace(search, data=data)
    # Fits without free initial states cannot be compared with others.
    tried = SearchHistory(first=end.tried.first, rejected=end.tried.rejected)
    end = search.moved(replace(end, tried=tried), best)
    of = ", ".join(str(named_part(part)) for part in best.hypothesis if unknown_starts(part.effects))
    note = f"Each trial begins with a state of its own of {of}: no recording shows the way before."
    inputs = replace(state.inputs, split=_split_remembering(state.inputs.split))
    state = replace(state, search=search, end=end, inputs=inputs, notes=(*state.notes, note))
    return state.decided(NAME, "each trial begins with a memory of its own", reason)


def _split_remembering(split: Split) -> Split:
    return replace(
        split,
        train=_remembering(split.train),
        validation=_remembering(split.validation),
        test=_remembering(split.test),
    )


def _remembering(segments: Sequence[Segment]) -> tuple[Segment, ...]:
    return tuple(replace(segment, may_remember=True) for segment in segments)
