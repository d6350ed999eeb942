"""A diagnosis, stage by stage: each takes what is known, a ``State``, and returns what is known after it.

    refit → search → groups → confirmation → unexplained → discretization → validation → other_holdout → alternatives
    → units → hidden_starts → report

``carried_out`` runs them in this order; ``STAGES`` has those between the refit and the report. ``other_holdout`` is a
second diagnosis, with other trials held out, by the same stages. Where a budget ends a stage, what was known before it
is reported; where it ends the search, held-out trials still judge what the search had come to.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial

import numpy as np

from equimus_ctrl.diagnosis.alternatives import listed
from equimus_ctrl.diagnosis.budget import Budget, BudgetSpent
from equimus_ctrl.diagnosis.confirmation import Confirmation, HoldoutResiduals, confirmed, confirmed_as_fitted
from equimus_ctrl.diagnosis.discretization import step_counted, without_step_error
from equimus_ctrl.diagnosis.experiment import separating
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
from equimus_ctrl.diagnosis.fitting import Fitted
from equimus_ctrl.diagnosis.holdout import Split
from equimus_ctrl.diagnosis.hypothesis import Part
from equimus_ctrl.diagnosis.localization import excess_variances, localise
from equimus_ctrl.diagnosis.noise_size import noise_sizes
from equimus_ctrl.diagnosis.policy import Thresholds
from equimus_ctrl.diagnosis.refit import nominal_residuals, refit, searched_from_short
from equimus_ctrl.diagnosis.residuals import ResidualAboveNoise, Residuals, Unexplained
from equimus_ctrl.diagnosis.results import STATES, Diagnosis, Equivalent
from equimus_ctrl.diagnosis.smooth_laws import analysed, analysed_without, without_redundant
from equimus_ctrl.diagnosis.state import DiagnosisInputs, State
from equimus_ctrl.diagnosis.unexplained import not_confirmed, not_on_test
from equimus_ctrl.diagnosis.unit_stages import compare_units, still_apart, tell_apart
from equimus_ctrl.errors import SimulationDiverged
from equimus_ctrl.identification.residuals import residuals_of
from equimus_ctrl.identification.segments import groups_of
from equimus_ctrl.types import Array

OTHER_SHARE = (0.94, 0.99)
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
        settles: whether findings and unexplained residuals depend on it.
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
    state = refit(inputs)
    for stage in ORDER:
        state = stage.after(state)
    unconfirmed = state.ended_in and STAGES.index(state.ended_in) <= STAGES.index(CONFIRMATION)
    return confirm_as_fitted(state) if unconfirmed else state


def find_effects(state: State) -> State:
    """The hypothesis that fits best, of those whose gain exceeds the threshold.

    A search begins with what measured torques ask for, where they say anything. Where residuals are large, a second
    search begins at the fit to short shooting intervals. Where the budget ends, what the search had come to is kept.
    """
    search, end = state.search, state.end
    try:
        end = search.begun_in_torques(end)
        for now in search.steps(end):
            end = now
        if state.short is not None and state.data.far_above_noise(end.best):
            search, end = searched_from_short(search, end, state.inputs.split, state.short)
    except BudgetSpent:
        return _accepted(replace(state, end=end)).ended("search")
    return _accepted(replace(state, search=search, end=end))


def _accepted(state: State) -> State:
    """With a decision for each part of the hypothesis."""
    best = state.end.best
    for part, without in zip(best.hypothesis, state.end.without, strict=True):
        gain, least = without.deviance - best.deviance, state.search.threshold(part.candidate.n_parameters)
        reason = f"−2Δln L {gain:.4g}, at least {least:.4g}"
        state = state.decided("search", f"{part.candidate.label} accepted", reason)
    if not best.hypothesis:
        reason = "no gain exceeds the threshold and the scatter of deviances"
        return state.decided("search", "no effect accepted", reason)
    if state.end.stopped is not None:
        state = state.decided("search", "no further effect", state.end.stopped)
    return state


def confirm(state: State) -> State:
    """The effects that held-out trials confirm; where they reject one, another that they do confirm."""
    said: dict[str, Confirmation] = {}
    end = confirmed(state.search, state.end, state.inputs.split, said.__setitem__)
    search, end = still_apart(state.search, end, state.inputs.split)
    return _said(state, replace(state, search=search, end=end), said)


def confirm_as_fitted(state: State) -> State:
    """The effects that held-out trials confirm, without any further fit."""
    said: dict[str, Confirmation] = {}
    end = confirmed_as_fitted(state.search, state.end, state.inputs.split, said.__setitem__)
    return _said(state, replace(state, end=end), said)


def _said(state: State, after: State, said: Mapping[str, Confirmation]) -> State:
    """With a decision for each effect that held-out trials confirm or reject, or that is accepted in another's place.

    Args:
        state: before.
        after: with what they leave.
        said: by them of each effect, by its label.
    """
    before, end = state.end.best.labels, after.end
    for label in sorted(before - end.best.labels):
        after = after.decided(CONFIRMATION, f"{label} rejected", str(said.get(label, "not needed beside the others")))
    for label in sorted(end.best.labels - before):
        reason = f"fits in its place, and {said[label]}" if label in said else "fits in its place"
        after = after.decided(CONFIRMATION, f"{label} accepted", reason)
    for label in sorted((end.best.labels & before) & said.keys()):
        after = after.decided(CONFIRMATION, f"{label} confirmed", str(said[label]))
    return after


def explain_residuals(state: State) -> State:
    """What the effects leave, and which of them residual forces make redundant: these are rejected.

    Where others stay, the search goes on beside them. It never comes back to what was rejected, a law at a joint
    (``SearchHistory.allows``), so none is both rejected here and part of the end. What was left beside effects
    stays unexplained where without them nothing is: something is missing there, whatever it is.
    """
    search, end, rejected = state.search, state.end, state.rejected
    reasons: dict[str, str] = {}
    further = search.settings.again
    analysis = analysed(search, end, state.inputs.split)
    while analysis.redundant:
        end, dropped = without_redundant(search, end, analysis)
        rejected += tuple(named_part(part) for part in dropped)
        reasons |= {part.candidate.label: reason for part, reason in dropped.items()}
        if end.best.hypothesis:
            end = confirmed(search, search.go_on(end, further=further > 0), state.inputs.split)
            search, end = still_apart(search, end, state.inputs.split)
            further -= 1
        analysis = analysed_without(search, end, state.inputs.split, analysis)
    after = replace(
        state,
        search=search,
        end=end,
        analysis=analysis,
        rejected=rejected,
        ranking=state.ranking or ranking(search, end),
    )
    return _explained(after, state.end.best, reasons)


def _explained(state: State, before: Fitted, reasons: Mapping[str, str]) -> State:
    """With a decision for each effect that was rejected or accepted beside residual forces, and for each of these.

    Args:
        state: after it.
        before: the hypothesis before it.
        reasons: why effects were rejected, by their labels.
    """
    after = state.end.best.labels
    for label in sorted((before.labels | reasons.keys()) - after):
        state = state.decided("unexplained", f"{label} rejected", reasons.get(label, "not needed beside the rest"))
    for label in sorted(after - before.labels):
        reason = "its gain exceeds the threshold beside the others"
        state = state.decided("unexplained", f"{label} accepted", reason)
    for residual in state.analysis.unexplained:
        over = f" over {residual.depends_on}" if residual.depends_on else ""
        reason = f"{_size(residual):.4g}, at least {residual.threshold:.4g}"
        state = state.decided("unexplained", f"unexplained at {residual.location}{over}", reason)
    return state


def _size(residual: Unexplained) -> float:
    """What is compared with the threshold."""
    return residual.excess if isinstance(residual, ResidualAboveNoise) else residual.gain


def take_off_step_error(state: State) -> State:
    """The same without the discretisation error, where that changes findings or unexplained residuals."""
    exact = without_step_error(state.search, state.end, state.analysis, state.inputs.split)
    if exact is None:
        return state
    after = replace(
        state,
        search=exact.search,
        end=exact.end,
        nominal=nominal_residuals(state.inputs, exact.search.data),
        analysis=exact.analysis,
        rejected=(*state.rejected, *map(named_part, exact.rejected)),
        coarse=exact.sentence,
    )
    for part, reason in exact.rejected.items():
        after = after.decided("discretization", f"{part.candidate.label} rejected", reason)
    return after.decided("discretization", "worked out without the step's error", exact.sentence)


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
    return _far_above_noise(replace(state, analysis=analysis), "validation", "held-out error")


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


def _far_above_noise(state: State, stage: str, error: str) -> State:
    """With a decision for each joint whose residuals are far above the noise."""
    for residual in state.analysis.unexplained:
        reason = f"{error} {_size(residual):.3g} times the noise's variance"
        state = state.decided(stage, f"unexplained at {residual.location}", reason)
    return state


def repeat_with_other_holdout(state: State) -> State:
    """A second diagnosis, with other trials held out, where those held out show what the others do not.

    What they alone show cannot be explained while they are not fitted. The second counts if it leaves nothing
    unexplained, neither on its validation trials nor on the test set, which is the same. Not where somebody said which
    trials are held out.
    """
    inputs, residuals = state.inputs, state.analysis.unexplained
    alone = [r for r in residuals if isinstance(r, ResidualAboveNoise) and r.only_on == "validation"]
    other = _other_inputs(inputs) if alone else None
    if other is None:
        return state
    names = _names(inputs.split), _names(other.split)
    rejected = f"held out instead: {names[1]}; rejected"
    try:
        second = tested(carried_out(other))
    except (SimulationDiverged, BudgetSpent):
        return state.decided("other_holdout", rejected, "the diagnosis without them could not be carried out")
    if second.analysis.unexplained or second.ended_in:
        return state.decided("other_holdout", rejected, "that diagnosis leaves residuals unexplained, or was ended")
    note = (
        f"{names[0]}, held out at first, showed what the other trials do not; so they were fitted, and {names[1]} "
        "judged."
    )
    second = replace(second, inputs=replace(other, progress=inputs.progress), notes=(*second.notes, note))
    reason = f"held out, {names[0]} showed what the other trials do not"
    return second.decided("other_holdout", f"held out instead: {names[1]}", reason)


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
    """What fits as well in each effect's place; intervals in which the error of the engine's step is counted.

    What fits better there is told and takes no effect's place: no held-out trial has judged it.
    """
    if state.equivalent is not None:  # the diagnosis with other trials held out has looked
        return state
    end = listed(state.search, state.end)
    if not state.coarse:
        end = step_counted(state.data, end)
    finely = cache(state.data.converge_finely)
    found = equivalents(state.search, end, bool(state.analysis.unexplained), finely)
    state = replace(state, end=end, equivalent=tuple(tuple(o for o in others if not o.better) for others in found))
    for part, others in zip(end.best.hypothesis, found, strict=True):
        for other in (o for o in others if o.better):
            state = _told_better(state, part, other)
    return state


def lead_by_fit(state: State) -> State:
    """The end's parameters where the motion that each fit predicts leads to what no sensor shows at starts."""
    data, end = state.data, state.end
    best = data.led_by_fit(end.best)
    if best is end.best:
        return state
    without = tuple(best if fitted is end.best else data.led_by_fit(fitted) for fitted in end.without)
    base = best if end.base is end.best else end.base
    reason = f"−2 log likelihood falls by {end.best.deviance - best.deviance:.4g}"
    state = replace(state, end=replace(end, best=best, base=base, without=without))
    return state.decided("hidden_starts", "what no sensor shows at starts follows from the fitted motion", reason)


