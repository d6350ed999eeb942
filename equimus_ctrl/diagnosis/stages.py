"""A diagnosis, stage by stage: each takes what is known, a ``State``, and returns what is known after it.

    refit → search → groups → initial_states → confirmation → unexplained → discretization → hidden_starts → validation
    → other_holdout → alternatives → units → report

``carried_out`` runs them in this order; ``STAGES`` has those between the refit and the report, which is made in
``diagnosis.reporting``. ``other_holdout`` is a second diagnosis, with other trials held out, by the stages before it.
Up to it, stages may change what is found; those after it only add to that (``Stage.settles``). Where a budget ends a
stage, what was known before it is reported; where it ends the search, held-out trials still judge what the search had
come to.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial

import numpy as np

from equimus_ctrl.diagnosis.alternatives import listed, with_all_fitted
from equimus_ctrl.diagnosis.budget import BudgetSpent
from equimus_ctrl.diagnosis.confirmation import Confirmation, best_as_fitted, confirmed, confirmed_as_fitted
from equimus_ctrl.diagnosis.discretization import step_counted, without_step_error
from equimus_ctrl.diagnosis.findings import equivalents, named_candidate, named_part, ranking
from equimus_ctrl.diagnosis.fitting import Data, Fitted
from equimus_ctrl.diagnosis.holdout import Split
from equimus_ctrl.diagnosis.holdout_residuals import HoldoutResiduals
from equimus_ctrl.diagnosis.hypothesis import Candidate, Part
from equimus_ctrl.diagnosis.initial_states import NAME as INITIAL_STATES
from equimus_ctrl.diagnosis.initial_states import free_initial_states
from equimus_ctrl.diagnosis.refit import nominal_residuals, refit
from equimus_ctrl.diagnosis.residuals import ResidualAboveNoise, Unexplained
from equimus_ctrl.diagnosis.results import CONFIRMATION, Equivalent
from equimus_ctrl.diagnosis.search_stage import find_effects
from equimus_ctrl.diagnosis.search_state import SearchState
from equimus_ctrl.diagnosis.smooth_laws import analysed, analysed_without, without_redundant
from equimus_ctrl.diagnosis.state import DiagnosisInputs, State
from equimus_ctrl.diagnosis.thresholds import Thresholds
from equimus_ctrl.diagnosis.unexplained import not_confirmed
from equimus_ctrl.diagnosis.unit_stages import compare_units, still_apart, tell_apart
from equimus_ctrl.errors import SimulationDiverged
from equimus_ctrl.types import Array

OTHER_SHARE = (0.88, 0.94)
"""Share of the whole that is done when a diagnosis with other trials held out begins, and when it ends."""


@dataclass(frozen=True)
class Stage:
    """A stage of a diagnosis.

    Attributes:
        name: in decisions and in what is told of stages not done.
        run: what is known before it → what is known after it. Raises BudgetSpent where its budget ends.
        decides: in words.
        label: that progress gives it; "" where it tells by itself, or not at all.
        share: of the whole that is done when it begins.
        settles: whether the verdict, or a finding's name, sizes or intervals, or an unexplained residual may change in
            it: the verdict is ``unfinished`` without it.
    """

    name: str
    run: Callable[[State], State]
    decides: str
    label: str = ""
    share: float = 0.0
    settles: bool = True

    def after(self, state: State) -> State:
        """What is known after it; what was known before it where the budget ends, or ended earlier."""
        if state.ended_in:
            return state
        if self.label:
            state.inputs.progress(self.label, self.share, state.end.best.label)
        try:
            return self.run(state)
        except BudgetSpent:
            return state.ended(self.name)


def carried_out(inputs: DiagnosisInputs) -> State:
    """What is known after all stages.

    Raises:
        BudgetSpent: where the budget ends before the model is refitted.
        SimulationDiverged: where the model diverges on every trial.
    """
    state = _through(inputs, ORDER)
    unconfirmed = state.ended_in and STAGES.index(state.ended_in) <= STAGES.index(CONFIRMATION)
    return confirm_as_fitted(state.without_budget()) if unconfirmed else state


def _through(inputs: DiagnosisInputs, order: Sequence[Stage], whole: bool = False) -> State:
    """What is known after the refit and some stages.

    Args:
        inputs: what is asked.
        order: the stages.
        whole: whether the answer is of no use where one of them is cut short, so that none follows.
    """
    state = refit(inputs)
    for stage in order:
        state = stage.after(state)
        if whole and state.cut_short:
            break
    return state


def confirm(state: State) -> State:
    """The effects that held-out trials confirm; where they reject one, another that they do confirm."""
    said: dict[str, Confirmation] = {}
    end = confirmed(state.search, state.end, state.inputs.split, said.__setitem__)
    against = _against(said, end)
    search, end = still_apart(state.search, end, state.inputs.split)
    return _said(state, replace(state, search=search, end=end), said, against)


def confirm_as_fitted(state: State) -> State:
    """The effects that held-out trials confirm, without any further fit."""
    said: dict[str, Confirmation] = {}
    begun = best_as_fitted(state.search, state.end)
    for label in sorted(state.end.best.labels - begun.best.labels):
        state = state.decided(CONFIRMATION, f"{label} not judged", "the fits without each part were not made in time")
    state = replace(state, end=begun)
    end = confirmed_as_fitted(state.search, state.end, state.inputs.split, said.__setitem__)
    return _said(state, replace(state, end=end), said, _against(said, end))


def _against(said: Mapping[str, Confirmation], end: SearchState) -> dict[str, str]:
    """What held-out trials say of the effects that they rejected, by their labels."""
    return {label: str(confirmation) for label, confirmation in said.items() if label not in end.best.labels}


def _said(state: State, after: State, said: Mapping[str, Confirmation], against: Mapping[str, str]) -> State:
    """With a decision for each effect that held-out trials confirm or reject, or that is accepted in another's place.

    Args:
        state: before.
        after: with what they leave.
        said: by them of each effect, by its label.
        against: of those that they rejected.
    """
    before, end = state.end.best.labels, after.end
    after = _rejections(state, after, CONFIRMATION, against, "not needed beside the others")
    for label in sorted(end.best.labels - before):
        reason = f"in the place of what was rejected: {said[label]}" if label in said else "fits in its place"
        after = after.decided(CONFIRMATION, f"{label} accepted", reason)
    for label in sorted((end.best.labels & before) & said.keys()):
        after = after.decided(CONFIRMATION, f"{label} confirmed", str(said[label]))
    return after


def _rejections(
    state: State,
    after: State,
    stage: str,
    said: Mapping[str, str],
    otherwise: str,
    dropped: Mapping[Part, str] | None = None,
) -> State:
    """With each effect that a stage rejected, of the hypothesis before it or of one on the way.

    A law that stays at some of its places is not among them, but what was dropped of it; nor is a richer law that
    held-out trials do not tell from the one named.

    Args:
        state: before the stage.
        after: it.
        stage: its name.
        said: reasons, by the labels of effects.
        otherwise: the reason where there is none.
        dropped: parts, or what of them was, with the reason.
    """
    before, end, gone = state.end.best, after.end, dropped or {}
    fits = (*end.tried.fitted, before)
    named = {candidate.label: named_candidate(candidate) for candidate in after.search.pool}
    named |= {part.candidate.label: named_part(part) for own in fits for part in own.hypothesis}
    named |= {part.candidate.label: named_part(part) for part in gone}
    reasons = {**said, **{part.candidate.label: reason for part, reason in gone.items()}}
    undecided = {own.rich.candidate.label for own in end.undecided}
    left = {c.label for c in before.candidates if not any(_narrowed_to(c, other) for other in end.best.candidates)}
    for label in sorted((left | reasons.keys()) - end.best.labels):
        why = reasons.get(label, otherwise)
        if label in undecided:
            after = after.decided(stage, f"{label} undecided", why)
        elif label in named:
            after = after.rejecting(stage, named[label], label, why)
        else:  # of a hypothesis on the way that values of groups have replaced
            after = after.decided(stage, f"{label} rejected", why)
    return after


def _narrowed_to(candidate: Candidate, other: Candidate) -> bool:
    """Whether another is a law with a size of its own at each of its places at some of these alone."""
    same = other.effect is candidate.effect and (other.each or len(other.locations) == 1)
    return candidate.each and same and set(other.locations) < set(candidate.locations)


def explain_residuals(state: State) -> State:
    """What the effects leave, and which of them residual forces make redundant: these are rejected.

    Where others stay, the search goes on beside them. It never comes back to what was rejected, a law at a joint
    (``SearchHistory.allows``), so none is both rejected here and part of the end. What was left beside effects
    stays unexplained where without them nothing is: something is missing there, whatever it is.
    """
    search, end, split = state.search, state.end, state.inputs.split
    rejected, against = dict[Part, str](), dict[str, str]()
    further = search.settings.again
    analysis = analysed(search, end, split)
    while analysis.redundant:
        end, dropped = without_redundant(search, end, analysis)
        rejected |= dropped
        if end.best.hypothesis:
            said: dict[str, Confirmation] = {}
            end = confirmed(search, search.go_on(end, further=further > 0), split, said.__setitem__)
            against |= _against(said, end)
            search, end = still_apart(search, end, split)
            further -= 1
        analysis = analysed_without(search, end, split, analysis)
    after = replace(state, search=search, end=end, analysis=analysis, ranking=state.ranking or ranking(search, end))
    after = _rejections(state, after, "unexplained", against, "not needed beside the rest", rejected)
    return _explained(after, state.end.best)


def _explained(state: State, before: Fitted) -> State:
    """With a decision for each effect that was accepted beside residual forces, and for each of these.

    Args:
        state: after it.
        before: the hypothesis before it.
    """
    for candidate in sorted(state.end.best.candidates, key=lambda c: c.label):
        if candidate.label not in before.labels and not any(_narrowed_to(c, candidate) for c in before.candidates):
            reason = "its gain exceeds the threshold beside the others"
            state = state.decided("unexplained", f"{candidate.label} accepted", reason)
    for residual in state.analysis.unexplained:
        over = f" over {residual.depends_on}" if residual.depends_on else ""
        reason = f"{_size(residual):.4g}, at least {residual.threshold:.4g}"
        state = state.decided("unexplained", f"unexplained at {residual.location}{over}", reason)
    return state


def _size(residual: Unexplained) -> float:
    """What is compared with the threshold."""
    return residual.excess if isinstance(residual, ResidualAboveNoise) else residual.gain


def take_off_step_error(state: State) -> State:
    """The same without the discretisation error, where that changes findings or unexplained residuals.

    Where it does not, intervals count it.
    """
    exact = without_step_error(state.search, state.end, state.analysis, state.inputs.split)
    if exact is None:
        return replace(state, end=step_counted(state.data, state.end))
    after = replace(
        state,
        search=exact.search,
        end=exact.end,
        nominal=nominal_residuals(state.inputs, exact.search.data),
        analysis=exact.analysis,
        coarse=exact.sentence,
    )
    otherwise = "without the error of the physics step it gains too little"
    after = _rejections(state, after, "discretization", {}, otherwise, exact.rejected)
    return after.decided("discretization", "worked out without the discretisation error", exact.sentence)


def lead_by_fit(state: State) -> State:
    """The end's parameters where the motion that each fit predicts leads to what no sensor shows at starts.

    What is fitted from here on is what the end was fitted to. Alternatives are compared as they were before.
    """
    end = state.end
    data, best = state.data.led_by_fit(end.best)
    if best is end.best:
        return state
    led = {end.best: best}
    for fitted in end.without:
        if fitted not in led:
            led[fitted] = state.data.led_by_fit(fitted)[1]
    new = [fitted for fitted, own in led.items() if own is not fitted and fitted in (end.best, end.base)]
    told = {fitted: led[fitted] if state.coarse else _step_counted(data, led[fitted]) for fitted in new}
    without = tuple(led[fitted] for fitted in end.without)
    after = replace(end, best=told[end.best], base=told.get(end.base, end.base), without=without)
    search = replace(state.search, data=data)
    state = replace(state, search=search, end=after, compared=(state.search, end))
    reason = f"−2 log likelihood falls by {end.best.deviance - best.deviance:.4g}"
    return state.decided("hidden_starts", "what no sensor shows at starts follows from the fitted motion", reason)


def _step_counted(data: Data, fitted: Fitted) -> Fitted:
    """A fit with intervals in which the error of the engine's step is counted."""
    return step_counted(data, SearchState(fitted, fitted)).best


