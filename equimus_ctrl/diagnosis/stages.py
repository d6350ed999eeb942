"""A diagnosis, stage by stage: each takes what is known and returns what is known after it.

    refit → search → confirmation → unexplained → discretization → validation → alternatives → report

``diagnose.diagnose`` runs them in this order. Where a budget ends one of them, what was known before it is reported.
"""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cache

import numpy as np

from equimus_ctrl.diagnosis.alternatives import listed, without_parts
from equimus_ctrl.diagnosis.budget import BudgetSpent
from equimus_ctrl.diagnosis.candidates import candidates
from equimus_ctrl.diagnosis.confirmation import HoldoutResiduals, confirmed
from equimus_ctrl.diagnosis.discretization import step_counted, without_step_error
from equimus_ctrl.diagnosis.experiment import Designs, separating
from equimus_ctrl.diagnosis.findings import (
    beyond_range,
    detectable,
    equivalents,
    findings,
    named_part,
    notes,
    ranking,
    verdict,
)
from equimus_ctrl.diagnosis.fitting import Data, Fitted
from equimus_ctrl.diagnosis.holdout import Split
from equimus_ctrl.diagnosis.hypothesis_moves import LONG, SearchState
from equimus_ctrl.diagnosis.localization import excess_variances, localise
from equimus_ctrl.diagnosis.policy import SearchSettings, Thresholds
from equimus_ctrl.diagnosis.results import STATES, Decision, Diagnosis, Named, Ranked, Residuals
from equimus_ctrl.diagnosis.search import Search
from equimus_ctrl.diagnosis.unexplained import ResidualAnalysis, not_confirmed, not_on_test, residual_analysis
from equimus_ctrl.effects.base import REGISTRY
from equimus_ctrl.engines.base import EngineName
from equimus_ctrl.errors import SimulationDiverged
from equimus_ctrl.identification.noise import white_noise
from equimus_ctrl.identification.residuals import residuals_of
from equimus_ctrl.identification.segments import Segment

AGAIN = 1
"""How often a search goes on beside the accepted effects where others were rejected. If it comes to rejected effects
again, the residuals stay unexplained."""
WINDOW = r" from [0-9.]+ s$"
"""What names of shooting intervals have beyond those of their recordings."""
ROUNDS = 12
"""So many steps of a search divide its share of the progress."""
STAGES = ("search", "confirmation", "unexplained", "discretization", "validation", "alternatives")
"""What follows the refit, in order."""
Progress = Callable[[str, float, str], None]
"""Called with the stage, the share of the whole that is done, and the best hypothesis so far."""


@dataclass(frozen=True)
class DiagnosisSettings:
    """How a diagnosis goes.

    Attributes:
        search: how sets of effects are searched.
        threads: of the simulations; all cores by default.
        engine: by its name; by default see ``engines.choice.engine_for``.
        exclude: names of effects that are not looked for.
        budget: how long it may take [s]; its best so far is given then. As long as it needs by default.
        thresholds: that decide.
    """

    search: SearchSettings = field(default_factory=SearchSettings)
    threads: int | None = None
    engine: EngineName | None = None
    exclude: tuple[str, ...] = ()
    budget: float | None = None
    thresholds: Thresholds = field(default_factory=Thresholds)


@dataclass(frozen=True, eq=False)
class DiagnosisInputs:
    """What is asked.

    Attributes:
        data: what hypotheses are fitted to.
        split: trials to fit and trials to validate on.
        settings: how it goes.
        designs: experiments to choose from where effects are not distinguishable.
        progress: see ``Progress``.
        begun: by ``time.perf_counter``.
    """

    data: Data
    split: Split
    settings: DiagnosisSettings
    designs: Designs
    progress: Progress
    begun: float