def _told_better(state: State, part: Part, other: Equivalent) -> State:
    """With a note on what fits better than a part in its place, with no more that its parameters change."""
    reason = f"−2 log likelihood is lower by {other.better:.4g} more than what is not distinguishable"
    note = f"{other.named} in the place of {named_part(part)} fits better: {reason}."
    state = replace(state, notes=(*state.notes, note))
    return state.decided("alternatives", f"{other.named} fits better than {part.candidate.label}", reason)


CONFIRMATION = "confirmation"
ORDER = (
    Stage("search", find_effects, "more effects"),
    Stage("groups", tell_apart, "what differs between groups of trials"),
    Stage(CONFIRMATION, confirm, "what held-out trials confirm in place of others", "held-out trials", 0.82),
    Stage("unexplained", explain_residuals, "what remains unexplained", "residual forces", 0.86),
    Stage("discretization", take_off_step_error, "the error of the physics step"),
    Stage("validation", validate, "whether the error on held-out trials is above the noise"),
    Stage("other_holdout", repeat_with_other_holdout, "what other held-out trials would show", settles=False),
    Stage("alternatives", find_alternatives, "what fits as well in an effect's place", "evidence", 0.94, settles=False),
    Stage("units", compare_units, "whether parameters differ from the nominal ones", settles=False),
    Stage("hidden_starts", lead_by_fit, "what the fitted motion leads to at starts of intervals", settles=False),
)
STAGES = tuple(stage.name for stage in ORDER)
"""What follows the refit, in order."""