def validate(state: State) -> State:
    """Joints whose residuals on held-out trials are far above the noise, whatever the parameters of the effects.

    A fit that is far worse there than on the fitted trials failed, see ``Thresholds.failed``.
    """
    split, best = state.inputs.split, state.end.best
    residuals = HoldoutResiduals(state.data, split, state.end).residuals(best.fit.model)
    if best.hypothesis and (failed := _failed(state, residuals)):
        state = replace(state, failed=failed).decided("validation", "the fit failed", failed)
    if state.analysis.unexplained:
        return state
    analysis = not_confirmed(state.data, best, split.validation, residuals)
    return decided_above_noise(replace(state, analysis=analysis), "validation", "held-out error")


def _failed(state: State, residuals: Sequence[Array]) -> str:
    """Why a fit says nothing of validation trials; "" where it does."""
    best = state.end.best
    for j, joint in enumerate(state.inputs.data.free.model.robot.joint_names):
        fitted = max(float(best.fit.rmse[j]), best.noise[j].sigma)
        there = float(np.sqrt(np.mean(np.concatenate(residuals)[:, j] ** 2))) if residuals else 0.0
        if state.data.thresholds.decides(partial(_far_worse, there / fitted)):
            return f"its error on validation trials is {there / fitted:.3g} times that on the fitted ones, at {joint}"
    return ""