@dataclass(frozen=True, eq=False)
class State:
    """What is known after a stage.

    Attributes:
        inputs: what is asked.
        search: that goes on from where it is.
        found: where it ended so far.
        rest: what that leaves unexplained.
        rejected: effects that were rejected, for a residual force explains as much.
        ranking: all candidates, alone.
        coarse: a sentence on the engine's step, where its error was taken off; "" else.
        equivalent: for each part of the hypothesis what fits as well in its place; empty where nobody looked.
        decisions: of the stages so far.
        ended_in: the stage in which the budget ended; "" where it did not.
    """

    inputs: DiagnosisInputs
    search: Search
    found: SearchState
    rest: ResidualAnalysis
    rejected: tuple[Named, ...] = ()
    ranking: tuple[Ranked, ...] = ()
    coarse: str = ""
    equivalent: tuple[tuple[Named, ...], ...] = ()
    decisions: tuple[Decision, ...] = ()
    ended_in: str = ""

    @property
    def not_done(self) -> tuple[str, ...]:
        """Stages that were not carried out to their end."""
        return STAGES[STAGES.index(self.ended_in) :] if self.ended_in else ()

    @property
    def data(self) -> Data:
        """What hypotheses are fitted to by now."""
        return self.search.data

    @property
    def label(self) -> str:
        """The best hypothesis."""
        return self.found.best.label

    def report(self, stage: str, share: float) -> None:
        """Say which stage begins, and what is best so far."""
        self.inputs.progress(stage, share, self.label)

    def ended(self, stage: str) -> State:
        """The same, its budget having ended in a stage."""
        return replace(self, ended_in=stage).decided(
            stage, "ended", "the time was up, or the best so far was asked for"
        )

    def decided(self, stage: str, decision: str, reason: str) -> State:
        """The same with one more decision."""
        return replace(self, decisions=(*self.decisions, Decision(stage, decision, reason)))


def refit(inputs: DiagnosisInputs) -> tuple[State, Fitted | None]:
    """The model without any effect, its parameters refitted, and the same fitted to short shooting intervals.

    Where residuals are large, and errors grow along the shooting intervals, the refit is also begun at the fit to
    short intervals.

    Returns:
        The state to search from, and the fit to short intervals; None where there was no need of one.

    Raises:
        SimulationDiverged: where the model diverges on every trial.
    """
    data, split = inputs.data, inputs.split
    inputs.progress("refitting the model", 0.02, "")
    base = data.base()
    short: Fitted | None = None
    with suppress(BudgetSpent):  # the search's first step meets it again
        short = _short_base(data, split) if data.far_above_noise(base) else None
        base = base if short is None else data.base_from(short, base)
    looked_for = {name: effect for name, effect in REGISTRY.items() if name not in inputs.settings.exclude}
    pool = candidates(data.free.model, split.train, looked_for)
    shares: Iterator[float] = iter(np.linspace(0.15, 0.8, ROUNDS))

    def notify(stage: str, best: str) -> None:
        inputs.progress(stage, float(next(shares, 0.8)), best)

    search = Search(data, pool, data.policy.applied(inputs.settings.search), notify)
    state = State(inputs, search, SearchState(base, base), ResidualAnalysis((), ()))
    excess_variance = ", ".join(
        f"{joint} {own:.3g}"
        for joint, own in zip(
            data.free.model.robot.joint_names, excess_variances(base.fit.residuals, base.noise), strict=True
        )
    )
    return state.decided(
        "refit", f"{len(data.free.free)} parameters refitted", f"excess variance: {excess_variance}"
    ), short


def search(state: State, short: Fitted | None) -> State:
    """The hypothesis that fits best, of those whose gain exceeds the threshold.

    Args:
        state: after the refit.
        short: the model fitted to short shooting intervals; where residuals are large, a second search begins there.
    """
    own, found = state.search, state.found
    try:
        for now in own.steps(found):
            found = now
        if short is not None and state.data.far_above_noise(found.best):
            own, found = _from_short(own, found, state.inputs.split, short)
    except BudgetSpent:
        return _searched(replace(state, found=found), "search").ended("search")
    return _searched(replace(state, search=own, found=found), "search")


def or_ended(stage: Callable[[State], State], state: State) -> State:
    """What is known after a stage; what was known before it where the budget ends, or ended earlier."""
    if state.ended_in:
        return state
    try:
        return stage(state)
    except BudgetSpent:
        return state.ended(stage.__name__)


def _searched(state: State, stage: str) -> State:
    """With a decision for each part of the hypothesis."""
    for part, without in zip(state.found.best.hypothesis, state.found.without, strict=True):
        gain = without.deviance - state.found.best.deviance
        least = state.search.threshold(part.candidate.n_parameters)
        state = state.decided(stage, f"{part.candidate.label} accepted", f"−2Δln L {gain:.4g}, at least {least:.4g}")
    if not state.found.best.hypothesis:
        state = state.decided(stage, "no effect accepted", "no gain exceeds the threshold and the scatter of deviances")
    return state


