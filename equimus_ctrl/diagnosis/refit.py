"""The refit, where a diagnosis begins: the model without any effect, its parameters fitted, and its search set up.

Where residuals are large, it is fitted to short shooting intervals too, and a second search begins at that fit.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace

import numpy as np

from equimus_ctrl.diagnosis.budget import BudgetSpent
from equimus_ctrl.diagnosis.candidates import candidates
from equimus_ctrl.diagnosis.fitting import Data, Fitted
from equimus_ctrl.diagnosis.group_splits import with_groups
from equimus_ctrl.diagnosis.groups import Apart, told_apart
from equimus_ctrl.diagnosis.holdout import Split
from equimus_ctrl.diagnosis.localization import excess_variances
from equimus_ctrl.diagnosis.noise_size import noise_sizes
from equimus_ctrl.diagnosis.search import Search
from equimus_ctrl.diagnosis.search_state import SearchState, begun_at
from equimus_ctrl.diagnosis.state import DiagnosisInputs, Progress, State
from equimus_ctrl.effects.base import REGISTRY
from equimus_ctrl.errors import SimulationDiverged
from equimus_ctrl.identification.noise import white_noise
from equimus_ctrl.identification.residuals import residuals_of
from equimus_ctrl.identification.segments import groups_of
from equimus_ctrl.types import Array

ROUNDS = 12
"""So many steps of a search divide its share of the progress."""
SEARCH_SHARE = (0.15, 0.8)
"""Share of the whole that is done when a search begins, and when it ends."""


def refit(inputs: DiagnosisInputs) -> State:
    """The model without any effect, its parameters refitted, and the search that goes on from there.

    Where residuals are large, it is fitted to short shooting intervals too. As errors grow along the shooting
    intervals, the refit is then also begun at that fit. The search gets its candidates, and the model a value of its
    own in each group of trials for the parameters that differ between them (``groups.told_apart``).

    Args:
        inputs: of the diagnosis.

    Raises:
        BudgetSpent: where the budget ends before there is any fit.
        SimulationDiverged: where the model diverges on every trial.
    """
    data, split, model = inputs.data, inputs.split, inputs.data.free.model
    inputs.progress("refitting the model", 0.02, "")
    base = data.base()
    short: Fitted | None = None
    with suppress(BudgetSpent):  # the search's first step meets it again
        short = _short_base(data, split) if data.far_above_noise(base) else None
        base = base if short is None else data.base_from(short, base)
    looked_for = {name: effect for name, effect in REGISTRY.items() if name not in inputs.settings.exclude}
    pool = with_groups(candidates(model, split.train, looked_for), groups_of(split.train))
    settings, notify = data.policy.applied(inputs.settings.search), _round_notify(inputs.progress)
    search = Search(data, pool, settings, notify, held_out=split)
    with suppress(BudgetSpent):
        if groups_of(split.train):
            apart = told_apart(Apart(search, base), split)
            search, base, looked, short = apart.search, apart.best, short is not None, None
            short = _short_base(search.data, split) if looked else None
    state = State(inputs, search, begun_at(base), short, nominal_residuals(inputs, data), notes=inputs.settings.notes)
    sigma = noise_sizes(search.data, base)
    excess = zip(model.robot.joint_names, excess_variances(base.fit.residuals, sigma), strict=False)
    said = ", ".join(f"{joint} {variance:.3g}" for joint, variance in excess)
    return state.decided("refit", f"{len(search.data.free.free)} parameters refitted", f"excess variance: {said}")


def _round_notify(progress: Progress) -> Callable[[str, str], None]:
    """Tells the steps of a search as shares of the whole."""
    shares: Iterator[float] = iter(np.linspace(*SEARCH_SHARE, ROUNDS))

    def notify(stage: str, best: str) -> None:
        progress(stage, float(next(shares, SEARCH_SHARE[1])), best)

    return notify


def nominal_residuals(inputs: DiagnosisInputs, data: Data) -> tuple[Array, ...]:
    """Of the nominal model: (m, nj + ne) for each segment fitted, ``residuals.DIVERGED`` where it diverges."""
    return tuple(residuals_of(inputs.nominal, inputs.split.train, data.simulator))


def _short_base(data: Data, split: Split) -> Fitted | None:
    """The model fitted to short shooting intervals; None where there are none, or where it diverges in them."""
    if not split.short_segments:
        return None
    try:
        return replace(data, segments=split.short_segments).base()
    except SimulationDiverged:  # so short intervals are of no use
        return None


def searched_from_short(search: Search, end: SearchState, split: Split, base: Fitted) -> tuple[Search, SearchState]:
    """The search's end, or that of one begun at the result of short shooting intervals, if that fits better.

    Errors do not grow in short intervals, so the cost is close to quadratic there.

    Args:
        search: with the shooting intervals asked for.
        end: of that search.
        split: with the short intervals.
        base: the model without effects, fitted to these.
    """
    data, settings = search.data, search.settings
    short = replace(search, data=replace(data, segments=split.short_segments), reached=lambda data, state: None)
    try:
        short_end = short.run(base, imitated=False)  # where it ends is only a beginning
    except SimulationDiverged:  # so short intervals are of no use
        return search, end
    best = short_end.best
    if not best.hypothesis or best.labels == end.best.labels:
        return search, end
    other = replace(search, fits_on_short_intervals=short_end.tried.fitted)
    begin = (best.fit.theta, [s.start for s in data.segments])
    try:
        noise = white_noise(best.fit.residuals)
        start = data.converge(data.coarse_fit(best.hypothesis, [begin], noise, settings.long_steps))
    except SimulationDiverged:  # so it cannot be what happened
        return search, end
    if not search.about_as_good(start, end.best):  # so the search has found better than these
        return search, end
    other_end = other.go_on(other.beginning(end.base, start))
    if other.score(other_end.best) < search.score(end.best):
        better_search, better = other, other_end
    else:
        better_search, better = search, end
    whole = replace(better.tried, fitted=(*end.tried.fitted, *other_end.tried.fitted))
    return better_search, replace(better, tried=whole)