def _far_worse(times: float, t: Thresholds) -> bool:
    return times > t.failed


def decided_above_noise(state: State, stage: str, error: str) -> State:
    """With a decision for each joint whose residuals are far above the noise."""
    for residual in state.analysis.unexplained:
        reason = f"{error} {_size(residual):.3g} times the noise's variance"
        state = state.decided(stage, f"unexplained at {residual.location}", reason)
    return state


def repeat_with_other_holdout(state: State) -> State:
    """A second diagnosis, with other trials held out, where those held out show what the others do not.

    What they alone show cannot be explained while they are not fitted. The second counts if it leaves nothing
    unexplained, by its own validation trials; the test set, which is the same, has no say. Not where somebody said
    which trials are held out.

    Raises:
        BudgetSpent: where the budget ends before the second diagnosis has come as far as the first.
    """
    inputs, residuals = state.inputs, state.analysis.unexplained
    alone = [r for r in residuals if isinstance(r, ResidualAboveNoise) and r.only_on == "validation"]
    other = _other_inputs(inputs) if alone else None
    if other is None:
        return state
    if state.cut_short:
        raise BudgetSpent
    names = _names(inputs.split), _names(other.split)
    rejected = f"held out instead: {names[1]}; rejected"
    try:
        second = _through(other, ORDER[: STAGES.index(OTHER_HOLDOUT)], whole=True)
    except SimulationDiverged:
        return state.decided(OTHER_HOLDOUT, rejected, "the diagnosis without them could not be carried out")
    if second.cut_short:
        raise BudgetSpent
    told = (*state.decisions, *(replace(decision, other_holdout=True) for decision in second.decisions))
    if second.analysis.unexplained or second.failed:
        reason = second.failed or "that diagnosis leaves residuals unexplained"
        return replace(state, decisions=told).decided(OTHER_HOLDOUT, rejected, reason)
    note = (
        f"{names[0]}, held out at first, showed what the other trials do not; so they were fitted, and {names[1]} "
        "judged."
    )
    own = replace(second.inputs, progress=inputs.progress)
    second = replace(second, inputs=own, decisions=told, notes=(*second.notes, note))
    reason = f"held out, {names[0]} showed what the other trials do not"
    return second.decided(OTHER_HOLDOUT, f"held out instead: {names[1]}", reason)