def confirmation(state: State) -> State:
    """The effects that held-out trials bear out; where they refuse one, another that they do bear out."""
    state.report("held-out trials", 0.82)
    found = confirmed(state.search, state.found, state.inputs.split)
    after = replace(state, found=found)
    for label in sorted(state.found.best.labels - found.best.labels):
        after = after.decided("confirmation", f"{label} rejected", "held-out trials do not improve enough with it")
    for label in sorted(found.best.labels - state.found.best.labels):
        after = after.decided("confirmation", f"{label} accepted", "fits in its place, and held-out trials confirm it")
    return after


def unexplained(state: State) -> State:
    """What the effects leave, and which of them are confounded with a residual force: these are rejected.

    Where others stay, the search goes on beside them, without the names that were rejected.
    """
    state.report("residual forces", 0.86)
    own, found, rejected = state.search, state.found, state.rejected
    rest = residual_analysis(state.data, found.base, found.best, found.without)
    again, confounded = AGAIN, set[str]()
    while rest.redundant:
        dropped = [found.best.hypothesis[k] for k in rest.redundant]
        rejected += tuple(named_part(part) for part in dropped)
        confounded |= {part.candidate.label for part in dropped}
        found = without_parts(own, found, rest.redundant)
        if found.best.hypothesis:
            names = [part.candidate.label for part in dropped]
            found = confirmed(own, own.go_on(found, names, further=again > 0), state.inputs.split)
            again -= 1
        rest = residual_analysis(state.data, found.base, found.best, found.without)
    after = replace(state, found=found, rest=rest, rejected=rejected)
    for label in sorted((state.found.best.labels | confounded) - found.best.labels):
        reason = "a residual force explains as much" if label in confounded else "not needed beside the rest"
        after = after.decided("unexplained", f"{label} rejected", reason)
    for label in sorted(found.best.labels - state.found.best.labels):
        after = after.decided("unexplained", f"{label} accepted", "its gain exceeds the threshold beside the others")
    for left in rest.unexplained:
        over = f" over {left.depends_on}" if left.depends_on else ""
        after = after.decided(
            "unexplained", f"something left at {left.location}{over}", f"{left.gain:.4g}, at least {left.threshold:.4g}"
        )
    return replace(after, ranking=ranking(own, found))


def discretization(state: State) -> State:
    """The same without the discretisation error, where that changes findings or unexplained residuals."""
    exact = without_step_error(state.search, state.found, state.rest, state.inputs.settings.threads)
    if exact is None:
        return state
    own, found, rest, coarse = exact
    return replace(state, search=own, found=found, rest=rest, coarse=coarse).decided(
        "discretization", "worked out without the step's error", coarse
    )


def validation(state: State) -> State:
    """Joints whose residuals on held-out trials are far above the noise, whatever the parameters of the effects."""
    if state.rest.unexplained:
        return state
    split, best = state.inputs.split, state.found.best
    rest = not_confirmed(
        state.data, best, split.validation, HoldoutResiduals(state.data, split, state.found).residuals(best.fit.model)
    )
    for left in rest.unexplained:
        reason = f"held-out error {left.gain:.3g} times the noise's variance"
        state = state.decided("validation", f"unexplained at {left.location}", reason)
    return replace(state, rest=rest)


def alternatives(state: State) -> State:
    """What fits as well in each effect's place; intervals in which the error of the engine's step is counted."""
    state.report("evidence", 0.94)
    found = listed(state.search, state.found)
    if not state.coarse:
        found = step_counted(state.data, found, state.inputs.settings.threads)
    finely = cache(state.data.converge_finely)
    equivalent = equivalents(state.search, found, bool(state.rest.unexplained), finely)
    return replace(state, found=found, equivalent=equivalent)