def skipped(state: State) -> tuple[Stage, ...]:
    """Stages that were not carried out to their end."""
    return ORDER[STAGES.index(state.ended_in) :] if state.ended_in else ()


def tested(state: State) -> State:
    """Joints whose residuals on the test set alone are far above the noise: told, and nothing is chosen by it."""
    if state.analysis.unexplained or state.ended_in:
        return state
    test, best = state.inputs.split.test, state.end.best
    residuals = residuals_of(best.fit.model, test, state.data.simulator)
    analysis = not_on_test(state.data, best, test, residuals)
    return _far_above_noise(replace(state, analysis=analysis), "report", "error on the test set")


def report(state: State) -> Diagnosis:
    """The findings with evidence and intervals, and the rest of the report, which no budget ends."""
    state = tested(replace(state, search=replace(state.search, data=replace(state.data, budget=Budget()))))
    inputs, search, end, unexplained = state.inputs, state.search, state.end, state.analysis.unexplained
    data, split, model = state.data, inputs.split, inputs.nominal
    sigma = noise_sizes(data.segments, end.best, data.thresholds)[: len(end.best.fit.rmse)]
    holdout, equivalent = HoldoutResiduals(data, split, end), state.equivalent or ()
    told = findings(search, end, holdout, equivalent)
    if state.failed:
        told = tuple(replace(finding, undetermined=state.failed) for finding in told)
    named, undetermined = ([f for f in told if bool(f.undetermined) is side] for side in (False, True))
    for finding in undetermined:
        state = state.decided("report", f"{finding.named} not named", finding.undetermined)
    residuals = _residuals(state, holdout)
    inputs.progress("done", 1.0, end.best.label)
    return Diagnosis(
        verdict=verdict(named, bool(unexplained or undetermined), not any(stage.settles for stage in skipped(state))),
        model=model,
        refitted=end.base.fit.model,
        corrected=end.best.fit.model,
        base=end.base,
        best=end.best,
        train=split.train,
        validation=split.validation,
        test=split.test,
        residuals=residuals,
        sigma=sigma,
        where=localise(model, split.train, end.base.fit.residuals, sigma),
        findings=tuple(named),
        undetermined=tuple(undetermined),
        unexplained=unexplained,
        rejected=state.rejected,
        ranking=state.ranking or ranking(search, end),
        detectable=() if told or unexplained or state.ended_in else detectable(search, end),
        experiment=None if state.ended_in else separating(data, end, named, equivalent, inputs.designs),
        excess_variance={name: float(excess_variances(residuals[name].train, sigma).mean()) for name in STATES},
        notes=(
            *notes(end, split, inputs.settings.exclude, [stage.decides for stage in skipped(state)]),
            *beyond_range(model, split),
            *([state.coarse] if state.coarse else []),
            *state.notes,
        ),
        seconds=time.perf_counter() - inputs.begun,
        decisions=state.decisions,
        not_done=tuple(stage.name for stage in skipped(state)),
        groups=groups_of((*split.train, *split.validation)),
        differences=state.differences,
        another_unit=state.another_unit,
    )


def _residuals(state: State, holdout: HoldoutResiduals) -> dict[str, Residuals]:
    """Of each of ``STATES`` on the trials fitted, on those for validation and on those of the test set."""
    end, test, simulator = state.end, state.inputs.split.test, state.data.simulator
    nj = len(state.inputs.data.free.model.robot.joint_names)
    models = state.inputs.nominal, end.base.fit.model, end.best.fit.model

    def of_joints(residuals: Iterable[Array]) -> tuple[Array, ...]:
        return tuple(r[:, :nj] for r in residuals)

    fitted = state.nominal, end.base.fit.residuals, end.best.fit.residuals
    return {
        name: Residuals(*map(of_joints, (train, holdout.residuals(model), residuals_of(model, test, simulator))))
        for name, model, train in zip(STATES, models, fitted, strict=True)
    }