def _other_inputs(inputs: DiagnosisInputs) -> DiagnosisInputs | None:
    """The same with other trials held out, where nobody said which; None where somebody did."""
    other = inputs.split.other
    if other is None:
        return None
    low, high = OTHER_SHARE

    def notify(stage: str, share: float, best: str) -> None:
        inputs.progress(f"{stage}, other trials held out", low + (high - low) * share, best)

    return replace(inputs, data=replace(inputs.data, segments=other.train), split=other, progress=notify)


def _names(split: Split) -> str:
    """The trials for validation."""
    return ", ".join({s.recording: s.recording_name for s in split.validation}.values())


def find_alternatives(state: State) -> State:
    """What fits as well in each effect's place.

    What fits better there is told and takes no effect's place: no held-out trial has judged it. Fits are compared in
    which the measured motion leads to what no sensor shows at starts, of the end as of the others.
    """
    search, end = state.compared or (state.search, state.end)
    end = with_all_fitted(search, listed(search, end))
    finely = cache(search.data.converge_finely)
    found = equivalents(search, end, bool(state.analysis.unexplained), finely)
    listed_end = replace(state.end, alternatives=end.alternatives, tried=end.tried)
    known = tuple(tuple(o for o in others if not o.better) for others in found)
    state = replace(state, end=listed_end, equivalent=known)
    for part, others in zip(end.best.hypothesis, found, strict=True):
        for other in (o for o in others if o.better):
            state = _told_better(state, part, other)
    return state