def report(state: State) -> Diagnosis:
    """The findings with evidence and intervals, and the rest of the report."""
    inputs, own, found, rest = state.inputs, state.search, state.found, state.rest
    data, split, model = state.data, inputs.split, inputs.data.free.model
    holdout = HoldoutResiduals(data, split, found)
    named = findings(own, found, holdout, state.equivalent)
    experiment = None if state.ended_in else separating(data, found, named, inputs.designs)
    residuals = {
        name: Residuals(
            train, tuple(holdout.residuals(own_model)), tuple(residuals_of(own_model, split.test, data.simulator))
        )
        for name, own_model, train in zip(
            STATES,
            (model, found.base.fit.model, found.best.fit.model),
            (tuple(holdout.nominal()), found.base.fit.residuals, found.best.fit.residuals),
            strict=True,
        )
    }
    noise = found.best.noise
    if not (rest.unexplained or state.ended_in):
        rest = not_on_test(data, found.best, split.test, residuals["corrected"].test)
        for left in rest.unexplained:
            reason = f"error on the test set {left.gain:.3g} times the noise's variance"
            state = state.decided("report", f"unexplained at {left.location}", reason)
    inputs.progress("done", 1.0, found.best.label)
    return Diagnosis(
        verdict(named, rest, state.ended_in in ("", "alternatives")),
        model,
        found.base.fit.model,
        found.best.fit.model,
        found.base,
        found.best,
        tuple(split.train),
        tuple(split.validation),
        tuple(split.test),
        residuals,
        localise(model, split.train, found.base.fit.residuals, noise),
        named,
        rest.unexplained,
        state.rejected,
        state.ranking or ranking(own, found),
        () if named or rest.unexplained or state.ended_in else detectable(own, found),
        experiment,
        {name: float(excess_variances(residuals[name].train, noise).mean()) for name in STATES},
        (
            *notes(found, split, inputs.settings.exclude, state.not_done),
            *beyond_range(model, split),
            *([state.coarse] if state.coarse else []),
        ),
        time.perf_counter() - inputs.begun,
        state.decisions,
        state.not_done,
    )


def other_inputs(inputs: DiagnosisInputs) -> DiagnosisInputs | None:
    """The same with other trials held out, where nobody said which; None where somebody did."""
    other = inputs.split.other
    if other is None:
        return None

    def notify(stage: str, share: float, best: str) -> None:
        inputs.progress(f"{stage}, other trials held out", 0.94 + 0.05 * share, best)

    return replace(inputs, data=replace(inputs.data, segments=other.train), split=other, progress=notify)


def on_others(inputs: DiagnosisInputs, other: DiagnosisInputs, found: Diagnosis) -> Diagnosis:
    """A diagnosis with other trials held out, which says so."""
    before, now = (", ".join(_trials(q.split.validation)) for q in (inputs, other))
    note = f"{before}, held out at first, showed what the other trials do not; so they were fitted, and {now} judged."
    return replace(found, notes=(*found.notes, note))


def _trials(segments: Sequence[Segment]) -> list[str]:
    """Names of the trials that segments are of; those of shooting intervals begin with their trial's."""
    names: dict[int, str] = {}
    for s in segments:
        names.setdefault(s.recording, re.sub(WINDOW, "", s.trial.name))
    return list(names.values())


def _short_base(data: Data, split: Split) -> Fitted | None:
    """The model fitted to short shooting intervals; None where there are none, or where it diverges in them."""
    if not split.short_segments:
        return None
    try:
        return replace(data, segments=split.short_segments).base()
    except SimulationDiverged:  # so short intervals are of no use
        return None


def _from_short(search: Search, found: SearchState, split: Split, base: Fitted) -> tuple[Search, SearchState]:
    """The search's end, or that of one begun at the result of short shooting intervals, if that fits better.

    Errors do not grow in short intervals, so the cost is close to quadratic there.
    """
    data, settings, notify = search.data, search.settings, search.notify
    short = Search(replace(data, segments=split.short_segments), search.pool, settings, notify)
    try:
        near_end = short.run(base)
    except SimulationDiverged:  # so short intervals are of no use
        return search, found
    best = near_end.best
    if not best.hypothesis or best.labels == found.best.labels:
        return search, found
    other = Search(data, search.pool, settings, notify, near_end.tried.fitted)
    begin = (best.fit.theta, [s.start for s in data.segments])
    try:
        start = data.converge(data.coarse_fit(best.hypothesis, [begin], white_noise(best.fit.residuals), LONG))
    except SimulationDiverged:  # so it cannot be what happened
        return search, found
    end = other.go_on(other.beginning(found.base, start))
    best_search, best_end = (other, end) if other.score(end.best) < search.score(found.best) else (search, found)
    whole = replace(best_end.tried, fitted=(*found.tried.fitted, *end.tried.fitted))
    return best_search, replace(best_end, tried=whole)