def _told_better(state: State, part: Part, other: Equivalent) -> State:
    """With a note on what fits better than a part in its place, with no more that its parameters change."""
    reason = f"−2 log likelihood is lower by {other.better:.4g} more than what is not distinguishable"
    note = f"{other.named} in the place of {named_part(part)} fits better: {reason}."
    state = replace(state, notes=(*state.notes, note))
    return state.decided("alternatives", f"{other.named} fits better than {part.candidate.label}", reason)


OTHER_HOLDOUT = "other_holdout"
ORDER = (
    Stage("search", find_effects, "more effects"),
    Stage("groups", tell_apart, "what differs between groups of trials"),
    Stage(INITIAL_STATES, free_initial_states, "what effects with a memory begin with"),
    Stage(CONFIRMATION, confirm, "what held-out trials confirm in place of others", "held-out trials", 0.82),
    Stage("unexplained", explain_residuals, "what remains unexplained", "residual forces", 0.86),
    Stage("discretization", take_off_step_error, "the error of the physics step"),
    Stage("hidden_starts", lead_by_fit, "what the fitted motion leads to at starts of intervals"),
    Stage("validation", validate, "whether the error on held-out trials is above the noise"),
    Stage(OTHER_HOLDOUT, repeat_with_other_holdout, "what other held-out trials would show"),
    Stage("alternatives", find_alternatives, "what fits as well in an effect's place", "evidence", 0.94, settles=False),
    Stage("units", compare_units, "whether parameters differ from the nominal ones", settles=False),
)
STAGES = tuple(stage.name for stage in ORDER)
"""What follows the refit, in order."""


def skipped(state: State) -> tuple[Stage, ...]:
    """Stages that were not carried out to their end."""
    after = STAGES.index(state.ended_in) if state.ended_in else len(ORDER)
    return tuple(stage for k, stage in enumerate(ORDER) if k >= after or stage.name in state.cut_short)


def settled(state: State) -> bool:
    """Whether all stages were carried out that the verdict depends on."""
    return not any(stage.settles for stage in skipped(state))
